"""ConceptGraphs from regions to a map: what is lifted and how, what the map keeps, when it is cleaned up."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conceptgraphs_scene import (
    DIMENSION,
    HEIGHT,
    QUIET,
    SCENE,
    WIDTH,
    Plate,
    at_cosine,
    axis,
    block,
    contents,
    look,
    mapped,
)
from painted import colour_perception

from su3d_bench import scene_run
from su3d_bench.baselines.conceptgraphs import ConceptGraphs
from su3d_bench.baselines.conceptgraphs_config import MappingConfig
from su3d_bench.baselines.conceptgraphs_regions import kept_regions, lift, subtract_contained
from su3d_bench.baselines.object_clouds import bounding_box, largest_cluster, voxel_average
from su3d_bench.cli.main import main
from su3d_bench.errors import DataError
from su3d_bench.geometry import back_project
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.timing import Timer
from su3d_bench.types import Detections

RNG = np.random.default_rng(3)
LEFT, RIGHT = Plate((-0.5, 0.0)), Plate((0.0, 0.5))
PUBLISHED = MappingConfig()
BARE = QUIET.model_copy(update={"obj_min_detections": 0})


def found_by(views: list[list[Plate]], config: MappingConfig = BARE) -> int:
    return len(mapped(ConceptGraphs(config), views).finish())


# Clouds


def test_a_voxel_average_is_the_mean_of_its_points_on_a_grid_from_half_a_voxel_below_the_minimum() -> None:
    along_x = np.array([5.0, 5.01, 5.013, 5.04])  # cells 0, 0, 1, 2 of 25 mm from 4.9875 m
    points = np.stack([along_x, np.zeros(4), np.zeros(4)], axis=1)
    assert voxel_average(points, 0.025)[:, 0].tolist() == pytest.approx([5.005, 5.013, 5.04])


def test_voxel_averages_are_those_of_open3d() -> None:
    import open3d as o3d

    points = RNG.normal(0, 0.3, (4000, 3)) + np.array([10, -20, 30])
    theirs = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(0.1)
    ours = voxel_average(points, 0.1)
    assert sorted(map(tuple, ours)) == sorted(map(tuple, np.asarray(theirs.points)))


def test_the_grid_moves_with_the_cloud_so_that_averaging_again_moves_points() -> None:
    points = RNG.random((500, 3))
    assert voxel_average(points + 0.037, 0.1) == pytest.approx(voxel_average(points, 0.1) + 0.037)
    along_x = np.array([[5.0, 0, 0], [5.012, 0, 0], [5.028, 0, 0], [5.04, 0, 0]])
    once = voxel_average(along_x, 0.025)
    assert once[:, 0].tolist() == pytest.approx([5.006, 5.028, 5.04])
    assert voxel_average(once, 0.025)[:, 0].tolist() == pytest.approx([5.006, 5.034])
    assert voxel_average(np.zeros((0, 3)), 0.1).shape == (0, 3)


def row_of_points(n: int, start: float, step: float = 0.01) -> np.ndarray:
    return np.stack([start + step * np.arange(n), np.zeros(n), np.zeros(n)], axis=1)


def test_the_largest_cluster_stays() -> None:
    small, large = row_of_points(11, 0.0), row_of_points(12, 1.0)
    assert largest_cluster(np.concatenate([small, large]), 0.1, 10).tolist() == large.tolist()


def test_of_equal_clusters_the_one_that_comes_first_stays() -> None:
    first, second = row_of_points(12, 1.0), row_of_points(12, 0.0)
    assert largest_cluster(np.concatenate([first, second]), 0.1, 10).tolist() == first.tolist()


def test_a_cloud_without_a_cluster_of_five_stays_whole() -> None:
    scattered = row_of_points(30, 0.0, step=0.2)
    assert largest_cluster(scattered, 0.1, 10) is scattered
    four = np.concatenate([row_of_points(4, 0.0), row_of_points(3, 1.0)])
    assert largest_cluster(four, 0.1, 2) is four
    five = np.concatenate([row_of_points(5, 0.0), row_of_points(3, 1.0)])
    assert len(largest_cluster(five, 0.1, 2)) == 5


def test_a_box_lies_along_the_object_and_one_of_three_points_along_the_world() -> None:
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    points = block((0, 0, 0), (1.0, 0.4, 0.2)) @ turn.T
    box = bounding_box(points, oriented=True)
    # the last points are a step before the end; the corners of the hull are joggled, hence not all of them count
    assert sorted(box.sizes) == pytest.approx([0.15, 0.35, 0.95], rel=0.15)
    assert abs(box.rotation[:, np.argmax(box.sizes)] @ turn[:, 0]) > 0.99
    assert box.distance_outside(points).max() < 1e-6
    for flat in (bounding_box(points, oriented=False), bounding_box(points[:3], oriented=True)):
        assert flat.rotation.tolist() == np.eye(3).tolist()
    assert bounding_box(points, oriented=False).sizes == pytest.approx(np.ptp(points, axis=0))


# Regions


def region(area_px: int = 400, box: tuple[int, int, int, int] = (0, 0, 40, 40), score: float = 1.0) -> Detections:
    """One region of so many pixels in a 96x72 image; the box need not be the mask's."""
    mask = (np.arange(WIDTH * HEIGHT) < area_px).reshape(1, HEIGHT, WIDTH)
    features = np.ones((1, 1, DIMENSION), np.float32)
    scores = np.array([score], np.float32)
    return Detections(0, mask, np.array([box], np.float32), scores, ("item",), ("",), (1.0,), features, features[0, 0])


