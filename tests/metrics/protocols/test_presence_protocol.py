"""Present and absent objects: equal to POPE to the last bit, hand-computed values, and the questions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import CASES
from scored_room import ENCODER, LABELS, instances, nothing, room, truth_as_prediction

from su3d_bench.core import registry
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.types import Float32Array, GroundTruth, LabelSet, UInt8Array
from su3d_bench.datasets.homes.dataset import Homes
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.presence import MEASURES, SAMPLINGS, PresenceCounts, measured, relevancies
from su3d_bench.metrics.questions.score import PresenceQuery, PresenceTruth
from su3d_bench.metrics.scoring import metric_of, plain_json, score_scene
from su3d_bench.questions.generated import absent_names, counted_scenes, drawn, presence_questions
from su3d_bench.questions.scene_map import is_called, is_room_surface, known_objects, plain_name

RULES = load_protocol("rooms-presence")
POPE = json.loads((CASES / "presence01_pope.json").read_text())
TRUTH = room()
PERFECT = truth_as_prediction(TRUTH, with_labels=False)
ASKED = (
    PresenceQuery("chair", "random", is_there=True),
    PresenceQuery("bed", "random", is_there=False),
    PresenceQuery("lamp", "random", is_there=True),
    PresenceQuery("sofa", "random", is_there=False),
)
QUESTIONS = PresenceTruth(TRUTH, ASKED, "made for a test")


def counts_of(
    there: Sequence[int], yes: Sequence[int], similarity: Sequence[float] | None = None, sampling: int = 0
) -> PresenceCounts:
    return PresenceCounts(
        np.full(len(there), sampling, np.int64),
        np.array(there, bool),
        np.array(yes, bool),
        np.zeros(len(there)) if similarity is None else np.array(similarity, np.float64),
    )


def once(counts: Sequence[PresenceCounts]) -> dict[str, float]:
    return {name: float(value[0]) for name, value in measured(counts, np.ones((1, len(counts)), np.int64)).items()}


@pytest.mark.parametrize("index", range(len(POPE["numbers"])))
def test_pope_values_are_equal_in_every_bit(index: int) -> None:
    problem = POPE["numbers"][index]
    ends = np.cumsum(problem["sizes"])[:-1]
    parts = zip(np.split(np.array(problem["there"]), ends), np.split(np.array(problem["yes"]), ends), strict=True)
    values = once([counts_of(there.tolist(), yes.tolist()) for there, yes in parts])
    assert {name: values[f"{name} random"] for name in problem["answer"]} == problem["answer"]


@pytest.mark.parametrize("index", range(len(POPE["negatives"])))
def test_absent_objects_are_drawn_as_in_pope(index: int) -> None:
    problem = POPE["negatives"][index]
    rooms, mine = problem["rooms"], problem["rooms"][problem["scene"]]
    absent = [name for name in dict.fromkeys(name for one in rooms for name in one) if name not in mine]
    for sampling, expected in problem["answer"].items():
        found = drawn("rooms/a", sampling, mine[: problem["n_things"]], absent, rooms)
        assert [other for _, other in found] == expected


def test_auroc_is_the_share_of_correctly_ordered_pairs_with_ties_as_half() -> None:
    values = once([counts_of([1, 1, 0, 0], [0] * 4, [0.9, 0.4, 0.4, 0.1])])
    assert values["AUROC random"] == (1 + 1 + 0.5 + 1) / 4
    assert np.isnan(values["AUROC popular"])


def test_map_that_never_says_yes_has_undefined_precision_and_zero_f1() -> None:
    values = once([counts_of([1, 0], [0, 0])])
    assert np.isnan(values["precision random"])
    assert (values["recall random"], values["F1 random"], values["accuracy random"]) == (0.0, 0.0, 0.5)
    nothing_there = once([counts_of([0, 0], [0, 1])])
    assert np.isnan(nothing_there["F1 random"])


def test_perfect_map_says_yes_to_present_and_no_to_absent_objects() -> None:
    values = metric_of(RULES).combine([score_scene(RULES, QUESTIONS, PERFECT, ENCODER).counts])
    assert [values[f"{name} random"] for name in MEASURES] == [1.0, 1.0, 1.0, 1.0, 0.5, 1.0]
    assert (values["n_random"], values["n_popular"]) == (4, 0)


def test_an_empty_map_says_no_to_everything() -> None:
    score = score_scene(RULES, QUESTIONS, nothing(TRUTH), ENCODER)
    values = plain_json(metric_of(RULES).combine([score.counts]))
    assert [values[f"{name} random"] for name in MEASURES] == [None, 0.0, 0.0, 0.5, 0.0, 0.5]
    assert score.counts.similarity.tolist() == [-1.0] * 4  # type: ignore[attr-defined]


class Plane:
    """Texts on a circle: "one" at 0 degrees, "object" at 40, all other canonical phrases at 90."""

    name, digest, dim = "plane", "plane", 2

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("scoring looks at no image")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        degrees = np.radians([{"one": 0.0, "object": 40.0}.get(text, 90.0) for text in texts])
        return np.stack([np.cos(degrees), np.sin(degrees)], axis=1).astype(np.float32)


@pytest.mark.parametrize(("degrees", "is_yes"), [((19.0, 60.0), True), ((21.0, 60.0), False)])
def test_yes_needs_an_instance_nearer_to_the_text_than_to_every_canonical_phrase(
    degrees: tuple[float, ...], is_yes: bool
) -> None:
    at = np.radians(degrees)
    features = np.stack([np.cos(at), np.sin(at)], axis=1).astype(np.float32)
    masks = [np.arange(10), np.arange(10, 20)]
    asked = PresenceTruth(TRUTH, (PresenceQuery("one", "popular", is_there=True),), "")
    counts = score_scene(RULES, asked, instances(TRUTH.points, masks, None, features), Plane()).counts
    assert isinstance(counts, PresenceCounts)
    assert counts.is_yes.tolist() == [is_yes]
    assert counts.similarity[0] == pytest.approx(np.cos(at[0]), abs=1e-6)
    assert counts.sampling.tolist() == [1]


def test_relevancy_equals_lerf() -> None:
    assert RULES.presence is not None
    cosine, canonical = np.array([[0.31, 0.2]]), np.array([[0.1, 0.25, 0.2, 0.0]])
    shares = np.exp(10 * cosine[..., None]) / (np.exp(10 * cosine[..., None]) + np.exp(10 * canonical[:, None, :]))
    np.testing.assert_allclose(relevancies(cosine, canonical, RULES.presence), shares.min(axis=2), rtol=1e-14)


def test_map_without_features_gives_a_reason_for_presence() -> None:
    with pytest.raises(PredictionError, match="needs features"):
        score_scene(RULES, QUESTIONS, truth_as_prediction(TRUTH, with_labels=True), ENCODER)


def test_room_has_equally_many_present_and_absent_questions() -> None:
    objects = known_objects(TRUTH, 100)
    asked = presence_questions("rooms/a", TRUTH, objects, 4, counted_scenes("rooms"))
    names = {plain_name(name) for name in LABELS.names}
    for sampling in SAMPLINGS:
        mine = [thing for thing in asked if thing.sampling == sampling]
        there = [thing.text for thing in mine if thing.is_there]
        absent = [thing.text for thing in mine if not thing.is_there]
        assert (len(there), len(absent), len(set(absent))) == (4, 4, 4)
        assert set(there) <= {"chair", "table", "lamp", "cushion", "book", "backpack"}
        assert set(absent) <= names - {"chair", "table", "lamp", "cushion", "book", "backpack", "wall", "floor"}
    assert asked == presence_questions("rooms/a", TRUTH, objects, 4, counted_scenes("rooms"))
    assert asked != presence_questions("rooms/b", TRUTH, objects, 4, counted_scenes("rooms"))


def test_synonyms_of_present_objects_are_not_absent() -> None:
    small = TRUTH.semantic.copy()
    small[-1] = LABELS.ids[LABELS.names.index("sofa")]  # one vertex without an object
    absent = absent_names(replace(TRUTH, semantic=small), known_objects(TRUTH, 100))
    there = ("chair", "table", "lamp", "cushion", "book", "backpack", "sofa")
    assert not [name for name in absent for known in there if is_called(name, known) or is_called(known, name)]
    assert not [name for name in absent if is_room_surface(name)]
    assert {"bed", "toilet"} <= set(absent)
    assert {"desk", "stool", "pillow", "countertop"}.isdisjoint(absent)  # a table, a chair and a cushion are there


@pytest.mark.parametrize("name", ["rooms", "replica", "scannet", "scannetpp", "hm3dsem"])
def test_every_dataset_with_class_names_has_the_same_rules_for_absent_objects(name: str) -> None:
    rules = load_protocol(f"{name}-presence")
    classes = load_protocol("scannet200-panoptic" if name == "scannet" else f"{name}-panoptic").classes
    ids, called = zip(*((entry.id, entry.name) for entry in classes), strict=True)
    of_point = np.array([ids[called.index("chair")], ids[called.index("wall")]], np.int32)
    numbers = np.array([1, 2], np.int32)
    labels = LabelSet(rules.label_space, ids, called)
    truth = GroundTruth(np.zeros((2, 3), np.float32), of_point, numbers, labels, rules.ground_truth, "by hand")
    absent = absent_names(truth, known_objects(truth, 1))
    assert {"chair", "wall", "unknown", "unknown/remove", "partial", "object"}.isdisjoint(absent)
    assert {"sink", "toilet", "lamp"} & set(called) <= set(absent) and len(absent) > 40
    same = {"presence", "per_kind", "synonyms", "prompt", "min_region_size", "headline"}
    assert rules.model_dump(include=same) == RULES.model_dump(include=same)
    assert name in registry.DATASETS and rules.ground_truth in registry.load("dataset", name).variants


def test_fewer_questions_are_asked_if_no_absent_objects_remain() -> None:
    assert list(drawn("a/b", "popular", ["bed", "lamp"], ["sink"], [["sink"]])) == [("bed", "sink"), ("lamp", None)]
    assert list(drawn("a/b", "adversarial", ["bed"], ["sink"], [["bed"]])) == [("bed", "sink")]  # by chance


@pytest.mark.parametrize("scene", ["studio0", "bathroom0"])
def test_co_occurrence_is_counted_over_the_rooms(scene: str, tmp_path: Path) -> None:
    names = [plain_name(LABELS.name_of(thing.class_id)) for thing in Rooms(tmp_path).objects(scene)]
    rooms = counted_scenes("rooms")
    assert tuple(dict.fromkeys(name for name in names if not is_room_surface(name))) in rooms
    assert len(rooms) == 48


@pytest.mark.parametrize("scene", ["seed900003", "seed900031"])
def test_co_occurrence_in_homes_is_counted_over_homes_of_the_generator(scene: str, tmp_path: Path) -> None:
    names = dict.fromkeys(plain_name(thing.class_name) for thing in Homes(tmp_path).objects(scene))
    homes = counted_scenes("homes")
    assert tuple(name for name in names if not is_room_surface(name)) == homes[int(scene[-2:])]
    assert len(homes) == 48
