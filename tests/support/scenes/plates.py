"""Plates in front of a camera, each with a feature and a name, for tests of methods that map them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from su3d_bench.baselines.conceptgraphs.objects import MappingConfig
from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import Detections, Frame, SceneInfo
from su3d_bench.perception.cache import mask_boxes

SCENE = SceneInfo("made", "plates", 4, 1, "rendered-rooms", seed=7)
WIDTH, HEIGHT, FOCAL = 96, 72, 72.0
INTRINSICS = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
DIMENSION = 4


def axis(k: int) -> tuple[float, ...]:
    """The unit feature along axis ``k``."""
    return tuple(float(i == k) for i in range(DIMENSION))


def at_cosine(cosine: float) -> tuple[float, ...]:
    """A unit feature with that cosine to ``axis(0)``."""
    return (cosine, float(np.sqrt(1 - cosine**2)), 0.0, 0.0)


@dataclass(frozen=True)
class Plate:
    """A rectangle facing the camera, bent towards it by ``bend_m``, with bounds in x and y and a depth (m)."""

    x: tuple[float, float]
    y: tuple[float, float] = (-0.3, 0.3)
    z: float = 1.5
    feature: tuple[float, ...] = axis(0)
    name: str = "item"
    text: tuple[float, ...] = axis(0)
    score: float = 1.0
    bend_m: float = 0.05


def look(plates: Sequence[Plate], index: int = 0, camera_x: float = 0.0) -> tuple[Frame, Detections]:
    """A frame of ``plates`` in front of nothing, and one detection each, which may overlap."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    depth, masks = np.zeros((HEIGHT, WIDTH)), np.zeros((len(plates), HEIGHT, WIDTH), np.bool_)
    for row, plate in enumerate(plates):
        x, y = ((c - INTRINSICS[i, 2]) / FOCAL * plate.z for i, c in enumerate((u, v)))
        x = x + camera_x
        masks[row] = (plate.x[0] <= x) & (x < plate.x[1]) & (plate.y[0] <= y) & (y < plate.y[1])
        depth[masks[row]] = plate.z + plate.bend_m * np.cos(3 * x + 2 * y)[masks[row]]
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pose = np.eye(4)
    pose[0, 3] = camera_x
    frame = Frame(index, index / 30, rgb, depth.astype(np.float32), pose, INTRINSICS)
    features = np.array([plate.feature for plate in plates], np.float32).reshape(len(plates), 1, DIMENSION)
    return frame, Detections(
        index,
        masks,
        mask_boxes(masks),
        np.array([plate.score for plate in plates], np.float32),
        tuple(plate.name for plate in plates),
        tuple(f"a {plate.name}" for plate in plates),
        (1.0,),
        features,
        np.full(DIMENSION, 0.5, np.float32),
        np.array([plate.text for plate in plates], np.float32).reshape(len(plates), DIMENSION),
    )


def mapped(method, views: Sequence[Sequence[Plate]]):  # type: ignore[no-untyped-def]
    """``method`` after the frames of ``views``."""
    method.start(SCENE)
    for index, plates in enumerate(views):
        method.update(*look(plates, index), Timer())
    return method


def block(low: Sequence[float], size: Sequence[float] = (0.3, 0.3, 0.3), step: float = 0.05) -> np.ndarray:
    """A filled block of points ``step`` apart from the corner ``low``."""
    grid = np.meshgrid(*(np.arange(0, side - 1e-9, step) for side in size), indexing="ij")
    return np.stack([part.ravel() for part in grid], axis=1) + np.asarray(low, np.float64)


def contents(found: Instances) -> tuple[object, ...]:
    """Every byte of a map."""
    values = (getattr(found, one.name) for one in fields(found))
    return tuple(value.tobytes() if isinstance(value, np.ndarray) else value for value in values)


# Noise-free frames, so that values can be computed by hand; the rest as published.
QUIET = MappingConfig(noise_m=0.0, max_bbox_area_ratio=1.0)
