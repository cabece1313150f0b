"""The ID image M': overlaps, rings, and their scale."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.core.types import BoolArray
from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.opensu3d.frame_cloud import NO_DETECTION, paint


def rectangle(rows: slice, columns: slice, height: int = 40, width: int = 60) -> BoolArray:
    mask = np.zeros((height, width), np.bool_)
    mask[rows, columns] = True
    return mask


def test_a_smaller_mask_shows_over_a_larger_one_whatever_their_order() -> None:
    large, small = rectangle(slice(5, 35), slice(5, 55)), rectangle(slice(10, 20), slice(10, 20))
    for masks, of_large, of_small in (([large, small], 0, 1), ([small, large], 1, 0)):
        image = paint(np.stack(masks), 0, "disc").ids
        assert (image[small] == of_small).all()
        assert (image[large & ~small] == of_large).all()
        assert (image[~large] == NO_DETECTION).all()


def test_the_ring_of_a_small_mask_erases_the_large_one_around_it_and_no_other_pixel() -> None:
    large, small = rectangle(slice(0, 40), slice(0, 60)), rectangle(slice(20, 21), slice(30, 31))
    image = paint(np.stack([large, small]), 3, "disc")
    rows, columns = np.mgrid[:40, :60]
    distance_squared = (rows - 20) ** 2 + (columns - 30) ** 2
    np.testing.assert_array_equal(image.ids == NO_DETECTION, (distance_squared <= 9) & (distance_squared > 0))
    assert image.ids[20, 30] == 1
    assert (image.ids[distance_squared > 9] == 0).all()
    assert image.owner[20, 30] == 1
    assert (image.owner[distance_squared > 0] == 0).all()


def test_two_instances_never_touch() -> None:
    rng = np.random.default_rng(0)
    masks = np.stack([rectangle(slice(r, r + 12), slice(c, c + 15)) for r, c in rng.integers(0, 40, (9, 2))])
    image = np.pad(paint(masks, 2, "disc").ids, 2, constant_values=NO_DETECTION)
    for shift in [(0, 1), (1, 0), (0, 2), (2, 0), (1, 1), (-1, 1)]:
        other = np.roll(image, shift, (0, 1))
        assert not ((image >= 0) & (other >= 0) & (image != other)).any()


@pytest.mark.parametrize(("width", "reference", "expected"), [(1200, 1200, 20), (640, 1200, 11), (640, 0, 20)])
def test_the_border_takes_the_same_share_of_every_image(width: int, reference: int, expected: int) -> None:
    assert OpenSU3DConfig(border_reference_width=reference).border_in(width) == expected
