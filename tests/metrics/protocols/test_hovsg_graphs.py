"""HOV-SG's objects, rooms and floors: what its own evaluator answers, and what it leaves open."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hm3dsem_walk import OBJECTS, SCENE, write_graph, write_walk
from places import CASES

from su3d_bench.baselines.oracle import Oracle
from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Floor, GroundTruth, LabelSet, Places, Room
from su3d_bench.datasets.hm3dsem.dataset import Hm3dSem
from su3d_bench.metrics.graphs import (
    FEW_LABELS,
    NEEDS_PLACES,
    Cloud,
    MatchedObjects,
    covered_share,
    floor_bounds,
    larger_share,
    voxel_ids,
    voxel_means,
)
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ClassEntry
from su3d_bench.metrics.scoring import combine, pack_scores, score_scene, unpack_scores
from su3d_bench.predictions.formats import READERS

OBJECT_RULES, PLACE_RULES = load_protocol("hm3dsem-objects"), load_protocol("hm3dsem-places")
UNIT_M = 1e-4  # of the coordinates in the cases
CASE: dict[str, Any] = {
    name: (json.loads((CASES / f"{name}.json").read_text())["problems"], np.load(CASES / f"{name}.npz"))
    for name in ("hovsg01_objects", "hovsg02_places")
}


class GivenTextEncoder:
    """An encoder that knows the feature of each name."""

    name, digest, device = "given", "given", "cpu"

    def __init__(self, names: list[str], text: np.ndarray) -> None:
        self.of_name = dict(zip(names, text, strict=True))

    def encode_texts(self, texts: list[str]) -> np.ndarray:
        return np.stack([self.of_name[text] for text in texts])


def rules_of(n: int) -> Any:
    """HOV-SG's rules over ``n`` categories c0, c1, ... that are compared as they stand."""
    classes = tuple(ClassEntry(id=k + 1, name=f"c{k}") for k in range(n))
    return OBJECT_RULES.model_copy(update={"classes": classes, "prompts": (), "prompt": "{}"})


def numbers(rules: Any, *scenes: tuple[GroundTruth, Instances], encoder: Any = None) -> dict[str, float]:
    """What the scenes score together, from counts as a run keeps them."""
    scores = {f"s{k}": score_scene(rules, truth, found, encoder) for k, (truth, found) in enumerate(scenes)}
    kept = {name: unpack_scores(pack_scores({rules.name: score}))[rules.name] for name, score in scores.items()}
    return dict(combine(rules, kept, with_intervals=False).metrics)


def split(points: np.ndarray, sizes: list[int]) -> list[np.ndarray]:
    return np.split(points * UNIT_M, np.cumsum(sizes)[:-1])


def map_of(clouds: list[np.ndarray], **more: Any) -> Instances:
    ends = np.cumsum([0, *map(len, clouds)])
    points = np.concatenate([np.zeros((0, 3)), *clouds]).astype(np.float32)
    return Instances.of(points, [np.arange(a, b) for a, b in pairwise(ends)], **more)


def truth_of(clouds: list[np.ndarray], ids: list[int], boxes: Any = (), places: Places | None = None) -> GroundTruth:
    sizes = list(map(len, clouds))
    given = dict(enumerate(boxes, 1))
    return GroundTruth(
        np.concatenate(clouds).astype(np.float32),
        np.repeat(ids, sizes).astype(np.int32),
        np.repeat(np.arange(1, len(clouds) + 1), sizes).astype(np.int32),
        LabelSet("hm3dsem", (1, 2, 3), ("c0", "c1", "c2")),
        "hovsg-objects",
        "made for a test",
        places=places or Places((), (), given),
    )


@pytest.mark.parametrize("index", range(30))
def test_objects_have_the_answer_of_hovsgs_evaluator(index: int) -> None:
    problem, arrays = CASE["hovsg01_objects"][0][index], CASE["hovsg01_objects"][1]
    names = [f"c{k}" for k in range(problem["names"])]
    ids = [names.index(name) + 1 if name in names else 0 for name in problem["categories"]]
    truth = truth_of(split(arrays[f"true_{index}"], problem["sizes"]["true"]), ids, arrays[f"boxes_{index}"])
    found = map_of(split(arrays[f"pred_{index}"], problem["sizes"]["pred"]), features=arrays[f"features_{index}"])
    encoder = GivenTextEncoder(names, arrays[f"text_{index}"])
    assert numbers(rules_of(len(names)), (truth, found), encoder=encoder) == problem["answer"]


@pytest.mark.parametrize("index", range(30))
def test_floors_and_rooms_have_the_answer_of_hovsgs_evaluator(index: int) -> None:
    problem, arrays = CASE["hovsg02_places"][0][index], CASE["hovsg02_places"][1]
    clouds = {side: split(arrays[f"{side}_{index}"], problem["sizes"][side]) for side in ("true", "pred")}
    rooms = [Room(cloud, *row) for cloud, row in zip(clouds["true"], problem["true"], strict=True)]
    true = Places(tuple(Floor(*row) for row in problem["floors"]), tuple(rooms))
    found = Places(
        tuple(Floor(*row) for row in problem["predicted_floors"]),
        tuple(
            Room(c, zero, zero + h, zero + h / 2) for c, (zero, h) in zip(clouds["pred"], problem["pred"], strict=True)
        ),
    )
    truth, prediction = (
        truth_of([np.zeros((1, 3))], [1], places=true),
        replace(map_of([np.zeros((1, 3))]), places=found),
    )
    answer = numbers(PLACE_RULES, (truth, prediction))
    assert answer.pop("number of floors") == 1.0
    assert answer == pytest.approx(problem["answer"], abs=1e-15)


