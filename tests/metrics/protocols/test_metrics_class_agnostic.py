"""Class-agnostic AP: three rules for instances and void, each with different values."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
from places import CASES
from scored_room import instances

from su3d_bench.core.errors import DataError
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.evaluation.ground_truth import VertexTruth
from su3d_bench.evaluation.scoring import score_on_vertices
from su3d_bench.metrics.instance.scene_counts import per_scene
from su3d_bench.metrics.instance.score import encode_truth
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.predictions.base import vertex_masks

NAMES = ("class-agnostic-maskclustering", "class-agnostic-open3dis", "class-agnostic-segment3d")
CHAIR, WALL, OTHER = 2, 1, 1000  # 1000 is not one of the 200
LABELS = LabelSet("scannet", (CHAIR, WALL, OTHER), ("chair", "wall", "gadget"))
N = 200


def scan(unannotated: int = N) -> GroundTruth:
    """Two chairs, a wall and an object without a class, 200 points each, and unannotated points."""
    semantic = np.repeat([CHAIR, CHAIR, WALL, OTHER, 0], [N, N, N, N, unannotated]).astype(np.int32)
    instance = np.repeat([1, 2, 3, 4, 0], [N, N, N, N, unannotated]).astype(np.int32)
    points = np.random.default_rng(0).random((len(semantic), 3)).astype(np.float32)
    return GroundTruth(points, semantic, instance, LABELS, "scannet200-vertices", "made for a test")


def masks(truth: GroundTruth, *ids: int, scores: list[float] | None = None) -> Instances:
    """Masks without labels and without features."""
    return instances(truth.points, [np.flatnonzero(truth.instance == one) for one in ids], None, scores=scores)


def ap_of(name: str, truth: GroundTruth, prediction: Instances | Partition) -> float:
    rules = load_protocol(name)
    return combine(rules, {"a": score_scene(rules, truth, prediction, None)}).metrics["AP"]


@pytest.mark.parametrize(
    ("sizes", "mask", "ap50"),
    [
        ((200, 200, 200), (0, 0), 1.0),  # two perfect masks: the object of value 7 is not missed
        ((200, 200, 200), (0, 200), 1.0),  # a mask on it is dropped
        ((90, 200, 200), (0, 150), 1.0),  # 90 of 150 points, counted twice since they are fewer than 100
        ((90, 200, 200), (70, 200), 5 / 6),  # 20 of 130, counted twice: a false positive
    ],
)
@pytest.mark.parametrize("is_text", [True, False])
def test_values_below_1000_are_forgiven_by_segment3d(
    sizes: tuple[int, ...], mask: tuple[int, int], ap50: float, is_text: bool
) -> None:
    rules = load_protocol("class-agnostic-segment3d")
    values = np.repeat([7, 3000 if is_text else 3001, 3002], sizes)
    found = [np.arange(*mask), *(np.flatnonzero(values == one) for one in (3000, 3001, 3002))]
    truth = GroundTruth(
        scan().points[: len(values)], values // 1000, values % 1000, LABELS, "scannet200-vertices", "made for a test"
    )
    prediction = instances(truth.points, [one for one in found if len(one)], None)
    if is_text:
        content = vertex_masks("a", [one.astype(np.int32) for one in found if len(one)], len(values))
        score = score_on_vertices(rules, VertexTruth(values, values // 1000, ()), "a", content, None).score
    else:
        score = score_scene(rules, truth, prediction, None)
    assert combine(rules, {"a": score}).metrics["AP50"] == pytest.approx(ap50)


@pytest.mark.parametrize(("name", "n_instances"), list(zip(NAMES, (5, 2, 4), strict=True)), ids=NAMES)
def test_each_rule_has_its_own_instances(name: str, n_instances: int) -> None:
    rules = load_protocol(name)
    counts = score_scene(rules, scan(), masks(scan(), 1), None).counts
    assert counts.n_truth.tolist() == [n_instances]  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", NAMES)
def test_ground_truth_scores_one_unless_unannotated_points_are_an_instance_and_empty_map_zero(name: str) -> None:
    truth = scan()
    assert ap_of(name, truth, masks(truth)) == 0.0
    value = ap_of(name, truth, masks(truth, 1, 2, 3, 4))
    assert value == (4 / 5 if name == "class-agnostic-maskclustering" else 1.0)
    annotated = scan(unannotated=0)
    assert ap_of(name, annotated, masks(annotated, 1, 2, 3, 4)) == 1.0
    assert ap_of(name, truth, masks(truth, 1, 2, 3, 4, 0)) == 1.0


def test_masks_on_void_are_dropped_by_open3dis() -> None:
    assert ap_of("class-agnostic-open3dis", scan(), masks(scan(), 1, 2, 0)) == 1.0


@pytest.mark.parametrize("is_own_writer", [True, False], ids=["MaskClustering's writer", "Mask3D's writer"])
def test_both_ground_truth_forms_of_maskclustering_give_equal_counts(is_own_writer: bool) -> None:
    """Values as written by the two programs, then mod 1000 + 1000 x the first class, as with --no_class."""
    truth = scan()
    known = np.isin(truth.semantic, [entry.id for entry in load_protocol("scannet200-instance").scored])
    identity = truth.instance.astype(np.int64) - 1  # the index in segGroups, -1 for none
    if is_own_writer:
        written = np.where(known, truth.semantic, 0) * 1000 + (identity + 1) + 1
    else:
        written = truth.semantic * 1000 + identity + 1
    values = written % 1000 + 2 * 1000
    prediction = masks(truth, 1, 3, 0)
    theirs = per_scene(values, prediction.indptr, prediction.indices, np.full(3, 2), np.ones(3), [2, 3])
    ours = score_scene(load_protocol(NAMES[0]), truth, prediction, None).counts
    assert theirs.n_truth.tolist()[0] == ours.n_truth.tolist()[0]  # type: ignore[attr-defined]
    assert theirs.n_missed.tolist()[0] == ours.n_missed.tolist()[0]  # type: ignore[attr-defined]
    assert theirs.is_true.tolist() == ours.is_true.tolist()  # type: ignore[attr-defined]


def test_instance_id_or_number_of_objects_beyond_the_encoding_is_refused() -> None:
    rules = load_protocol("class-agnostic-segment3d")
    with pytest.raises(DataError, match="instance id 1000 would spill into the next class"):
        encode_truth(rules, np.array([CHAIR]), np.array([1000]))
    number = np.arange(1000)
    assert encode_truth(rules, 1 + number[:999] // 500, 1 + number[:999] % 500).tolist()[-1] == 1999
    with pytest.raises(DataError, match="has 1000 objects; without classes a scene may have 999"):
        encode_truth(rules, 1 + number // 500, 1 + number % 500)


# ---- answers of the originals if the order of objects matters, or if numbers restart with each class

CASE = "agnostic01_class_after_class"
PROBLEMS = json.loads((CASES / f"{CASE}.json").read_text())["problems"]


def problem(index: int) -> Iterator[tuple[np.ndarray, list[np.ndarray]]]:
    """Ground truth, label * 1000 + instance, and the masks of each scene."""
    with np.load(CASES / f"{CASE}.npz") as archive:
        for s in range(PROBLEMS[index]["n_scenes"]):
            values = archive[f"gt_{index}_{s}"]
            packed = archive[f"masks_packed_{index}_{s}"]
            yield values, [np.flatnonzero(row) for row in np.unpackbits(packed, axis=1)[:, : len(values)]]


@pytest.mark.parametrize("name", ["open3dis", "segment3d"])
@pytest.mark.parametrize("index", range(len(PROBLEMS)))
def test_objects_are_matched_class_by_class_as_in_the_original_in_every_bit(index: int, name: str) -> None:
    rules = load_protocol(f"class-agnostic-{name}")
    scores = {}
    for s, (values, masks) in enumerate(problem(index)):
        labels = LabelSet(
            "scannet", tuple(np.unique(values // 1000).tolist()), tuple(map(str, np.unique(values // 1000)))
        )
        points = np.random.default_rng(s).random((len(values), 3)).astype(np.float32)
        truth = GroundTruth(points, values // 1000, values % 1000, labels, "scannet200-vertices", "made for a test")
        scores[f"scene{s}"] = score_scene(rules, truth, instances(points, masks, None), None)
    found = combine(rules, scores).metrics
    assert [found["AP"], found["AP50"], found["AP25"]] == list(PROBLEMS[index][name].values())
