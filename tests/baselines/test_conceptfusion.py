"""ConceptFusion on hand-worked values: the mixing of features, the field of pixels, the means over views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_room import SIZE, write_box_room
from scannet_scan import SCAN, write_recording

from su3d_bench.baselines.conceptfusion.method import (
    ConceptFusion,
    ConceptFusionConfig,
    ConceptFusionSam,
    mixed_features,
    mixing_weights,
    paint,
)
from su3d_bench.baselines.conceptfusion.point_fusion import FeatureTable
from su3d_bench.core.errors import DataError
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Float32Array, Frame, SceneInfo
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.datasets.scannet.dataset import ScanNet
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.pipeline import OpenSU3D

E1, E2 = np.eye(2)
BOX = np.array([0, 0, 2, 2], np.float32)
SIDE = 8
INTRINSICS = np.array([[SIDE, 0, (SIDE - 1) / 2], [0, SIDE, (SIDE - 1) / 2], [0, 0, 1.0]])
SCENE = SceneInfo("made", "wall", 2, 1, "rendered-rooms")


def rows(*features: Any) -> Float32Array:
    return np.array(features, np.float32)


def unit(*values: float) -> np.ndarray:
    direction: np.ndarray = np.array(values) / np.linalg.norm(values)
    return direction


# ---- 4.1: weights and mixtures


def test_weights_are_a_softmax_over_the_regions_of_their_cosines_with_the_image() -> None:
    e = np.e
    assert mixing_weights(rows(*E1), rows(E1, E2), "softmax") == pytest.approx([e / (e + 1), 1 / (e + 1)])
    half = mixing_weights(rows(*E1), rows(E1, E2), "softmax", temperature=0.5)
    assert half == pytest.approx([e**2 / (e**2 + 1), 1 / (e**2 + 1)])


def test_uniqueness_adds_the_mean_cosine_with_the_other_regions() -> None:
    regions = rows(E1, E2, E2)  # cosines with the image 1 0 0, with the others 0 1/2 1/2
    scores = np.exp([1.0, 0.5, 0.5])
    assert mixing_weights(rows(*E1), regions, "uniqueness") == pytest.approx(scores / scores.sum())
    plain = np.exp([1.0, 0.0, 0.0])
    assert mixing_weights(rows(*E1), regions, "softmax") == pytest.approx(plain / plain.sum())


@pytest.mark.parametrize("rule", ["softmax", "uniqueness"])
def test_one_region_alone_has_nothing_of_its_own_feature(rule: Any) -> None:
    weights = mixing_weights(rows(*E1), rows(E2), rule)
    assert weights.tolist() == [1.0]
    assert mixed_features(rows(*E1), rows(E2), weights).tolist() == [[1.0, 0.0]]


def test_the_feature_of_a_region_is_the_normalised_mixture() -> None:
    mixed = mixed_features(rows(*E1), rows(E2, E1), np.array([0.25, 0.75]))
    assert mixed[0] == pytest.approx(unit(0.25, 0.75))
    assert mixed[1] == pytest.approx(E1)


# ---- 4.1: the field


def field_of(features: list[np.ndarray], overlaps: Any = "sum", boxes: Any = None) -> np.ndarray:
    """The field of one pixel under all of ``features``, in their order."""
    masks = np.ones((len(features), 1, 1), bool)
    boxes = np.tile(BOX, (len(features), 1)) if boxes is None else rows(*boxes)
    painted = paint(masks, boxes, np.array(features), overlaps, 1, 1)
    of_pixel: np.ndarray = painted.features[painted.row[0, 0]].astype(float)
    return of_pixel


def test_where_masks_overlap_the_last_counts_as_much_as_all_before_it() -> None:
    assert field_of([E1, E2]) == pytest.approx(unit(1, 1), abs=1e-3)
    assert field_of([E1, E2, E2]) == pytest.approx(unit(0.5**0.5, 0.5**0.5 + 1), abs=1e-3)
    assert field_of([E2, E2, E1]) == pytest.approx(unit(1, 1), abs=1e-3)


def test_small_over_large_shows_the_mask_of_the_smallest_box_alone() -> None:
    boxes = [(0, 0, 4, 1), (0, 0, 3, 3), (0, 0, 2, 1)]
    assert field_of([E1, E2, unit(1, 1)], "small-over-large", boxes) == pytest.approx(unit(1, 1), abs=1e-3)
    assert field_of([E1, E2], "small-over-large", boxes[:2]) == pytest.approx(E1)
    assert field_of([E1, E2], "small-over-large", [BOX, BOX]) == pytest.approx(E1)


def test_pixels_of_no_mask_stay_zero_and_a_frame_of_no_mask_is_all_zero() -> None:
    masks = np.array([[[True, False], [False, False]]])
    painted = paint(masks, BOX[None], E1[None], "sum", 2, 2)
    assert painted.features[painted.row].tolist() == [[[1, 0], [0, 0]], [[0, 0], [0, 0]]]
    empty = paint(masks[:0], BOX[None][:0], np.zeros((0, 2)), "sum", 2, 2)
    assert empty.features[empty.row].tolist() == [[[0, 0], [0, 0]], [[0, 0], [0, 0]]]


@pytest.mark.parametrize("overlaps", ["sum", "small-over-large"])
def test_the_field_is_that_of_painting_mask_after_mask_at_full_size(overlaps: Any) -> None:
    rng = np.random.default_rng(2)
    masks, features = rng.random((11, 12, 9)) < 0.3, rng.normal(size=(11, 5))
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    boxes = rng.integers(0, 5, (11, 4)).astype(np.float32) + rows(0, 0, 5, 5)
    whole = np.zeros((12, 9, 5))
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    for i in range(11) if overlaps == "sum" else np.argsort(areas, kind="stable")[::-1]:
        painted = whole[masks[i]] + features[i] if overlaps == "sum" else features[i]
        whole[masks[i]] = painted / np.linalg.norm(painted, axis=-1, keepdims=True)
    painted_small = paint(masks, boxes, features, overlaps, 4, 3)
    np.testing.assert_array_equal(painted_small.features[painted_small.row], whole[::3, ::3].astype(np.float16))


# ---- 4.2: means over views


def wall(index: int = 0, depth_m: float = 1.0) -> Frame:
    """A wall 1 m before the world's origin, seen from ``depth_m`` away."""
    camera = np.eye(4)
    camera[2, 3] = 1.0 - depth_m
    depth = np.full((SIDE, SIDE), depth_m, np.float32)
    return Frame(index, 0.0, np.zeros((SIDE, SIDE, 3), np.uint8), depth, camera, INTRINSICS)


