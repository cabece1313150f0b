"""ConceptGraphs from the regions of an image to clouds: averages, clusters, boxes, filters, subtraction, lifting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plates import DIMENSION, HEIGHT, QUIET, WIDTH, Plate, block, look

from su3d_bench.baselines.conceptgraphs.objects import (
    LiftedRegion,
    MappingConfig,
    bounding_box,
    density_clusters,
    kept_regions,
    largest_cluster,
    lift,
    subtract_contained,
    voxel_average,
)
from su3d_bench.core.geometry import back_project
from su3d_bench.core.types import Detections

RNG = np.random.default_rng(3)
LEFT = Plate((-0.5, 0.0))
PUBLISHED = MappingConfig()


# Clouds


def test_voxel_average_is_the_mean_on_a_grid_half_a_voxel_below_the_minimum() -> None:
    along_x = np.array([5.0, 5.01, 5.013, 5.04])  # cells 0, 0, 1, 2 of 25 mm from 4.9875 m
    points = np.stack([along_x, np.zeros(4), np.zeros(4)], axis=1)
    assert voxel_average(points, 0.025)[:, 0].tolist() == pytest.approx([5.005, 5.013, 5.04])


def test_voxel_averages_match_open3d() -> None:
    import open3d as o3d

    points = RNG.normal(0, 0.3, (4000, 3)) + np.array([10, -20, 30])
    theirs = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(0.1)
    ours = voxel_average(points, 0.1)
    assert sorted(map(tuple, ours)) == sorted(map(tuple, np.asarray(theirs.points)))


def row_of_points(n: int, start: float, step: float = 0.01) -> np.ndarray:
    return np.stack([start + step * np.arange(n), np.zeros(n), np.zeros(n)], axis=1)


@pytest.mark.parametrize("min_points", [1, 4, 10, 40])
def test_dbscan_clusters_match_open3d(min_points: int) -> None:
    import open3d as o3d

    points = np.concatenate([RNG.random((600, 3)), RNG.normal(2, 0.05, (300, 3)), row_of_points(40, 3.0, 0.05)])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    for eps in (0.06, 0.1, 0.15):
        theirs = np.asarray(cloud.cluster_dbscan(eps, min_points))
        assert density_clusters(points, eps, min_points).tolist() == theirs.tolist()
    assert density_clusters(np.zeros((0, 3)), 0.1, 10).tolist() == []


def test_cloud_without_a_cluster_of_five_is_kept() -> None:
    scattered = row_of_points(30, 0.0, step=0.2)
    assert largest_cluster(scattered, 0.1, 10) is scattered
    four = np.concatenate([row_of_points(4, 0.0), row_of_points(3, 1.0)])
    assert largest_cluster(four, 0.1, 2) is four
    five = np.concatenate([row_of_points(5, 0.0), row_of_points(3, 1.0)])
    assert len(largest_cluster(five, 0.1, 2)) == 5


def test_box_is_aligned_to_the_object_or_with_three_points_to_the_world() -> None:
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    points = block((0, 0, 0), (1.0, 0.4, 0.2)) @ turn.T
    box = bounding_box(points, oriented=True)
    # the last points are a step before the end; the hull is joggled, so not all corners count
    assert sorted(box.sizes) == pytest.approx([0.15, 0.35, 0.95], rel=0.15)
    assert abs(box.rotation[:, np.argmax(box.sizes)] @ turn[:, 0]) > 0.99
    assert box.distance_outside(points).max() < 1e-6
    for flat in (bounding_box(points, oriented=False), bounding_box(points[:3], oriented=True)):
        assert flat.rotation.tolist() == np.eye(3).tolist()
    assert bounding_box(points, oriented=False).sizes == pytest.approx(np.ptp(points, axis=0))


# Regions


def region(area_px: int = 400, box: tuple[int, int, int, int] = (0, 0, 40, 40), score: float = 1.0) -> Detections:
    """One region of that many pixels in a 96x72 image; the box may differ from the mask's."""
    mask = (np.arange(WIDTH * HEIGHT) < area_px).reshape(1, HEIGHT, WIDTH)
    features = np.ones((1, 1, DIMENSION), np.float32)
    scores = np.array([score], np.float32)
    return Detections(0, mask, np.array([box], np.float32), scores, ("item",), ("",), (1.0,), features, features[0, 0])


