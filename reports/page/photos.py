"""Photos of single errors: the part of a frame around an object, with what was called it and what it is."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, Frame, UInt8Array
from su3d_bench.reports.pictures.items import PIXEL_STEP, draw_outline, fitted, seen_in, window_around

PHOTO = (256, 192)  # width and height
PREDICTED, TRUTH = (255, 64, 200), (0, 96, 255)  # an area and a line: told apart without colours, too
SHADE = 0.45  # of the area over the photo
LEAST_ROWS = 48.0  # of a mask, which has a row for every second one of the frame
MOST_POINTS = 20_000  # of a mask that are looked for in a frame
PROBES = 16  # points of a mask by which its spacing is told
JPEG_QUALITY = 60


@dataclass(frozen=True)
class SeenError:
    """The points (N, 3) m of each mask that is ``predicted`` and of each object of the ``truth``."""

    predicted: tuple[Float32Array, ...]
    truth: tuple[Float32Array, ...]

    @property
    def points(self) -> Float32Array:
        return np.concatenate([np.zeros((0, 3), np.float32), *self.predicted, *self.truth])


def error_photo(frame: Frame, error: SeenError) -> UInt8Array | None:
    """A photo (192, 256, 3): what is predicted as an area, each object of the truth with a line around it.

    None where the frame shows nothing of either. Of several masks each has a thin line of its own.
    """
    areas = [seen_mask(frame, points) for points in error.predicted]
    objects = [seen_mask(frame, points) for points in error.truth]
    seen = np.any([*areas, *objects], axis=0)
    if not seen.any():
        return None
    rows, columns = window_around(seen, PHOTO[0] / PHOTO[1], LEAST_ROWS)
    part = tuple(slice(one.start * PIXEL_STEP, one.stop * PIXEL_STEP) for one in (rows, columns))
    shown = fitted(np.ascontiguousarray(frame.rgb[part]), PHOTO)
    area = np.any([np.zeros_like(seen), *areas], axis=0)[rows, columns]
    is_area = fitted(area.astype(np.uint8) * 255, PHOTO) > 127
    shown[is_area] = ((1 - SHADE) * shown[is_area] + SHADE * np.array(PREDICTED, np.float32)).astype(np.uint8)
    for mask in areas if len(areas) > 1 else ():
        draw_outline(shown, mask[rows, columns], line=1, colour=PREDICTED, halo=0)
    for mask in objects:
        draw_outline(shown, mask[rows, columns], line=2, colour=TRUTH, halo=2 if len(objects) == 1 else 0)
    return shown


def seen_mask(frame: Frame, points: Float32Array) -> BoolArray:
    """Where the frame shows ``points`` (N, 3) m, hidden by nothing: every ``PIXEL_STEP``-th pixel, gaps closed."""
    import cv2

    height, width = frame.depth_m.shape
    mask = np.zeros((-(-height // PIXEL_STEP), -(-width // PIXEL_STEP)), np.uint8)
    looked_for = points[:: -(-len(points) // MOST_POINTS) or 1].astype(np.float64)
    columns, rows, is_seen = seen_in(frame, looked_for)
    if not is_seen.any():
        return mask.astype(bool)
    mask[rows[is_seen].astype(np.int64) // PIXEL_STEP, columns[is_seen].astype(np.int64) // PIXEL_STEP] = 1
    depth_m = (looked_for[is_seen] - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, 2]
    pixels = _spacing(looked_for) * frame.intrinsics[0, 0] / max(float(np.median(depth_m)), 1e-6) / PIXEL_STEP
    reach = int(np.clip(np.ceil(pixels), 1, width // 16 or 1))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    padded = np.pad(mask, reach)  # at the border the image would end the area
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[reach:-reach, reach:-reach]
    return closed.astype(bool)


def _spacing(points: np.ndarray) -> float:
    """How far apart neighbouring points are, in metres."""
    if len(points) < 2:
        return 0.0
    probes = points[np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)]
    squared = ((points[None] - probes[:, None]) ** 2).sum(axis=2)
    return float(np.median(np.sqrt(np.partition(squared, 1, axis=1)[:, 1])))


def photo_text(photo: UInt8Array) -> str:
    """A photo as a JPEG in base64."""
    import cv2

    _, encoded = cv2.imencode(".jpg", photo[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return base64.b64encode(encoded.tobytes()).decode("ascii")