def seen(index: int, *parts: tuple[Any, np.ndarray], whole: np.ndarray | None = None) -> Detections:
    """Regions at slices of columns; by default the image's feature is theirs, so that the mixture is too."""
    masks = np.zeros((len(parts), SIDE, SIDE), bool)
    for mask, (columns, _) in zip(masks, parts, strict=True):
        mask[:, columns] = True
    features = np.array([feature for _, feature in parts], np.float32).reshape(len(parts), 2)
    return Detections(
        frame_index=index,
        masks=masks,
        boxes=np.tile(rows(0, 0, SIDE, SIDE), (len(parts), 1)),
        scores=np.ones(len(parts), np.float32),
        names=("thing",) * len(parts),
        captions=("",) * len(parts),
        crop_ratios=(1.0,),
        crop_features=features[:, None],
        global_feature=(features[0] if whole is None else whole.astype(np.float32)) if parts else rows(0, 0),
    )


def fused(*updates: tuple[Frame, Detections], **settings: Any) -> ConceptFusion:
    method = ConceptFusion(ConceptFusionConfig(height=SIDE, width=SIDE, **settings))
    method.start(SCENE)
    for frame, detections in updates:
        method.update(frame, detections, Timer())
    return method


def alpha_at(x: float, y: float, z: float) -> float:
    return float(np.exp(-(x * x + y * y + z * z) / (2 * 0.6**2)))


EVERYWHERE = slice(0, SIDE)
A, B = unit(3, 4), unit(4, 3)


