"""ConceptFusion on hand-worked values: mixing of features, the pixel field, means over views."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from su3d_bench.baselines.conceptfusion.method import (
    ConceptFusion,
    ConceptFusionConfig,
    mixed_features,
    mixing_weights,
    paint,
)
from su3d_bench.baselines.conceptfusion.point_fusion import FeatureTable
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Float32Array, Frame, SceneInfo

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


def test_weights_are_a_softmax_over_cosines_of_regions_and_image() -> None:
    e = np.e
    assert mixing_weights(rows(*E1), rows(E1, E2), "softmax") == pytest.approx([e / (e + 1), 1 / (e + 1)])
    half = mixing_weights(rows(*E1), rows(E1, E2), "softmax", temperature=0.5)
    assert half == pytest.approx([e**2 / (e**2 + 1), 1 / (e**2 + 1)])


def test_region_feature_is_the_normalised_mixture() -> None:
    mixed = mixed_features(rows(*E1), rows(E2, E1), np.array([0.25, 0.75]))
    assert mixed[0] == pytest.approx(unit(0.25, 0.75))
    assert mixed[1] == pytest.approx(E1)


# ---- 4.1: the field


def field_of(features: list[np.ndarray], overlaps: Any = "sum", boxes: Any = None) -> np.ndarray:
    """The field of one pixel under all ``features``, in order."""
    masks = np.ones((len(features), 1, 1), bool)
    boxes = np.tile(BOX, (len(features), 1)) if boxes is None else rows(*boxes)
    painted = paint(masks, boxes, np.array(features), overlaps, 1, 1)
    of_pixel: np.ndarray = painted.features[painted.row[0, 0]].astype(float)
    return of_pixel


def test_last_of_overlapping_masks_counts_as_much_as_all_before() -> None:
    assert field_of([E1, E2]) == pytest.approx(unit(1, 1), abs=1e-3)
    assert field_of([E1, E2, E2]) == pytest.approx(unit(0.5**0.5, 0.5**0.5 + 1), abs=1e-3)
    assert field_of([E2, E2, E1]) == pytest.approx(unit(1, 1), abs=1e-3)


@pytest.mark.parametrize("overlaps", ["sum", "small-over-large"])
def test_field_matches_painting_masks_at_full_size(overlaps: Any) -> None:
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
    """A wall 1 m in front of the world's origin, seen from ``depth_m`` away."""
    camera = np.eye(4)
    camera[2, 3] = 1.0 - depth_m
    depth = np.full((SIDE, SIDE), depth_m, np.float32)
    return Frame(index, 0.0, np.zeros((SIDE, SIDE, 3), np.uint8), depth, camera, INTRINSICS)


def seen(index: int, *parts: tuple[Any, np.ndarray], whole: np.ndarray | None = None) -> Detections:
    """Regions at slices of columns; by default the image's feature equals theirs, and so does the mixture."""
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


EVERYWHERE = slice(0, SIDE)
A, B = unit(3, 4), unit(4, 3)


def test_two_observations_give_the_unnormalised_mean_weighted_by_alpha() -> None:
    method = fused((wall(0), seen(0, (EVERYWHERE, A))), (wall(1), seen(1, (EVERYWHERE, B))))
    prediction = method.finish()
    assert method.n_points == len(prediction.points) == SIDE * SIDE
    np.testing.assert_allclose(prediction.features, np.tile((A + B) / 2, (SIDE * SIDE, 1)), atol=1e-3)
    assert np.linalg.norm(prediction.features[0].astype(float)) < 0.995


def test_pixel_without_mask_creates_a_zero_feature_that_dilutes_later_ones() -> None:
    left = slice(0, SIDE // 2)
    method = fused((wall(0), seen(0, (left, A))))
    first = method.finish()
    bare = ~(first.features != 0).any(axis=1)
    assert len(first.points) == SIDE * SIDE and bare.sum() == SIDE * SIDE // 2
    method.update(wall(1), seen(1, (EVERYWHERE, B)), Timer())
    after = method.finish().features.astype(float)
    np.testing.assert_allclose(after[bare], np.tile(B / 2, (bare.sum(), 1)), atol=1e-3)


def test_feature_with_a_zero_channel_is_averaged_only_with_any_channel() -> None:
    updates = (wall(0), seen(0, (EVERYWHERE, E1))), (wall(1), seen(1, (EVERYWHERE, E2)))
    assert fused(*updates).finish().features[0].tolist() == [1.0, 0.0]
    assert fused(*updates, valid_feature_rule="any-channel").finish().features[0].tolist() == [0.5, 0.5]


# ---- products in half precision, as in gradslam


def table_of(features: np.ndarray, confidences: np.ndarray, place: Any = "memory") -> FeatureTable:
    table = FeatureTable(features.shape[1], place)
    table.append(features.astype(np.float16), np.arange(len(features), dtype=np.int32), confidences)
    return table


def test_half_precision_products_match_whole_arrays() -> None:
    """Against gradslam's formula for all points at once, half precision in the first step and single afterwards."""
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


def test_finish_midway_changes_nothing() -> None:
    updates = [(wall(k), seen(k, (EVERYWHERE, (A, B)[k % 2]))) for k in range(4)]
    whole = fused(*updates).finish()
    method = fused(*updates[:2])
    method.finish()
    for frame, detections in updates[2:]:
        method.update(frame, detections, Timer())
    np.testing.assert_array_equal(method.finish().features, whole.features)
    np.testing.assert_array_equal(method.finish().points, whole.points)


# ---- differences from other methods