def is_kept(one: Detections, config: MappingConfig = PUBLISHED, *, background: bool = False) -> bool:
    return len(kept_regions(one, np.array([background]), config)) == 1


def test_masks_below_25_pixels_are_left_out_and_below_10_whatever_is_configured() -> None:
    assert is_kept(region(25))
    assert not is_kept(region(24))
    config = MappingConfig(mask_area_threshold=3)
    assert is_kept(region(10), config)
    assert not is_kept(region(9), config)


def test_masks_below_the_confidence_are_left_out() -> None:
    assert is_kept(region(score=0.95))
    assert not is_kept(region(score=0.949))


def test_scores_on_a_scale_of_their_own_have_a_threshold_of_their_own() -> None:
    unsure = replace(region(score=0.3), score_scale="own")
    assert is_kept(unsure)
    assert not is_kept(unsure, MappingConfig(own_scale_conf_threshold=0.5))
    assert not is_kept(region(score=0.3))


def test_boxes_above_half_the_image_are_left_out_but_not_background() -> None:
    half, more = (0, 0, 48, 72), (0, 0, 49, 72)
    assert is_kept(region(box=half))
    assert not is_kept(region(box=more))
    assert is_kept(region(box=more), background=True)


def boxes_and_masks(*boxes: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    masks = np.zeros((len(boxes), 40, 40), np.bool_)
    for mask, (x0, y0, x1, y1) in zip(masks, boxes, strict=True):
        mask[y0:y1, x0:x1] = True
    return np.array(boxes, np.float32), masks


def test_a_contained_mask_is_cut_out_of_its_container() -> None:
    result = subtract_contained(*boxes_and_masks((0, 0, 20, 20), (5, 5, 15, 15)))
    assert result.sum(axis=(1, 2)).tolist() == [300, 100]
    assert not (result[0] & result[1]).any()


def test_containment_is_less_than_070_of_the_container_and_more_than_080_of_the_contained() -> None:
    def cut(*boxes: tuple[int, int, int, int]) -> int:
        boxes_px, masks = boxes_and_masks(*boxes)
        return int(masks[0].sum() - subtract_contained(boxes_px, masks)[0].sum())

    assert cut((0, 0, 10, 10), (0, 0, 10, 7)) == 0  # 70 of 100: not below 0.7
    assert cut((0, 0, 10, 10), (0, 0, 3, 23)) == 0  # 30 of 69 is no 0.8
    assert cut((0, 0, 10, 10), (6, 0, 11, 5)) == 0  # 20 of 25: not above 0.8
    assert cut((0, 0, 20, 20), (11, 0, 21, 10)) == 90  # 90 of 100


def test_masks_are_cut_one_after_the_other_with_what_is_left_of_them() -> None:
    # the middle box holds 6 / 6.5 of the inner one and lies in the outer one, which holds only 5 / 6.5 of the inner one
    boxes, masks = boxes_and_masks((0, 0, 25, 25), (14, 5, 25, 17), (21, 6, 25, 8))
    boxes[1], boxes[2] = (14, 5, 26, 17), (20, 6, 26.5, 8)
    outer_first = subtract_contained(boxes, masks)
    assert not outer_first[0][masks[1]].any()  # the middle one was whole when it was cut out of the outer one
    order = [1, 0, 2]
    middle_first = subtract_contained(boxes[order], masks[order])
    assert middle_first[1][masks[2]].all()  # now it had lost the inner one, which thus stays in the outer one


def test_a_box_without_area_contains_nothing_and_is_in_nothing() -> None:
    boxes, masks = boxes_and_masks((0, 0, 20, 20), (5, 5, 15, 15))
    boxes[1] = 5, 5, 5, 5
    assert subtract_contained(boxes, masks).tolist() == masks.tolist()


def lifted(plates: list[Plate], config: MappingConfig = QUIET, index: int = 0, seed: int = 0) -> list:  # type: ignore[type-arg]
    frame, detections = look(plates, index)
    return list(lift(frame, np.arange(len(detections)), detections.masks, config, seed))


def test_without_noise_a_region_is_lifted_to_the_voxel_averages_of_its_pixels() -> None:
    frame, detections = look([LEFT])
    points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, detections.masks[0])
    (one,) = lifted([LEFT])
    assert one.points == pytest.approx(voxel_average(points, 0.025), abs=1e-12)