def test_two_observations_give_the_mean_weighted_by_alpha_which_is_not_normalised() -> None:
    method = fused((wall(0), seen(0, (EVERYWHERE, A))), (wall(1), seen(1, (EVERYWHERE, B))))
    prediction = method.finish()
    assert method.n_points == len(prediction.points) == SIDE * SIDE
    np.testing.assert_allclose(prediction.features, np.tile((A + B) / 2, (SIDE * SIDE, 1)), atol=1e-3)
    assert np.linalg.norm(prediction.features[0].astype(float)) < 0.995


def test_a_nearer_view_counts_more_by_its_distance_in_the_camera_frame() -> None:
    """The camera steps back by 3 cm: the same pixels see nearly the same points with another alpha."""
    method = fused((wall(0, 0.5), seen(0, (EVERYWHERE, A))), (wall(1, 0.52), seen(1, (EVERYWHERE, B))), distance_m=0.05)
    x = -(SIDE - 1) / 2 / SIDE
    near, far = alpha_at(0.5 * x, 0.5 * x, 0.5), alpha_at(0.52 * x, 0.52 * x, 0.52)
    expected = (near * A + far * B) / (near + far)
    assert method.n_points == SIDE * SIDE
    np.testing.assert_allclose(method.finish().features[0], expected, atol=1e-3)


def test_a_pixel_without_a_mask_makes_a_point_of_zero_feature_whose_confidence_dilutes_what_comes_later() -> None:
    left = slice(0, SIDE // 2)
    method = fused((wall(0), seen(0, (left, A))))
    first = method.finish()
    bare = ~(first.features != 0).any(axis=1)
    assert len(first.points) == SIDE * SIDE and bare.sum() == SIDE * SIDE // 2
    method.update(wall(1), seen(1, (EVERYWHERE, B)), Timer())
    after = method.finish().features.astype(float)
    np.testing.assert_allclose(after[bare], np.tile(B / 2, (bare.sum(), 1)), atol=1e-3)


def test_a_pixel_without_a_mask_leaves_the_feature_of_its_point_as_it_is() -> None:
    method = fused((wall(0), seen(0, (EVERYWHERE, A))), (wall(1), seen(1)), (wall(2), seen(2, (EVERYWHERE, B))))
    np.testing.assert_allclose(method.finish().features[0], (A + B) / 2, atol=1e-3)


def test_a_feature_with_a_zero_channel_is_never_averaged_in_unless_any_channel_will_do() -> None:
    updates = (wall(0), seen(0, (EVERYWHERE, E1))), (wall(1), seen(1, (EVERYWHERE, E2)))
    assert fused(*updates).finish().features[0].tolist() == [1.0, 0.0]
    assert fused(*updates, valid_features="any-channel").finish().features[0].tolist() == [0.5, 0.5]


def test_the_first_seen_feature_with_a_zero_channel_keeps_its_weight_against_a_full_one() -> None:
    method = fused((wall(0), seen(0, (EVERYWHERE, E1))), (wall(1), seen(1, (EVERYWHERE, A))))
    np.testing.assert_allclose(method.finish().features[0], (E1 + A) / 2, atol=1e-3)


# ---- products in half precision, as gradslam has them


def table_of(features: np.ndarray, confidences: np.ndarray, place: Any = "memory") -> FeatureTable:
    table = FeatureTable(features.shape[1], place)
    table.append(features.astype(np.float16), np.arange(len(features), dtype=np.int32), confidences)
    return table


@pytest.mark.parametrize("place", ["memory", "disk"])
def test_in_half_precision_a_confidence_at_its_floor_takes_the_feature_of_the_first_image_with_it(place: Any) -> None:
    features = np.full((3, 4), 0.03)
    table = table_of(features, np.array([1e-7, 0.5, 1e-7]), place)
    none = np.zeros(0, np.int64)
    table.average(none, features.astype(np.float16), none.astype(np.int32), np.zeros(0))
    assert (table.features() != 0).all()
    table.average_in_half(none, features.astype(np.float16), none.astype(np.int32), np.zeros(0))
    assert (table.features() != 0).any(axis=1).tolist() == [False, True, False]
    table.append(features.astype(np.float16), np.arange(3, dtype=np.int32), np.full(3, 1e-7))
    for _ in range(1000):  # of single precision by now: not lost, and kept from overflow
        table.average_in_half(none, features.astype(np.float16), none.astype(np.int32), np.zeros(0))
    np.testing.assert_array_equal(table.features()[3:], features.astype(np.float16))


def test_products_in_half_precision_are_those_of_whole_arrays() -> None:
    """Against gradslam's formula for all points at once, half in the first step and single from then on."""
    rng = np.random.default_rng(5)
    n, d = 40, 16
    confidences = np.where(rng.random(n) < 0.4, 1e-7, rng.random(n))
    first = unit_rows(rng.normal(size=(n, d)))
    table = table_of(first, confidences)
    whole: np.ndarray = first.astype(np.float16)
    for step in range(5):
        point = np.sort(rng.choice(n, 12, replace=False))
        seen = unit_rows(rng.normal(size=(12, d))).astype(np.float16)
        weights = np.where(rng.random(12) < 0.4, 1e-7, rng.random(12))
        table.average_in_half(point, seen, np.arange(12, dtype=np.int32), weights)
        of_map, of_image = np.zeros((n, d), np.float16), np.zeros(n)
        of_map[point], of_image[point] = seen, weights
        product = confidences.astype(np.float16)[:, None] * whole + of_image.astype(np.float16)[:, None] * of_map
        assert product.dtype == (np.float16 if step == 0 else np.float32)
        confidences = confidences + of_image
        whole = product.astype(np.float32) / confidences[:, None].astype(np.float32)
        shown = table.features().astype(float)
        lengths = np.maximum(np.linalg.norm(whole, axis=1), 1e-9)[:, None]
        assert ((shown != 0).any(axis=1) == (whole != 0).any(axis=1)).all()
        shown /= np.maximum(np.linalg.norm(shown, axis=1), 1e-9)[:, None]
        np.testing.assert_allclose(shown, whole / lengths, atol=3e-3)
    np.testing.assert_allclose(table.confidences, confidences)


def unit_rows(values: np.ndarray) -> np.ndarray:
    return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True))


