"""The annotation protocol: labels n and n' against the lexicon, masks well, under- and over-merged, by hand."""

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
    """The true masks with names of perception and, in one view each, a second name of more weight."""
    whole = truth_as_prediction(TRUTH, with_labels=False)
    k = len(names)
    views = np.zeros((2 * k, 2), np.int32)
    told = tuple(name for one in names for name in (one, "couch"))
    return replace(
        whole, names=names, views=views, view_indptr=np.arange(k + 1, dtype=np.int64) * 2,
        view_names=told, view_scores=np.tile([0.9, 0.1], k),
    )  # fmt: skip


def test_the_truth_itself_is_all_right() -> None:
    found = values(truth_as_prediction(TRUTH, with_labels=True))
    assert [found[key] for key in ("label n", "well-merged", "under-merged", "over-merged")] == [1, 1, 0, 0]
    assert found["n_label n"] == len(NAMES) - 1  # the wall is not judged
    assert np.isnan(found["label n'"])
    assert found["n_label n'"] == 0


def test_labels_go_by_the_lexicon() -> None:
    names = ("wall", "office chair", "table", "coffee table", "floor lamp", "throw pillow", "", "rucksack")
    found = values(named(names))
    assert found["label n"] == 5 / 7  # a chair called a table and a book without a name are wrong
    assert found["label n'"] == 5 / 7


def test_refined_names_are_those_that_are_handed_in() -> None:
    right = RefinedNames(NAMES, "the model m of su3d-bench runs refine, names of 5 views")
    prediction = named(("couch",) * len(NAMES))
    assert (values(prediction, lambda _: right)["label n"], values(prediction, lambda _: right)["label n'"]) == (0, 1)
    assert "n': the model m" in " ".join(score_scene(RULES, truth(lambda _: right), prediction, None).warnings)


def test_what_labels_n_prime_leave_out_counts_before_and_not_after() -> None:
    chair, table = np.flatnonzero(TRUTH.instance == 2), np.flatnonzero(TRUTH.instance == 4)
    both = np.concatenate([chair[:60], np.flatnonzero(TRUTH.instance == 3)])  # over-merged: of two chairs
    masks = [chair[60:], both, table, np.flatnonzero(TRUTH.instance == 5)]
    prediction = instances(TRUTH.points, masks, ["chair", "chair", "chair", "lamp"])
    refined = RefinedNames(("chair", "wall", "table", "lamp"), "the model m", ("", "'wall' is background", "", ""))
    found = values(prediction, lambda _: refined)
    assert [found[name] for name in ("label n", "label n'", "n_label n", "n_label n'")] == [0.75, 1.0, 4, 3]
    assert (found["over-merged"], found["over-merged n'"]) == (0.25, 0.0)
    assert found["well-merged n'"] == found["n_well-merged n'"] / 3 == 1.0
    said = " ".join(score_scene(RULES, truth(lambda _: refined), prediction, None).warnings)
    assert "n' leaves out 1 of 4 instances: 'wall' is background" in said


def test_what_covers_a_part_is_whole_once_the_rest_is_left_out() -> None:
    chair = np.flatnonzero(TRUTH.instance == 2)
    prediction = instances(TRUTH.points, [chair[:80], chair[80:]], ["chair", "chair"])
    found = values(prediction, lambda _: RefinedNames(("chair", "floor"), "the model m", ("", "'floor' is background")))
    assert (found["under-merged"], found["well-merged n'"]) == (1.0, 1.0)


def test_the_vote_leaves_out_what_is_background_under_it() -> None:
    voted = voted_names(replace(named(("chair", *["wall"] * 7)), view_scores=np.tile([0.9, 0.1], 8)))
    assert voted is not None
    assert voted.is_kept.tolist() == [True, *[False] * 7]


def test_the_vote_takes_the_name_of_most_weight() -> None:
    prediction = replace(named(("chair",) * 8), view_scores=np.tile([0.1, 0.9], 8))
    voted = voted_names(prediction)
    assert voted is not None
    assert set(voted.names) == {"couch"}
    assert voted_names(truth_as_prediction(TRUTH, with_labels=True)) is None


def test_who_named_is_what_stands_behind_the_name_of_a_scene_alone() -> None:
    told = ["a/b: n': the vote", "n': a model", "c/d: seen beside n': nobody", "e/f: n': ", "n' leaves out 1 of 4"]
    assert remarks_starting(told, REFINED_BY) == ("the vote", "a model")