def test_the_truth_itself_is_found_whole_and_the_area_ends_at_the_last_ten(tmp_path: Any) -> None:
    write_walk(tmp_path)
    oracle = Oracle(Oracle.Config())
    oracle.receive_ground_truth(truth := Hm3dSem(tmp_path).ground_truth(SCENE, "hovsg-objects"))
    answer = numbers(OBJECT_RULES, (truth, oracle.finish()))
    assert answer.pop("AUC") == pytest.approx((1620 - 5) / 1624)
    assert set(answer.values()) == {1.0}
    assert set(numbers(PLACE_RULES, (truth, oracle.finish())).values()) == {1.0}


def test_labels_are_the_first_ranks_and_what_they_do_not_name_is_never_right() -> None:
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    truth = truth_of([cube, cube + 5], [1, 2])
    found = map_of([cube, cube + 5], labels=["c2", "c0"], further_labels=[["c0"], [""]])
    score = score_scene(rules_of(12), truth, found, None)
    assert isinstance(score.counts, MatchedObjects) and FEW_LABELS in score.warnings
    assert score.counts.n_ranked.tolist() == [0, 1, *[0] * 10, 1] and score.counts.n_objects.tolist() == [2, 2]


def test_an_object_without_a_feature_has_no_category_and_no_points_no_overlap() -> None:
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    truth = truth_of([cube, cube + 5], [1, 2])
    found = map_of([cube, np.zeros((0, 3))], features=np.array([[0.0, 0.0], [0.0, 1.0]], np.float32))
    encoder: Any = GivenTextEncoder(["c0", "c1"], np.eye(2, dtype=np.float32))
    score = score_scene(rules_of(2), truth, found, encoder)
    assert isinstance(score.counts, MatchedObjects)
    assert score.counts.n_ranked.tolist() == [1, 0, 1] and score.counts.n_found.tolist() == [1] * 10 + [0]


def test_an_empty_map_scores_0_where_the_original_divides_by_zero() -> None:
    truth = truth_of([np.eye(3)], [1], places=Places((Floor(0, 2),), (Room(np.zeros((1, 3)), 0, 2, 1),)))
    assert set(numbers(OBJECT_RULES, (truth, map_of([], labels=()))).values()) == {0.0}
    assert set(numbers(PLACE_RULES, (truth, map_of([], labels=()))).values()) == {0.0}


def test_a_map_without_floors_and_rooms_is_refused_in_one_line() -> None:
    truth = truth_of([np.eye(3)], [1])
    with pytest.raises(PredictionError, match=f"^hm3dsem-places: {NEEDS_PLACES}$"):
        score_scene(PLACE_RULES, truth, map_of([np.eye(3)], labels=["c0"]), None)
    with pytest.raises(PredictionError, match="needs features and an encoder, or labels"):
        score_scene(OBJECT_RULES, truth, map_of([np.eye(3)]), None)
    with pytest.raises(DataError, match="knows no floors and no rooms"):
        score_scene(PLACE_RULES, replace(truth, places=None), map_of([], labels=()), None)


def test_another_number_of_floors_finds_no_bound_and_says_so(tmp_path: Any) -> None:
    write_walk(tmp_path)
    truth = Hm3dSem(tmp_path).ground_truth(SCENE, "hovsg-objects")
    found = READERS["hovsg-graph"].read(write_graph(tmp_path / "x"), "x").content
    assert isinstance(found, Instances) and found.places is not None and truth.places is not None
    right, wrong = found, replace(found, places=replace(found.places, floors=(Floor(0.0, 1.0), Floor(1.4, 2.4))))
    score = score_scene(PLACE_RULES, truth, wrong, None)
    assert score.warnings == (
        "2 floors are predicted, 1 are true: no bound counts as found (the original ends in an error)",
    )
    both = numbers(PLACE_RULES, (truth, right), (truth, wrong))
    assert (both["number of floors"], both["floor recall"], both["room recall"]) == (0.5, 0.5, 1.0)
    assert floor_bounds([], [Floor(0, 1)])[0].tolist() == [0, 2]


def test_points_at_the_radius_are_not_near_and_shares_are_of_the_right_side() -> None:
    one, other = Cloud(np.array([[0.0, 0], [1, 0], [2, 0]])), Cloud(np.array([[0.5, 0], [2.25, 0]]))
    assert (one.n_near(other, 0.5), other.n_near(one, 0.5), one.n_near(other, 0.51)) == (1, 1, 3)
    assert larger_share(one, other, 0.5) == 0.5 and larger_share(other, one, 0.51) == 1.0
    assert covered_share(one, other, 0.5) == pytest.approx(1 / 3) and covered_share(other, one, 0.51) == 1.0
    assert covered_share(Cloud(np.zeros((0, 2))), one, 1.0) == 0.0 == larger_share(one, Cloud(np.zeros((0, 2))), 1.0)


def test_voxels_are_those_of_open3d() -> None:
    import open3d as o3d

    points = np.random.default_rng(0).random((300, 3)) * 0.4
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    theirs = np.asarray(cloud.voxel_down_sample(0.05).points)
    ours = voxel_means(points, voxel_ids(points, 0.05))
    np.testing.assert_allclose(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)], rtol=0, atol=1e-15)


def test_the_names_of_the_walk_are_categories_of_the_list() -> None:
    assert {name for _, name, _, _ in OBJECTS} <= {entry.name for entry in OBJECT_RULES.classes}
