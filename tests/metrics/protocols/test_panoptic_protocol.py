"""Panoptic quality: equal to the originals to the last bit, hand-computed segments, and the scoring of a map."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CASES
from scored_room import ID

from su3d_bench.cli.main import main
from su3d_bench.core.maps import Masks
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import metric_of
from su3d_bench.metrics.semantic import panoptic
from su3d_bench.metrics.semantic.panoptic import PanopticCounts, Rule, Segments, count_segments

RULES = load_protocol("rooms-panoptic")
ORIGINALS: dict[str, Rule] = {"panoptic01_panopticapi": "panopticapi", "panoptic02_semantic_kitti": "semantic-kitti"}
PROBLEMS = {name: json.loads((CASES / f"{name}.json").read_text())["problems"] for name in ORIGINALS}
ONE_THING, THING_AND_STUFF = np.array([True]), np.array([True, False])


def segments(classes: Sequence[int], numbers: Sequence[int]) -> Segments:
    return Segments(np.array(classes, np.int64), np.array(numbers, np.int64))


@pytest.mark.parametrize(("name", "index"), [(name, k) for name in ORIGINALS for k in range(len(PROBLEMS[name]))])
def test_panoptic_values_equal_the_original_in_every_bit(name: str, index: int) -> None:
    rule, problem = ORIGINALS[name], PROBLEMS[name][index]
    with np.load(CASES / f"{name}.npz") as archive:
        is_thing, ends, points = (archive[f"{index}/{key}"] for key in ("is_thing", "ends", "points"))
    scenes = np.split(points.astype(np.int64), ends[:-1], axis=1)
    size = problem.get("min_region_size", 1)
    counts = [panoptic.per_scene(Segments(*one[:2]), Segments(*one[2:]), is_thing, rule, size) for one in scenes]
    answer: dict[str, Any] = problem["answer"]
    qualities = panoptic.class_qualities(vars(PanopticCounts.joined(counts)), rule)
    means = panoptic.means({key: values[None] for key, values in qualities.items()}, is_thing, rule)
    for key, values in qualities.items():
        assert np.nan_to_num(values).tolist() == answer["classes"][key]  # the original prints 0 for absent classes
    assert {key: float(value[0]) for key, value in means.items()} == {key: answer[key] for key in means}


def test_iou_of_one_half_is_not_a_match() -> None:
    truth = segments([0] * 4, [1] * 4)
    half = panoptic.per_scene(truth, segments([0, 0, -1, -1], [5, 5, 0, 0]), ONE_THING)
    more = panoptic.per_scene(truth, segments([0, 0, 0, -1], [5, 5, 5, 0]), ONE_THING)
    assert (half.n_matched[0], half.n_false[0], half.n_missed[0]) == (0, 1, 1)
    assert (more.n_matched[0], more.iou[0]) == (1, 0.75)


def test_stuff_is_one_segment_whatever_its_numbers() -> None:
    truth = segments([1] * 6, [4, 4, 4, 9, 9, 9])
    found = segments([1] * 6, [1, 2, 3, 4, 5, 6])
    assert panoptic.per_scene(truth, found, THING_AND_STUFF).iou.tolist() == [0.0, 1.0]


def test_void_is_subtracted_from_the_union_and_excuses_segments_mostly_in_it() -> None:
    truth = segments([0, 0, -1, -1, -1, -1], [1, 1, 0, 0, 0, 0])
    found = segments([0] * 6, [1, 1, 1, 2, 2, 2])
    counts = panoptic.per_scene(truth, found, ONE_THING)
    assert (counts.n_matched[0], counts.iou[0], counts.n_false[0]) == (1, 1.0, 0)
    half_void = panoptic.per_scene(segments([1, -1], [0, 0]), segments([0, 0], [1, 1]), THING_AND_STUFF)
    assert half_void.n_false.tolist() == [1, 0]  # more than half is ignored, half is not


def test_thing_points_without_instance_are_a_crowd() -> None:
    crowd = segments([0] * 5, [0] * 5)
    counts = panoptic.per_scene(crowd, segments([0, 0, 0, -1, -1], [1, 1, 1, 0, 0]), ONE_THING)
    assert (counts.n_matched[0], counts.n_false[0], counts.n_missed[0]) == (0, 0, 0)
    other = panoptic.per_scene(crowd, segments([1] * 5, [0] * 5), THING_AND_STUFF)
    assert other.n_false.tolist() == [0, 1]  # a crowd excuses only its own class
    as_kitti = panoptic.per_scene(crowd, segments([0] * 5, [1] * 5), ONE_THING, "semantic-kitti")
    assert as_kitti.iou.tolist() == [1.0]


def test_small_segments_are_neither_missed_nor_wrong_with_a_minimum_size() -> None:
    truth, found = segments([0, 0, 1, 1], [1, 1, 0, 0]), segments([1, 1, 0, 0], [0, 0, 8, 8])
    for size, expected in ((2, [1, 1]), (3, [0, 0])):
        counts = panoptic.per_scene(truth, found, THING_AND_STUFF, "semantic-kitti", size)
        assert (counts.n_false.tolist(), counts.n_missed.tolist()) == (expected, expected)


def test_point_in_several_masks_belongs_to_the_most_confident_or_first() -> None:
    masks = Masks.of_sets([np.arange(4), np.arange(4), np.arange(4)])
    semantic, instance = np.full(4, ID["chair"]), np.ones(4, np.int64)
    ids = np.array([ID["lamp"], ID["chair"], ID["table"]])
    place = {entry.name: k for k, entry in enumerate(RULES.scored)}
    for scores, best in (((0.1, 0.9, 0.5), "chair"), ((0.5, 0.5, 0.5), "lamp"), ((0.1, 0.2, 0.5), "table")):
        counts = count_segments(RULES, semantic, instance, masks, np.array(scores), ids)
        found = np.flatnonzero(counts.n_matched + counts.n_false)
        assert found.tolist() == [place[best]]
    without = count_segments(RULES, semantic, instance, masks, np.array([0.1, 0.2, 0.9]), np.array([1, ID["chair"], 0]))
    assert without.n_matched[place["chair"]] == 1  # a mask without a class hides nothing


def test_groups_of_classes_have_their_own_means() -> None:
    rules = load_protocol("scannet200-panoptic")
    none, one_each = np.zeros(200, np.int64), np.ones(200, np.int64)
    whole = metric_of(rules).pooled([PanopticCounts(none, none, one_each, np.zeros(200))])
    assert whole.groups == {name: {"PQ": 0.0, "SQ": 0.0, "RQ": 0.0} for name in ("head", "common", "tail")}


def test_mask_text_files_are_scored_against_ground_truth_text_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    values = np.repeat([1001, 5001, 5002, 0], 200)  # a wall, two chairs, void
    for folder in ("truth", "pred/masks"):
        Path(folder).mkdir(parents=True)
    Path("truth/scene0000_00.txt").write_text("\n".join(map(str, values)))
    lines = []
    for k, (label, rows) in enumerate({(1, (0, 200)): 0, (5, (200, 400)): 0, (5, (400, 550)): 0}):
        mask = (np.arange(800) >= rows[0]) & (np.arange(800) < rows[1])
        Path(f"pred/masks/{k}.txt").write_text("\n".join(map(str, mask.astype(int))))
        lines.append(f"masks/{k}.txt {label} 0.9\n")
    Path("pred/scene0000_00.txt").write_text("".join(lines))
    names = ["scannet-panoptic", "scannet-panoptic-oneformer3d"]
    words = ["evaluate", "pred", "--ground-truth", "truth", "--protocols", *names, "--json", "a.json", "--quiet"]
    assert main(words) == 0
    scored = json.loads(Path("a.json").read_text())["protocols"]
    api, kitti = (scored[name]["metrics"] for name in names)
    assert (api["pq"], api["pq stuff"], api["sq things"]) == ((1 + 0.875) / 2, 1.0, 0.875)
    assert kitti["pq"] == pytest.approx((1 + 0.875) / 20)
    assert {scored[name]["ceiling"]["pq"] for name in names} == {1.0, 2 / 20}
    capsys.readouterr()