def test_a_wall_beyond_the_floor_of_confidence_loses_its_feature_in_half_precision_alone() -> None:
    dim = unit(3, 4) / 100
    updates = (wall(0, 4.0), seen(0, (EVERYWHERE, A))), (wall(1, 4.0), seen(1))
    assert ConceptFusion.presets["half-products"] == {"products": "half"}
    for products, alive in (("single", True), ("half", False)):
        method = fused(updates[0], products=products, features_in="memory")
        assert method._features is not None
        method._features._held[:] = dim  # as small as those of a thousand dimensions
        method.update(*updates[1], Timer())
        assert (method.finish().features != 0).all() == alive


def test_the_map_grows_by_what_no_point_was_seen_at() -> None:
    moved = wall(1)
    camera = moved.camera_to_world.copy()
    camera[0, 3] = 0.5  # four pixels of 1/8 m
    method = fused((wall(0), seen(0, (EVERYWHERE, A))), (replace(moved, camera_to_world=camera), seen(1)))
    assert method.n_points == SIDE * SIDE + SIDE * SIDE // 2
    assert method.map_bytes > method.n_points * 2 * 2


def test_finish_midway_changes_nothing() -> None:
    updates = [(wall(k), seen(k, (EVERYWHERE, (A, B)[k % 2]))) for k in range(4)]
    whole = fused(*updates).finish()
    method = fused(*updates[:2])
    method.finish()
    for frame, detections in updates[2:]:
        method.update(frame, detections, Timer())
    np.testing.assert_array_equal(method.finish().features, whole.features)
    np.testing.assert_array_equal(method.finish().points, whole.points)


def test_a_map_of_nothing_is_empty_and_a_second_scene_starts_anew() -> None:
    method = fused()
    assert method.finish().points.shape == (0, 3) and len(method.finish().features) == 0
    method.update(wall(0), seen(0, (EVERYWHERE, A)), Timer())
    method.start(SCENE)
    assert method.n_points == len(method.finish().features) == 0


def test_every_update_books_its_stages() -> None:
    timer = Timer()
    method = fused()
    method.update(wall(0), seen(0, (EVERYWHERE, A)), timer)
    assert list(timer.take()) == ["backproject", "paint", "match", "fuse", "insert"]


