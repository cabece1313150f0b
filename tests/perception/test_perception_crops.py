"""Crops around detections, against values worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.perception.crops import crop_images, crop_window, mask_boxes


@pytest.mark.parametrize(
    ("box", "ratio", "expected"),
    [
        ((10, 20, 30, 40), 1.0, (10, 20, 30, 40)),
        ((10, 20, 30, 40), 0.8, (12, 22, 28, 38)),
        ((10, 20, 30, 40), 1.2, (8, 18, 32, 42)),
        ((10, 20, 31, 41), 2.0, (0, 10, 42, 50)),  # -0.5 clips, 41.5 rounds up, 51.5 clips
        ((10, 20, 13, 24), 0.5, (11, 21, 12, 23)),  # 10.75..12.25 rounds to 11..12
        ((10, 20, 11, 21), 0.1, (10, 20, 11, 21)),  # 10.45..10.55 rounds to 10..11
        ((10, 20, 12, 22), 0.1, (11, 21, 12, 22)),  # 10.9..11.1 would be empty: one pixel
        ((98, 48, 100, 50), 0.1, (99, 49, 100, 50)),  # an empty window at the far border stays inside
        ((0, 0, 100, 50), 4.0, (0, 0, 100, 50)),
    ],
)
def test_a_crop_is_the_box_scaled_about_its_centre_clipped_and_rounded(
    box: tuple[float, ...], ratio: float, expected: tuple[int, ...]
) -> None:
    assert tuple(crop_window(box, ratio, width=100, height=50)) == expected


def test_a_whole_pixel_box_at_ratio_one_is_returned_as_it_is() -> None:
    generator = np.random.default_rng(0)
    for _ in range(200):
        x0, x1 = np.sort(generator.choice(641, 2, replace=False))
        y0, y1 = np.sort(generator.choice(481, 2, replace=False))
        assert tuple(crop_window((x0, y0, x1, y1), 1.0, 640, 480)) == (x0, y0, x1, y1)


def test_a_crop_holds_the_pixels_of_its_window() -> None:
    rgb = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    (crop,) = crop_images(rgb, np.array([[2, 1, 6, 5]], np.float32), 0.5)
    assert np.array_equal(crop, rgb[2:4, 3:5])


def test_mask_boxes_are_tight_with_exclusive_ends() -> None:
    masks = np.zeros((2, 6, 8), bool)
    masks[0, 1:3, 4:7] = True
    assert mask_boxes(masks).tolist() == [[4, 1, 7, 3], [0, 0, 0, 0]]
    assert mask_boxes(masks[:0]).shape == (0, 4)
