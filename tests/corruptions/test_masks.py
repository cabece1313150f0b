"""Corruptions of regions: what all have in common, and hand-worked values of each."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from su3d_bench.core.types import BoolArray, Detections, Float32Array
from su3d_bench.corruptions import masks
from su3d_bench.corruptions.model import Corruption, generator

ROWS = {row.name: row for row in masks.ROWS}
N = 24


def of_masks(each: BoolArray, boxes: Float32Array | None = None) -> Detections:
    """Regions whose scores, names and features tell which they are."""
    n = len(each)
    numbers = np.arange(n, dtype=np.float32)
    crops = np.stack([np.cos(numbers), np.sin(numbers)], axis=1)
    return Detections(
        7, each, np.zeros((n, 4), np.float32) if boxes is None else boxes, np.float32(1 / (n + 1)) * (numbers + 1),
        tuple(f"name {k}" for k in range(n)), tuple(f"caption {k}" for k in range(n)), (1.0,), crops[:, None],
        np.ones(2, np.float32), name_features=crops.copy(),
    )  # fmt: skip


def rectangle(left: int, top: int, right: int, bottom: int, shape: tuple[int, int] = (48, 640)) -> BoolArray:
    mask = np.zeros(shape, bool)
    mask[top:bottom, left:right] = True
    return mask


def scene() -> Detections:
    """Discs of 18 to 38 px radius in an image 640 wide, apart from each other, with read-only arrays."""
    v, u = np.mgrid[:240, :640]
    middles = [(40 + 80 * (k % 8), 40 + 80 * (k // 8)) for k in range(N)]
    radii = 18 + 20 * np.random.default_rng(8).random(N)
    each = np.stack([(u - x) ** 2 + (v - y) ** 2 <= r * r for (x, y), r in zip(middles, radii, strict=True)])
    found = of_masks(each)
    for array in (found.masks, found.boxes, found.scores, found.crop_features, found.name_features):
        assert array is not None
        array.setflags(write=False)
    return found


SCENE = scene()


def changed(name: str, found: Detections, value: float, seed: int = 5, of: str = "scene") -> Detections:
    row = ROWS[name]
    return cast(Detections, row.function(found, value, generator(row, seed, of)))


def quality(found: Detections) -> float:
    """Mean over the clean regions of the best IoU with a region of that name, 0 if there is none."""
    total = 0.0
    for k, clean in enumerate(SCENE.masks):
        own = [mask for mask, name in zip(found.masks, found.names, strict=True) if name == SCENE.names[k]]
        total += max(((mask & clean).sum() / (mask | clean).sum() for mask in own), default=0.0)
    return total / len(SCENE)


def rank_correlation(found: Detections) -> float:
    from scipy.stats import spearmanr

    return float(spearmanr(SCENE.scores, found.scores)[0])


@pytest.mark.parametrize("row", masks.ROWS, ids=lambda row: row.name)
def test_each_severity_is_worse_over_a_few_frames(row: Corruption) -> None:
    measure = rank_correlation if row.name == "scores-shuffled" else quality
    n_frames = 1 if row.name in ("eroded", "dilated") else 6

    def mean(value: float) -> float:
        return sum(measure(changed(row.name, SCENE, value, seed)) for seed in range(n_frames)) / n_frames

    values = [mean(row.value_at(severity)) for severity in range(6)]
    assert values[0] == pytest.approx(1)
    assert all(np.diff(values) < 0), values


@pytest.mark.parametrize("row", masks.ROWS, ids=lambda row: row.name)
def test_one_seed_repeats_and_everything_else_stays_with_its_region(row: Corruption) -> None:
    first = changed(row.name, SCENE, row.value_at(3))
    again, other = changed(row.name, SCENE, row.value_at(3)), changed(row.name, SCENE, row.value_at(3), of="other")
    assert first.masks.tobytes() == again.masks.tobytes() and first.scores.tobytes() == again.scores.tobytes()
    differs = first.masks.shape != other.masks.shape or (first.masks != other.masks).any()
    assert (differs or (first.scores != other.scores).any()) == (row.name not in ("eroded", "dilated"))
    assert len(first) and first.masks.any(axis=(1, 2)).all() and first.masks.dtype == bool
    of = [SCENE.names.index(name) for name in first.names]
    assert first.captions == tuple(SCENE.captions[k] for k in of) and [first.row_of(k) for k in range(len(of))] == of
    assert np.array_equal(first.crop_features, SCENE.crop_features[of]) and first.name_features is not None
    assert np.array_equal(first.name_features, first.crop_features[:, 0])
    assert row.name == "scores-shuffled" or np.array_equal(first.scores, SCENE.scores[of])
    assert (first.frame_index, first.crop_ratios) == (7, (1.0,)) and first.global_feature is SCENE.global_feature


@pytest.mark.parametrize("row", masks.ROWS, ids=lambda row: row.name)
def test_boxes_surround_the_pixels_of_changed_masks_only(row: Corruption) -> None:
    found = changed(row.name, SCENE, row.value_at(2))
    for mask, box, name in zip(found.masks, found.boxes, found.names, strict=True):
        v, u = np.nonzero(mask)
        is_clean = np.array_equal(mask, SCENE.masks[SCENE.names.index(name)])
        expected = [0, 0, 0, 0] if is_clean else [u.min(), v.min(), u.max() + 1, v.max() + 1]
        assert box.tolist() == expected, name


@pytest.mark.parametrize("row", masks.ROWS, ids=lambda row: row.name)
def test_no_region_and_regions_without_pixels_are_no_problem(row: Corruption) -> None:
    for found in (of_masks(np.zeros((0, 24, 32), bool)), of_masks(np.zeros((2, 24, 32), bool))):
        result = changed(row.name, found, row.value_at(5))
        assert result.masks.shape[1:] == (24, 32) and len(result) <= len(found)


def test_a_rectangle_loses_and_gains_as_many_pixels_as_told_on_every_side() -> None:
    found = of_masks(np.stack([rectangle(100, 10, 140, 30), rectangle(200, 10, 203, 30)]))
    smaller, larger = changed("eroded", found, 3), changed("dilated", found, 3)
    assert smaller.names == ("name 0",) and smaller.boxes.tolist() == [[103, 13, 137, 27]]  # the thin one is gone
    assert np.array_equal(smaller.masks[0], rectangle(103, 13, 137, 27))
    assert larger.boxes.tolist() == [[97, 7, 143, 33], [197, 7, 206, 33]]
    assert larger.masks[0].sum() < 46 * 26  # its corners are round


def test_erosion_leaves_the_border_of_the_image_alone_and_pixels_scale_with_its_width() -> None:
    half = rectangle(0, 0, 20, 24, (24, 32))
    assert changed("eroded", of_masks(half[None]), 40).boxes.tolist() == [[0, 0, 18, 24]]  # 40 px are 2 of 32
    assert changed("eroded", of_masks(np.ones((1, 24, 32), bool)), 40).masks.all()


def test_a_shifted_mask_has_moved_by_its_distance_and_loses_what_leaves_the_image() -> None:
    many = of_masks(np.stack([rectangle(300, 300, 310, 310, (640, 640))] * 30))
    found = changed("shifted", many, 32)
    steps = found.boxes[:, :2] - 300
    assert np.abs(np.hypot(*steps.T) - 32).max() < 0.8  # rounded to pixels
    assert len(np.unique(steps, axis=0)) > 20 and (found.masks.sum(axis=(1, 2)) == 100).all()
    corner = of_masks(np.stack([rectangle(0, 0, 4, 4)] * 30))
    left = changed("shifted", corner, 4)
    assert 0 < len(left) < 30 and (left.masks.sum(axis=(1, 2)) <= 16).all()


def test_dropped_regions_are_a_share_and_stay_dropped_at_higher_severities() -> None:
    many = of_masks(np.ones((400, 4, 4), bool))
    some, more = changed("dropped", many, 0.2), changed("dropped", many, 0.6)
    assert len(some) == pytest.approx(320, abs=25) and len(more) == pytest.approx(160, abs=30)
    assert set(more.names) < set(some.names)


def test_merged_regions_join_the_nearest_and_keep_the_name_of_the_larger() -> None:
    small, large, far = rectangle(100, 10, 110, 20), rectangle(113, 10, 153, 40), rectangle(500, 10, 505, 15)
    found = changed("merged", of_masks(np.stack([small, large, far])), 1.0)
    assert found.names == ("name 1",) and np.array_equal(found.masks[0], small | large | far)
    near = [rectangle(20 * k, 10, 20 * k + 8, 20) for k in range(2)]
    apart = [rectangle(300 + 20 * k, 10, 310 + 25 * k, 20) for k in range(2)]
    pairs = changed("merged", of_masks(np.stack([*near, *apart])), 1.0)
    assert pairs.names == ("name 0", "name 3")  # equally large: the first; otherwise the larger
    assert np.array_equal(pairs.masks[1], apart[0] | apart[1])
    assert changed("merged", of_masks(small[None]), 1.0).names == ("name 0",)


def test_split_regions_become_two_halves_without_a_common_pixel() -> None:
    found = changed("split", of_masks(np.stack([rectangle(100, 10, 130, 40), rectangle(300, 10, 301, 11)])), 1.0)
    assert found.names == ("name 0", "name 0", "name 1")  # one pixel cannot be cut
    one, other = found.masks[:2]
    assert not (one & other).any() and np.array_equal(one | other, rectangle(100, 10, 130, 40))
    assert one.sum() == pytest.approx(450, abs=30) and other.sum() == pytest.approx(450, abs=30)


def test_split_leaves_the_others_whole() -> None:
    assert len(changed("split", SCENE, 0.4)) == pytest.approx(1.4 * N, abs=0.3 * N)
    assert len(changed("split", SCENE, 1.0)) == 2 * N


def test_shuffled_scores_are_the_same_scores_in_other_places() -> None:
    found, some = changed("scores-shuffled", SCENE, 1.0), changed("scores-shuffled", SCENE, 0.4)
    assert sorted(found.scores) == sorted(SCENE.scores) and sorted(some.scores) == sorted(SCENE.scores)
    assert (found.scores != SCENE.scores).all()
    assert np.mean(some.scores != SCENE.scores) == pytest.approx(0.4, abs=0.2)
    assert found.masks is SCENE.masks and found.names is SCENE.names