def test_noise_of_4_mm_comes_from_the_seed_and_the_frame() -> None:
    fine = QUIET.model_copy(update={"downsample_voxel_size": 1e-4, "dbscan_remove_noise": False})
    noisy = fine.model_copy(update={"noise_m": 0.004})
    (still,), (moved,) = lifted([LEFT], fine), lifted([LEFT], noisy)
    offsets = moved.points - still.points
    assert offsets.std(axis=0) == pytest.approx(np.full(3, 0.004), rel=0.1)
    assert np.abs(offsets.mean(axis=0)).max() < 5e-4
    assert lifted([LEFT], noisy)[0].points.tobytes() == moved.points.tobytes()
    assert lifted([LEFT], noisy, seed=1)[0].points.tobytes() != moved.points.tobytes()
    assert lifted([LEFT], noisy, index=1)[0].points.tobytes() != moved.points.tobytes()


def test_a_region_of_fewer_than_16_points_with_depth_is_left_out() -> None:
    frame, detections = look([LEFT])
    rows, columns = np.nonzero(detections.masks[0])
    depth = frame.depth_m.copy()
    depth[rows[16:], columns[16:]] = 0
    # 16 pixels of a row 2 cm apart: without noise their box has no volume
    noisy = QUIET.model_copy(update={"noise_m": 0.004})
    assert len(list(lift(replace(frame, depth_m=depth), np.array([0]), detections.masks, noisy, 0))) == 1
    depth[rows[15], columns[15]] = np.nan
    assert not list(lift(replace(frame, depth_m=depth), np.array([0]), detections.masks, noisy, 0))


def test_a_region_whose_box_is_below_one_cubic_centimetre_is_left_out() -> None:
    flat = np.full((HEIGHT, WIDTH), 1.5, np.float32)
    frame, detections = look([LEFT])
    assert len(lifted([LEFT])) == 1
    assert not list(lift(replace(frame, depth_m=flat), np.array([0]), detections.masks, QUIET, 0))


def test_masks_of_another_size_than_the_image_are_refused() -> None:
    frame, detections = look([LEFT])
    with pytest.raises(DataError, match="frame 0: masks are 90x72 and the image is 96x72"):
        list(lift(frame, np.array([0]), detections.masks[:, :, :90], QUIET, 0))
    with pytest.raises(DataError, match="frame 3: the detections are those of frame 0"):
        ConceptGraphs().update(replace(frame, index=3), detections, Timer())


# The map


def test_in_the_first_frame_every_region_becomes_an_object_however_alike_they_are() -> None:
    method = mapped(ConceptGraphs(BARE), [[LEFT, LEFT]])
    assert method.n_instances == 2


def test_in_the_next_frame_several_regions_may_join_one_object() -> None:
    method = mapped(ConceptGraphs(BARE), [[Plate((-0.5, 0.5))], [LEFT, RIGHT]])
    found = method.finish()
    assert len(found) == 1
    assert found.views.tolist() == [[0, 0], [1, 0], [1, 1]]


def test_the_feature_is_the_average_weighted_by_detections() -> None:
    views = [
        [replace(LEFT, feature=axis(0))],
        [replace(LEFT, feature=axis(0))],
        [replace(LEFT, feature=at_cosine(0.6))],
    ]
    found = mapped(ConceptGraphs(BARE), views).finish()
    mean = np.array([(2 * 1 + 0.6) / 3, 0.8 / 3, 0, 0])
    assert np.asarray(found.features)[0] == pytest.approx(mean / np.linalg.norm(mean), abs=1e-6)


def test_objects_of_fewer_than_three_detections_are_left_out_at_the_end() -> None:
    far = Plate((0.6, 0.9))
    assert found_by([[LEFT, far], [LEFT, far], [LEFT]], QUIET) == 1
    assert found_by([[LEFT, far], [LEFT, far], [LEFT, far]], QUIET) == 2
    assert found_by([[LEFT]], QUIET) == 0