def test_a_label_that_the_method_decided_goes_before_the_name() -> None:
    prediction = replace(named(("a",) * 8), labels=("b", *[""] * 7))
    assert labels_n(prediction) == ("b", *["a"] * 7)


@pytest.mark.parametrize(
    ("shared", "judged"),
    [
        ([[100, 0]], ("well-merged",)),
        ([[76, 24]], ("well-merged",)),  # 24 % of others, below a quarter
        ([[75, 25]], ("over-merged",)),
        ([[75, 0], [25, 0]], ("well-merged", "under-merged")),
        ([[74, 0], [26, 0]], ("under-merged", "under-merged")),
        ([[100, 0], [100, 0]], ("under-merged", "under-merged")),  # the same thing twice was not merged
        ([[10, 90], [100, 0]], ("well-merged", "well-merged")),
        ([[0, 0]], ("well-merged",)),
    ],
)
def test_merging_is_judged_by_shares(shared: list[list[int]], judged: tuple[str, ...]) -> None:
    assert RULES.merging is not None
    assert judge_merging(RULES.merging, CoveredObjects(np.array([1, 2]), np.array(shared))) == judged


def test_masks_of_half_and_of_two_objects_are_faulty() -> None:
    chair, table = np.flatnonzero(TRUTH.instance == 2), np.flatnonzero(TRUTH.instance == 4)
    lamp, book = np.flatnonzero(TRUTH.instance == 5), np.flatnonzero(TRUTH.instance == 7)
    masks = [chair[:75], chair[75:], table, np.concatenate([lamp, book])]
    found = values(instances(TRUTH.points, masks, ["chair", "chair", "table", "lamp"]))
    assert [found[key] for key in ("well-merged", "under-merged", "over-merged")] == [0.25, 0.5, 0.25]


def test_instances_that_stand_for_nothing_that_is_judged_are_told() -> None:
    whole = truth_as_prediction(TRUTH, with_labels=True)
    masks, labels = [whole.mask(k) for k in range(len(whole))], list(whole.labels or ())
    without_wall = instances(TRUTH.points, masks[1:], labels[1:])
    told = [score_scene(RULES, truth(), one, None).warnings for one in (whole, without_wall)]
    assert [sum("not judged" in line for line in lines) for lines in told] == [1, 0]


def test_shuffled_instances_change_nothing() -> None:
    prediction = named(("wall", "office chair", "table", "coffee table", "lamp", "pillow", "", "rucksack"))
    order = np.random.default_rng(1).permutation(8)
    mixed = replace(
        instances(TRUTH.points, [prediction.mask(k) for k in order], None),
        names=tuple(prediction.names[k] for k in order),
    )
    assert values(mixed)["label n"] == values(prediction)["label n"]


def test_a_map_without_names_is_told_why() -> None:
    assert "needs names" in str(kind_incompatibility(RULES, truth_as_prediction(TRUTH, with_labels=False)))
    partition = Partition(TRUTH.points, TRUTH.instance - 1, np.ones((8, 3), np.float32))
    assert "gives a partition" in str(kind_incompatibility(RULES, partition))


def test_labels_of_the_file_beside_a_map_are_taken_while_it_is_that_maps(tmp_path: Path) -> None:
    job = JobFolder(tmp_path)
    prediction = named(("chair",) * 8)
    write_bytes(job.prediction, b"a map")
    assert refined_digest(job) == {}
    assert "vote" in (refined_names(job, prediction) or RefinedNames((), "")).source
    tops = [TopNames("chair", ("chair",), (1.0,))] * 8
    records = records_of(job, prediction, tops, [RefinedName("sofa", "model", "")] * 8, "model", "m", 5, FilterConfig())
    write_records(job, records)
    found = refined_names(job, prediction)
    source = "the model m of su3d-bench runs refine, names of 5 views"
    assert found == RefinedNames(("sofa",) * 8, source, ("",) * 8)
    assert set(refined_digest(job)) == {"refined"}
    write_bytes(job.prediction, b"another map")
    assert "vote" in (refined_names(job, prediction) or RefinedNames((), "")).source
    (tmp_path / FILE_NAME).write_text("[]")
    assert "vote" in (refined_names(job, prediction) or RefinedNames((), "")).source