def test_what_does_not_fit_is_one_line() -> None:
    method = fused((wall(0), seen(0, (EVERYWHERE, A))))
    with pytest.raises(DataError, match="frame 1: the detections are those of frame 2"):
        method.update(wall(1), seen(2), Timer())
    three = replace(seen(1), global_feature=rows(1, 0, 0))
    with pytest.raises(DataError, match="frame 1: features have 3 dimensions, those of the map have 2; make all with"):
        method.update(wall(1), three, Timer())
    small = replace(seen(1, (EVERYWHERE, A)), masks=np.ones((1, 4, 6), bool))
    with pytest.raises(DataError, match="frame 1: masks are 6x4 and the image is 8x8"):
        method.update(wall(1), small, Timer())


def test_frames_of_recordings_fuse_into_the_room_that_they_show(tmp_path: Path) -> None:
    """Replica's layout and ScanNet's .sens files, at the size of the depth image and below."""
    write_box_room(tmp_path, n_frames=4)
    folder = tmp_path / "scans" / SCAN
    folder.mkdir(parents=True)
    write_recording(folder / f"{SCAN}.sens", n_frames=4)
    for dataset, scene, far in ((Replica(tmp_path), "room0", SIZE), (ScanNet(tmp_path), SCAN, None)):
        frames = dataset.frames(scene, 1)
        height, width = frames[0].depth_m.shape
        method = ConceptFusion(ConceptFusionConfig(height=height, width=width))
        method.start(SCENE)
        for k, frame in enumerate(frames):
            none = replace(seen(frame.index), masks=np.zeros((0, height, width), bool))
            method.update(frame, none, Timer())
            assert k or method.n_points == (frame.depth_m > 0).sum()
        points = method.finish().points.astype(float)
        assert len(points) < (len(frames) - 1) * height * width  # the views overlap
        off = np.abs(points[:, 2]) if far is None else np.minimum(np.abs(points), np.abs(points - far)).min(axis=1)
        assert off.max() < 0.02


# ---- what it does unlike the others


def test_the_two_differ_in_their_masks_and_in_the_term_that_goes_with_them() -> None:
    paper, sam = ConceptFusion(), ConceptFusionSam()
    assert (paper.needs.masks, sam.needs.masks) == ("grounded", "class-agnostic")
    regions = (slice(0, 2), A), (slice(2, 5), B), (slice(5, 8), B)
    features = []
    for method in (ConceptFusion, ConceptFusionSam):
        one = method(method.Config(height=SIDE, width=SIDE))
        one.start(SCENE)
        one.update(wall(0), seen(0, *regions, whole=unit(1, 5)), Timer())
        features.append(one.finish().features.astype(float))
    assert np.abs(features[0] - features[1]).max() > 1e-3


def test_masks_that_bleed_over_a_border_smear_its_points_but_not_the_instances_of_opensu3d() -> None:
    """Two objects side by side; in every second image the left mask reaches a column into the right object."""
    true_parts = (slice(0, 4), A), (slice(4, 8), B)
    bleeding = (slice(0, 5), A), (slice(5, 8), B)
    updates = [(wall(k), seen(k, *(bleeding if k % 2 else true_parts), whole=unit(7, 7))) for k in range(4)]
    prediction = fused(*updates).finish()
    features = prediction.features.astype(float).reshape(SIDE, SIDE, 2)
    left, border, right = features[:, 1], features[:, 4], features[:, 7]
    assert np.ptp(features.reshape(-1, 2), axis=0).max() > 0.05
    np.testing.assert_allclose(border, (left + right) / 2, atol=2e-3)  # neither the one nor the other

    config = OpenSU3DConfig(border_px=0, frame_voxel=0, crop_ratios=(1.0,), dbscan_eps=0.3, dbscan_min_points=2)
    instances = OpenSU3D(config)
    instances.start(SCENE)
    for frame, detections in updates:
        instances.update(frame, detections, Timer())
    found = instances.finish()
    assert len(found) == 2 and found.features is not None
    for k, feature in enumerate((A, B)):
        np.testing.assert_allclose(found.features[k] / np.linalg.norm(found.features[k]), feature, atol=1e-5)
    assert sum(len(found.mask(k)) for k in range(2)) == SIDE * SIDE  # each point one instance, one feature each
