"""Contents of files that several layouts write: JPEG and PNG images, depth in whole units, triangles."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.types import Float32Array, Int32Array, UInt8Array
from su3d_bench.formats.images import UInt16Array
from su3d_bench.formats.ply import ListColumn

JPEG_QUALITY = 95
PNG_COMPRESSION = 3


def jpeg_bytes(rgb: UInt8Array) -> bytes:
    import cv2

    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def png_bytes(image: UInt8Array | UInt16Array) -> bytes:
    """A PNG of an image (H, W, 3) RGB of 8 bits, or (H, W) grey of 16."""
    import cv2

    stored = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    return bytes(cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])[1])


def depth_in_units(depth_m: Float32Array, units_per_metre: float) -> UInt16Array:
    """Depth in whole units, rounded; what 16 bits cannot hold becomes 0, no reading."""
    values = np.rint(depth_m.astype(np.float64) * units_per_metre)
    return np.where(values > np.iinfo(np.uint16).max, 0, values).astype(np.uint16)


def list_column(rows: Int32Array) -> ListColumn:
    """Rows (N, k) as lists of k in a PLY file."""
    return ListColumn(np.arange(len(rows) + 1) * rows.shape[1], rows.reshape(-1).astype(np.int32))


def triangles_of(quads: Int32Array) -> Int32Array:
    """Quads (F, 4) as triangles (2F, 3), split from the first corner to the third as habitat does."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
