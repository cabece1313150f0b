"""What colour an object has, from the frames that see it: one word, or none where the pictures do not settle it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from su3d_bench.core.types import Float64Array, Frame, GroundTruth, Int64Array
from su3d_bench.questions.known_objects import instance_rows

N_FRAMES = 24  # ours: spread evenly, enough to see nearly everything of a room
MOST_VERTICES = 300  # of one object
SAME_SURFACE_M = 0.05  # a vertex is seen where the depth image agrees with it
MIN_PIXELS = 60  # ours: fewer say too little
MIN_SHARE = 0.6  # ours: of the pixels of an object that have the same word
# CIELAB, all ours: below this chroma a colour is black, grey or white, by its lightness.
GREY_CHROMA, BLACK_L, WHITE_L = 12.0, 25.0, 75.0
HUES_DEGREES = (
    (40.0, "red"), (75.0, "orange"), (105.0, "yellow"), (200.0, "green"), (310.0, "blue"), (345.0, "purple"),
)  # fmt: skip
BROWN_L, BROWN_CHROMA, BEIGE_CHROMA = 60.0, 45.0, 30.0  # a dull dark orange is brown, a pale orange or yellow beige
PINK_L = 60.0  # a light red is pink


def colour_words(dataset: Any, scene: str, truth: GroundTruth, min_vertices: int) -> Mapping[int, str]:
    """Instance id -> the word for its colour, for the instances of the truth whose colour the frames settle."""
    rows = _sampled_vertices(truth, min_vertices)
    points, owner = truth.points[rows].astype(np.float64), truth.instance[rows]
    n_frames = int(dataset.info(scene, 1).n_frames)
    step = max(1, n_frames // N_FRAMES)
    frames = dataset.frames(scene, step)
    pixels: dict[int, list[Float64Array]] = {}
    for k in range(min(len(frames), N_FRAMES)):
        seen, rgb = _seen(frames[k], points)
        for instance in np.unique(owner[seen]).tolist():
            pixels.setdefault(instance, []).append(rgb[owner[seen] == instance])
    words = {instance: colour_word(np.concatenate(parts)) for instance, parts in pixels.items()}
    return {instance: word for instance, word in sorted(words.items()) if word}


def _sampled_vertices(truth: GroundTruth, min_vertices: int) -> Int64Array:
    """Rows of the truth: up to 300 of each instance that is large enough, spread evenly in its order."""
    parts = [
        rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_VERTICES)).astype(np.int64)]
        for _, rows in instance_rows(truth, min_vertices)
    ]
    return np.concatenate([np.zeros(0, np.int64), *parts])


def _seen(frame: Frame, points: Float64Array) -> tuple[Int64Array, Float64Array]:
    """The points that the frame sees, and the colour (N, 3), 0..255, of the pixel of each."""
    rotation, centre = frame.camera_to_world[:3, :3], frame.camera_to_world[:3, 3]
    camera = (points - centre) @ rotation
    rows = np.flatnonzero(camera[:, 2] > 0)
    projected = camera[rows] @ frame.intrinsics.T
    column, line = np.rint(projected[:, :2] / projected[:, 2:]).T
    height, width = frame.depth_m.shape
    inside = (column >= 0) & (column < width) & (line >= 0) & (line < height)
    rows, column, line = rows[inside], column[inside].astype(np.int64), line[inside].astype(np.int64)
    agrees = np.abs(frame.depth_m[line, column] - camera[rows, 2]) < SAME_SURFACE_M
    return rows[agrees], frame.rgb[line[agrees], column[agrees]].astype(np.float64)


def colour_word(rgb: Float64Array) -> str:
    """The word for pixels (N, 3), 0..255, empty where they are too few or of too many colours.

    >>> colour_word(np.tile([200.0, 40.0, 40.0], (100, 1))), colour_word(np.tile([200.0, 40.0, 40.0], (3, 1)))
    ('red', '')
    """
    if len(rgb) < MIN_PIXELS:
        return ""
    words, counts = np.unique(_words_of(rgb), return_counts=True)
    best = int(counts.argmax())
    return str(words[best]) if counts[best] >= MIN_SHARE * len(rgb) else ""


def _words_of(rgb: Float64Array) -> np.ndarray:
    """The word for each pixel, by lightness, chroma and hue in CIELAB."""
    import cv2

    lab = cv2.cvtColor((rgb / 255.0).astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0].astype(np.float64)
    lightness, chroma = lab[:, 0], np.hypot(lab[:, 1], lab[:, 2])
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) % 360
    ends = np.array([end for end, _ in HUES_DEGREES])
    names = np.array([*(name for _, name in HUES_DEGREES), "red"])
    words = names[np.searchsorted(ends, hue, side="right")]
    is_warm = (words == "orange") | (words == "yellow")
    words = np.where(is_warm & (lightness >= BROWN_L) & (chroma < BEIGE_CHROMA), "beige", words)
    words = np.where((words == "orange") & (lightness < BROWN_L) & (chroma < BROWN_CHROMA), "brown", words)
    words = np.where((words == "red") & (lightness >= PINK_L), "pink", words)
    greys = np.where(lightness < BLACK_L, "black", np.where(lightness >= WHITE_L, "white", "grey"))
    return np.where(chroma < GREY_CHROMA, greys, words)