def is_kept(one: Detections, config: MappingConfig = PUBLISHED, *, background: bool = False) -> bool:
    return len(kept_regions(one, np.array([background]), config)) == 1


def test_masks_below_25_pixels_are_excluded_and_below_10_regardless_of_settings() -> None:
    assert is_kept(region(25))
    assert not is_kept(region(24))
    config = MappingConfig(mask_area_threshold=3)
    assert is_kept(region(10), config)
    assert not is_kept(region(9), config)


def boxes_and_masks(*boxes: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    masks = np.zeros((len(boxes), 40, 40), np.bool_)
    for mask, (x0, y0, x1, y1) in zip(masks, boxes, strict=True):
        mask[y0:y1, x0:x1] = True
    return np.array(boxes, np.float32), masks


def test_contained_mask_is_subtracted_from_its_container() -> None:
    result = subtract_contained(*boxes_and_masks((0, 0, 20, 20), (5, 5, 15, 15)))
    assert result.sum(axis=(1, 2)).tolist() == [300, 100]
    assert not (result[0] & result[1]).any()


def test_containment_thresholds_are_070_and_080() -> None:
    def cut(*boxes: tuple[int, int, int, int]) -> int:
        boxes_px, masks = boxes_and_masks(*boxes)
        return int(masks[0].sum() - subtract_contained(boxes_px, masks)[0].sum())

    assert cut((0, 0, 10, 10), (0, 0, 10, 7)) == 0  # 70 of 100: not below 0.7
    assert cut((0, 0, 10, 10), (0, 0, 3, 23)) == 0  # 30 of 69 is less than 0.8
    assert cut((0, 0, 10, 10), (6, 0, 11, 5)) == 0  # 20 of 25: not above 0.8
    assert cut((0, 0, 20, 20), (11, 0, 21, 10)) == 90  # 90 of 100


def lifted(plates: list[Plate], config: MappingConfig = QUIET, index: int = 0, seed: int = 0) -> list[LiftedRegion]:
    frame, detections = look(plates, index)
    return list(lift(frame, np.arange(len(detections)), detections.masks, config, seed))


def test_without_noise_a_region_becomes_the_voxel_averages_of_its_pixels() -> None:
    frame, detections = look([LEFT])
    points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, detections.masks[0])
    (one,) = lifted([LEFT])
    assert one.points == pytest.approx(voxel_average(points, 0.025), abs=1e-12)


def test_noise_of_4_mm_depends_on_seed_and_frame() -> None:
    fine = QUIET.model_copy(update={"downsample_voxel_size": 1e-4, "dbscan_remove_noise": False})
    noisy = fine.model_copy(update={"noise_m": 0.004})
    (still,), (moved,) = lifted([LEFT], fine), lifted([LEFT], noisy)
    offsets = moved.points - still.points
    assert offsets.std(axis=0) == pytest.approx(np.full(3, 0.004), rel=0.1)
    assert np.abs(offsets.mean(axis=0)).max() < 5e-4
    assert lifted([LEFT], noisy)[0].points.tobytes() == moved.points.tobytes()
    assert lifted([LEFT], noisy, seed=1)[0].points.tobytes() != moved.points.tobytes()
    assert lifted([LEFT], noisy, index=1)[0].points.tobytes() != moved.points.tobytes()


def test_region_with_fewer_than_16_valid_points_is_dropped() -> None:
    frame, detections = look([LEFT])
    rows, columns = np.nonzero(detections.masks[0])
    depth = frame.depth_m.copy()
    depth[rows[16:], columns[16:]] = 0
    # 16 pixels in a row 2 cm apart: without noise their box has no volume
    noisy = QUIET.model_copy(update={"noise_m": 0.004})
    assert len(list(lift(replace(frame, depth_m=depth), np.array([0]), detections.masks, noisy, 0))) == 1
    depth[rows[15], columns[15]] = np.nan
    assert not list(lift(replace(frame, depth_m=depth), np.array([0]), detections.masks, noisy, 0))