def stages(method: ConceptGraphs, plates: list[Plate], index: int) -> set[str]:
    timer = Timer()
    method.update(*look(plates, index), timer)
    return set(timer.take())


def test_every_twentieth_frame_objects_are_denoised_and_overlapping_ones_merged() -> None:
    method = ConceptGraphs(QUIET)
    method.start(SCENE)
    told = [stages(method, [LEFT], index) for index in range(40)]
    assert [k for k, names in enumerate(told) if "denoise" in names] == [19, 39]
    assert [k for k, names in enumerate(told) if "overlap" in names] == [19, 39]
    assert told[1] == {"filter", "backproject", "background", "match", "merge"}


def test_a_frame_without_regions_is_counted_but_not_followed_by_cleaning_up() -> None:
    method = ConceptGraphs(QUIET.model_copy(update={"denoise_interval": 2, "merge_interval": 3}))
    method.start(SCENE)
    told = [stages(method, [LEFT] if shown else [], k) for k, shown in enumerate((1, 0, 1, 1, 1, 0))]
    assert [k for k, names in enumerate(told) if "denoise" in names] == [3]
    assert [k for k, names in enumerate(told) if "overlap" in names] == [2]


def test_the_first_frame_with_regions_is_not_followed_by_cleaning_up() -> None:
    method = ConceptGraphs(QUIET.model_copy(update={"denoise_interval": 1}))
    method.start(SCENE)
    assert "denoise" not in stages(method, [], 0) | stages(method, [LEFT], 1)
    assert "denoise" in stages(method, [LEFT], 2)


def test_filtering_midway_drops_what_was_seen_too_rarely() -> None:
    config = QUIET.model_copy(update={"filter_interval": 3})
    far = Plate((0.6, 0.9))
    assert mapped(ConceptGraphs(QUIET), [[LEFT, far], [LEFT], [LEFT]]).n_instances == 2
    assert mapped(ConceptGraphs(config), [[LEFT, far], [LEFT], [LEFT]]).n_instances == 1


def test_finish_midway_changes_nothing() -> None:
    config = MappingConfig(max_bbox_area_ratio=1.0, denoise_interval=3, merge_interval=4, obj_min_detections=2)
    views = [[LEFT, RIGHT], [RIGHT], [Plate((-0.3, 0.3)), LEFT], [LEFT, RIGHT], [Plate((-0.5, 0.5))]]
    straight = mapped(ConceptGraphs(config), views)
    asked = ConceptGraphs(config)
    asked.start(SCENE)
    for index, plates in enumerate(views):
        asked.update(*look(plates, index), Timer())
        assert contents(asked.finish()) == contents(asked.finish())
    assert contents(asked.finish()) == contents(straight.finish())
    assert len(straight.finish()) > 0


def test_start_forgets_the_scene_before() -> None:
    method = mapped(ConceptGraphs(BARE), [[LEFT], [RIGHT]])
    once = contents(method.finish())
    assert contents(mapped(method, [[LEFT], [RIGHT]]).finish()) == once


def test_each_object_has_points_of_its_own_and_tells_its_views() -> None:
    near = [replace(LEFT, name="desk", score=0.96), replace(RIGHT, name="lamp")]
    again = [replace(LEFT, name="table", score=0.99), replace(RIGHT, name="lamp")]
    found = mapped(ConceptGraphs(BARE), [near, again, [replace(LEFT, name="table", score=0.97)]]).finish()
    assert found.labels is None
    assert found.names == ("table", "lamp")
    assert found.captions == ("a table", "a lamp")
    assert found.view_names == ("desk", "table", "table", "lamp", "lamp")
    assert found.view_scores is not None
    assert found.view_scores.tolist() == pytest.approx([0.96, 0.99, 0.97, 1, 1])
    assert found.views.tolist() == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1]]
    assert found.indices.tolist() == list(range(len(found.points)))
    assert found.points[found.mask(0)][:, 0].max() < 0.05 < found.points[found.mask(1)][:, 0].max()


@pytest.mark.parametrize(("rule", "score"), [("ones", 1.0), ("num-detections", 2.0), ("max-confidence", 0.98)])
def test_scores_are_ones_or_what_is_configured_and_the_caveat_says_so(rule: str, score: float) -> None:
    config = BARE.model_copy(update={"instance_score": rule})
    views = [[replace(LEFT, score=0.96)], [replace(LEFT, score=0.98)]]
    method = mapped(ConceptGraphs(config), views)
    assert method.finish().scores.tolist() == pytest.approx([score])
    assert method.caveat.startswith("the original has no scores")
    assert ("1 for every object" in method.caveat) == (rule == "ones")


