"""Random problems and settings for the literal paper and the pipeline."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from literal_paper import Array
from scipy.spatial.transform import Rotation

from su3d_bench.core.types import Detections, Frame
from su3d_bench.opensu3d.config import OpenSU3DConfig

NAMES = ("chair", "sofa", "table", "oven", "armchair", "vase")
DIMENSIONS = 6


class Problem(NamedTuple):
    settings: OpenSU3DConfig
    images: tuple[tuple[Frame, Detections], ...]


def random_problem(seed: int) -> Problem:
    """A wall with boxes in front, seen by a camera that trembles or moves, and masks that do too."""
    rng = np.random.default_rng(seed)
    settings = random_settings(rng)
    height, width = (int(n) for n in rng.integers(10, 30, 2))
    masks, depth = random_masks(rng, height, width, int(rng.integers(1, 6))), random_depth(rng, height, width)
    pose, focal = random_pose(rng, 3.0, 5.0), rng.uniform(15, 40)
    intrinsics = np.diag([focal, focal * rng.uniform(0.9, 1.1), 1])
    intrinsics[:2, 2] = width / 2 - 0.5, height / 2 - 0.5
    move, turn = rng.choice([0.005, 0.05, 0.3]), rng.choice([0.002, 0.02, 0.1])
    images = []
    for nth in range(int(rng.integers(2, 6))):
        index = 7 * nth
        seen_depth = (depth + rng.normal(0, 0.003, depth.shape)).astype(np.float32)
        seen_depth[rng.random(depth.shape) < 0.03] = rng.choice([0.0, np.nan, 20.0])
        seen_from = pose @ random_pose(rng, turn, move)
        frame = Frame(index, float(nth), np.zeros((height, width, 3), np.uint8), seen_depth, seen_from, intrinsics)
        images.append((frame, random_detections(rng, index, masks, settings)))
    return Problem(settings, tuple(images))


# Values for tiny images and defaults are more frequent.
CHOICES: dict[str, tuple[Any, ...]] = {
    "multi_scale": ("direct", "weighted"),
    "multi_view": ("direct", "global"),
    "top_m": (1, 2, 3, 4, 5, 6),
    "border_px": (0.0, 0.4, 1.0, 2.0, 3.0),
    "border_reference_width": (0, 0, 12, 20),
    "border_shape": ("disc", "square"),
    "background_pixel_rule": ("keep", "keep", "drop"),
    "depth_min": (0.0, 0.0, 0.9),
    "depth_max": (1.1, 10.0),
    "eps": (0.02, 0.04, 0.08, 0.15),
    "frame_voxel": (None, None, None, 0.0, 0.5, 1.5),  # in eps
    "overlap_threshold": (0.0, 0.1, 0.3, 0.3, 0.5, 1.0),
    "overlap_rule": ("smaller-segment", "smaller-segment", "frame-segment", "as-printed"),
    "density": ("scene", "scene", "frame", "all"),
    "dbscan_eps": (0.05, 0.1, 0.2),
    "dbscan_min_points": (1, 2, 4, 8),
    "split_fraction": (0.0, 0.3, 0.8, 0.8, 1.0),
}


def random_settings(rng: np.random.Generator) -> OpenSU3DConfig:
    """Random values, in combinations allowed by the settings."""
    chosen = {name: values[rng.integers(len(values))] for name, values in CHOICES.items()}
    ratios = rng.choice([0.8, 1.2, 2.0, 4.0], rng.integers(4), replace=False).tolist()
    if chosen["multi_scale"] == "weighted" or not ratios or rng.random() < 0.5:
        ratios.insert(rng.integers(len(ratios) + 1), 1.0)
    if chosen["frame_voxel"] is not None:
        chosen["frame_voxel"] *= chosen["eps"]
    if chosen["density"] != "scene":
        chosen["dbscan_eps"] = 5.0  # which views hit a part is determined if a voxel's points are of one instance
    if chosen["background_pixel_rule"] == "drop":
        chosen["border_pixel_rule"] = "drop"
    return OpenSU3DConfig(crop_ratios=tuple(ratios), **chosen)


def random_depth(rng: np.random.Generator, height: int, width: int) -> Array:
    """Metres to a slanted wall with up to three boxes in front."""
    v, u = np.mgrid[:height, :width]
    depth = rng.uniform(0.8, 1.2) + rng.uniform(-0.01, 0.01) * u + rng.uniform(-0.01, 0.01) * v
    for _ in range(int(rng.integers(0, 4))):
        depth[random_rectangle(rng, height, width)] -= rng.uniform(0.05, 0.4)
    return np.asarray(depth)


def random_masks(rng: np.random.Generator, height: int, width: int, n: int) -> Array:
    """Masks (n, H, W), rectangles or pairs of them, which may overlap, be equal or cover everything."""
    masks = np.zeros((n, height, width), bool)
    for mask in masks:
        for _ in range(int(rng.integers(1, 3))):
            mask[random_rectangle(rng, height, width)] = True
    return masks


def random_rectangle(rng: np.random.Generator, height: int, width: int) -> tuple[slice, slice]:
    top, left = int(rng.integers(height)), int(rng.integers(width))
    return slice(top, top + int(rng.integers(1, height))), slice(left, left + int(rng.integers(1, width)))


def random_pose(rng: np.random.Generator, turn: float, move: float) -> Array:
    """Camera to world: a rotation of about that many radians and a step of about that many metres."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", rng.normal(0, turn, 3)).as_matrix()
    pose[:3, 3] = rng.normal(0, move, 3)
    return pose


def random_detections(rng: np.random.Generator, index: int, masks: Array, settings: OpenSU3DConfig) -> Detections:
    """Some of ``masks``, possibly shifted by a pixel, in another order, and sometimes one unique to this image."""
    seen = [np.roll(mask, rng.integers(-1, 2, 2), axis=(0, 1)) for mask in rng.permutation(masks) if rng.random() < 0.8]
    if rng.random() < 0.2:
        _, height, width = masks.shape
        seen.append(random_masks(rng, height, width, 1)[0] & (rng.random((height, width)) < 0.9))
    if rng.random() < 0.1:
        seen.append(np.zeros_like(masks[0]))
    n, ratios = len(seen), (*settings.fusion.crop_ratios, 7.0)
    return Detections(
        index,
        np.array(seen, bool).reshape(n, *masks.shape[1:]),
        np.zeros((n, 4), np.float32),
        (rng.integers(0, 5, n) / 4).astype(np.float32),
        tuple(rng.choice(NAMES, n).tolist()),
        tuple(rng.choice(["", " ", "something red"], n).tolist()),
        ratios[::-1],
        random_features(rng, (n, len(ratios), DIMENSIONS)),
        random_features(rng, (DIMENSIONS,)),
    )


def random_features(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Features of length 1, a few of them 0."""
    features = rng.normal(size=shape)
    features /= np.linalg.norm(features, axis=-1, keepdims=True)
    return np.asarray(features * (rng.random(shape[:-1]) > 0.05)[..., None], np.float32)
