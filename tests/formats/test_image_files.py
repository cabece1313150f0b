"""Colour images of every kind come out as OpenCV's own decoding has them, in the order red, green, blue."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from su3d_bench.formats.images import decode_colour

RANDOM = np.random.default_rng(0)
BGR = cv2.GaussianBlur(RANDOM.integers(0, 256, (61, 77, 3), np.uint8), (0, 0), 2)
HALVED = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
FULL = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


@pytest.mark.parametrize(
    ("suffix", "pixels", "options"),
    [
        (".jpg", BGR, HALVED),
        (".jpg", BGR, FULL),
        (".jpg", BGR, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", BGR[:, :, 0], []),
        (".png", BGR, []),
        (".png", BGR[:, :, 0], []),
        (".png", np.dstack([BGR, BGR[:, :, 0]]), []),
        (".png", BGR.astype(np.uint16) * 257, []),
    ],
    ids=["halved chroma", "full chroma", "progressive", "grey JPEG", "PNG", "grey PNG", "alpha", "16 bits"],
)
def test_pixels_are_red_green_blue(suffix: str, pixels: np.ndarray, options: list[int]) -> None:
    content = cv2.imencode(suffix, pixels, options)[1]
    rgb = decode_colour(content.tobytes(), "here")
    assert rgb.flags.c_contiguous
    assert np.array_equal(rgb, np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR))[:, :, ::-1])
    if suffix == ".png":
        assert np.array_equal(rgb, (BGR if pixels.ndim == 3 else np.dstack([pixels] * 3))[:, :, ::-1])