def test_nothing_seen_is_an_empty_map() -> None:
    method = mapped(ConceptGraphs(), [[], []])
    assert (len(method.finish()), method.n_points, method.n_instances) == (0, 0, 0)


def test_class_agnostic_means_that_names_decide_nothing() -> None:
    walls = [[replace(LEFT, name="wall", text=axis(1))], [replace(LEFT, name="floor", text=axis(2))]]
    found = mapped(ConceptGraphs(BARE), walls).finish()
    assert len(found) == 1
    assert found.labels is None


def test_the_defaults_are_those_of_the_commands_of_the_readme() -> None:
    config = ConceptGraphs().config
    expected = {
        "stride": 5, "spatial_sim_type": "overlap", "phys_bias": 0, "mask_area_threshold": 25,
        "mask_conf_threshold": 0.95, "max_bbox_area_ratio": 0.5, "min_points_threshold": 16,
        "downsample_voxel_size": 0.025, "dbscan_eps": 0.1, "dbscan_min_points": 10, "denoise_interval": 20,
        "filter_interval": -1, "merge_interval": 20, "obj_min_points": 0, "obj_min_detections": 3,
        "merge_overlap_thresh": 0.7, "merge_visual_sim": 0.8, "merge_text_sim": 0.8, "noise_m": 0.004,
    }  # fmt: skip
    assert {key: getattr(config, key) for key in expected} == expected
    assert config.association_threshold == 1.2
    needs = ConceptGraphs().needs
    assert (needs.masks, needs.crop_ratios, needs.crop_padding_px) == ("class-agnostic", (1.0,), 20)


# What it does unlike others


def opensu3d_finds(views: list[list[Plate]]) -> int:
    """Objects of OpenSU3D on the same frames."""
    method = OpenSU3D(OpenSU3DConfig(border_px=1, border_reference_width=0, crop_ratios=(1.0,)))
    return len(mapped(method, views).finish())


def test_two_touching_objects_of_one_class_stay_apart() -> None:
    # features are alike, so geometry decides: each plate lies in itself (1 + 1), hardly in its neighbour (0.1 + 1)
    assert found_by([[LEFT, RIGHT]] * 3, QUIET) == 2


def test_two_similar_objects_apart_stay_apart() -> None:
    # 0 + 1 is below 1.2, however alike they are
    assert found_by([[Plate((-0.5, -0.2))], [Plate((0.2, 0.5))]]) == 2


def test_features_that_disagree_keep_apart_what_lies_in_one_place() -> None:
    # 1 + 0.1 is below 1.2; OpenSU3D looks at geometry alone
    views = [[LEFT], [replace(LEFT, feature=at_cosine(0.1))]]
    assert found_by(views) == 2
    assert opensu3d_finds(views) == 1
    assert found_by([[LEFT], [replace(LEFT, feature=at_cosine(0.3))]]) == 1


def test_halves_of_an_object_stay_two_until_the_overlap_merge() -> None:
    whole = Plate((-0.5, 0.5))
    views = [[LEFT], [RIGHT], [whole]]
    late = BARE.model_copy(update={"merge_interval": 4})
    early = BARE.model_copy(update={"merge_interval": 3})
    assert mapped(ConceptGraphs(late), views).n_instances == 2
    assert mapped(ConceptGraphs(early), views).n_instances == 1
    assert found_by(views, late) == 1  # the last overlap merge joins them anyhow
    assert found_by(views, late.model_copy(update={"merge_overlap_thresh": 0.0})) == 2
    assert opensu3d_finds(views) == 2


def test_a_run_maps_painted_scenes_and_times_the_stages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    painted = f"{Path(__file__).parent}/painted.py:Painted/a"
    settings = ["conceptgraphs.stride=1", "conceptgraphs.max_bbox_area_ratio=1.0", "conceptgraphs.denoise_interval=2"]
    protocols = ["--protocols", "rooms-semantic", "rooms-instance"]
    out = [*protocols, "--no-pictures", "--jobs", "1", "--out", str(tmp_path / "out")]
    assert main(["run", "--scenes", painted, "--methods", "conceptgraphs", "--set", *settings, *out]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    values = {name: value for one in metrics["results"] for name, value in one["result"]["metrics"].items()}
    assert values["mAcc"] > 0.9
    assert values["AP50"] == 1.0
    (table,) = (tmp_path / "out").rglob("conceptgraphs/updates.csv")
    columns = set(next(csv.reader(table.open())))
    assert columns >= {f"{name}_ms" for name in ("filter", "backproject", "match", "merge", "denoise")}
    assert columns >= {"n_points", "n_instances"}
