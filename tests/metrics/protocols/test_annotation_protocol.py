"""The annotation protocol: labels n and n' compared with the lexicon; well-, under- and over-merged masks, by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scored_room import NAMES, instances, room, truth_as_prediction

from su3d_bench.core.files.atomic import write_bytes
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.instance.score import CoveredObjects
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.score import (
    REFINED_BY,
    AnnotationTruth,
    RefinedNames,
    judge_merging,
    labels_n,
    remarks_starting,
)
from su3d_bench.metrics.scoring import metric_of, score_scene
from su3d_bench.questions.ground_truths import Refine, question_truth
from su3d_bench.questions.refining import (
    FILE_NAME,
    FilterConfig,
    RefinedName,
    TopNames,
    records_of,
    refined_digest,
    refined_names,
    voted_names,
    write_records,
)
from su3d_bench.store.run_folder import JobFolder

RULES = load_protocol("rooms-annotation")
TRUTH = room()


def truth(refine: Refine | None = None) -> AnnotationTruth:
    found = question_truth(RULES, SimpleNamespace(name="rooms"), "made", TRUTH, refine)
    assert isinstance(found, AnnotationTruth)
    return found


def values(prediction: Instances, refine: Refine | None = None) -> dict[str, float]:
    score = score_scene(RULES, truth(refine), prediction, None)
    return metric_of(RULES).combine([score.counts])


def named(names: tuple[str, ...]) -> Instances:
    """The true masks with names from perception and, in one view each, a second name with more weight."""
    whole = truth_as_prediction(TRUTH, with_labels=False)
    k = len(names)
    views = np.zeros((2 * k, 2), np.int32)
    result = tuple(name for one in names for name in (one, "couch"))
    return replace(
        whole, names=names, views=views, view_indptr=np.arange(k + 1, dtype=np.int64) * 2,
        view_names=result, view_scores=np.tile([0.9, 0.1], k),
    )  # fmt: skip


def test_ground_truth_scores_one_in_annotation() -> None:
    found = values(truth_as_prediction(TRUTH, with_labels=True))
    assert [found[key] for key in ("label n", "well-merged", "under-merged", "over-merged")] == [1, 1, 0, 0]
    assert found["n_label n"] == len(NAMES) - 1  # the wall is not judged
    assert np.isnan(found["label n'"])
    assert found["n_label n'"] == 0


def test_labels_are_compared_with_the_lexicon() -> None:
    names = ("wall", "office chair", "table", "coffee table", "floor lamp", "throw pillow", "", "rucksack")
    found = values(named(names))
    assert found["label n"] == 5 / 7  # a chair named table and a book without a name are wrong
    assert found["label n'"] == 5 / 7


def test_refined_names_are_the_given_ones() -> None:
    right = RefinedNames(NAMES, "the model m of the refiner, names of 5 views")
    prediction = named(("couch",) * len(NAMES))
    assert (values(prediction, lambda _: right)["label n"], values(prediction, lambda _: right)["label n'"]) == (0, 1)
    assert "n': the model m" in " ".join(score_scene(RULES, truth(lambda _: right), prediction, None).warnings)


def test_instances_excluded_by_n_prime_count_only_for_n() -> None:
    chair, table = np.flatnonzero(TRUTH.instance == 2), np.flatnonzero(TRUTH.instance == 4)
    both = np.concatenate([chair[:60], np.flatnonzero(TRUTH.instance == 3)])  # over-merged: two chairs
    masks = [chair[60:], both, table, np.flatnonzero(TRUTH.instance == 5)]
    prediction = instances(TRUTH.points, masks, ["chair", "chair", "chair", "lamp"])
    refined = RefinedNames(("chair", "wall", "table", "lamp"), "the model m", ("", "'wall' is background", "", ""))
    found = values(prediction, lambda _: refined)
    assert [found[name] for name in ("label n", "label n'", "n_label n", "n_label n'")] == [0.75, 1.0, 4, 3]
    assert (found["over-merged"], found["over-merged n'"]) == (0.25, 0.0)
    assert found["well-merged n'"] == found["n_well-merged n'"] / 3 == 1.0
    printed = " ".join(score_scene(RULES, truth(lambda _: refined), prediction, None).warnings)
    assert "n' excludes 1 of 4 instances: 'wall' is background" in printed


def test_part_becomes_well_merged_when_the_other_part_is_excluded() -> None:
    chair = np.flatnonzero(TRUTH.instance == 2)
    prediction = instances(TRUTH.points, [chair[:80], chair[80:]], ["chair", "chair"])
    found = values(prediction, lambda _: RefinedNames(("chair", "floor"), "the model m", ("", "'floor' is background")))
    assert (found["under-merged"], found["well-merged n'"]) == (1.0, 1.0)


def test_vote_excludes_background_instances() -> None:
    voted = voted_names(replace(named(("chair", *["wall"] * 7)), view_scores=np.tile([0.9, 0.1], 8)))
    assert voted is not None
    assert voted.is_kept.tolist() == [True, *[False] * 7]


def test_vote_uses_the_name_with_most_weight() -> None:
    prediction = replace(named(("chair",) * 8), view_scores=np.tile([0.1, 0.9], 8))
    voted = voted_names(prediction)
    assert voted is not None
    assert set(voted.names) == {"couch"}
    assert voted_names(truth_as_prediction(TRUTH, with_labels=True)) is None


def test_label_source_is_read_only_after_the_scene_name() -> None:
    result = ["a/b: n': the vote", "n': a model", "c/d: seen beside n': nobody", "e/f: n': ", "n' excludes 1 of 4"]
    assert remarks_starting(result, REFINED_BY) == ("the vote", "a model")


def test_label_of_the_method_has_priority_over_the_name() -> None:
    prediction = replace(named(("a",) * 8), labels=("b", *[""] * 7))
    assert labels_n(prediction) == ("b", *["a"] * 7)


@pytest.mark.parametrize(
    ("shared", "judged"),
    [
        ([[100, 0]], ("well-merged",)),
        ([[76, 24]], ("well-merged",)),  # 24 % from other objects, below a quarter
        ([[75, 25]], ("over-merged",)),
        ([[75, 0], [25, 0]], ("well-merged", "under-merged")),
        ([[74, 0], [26, 0]], ("under-merged", "under-merged")),
        ([[100, 0], [100, 0]], ("under-merged", "under-merged")),  # duplicates of one object were not merged
        ([[10, 90], [100, 0]], ("well-merged", "well-merged")),
        ([[0, 0]], ("well-merged",)),
    ],
)
def test_merging_is_judged_by_covered_shares(shared: list[list[int]], judged: tuple[str, ...]) -> None:
    assert RULES.merging is not None
    assert judge_merging(RULES.merging, CoveredObjects(np.array([1, 2]), np.array(shared))) == judged


def test_half_masks_and_masks_of_two_objects_are_faulty() -> None:
    chair, table = np.flatnonzero(TRUTH.instance == 2), np.flatnonzero(TRUTH.instance == 4)
    lamp, book = np.flatnonzero(TRUTH.instance == 5), np.flatnonzero(TRUTH.instance == 7)
    masks = [chair[:75], chair[75:], table, np.concatenate([lamp, book])]
    found = values(instances(TRUTH.points, masks, ["chair", "chair", "table", "lamp"]))
    assert [found[key] for key in ("well-merged", "under-merged", "over-merged")] == [0.25, 0.5, 0.25]


def test_unjudged_instances_are_reported() -> None:
    whole = truth_as_prediction(TRUTH, with_labels=True)
    masks, labels = [whole.mask(k) for k in range(len(whole))], list(whole.labels or ())
    without_wall = instances(TRUTH.points, masks[1:], labels[1:])
    result = [score_scene(RULES, truth(), one, None).warnings for one in (whole, without_wall)]
    assert [sum("not judged" in line for line in lines) for lines in result] == [1, 0]


def test_shuffled_instances_change_nothing() -> None:
    prediction = named(("wall", "office chair", "table", "coffee table", "lamp", "pillow", "", "rucksack"))
    order = np.random.default_rng(1).permutation(8)
    mixed = replace(
        instances(TRUTH.points, [prediction.mask(k) for k in order], None),
        names=tuple(prediction.names[k] for k in order),
    )
    assert values(mixed)["label n"] == values(prediction)["label n"]


def test_map_without_names_gives_a_reason() -> None:
    assert "needs names" in str(kind_incompatibility(RULES, truth_as_prediction(TRUTH, with_labels=False)))
    partition = Partition(TRUTH.points, TRUTH.instance - 1, np.ones((8, 3), np.float32))
    assert "gives a partition" in str(kind_incompatibility(RULES, partition))


def test_label_file_is_used_only_with_its_own_map(tmp_path: Path) -> None:
    job = JobFolder(tmp_path)
    prediction = named(("chair",) * 8)
    write_bytes(job.prediction, b"a map")
    assert refined_digest(job) == {}
    assert "vote" in (refined_names(job, prediction) or RefinedNames((), "")).source
    tops = [TopNames("chair", ("chair",), (1.0,))] * 8
    records = records_of(job, prediction, tops, [RefinedName("sofa", "model", "")] * 8, "model", "m", 5, FilterConfig())
    write_records(job, records)
    found = refined_names(job, prediction)
    source = "the model m of the refiner, names of 5 views"
    assert found == RefinedNames(("sofa",) * 8, source, ("",) * 8)
    assert set(refined_digest(job)) == {"refined"}
    write_bytes(job.prediction, b"another map")
    assert "vote" in (refined_names(job, prediction) or RefinedNames((), "")).source
    (tmp_path / FILE_NAME).write_text("[]")
    assert "vote" in (refined_names(job, prediction) or RefinedNames((), "")).source
