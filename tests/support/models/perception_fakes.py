"""Small stand-ins shared by the tests of perception."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.types import Float32Array, Float64Array, Frame, UInt8Array

INTRINSICS: Float64Array = np.array([[100.0, 0, 79.5], [0, 100.0, 59.5], [0, 0, 1]])


class CountingEncoder:
    """A deterministic encoder of colour statistics that counts the images it encodes."""

    name = "counting"
    digest = "counting-1"
    dim = 8

    def __init__(self) -> None:
        self.n_images = 0

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        self.n_images += len(images)
        rows = [np.r_[i.mean((0, 1)), i.std((0, 1)), i.shape[0] / 9, i.shape[1] / 9] for i in images]
        return _normalised(np.array(rows, np.float32).reshape(-1, 8))

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        rows = [np.random.default_rng(list(text.encode())).normal(size=8) for text in texts]
        return _normalised(np.array(rows, np.float32).reshape(-1, 8))


def _normalised(rows: Float32Array) -> Float32Array:
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def still_life(index: int = 0) -> Frame:
    """A frame (120x160) of a wall at 3 m with a red box at 2 m, a green one at 2.5 m and a blue picture on the wall."""
    rgb = np.full((120, 160, 3), 205, np.uint8)
    depth_m = np.full((120, 160), 3.0, np.float32)
    rgb[40:80, 20:60] = 190, 40, 40
    depth_m[40:80, 20:60] = 2.0
    rgb[50:90, 90:120] = 50, 140, 60
    depth_m[50:90, 90:120] = 2.5
    rgb[10:30, 70:110] = 40, 60, 180
    return Frame(index, index / 30, rgb, depth_m, np.eye(4), INTRINSICS)
