"""The steps of OpenSU3D on hand-computed values: back-projection, the ID image, association, fusion, clusters."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from su3d_bench.core.geometry import back_project, valid_depth
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame
from su3d_bench.opensu3d.config import Fusion, OpenSU3DConfig, OverlapRule, Scheme
from su3d_bench.opensu3d.frame_cloud import NO_DETECTION, frame_cloud, paint
from su3d_bench.opensu3d.postprocess import cluster
from su3d_bench.opensu3d.tracking import Overlaps, assign_ids, count_overlaps, fuse_scales, fuse_views, overlap_ratios

INTRINSICS = np.array([[50.0, 0, 15.5], [0, 40.0, 11.5], [0, 0, 1]])


def pose() -> Float64Array:
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(0.8) * cross + (1 - np.cos(0.8)) * cross @ cross
    matrix[:3, 3] = [4.0, -2.0, 1.5]
    return matrix


def frame_of(depth_m: Float32Array) -> Frame:
    return Frame(0, 0.0, np.zeros((*depth_m.shape, 3), np.uint8), depth_m, pose(), INTRINSICS)


def random_depth() -> Float32Array:
    return np.random.default_rng(0).uniform(0.5, 4, (24, 32)).astype(np.float32)


def test_back_projection_follows_the_equation_in_row_major_order() -> None:
    depth_m, pixels = random_depth(), np.random.default_rng(1).random((24, 32)) < 0.3
    expected = []
    for v, u in zip(*np.nonzero(pixels), strict=True):
        in_camera = float(depth_m[v, u]) * np.linalg.inv(INTRINSICS) @ np.array([u, v, 1.0])
        expected.append((pose() @ np.append(in_camera, 1.0))[:3])
    np.testing.assert_allclose(back_project(depth_m, INTRINSICS, pose(), pixels), expected, atol=1e-12)


def test_zero_nan_negative_and_out_of_range_depth_is_dropped() -> None:
    depth_m = np.array([[0.0, np.nan, np.inf, -1.0, 0.05, 0.1, 2.0, 2.01]], np.float32)
    assert valid_depth(depth_m, 0.1, 2.0).tolist() == [[False] * 5 + [True, True, False]]
    depth_m[0, 5] = 0.11
    cloud = frame_cloud(frame_of(depth_m), np.zeros((0, 1, 8), np.bool_), OpenSU3DConfig(depth_min=0.1, depth_max=2.0))
    assert (len(cloud.points), cloud.n_inside) == (2, 0)


def rectangle(rows: slice, columns: slice, height: int = 40, width: int = 60) -> BoolArray:
    mask = np.zeros((height, width), np.bool_)
    mask[rows, columns] = True
    return mask


def test_smaller_mask_is_visible_over_a_larger_one_in_any_order() -> None:
    large, small = rectangle(slice(5, 35), slice(5, 55)), rectangle(slice(10, 20), slice(10, 20))
    for masks, of_large, of_small in (([large, small], 0, 1), ([small, large], 1, 0)):
        image = paint(np.stack(masks), 0, "disc").ids
        assert (image[small] == of_small).all()
        assert (image[large & ~small] == of_large).all()
        assert (image[~large] == NO_DETECTION).all()


def test_ring_of_a_small_mask_erases_only_the_large_mask_around_it() -> None:
    large, small = rectangle(slice(0, 40), slice(0, 60)), rectangle(slice(20, 21), slice(30, 31))
    image = paint(np.stack([large, small]), 3, "disc")
    rows, columns = np.mgrid[:40, :60]
    distance_squared = (rows - 20) ** 2 + (columns - 30) ** 2
    np.testing.assert_array_equal(image.ids == NO_DETECTION, (distance_squared <= 9) & (distance_squared > 0))
    assert image.ids[20, 30] == 1
    assert (image.ids[distance_squared > 9] == 0).all()
    assert image.owner[20, 30] == 1
    assert (image.owner[distance_squared > 0] == 0).all()


@pytest.mark.parametrize(("width", "reference", "expected"), [(1200, 1200, 20), (640, 1200, 11), (640, 0, 20)])
def test_border_is_the_same_fraction_of_every_image(width: int, reference: int, expected: int) -> None:
    assert OpenSU3DConfig(border_reference_width=reference).border_in(width) == expected


def overlaps_of(best: list[int], shared: list[int], n_frame: list[int]) -> Overlaps:
    return Overlaps(np.arange(len(best), dtype=np.int32), np.array(n_frame), np.array(best, np.int32), np.array(shared))


def test_best_scene_segment_has_the_most_matched_pairs() -> None:
    segment = np.array([2, 2, 2, 2, 2, 5, 5, 9], np.int32)
    matched_id = np.array([7, 7, 3, 0, 7, 3, 3, 0], np.int32)
    overlaps = count_overlaps(segment, matched_id)
    assert overlaps.segments.tolist() == [2, 5, 9]
    assert overlaps.n_frame.tolist() == [5, 2, 1]
    assert overlaps.best.tolist() == [7, 3, 0]
    assert overlaps.shared.tolist() == [3, 2, 0]


def test_scene_segments_with_equally_many_pairs_prefer_the_lower_id() -> None:
    overlaps = count_overlaps(np.zeros(5, np.int32), np.array([8, 4, 8, 4, 11], np.int32))
    assert (overlaps.best.tolist(), overlaps.shared.tolist()) == ([4], [2])


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("smaller-segment", [30 / 40, 30 / 60, 0.0]),  # over min(100, 40) and min(60, 500)
        ("frame-segment", [30 / 100, 30 / 60, 0.0]),
        ("as-printed", [1.0, 1.0, 0.0]),  # max(c) / min(c_f, max(c)), with c_f never below the matched pairs
    ],
)
def test_each_overlap_rule_gives_its_ratio(rule: OverlapRule, expected: list[float]) -> None:
    overlaps = overlaps_of([4, 6, 0], [30, 30, 0], [100, 60, 50])
    np.testing.assert_allclose(overlap_ratios(overlaps, np.array([40, 500, 0]), rule), expected)


def test_ratio_equal_to_the_threshold_joins_and_one_below_does_not() -> None:
    overlaps = overlaps_of([4, 6, 0], [3, 3, 0], [10, 11, 5])
    ratios = overlap_ratios(overlaps, np.array([10, 11, 0]), "smaller-segment")
    ids, next_id = assign_ids(overlaps, ratios, 0.3, 20)
    assert ids.tolist() == [4, 20, 21]
    assert next_id == 22


def test_two_frame_segments_may_join_one_scene_segment() -> None:
    ids, next_id = assign_ids(overlaps_of([4, 4], [9, 8], [10, 10]), np.array([0.9, 0.8]), 0.3, 5)
    assert (ids.tolist(), next_id) == ([4, 4], 5)


CROPS = np.array([[[0.6, 0.8], [1.0, 0.0], [0.0, 1.0]]])  # one region, crops at ratios 0.8, 1.0, 1.2


def test_weighted_multi_scale_fusion_uses_the_cosine_with_the_crop_at_ratio_one() -> None:
    # cosines with (1, 0): 0.6, 1, 0
    expected = [[(0.6 * 0.6 + 1.0) / 3, 0.6 * 0.8 / 3]]
    np.testing.assert_allclose(fuse_scales(CROPS, (0.8, 1.0, 1.2), "weighted"), expected)
    np.testing.assert_allclose(fuse_scales(CROPS[:, [1, 0, 2]], (1.0, 0.8, 1.2), "weighted"), expected)


def test_global_multi_view_fusion_adds_the_weighted_global_feature_inside_the_mean() -> None:
    views, images = np.array([[1.0, 0.0], [0.0, 2.0]]), np.array([[0.6, 0.8], [0.0, 1.0]])
    # cosines 0.6 and 1: ((1, 0) + 0.6 (0.6, 0.8) + (0, 2) + (0, 1)) / 2
    np.testing.assert_allclose(fuse_views(views, images, "global"), [1.36 / 2, 3.48 / 2])


@pytest.mark.parametrize(
    ("scheme", "expected"),
    [
        ("scheme1", Fusion("direct", "direct", (0.8, 1.0, 1.2))),
        ("scheme2", Fusion("direct", "global", (0.8, 1.0, 1.2))),
        ("scheme3", Fusion("weighted", "direct", (1.0, 2.0, 4.0))),
        ("scheme4", Fusion("weighted", "global", (1.0, 2.0, 4.0))),
        ("scheme4-narrow", Fusion("weighted", "global", (0.8, 1.0, 1.2))),
    ],
)
def test_schemes_are_those_of_the_paper(scheme: Scheme, expected: Fusion) -> None:
    config = OpenSU3DConfig(scheme=scheme)
    assert config.fusion == expected
    assert config.needs.crop_ratios == expected.crop_ratios


def assert_same_labels(points: Float64Array, eps: float, min_points: int) -> None:
    config = OpenSU3DConfig(dbscan_eps=eps, dbscan_min_points=min_points)
    expected = DBSCAN(eps=eps, min_samples=min_points).fit_predict(points)
    np.testing.assert_array_equal(cluster(points, config), expected)


# Steps of a quarter of eps put many points at exactly eps from each other; binary fractions are not rounded.
lattice = st.lists(st.tuples(*[st.integers(-12, 12)] * 3), min_size=1, max_size=120)


@settings(max_examples=60, deadline=None)
@given(lattice, st.sampled_from([0.0, -3.75, 1e4]), st.sampled_from([0.125, 0.25]), st.integers(1, 12))
def test_cluster_labels_match_scikit_learn_on_lattices(
    points: list[tuple[int, ...]], offset: float, eps: float, min_points: int
) -> None:
    assert_same_labels(np.array(points, np.float64) * eps / 4 + offset, eps, min_points)


def test_border_point_between_two_clusters_belongs_to_the_first() -> None:
    row = np.column_stack([np.arange(5) * 0.02, np.zeros((5, 2))])
    other = row + np.array([0.26, 0, 0])
    between = np.array([[0.17, 0, 0]])  # 0.09 from the nearest of either
    for order in ([row, between, other], [other, between, row]):
        points = np.concatenate(order)
        assert cluster(points, OpenSU3DConfig(dbscan_min_points=5)).tolist() == [0] * 6 + [1] * 5
        assert_same_labels(points, 0.1, 5)
