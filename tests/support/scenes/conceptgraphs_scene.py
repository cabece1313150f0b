"""Plates before a camera, each with a feature and a name, and objects of made-up clouds, for ConceptGraphs' tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.baselines.conceptgraphs.objects import MapObject, MappingConfig, Sighting, bounding_box
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
    """A unit feature of that cosine to ``axis(0)``."""
    return (cosine, float(np.sqrt(1 - cosine**2)), 0.0, 0.0)


@dataclass(frozen=True)
class Plate:
    """A rectangle facing the camera, bent a little towards it: its lower and upper x and y and its depth, metres."""

    x: tuple[float, float]
    y: tuple[float, float] = (-0.3, 0.3)
    z: float = 1.5
    feature: tuple[float, ...] = axis(0)
    name: str = "item"
    text: tuple[float, ...] = axis(0)
    score: float = 1.0


def look(plates: Sequence[Plate], index: int = 0) -> tuple[Frame, Detections]:
    """A frame of ``plates`` in front of nothing, and one detection each."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    depth, masks = np.zeros((HEIGHT, WIDTH)), np.zeros((len(plates), HEIGHT, WIDTH), np.bool_)
    for row, plate in enumerate(plates):
        x, y = ((c - INTRINSICS[i, 2]) / FOCAL * plate.z for i, c in enumerate((u, v)))
        masks[row] = (plate.x[0] <= x) & (x < plate.x[1]) & (plate.y[0] <= y) & (y < plate.y[1])
        depth[masks[row]] = plate.z + 0.05 * np.cos(3 * x + 2 * y)[masks[row]]
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    frame = Frame(index, index / 30, rgb, depth.astype(np.float32), np.eye(4), INTRINSICS)
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


def an_object(
    points: np.ndarray,
    number: int = 1,
    *,
    n: int = 1,
    feature: tuple[float, ...] = axis(0),
    text: tuple[float, ...] = axis(0),
) -> MapObject:
    """An object of ``n`` detections."""
    seen = tuple(Sighting(k, 0, "item", "", 1.0) for k in range(n))
    cloud = np.asarray(points, np.float64)
    return MapObject(number, cloud, bounding_box(cloud, oriented=True), np.array(feature), np.array(text), seen)


def block(low: Sequence[float], size: Sequence[float] = (0.3, 0.3, 0.3), step: float = 0.05) -> np.ndarray:
    """A filled block of points ``step`` apart from its corner ``low``."""
    grid = np.meshgrid(*(np.arange(0, side - 1e-9, step) for side in size), indexing="ij")
    return np.stack([part.ravel() for part in grid], axis=1) + np.asarray(low, np.float64)


def contents(found: Instances) -> tuple[object, ...]:
    """Everything of ``found`` in bytes."""
    parts = (found.points, found.indptr, found.indices, found.scores, found.boxes, found.views, found.ids)
    features = np.asarray(found.features).tobytes()
    return (*(part.tobytes() for part in parts), features, found.names, found.captions, found.labels)


# Frames without noise, so that values can be worked out by hand; the rest as published.
QUIET = MappingConfig(noise_m=0.0, max_bbox_area_ratio=1.0)
