"""Perfect detections: masks projected from the annotated mesh or the boxes of objects, with noise on request."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.digests import package_digest
from su3d_bench.core.geometry import back_project
from su3d_bench.core.types import Float32Array, Frame, InstanceMesh, Int32Array, ObjectBoxes, Regions
from su3d_bench.numerics.open3d_core import compiled_open3d
from su3d_bench.perception.cache import CACHE_SOURCES, array_digest, content_key
from su3d_bench.perception.crops import mask_boxes
from su3d_bench.perception.oracle.noise import OracleNoise, disturb

if TYPE_CHECKING:
    import open3d


# What moves the regions: their key follows it.
SOURCES = (
    "core/types.py",
    "core/geometry.py",
    "numerics/open3d_core.py",
    "perception/oracle/noise.py",
    "perception/oracle/segmenter.py",
    *CACHE_SOURCES,
)


class OracleConfig(BaseModel):
    """How the truth is projected into a frame.

    A pixel takes the instance of the surface that its ray hits where that surface lies within ``depth_tolerance_m`` of
    the measured depth. Pixels that hit nothing, or another surface, take the instance of the nearest labelled pixel
    within ``fill_px`` whose depth is within the tolerance: scanned surfaces have small holes. Instances below
    ``min_pixels`` are dropped.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    depth_tolerance_m: float = Field(default=0.05, gt=0)
    fill_px: int = Field(default=3, ge=0)
    min_pixels: int = Field(default=100, ge=1)  # as many as a region of 10x10 pixels, the least that a crop can show
    prompt: str = Field(default="{} in a scene", pattern=r"\{\}")  # whose text feature stands for a region
    noise: OracleNoise = OracleNoise()


class MeshProjector:
    """Instance images of an annotated mesh, by ray casting."""

    def __init__(self, mesh: InstanceMesh, config: OracleConfig) -> None:
        self._mesh = mesh
        self._config = config
        self._scene: open3d.t.geometry.RaycastingScene | None = None

    def instance_image(self, frame: Frame) -> Int32Array:
        """The instance id (H, W) of every pixel, 0 where there is none."""
        hit_depth_m, instance = self._cast(frame)
        depth_m = frame.depth_m
        tolerance = np.float32(self._config.depth_tolerance_m)
        measured = np.isfinite(depth_m) & (depth_m > 0)
        with np.errstate(invalid="ignore"):
            agrees = measured & (np.abs(hit_depth_m - depth_m) < tolerance)
        instance[~agrees] = 0
        return self._fill(instance, depth_m, measured & ~agrees, agrees)

    def _cast(self, frame: Frame) -> tuple[Float32Array, Int32Array]:
        o3d = compiled_open3d()
        if self._scene is None:
            self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
            self._scene.add_triangles(
                o3d.core.Tensor(np.ascontiguousarray(self._mesh.vertices, np.float32)),
                o3d.core.Tensor(np.ascontiguousarray(self._mesh.triangles, np.uint32)),
            )
        answer: Any = self._scene.cast_rays(o3d.core.Tensor(pixel_rays(frame)), nthreads=1)
        hit_depth_m: Float32Array = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy()
        instance = np.zeros(triangle.shape, np.int32)
        is_hit = np.isfinite(hit_depth_m)
        instance[is_hit] = self._mesh.instance_of_triangle[triangle[is_hit]]
        return hit_depth_m, instance

    def _fill(self, instance: Int32Array, depth_m: Float32Array, wanting: Any, agrees: Any) -> Int32Array:
        if self._config.fill_px == 0 or not wanting.any() or not agrees.any():
            return instance
        import cv2

        cv2.setNumThreads(1)
        distance, source = cv2.distanceTransformWithLabels(
            (~agrees).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        # Labels count the agreeing pixels in row-major order, from 1.
        nearest = np.flatnonzero(agrees)[source - 1]
        is_near = wanting & (distance <= self._config.fill_px)
        is_near &= np.abs(depth_m.ravel()[nearest] - depth_m) < self._config.depth_tolerance_m
        instance[is_near] = instance.ravel()[nearest[is_near]]
        return instance


class BoxProjector:
    """Instance images of objects whose boxes are known: what a pixel measures is of the smallest box that holds it."""

    def __init__(self, boxes: ObjectBoxes, config: OracleConfig) -> None:
        self._boxes = boxes
        self._slack_m = config.depth_tolerance_m

    def instance_image(self, frame: Frame) -> Int32Array:
        """The instance id (H, W) of every pixel, 0 where there is none."""
        measured = np.isfinite(frame.depth_m) & (frame.depth_m > 0)
        points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, measured)
        instance = np.zeros(frame.depth_m.shape, np.int32)
        instance[measured] = self._boxes.instance_at(points, self._slack_m)
        return instance


def pixel_rays(frame: Frame) -> Float32Array:
    """World rays (H, W, 6) of the pixels: origin and direction, scaled so that a hit's parameter is its depth."""
    height, width = frame.depth_m.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(frame.intrinsics).T
    rays = np.empty((height, width, 6), np.float32)
    rays[..., :3] = frame.camera_to_world[:3, 3]
    rays[..., 3:] = directions @ frame.camera_to_world[:3, :3].T
    return rays


def _digest_of_boxes(truth: ObjectBoxes) -> str:
    boxes = [truth.boxes[instance] for instance in sorted(truth.boxes)]
    parts = [(box.centre, box.sizes, box.rotation.ravel()) for box in boxes]
    rows = np.array([np.concatenate(part) for part in parts]).reshape(-1, 15)
    return array_digest(np.array(sorted(truth.boxes), np.int64), rows)


class OracleSegmenter:
    """Regions that are the visible parts of the true instances, named by their class, all scored 1."""

    name = "oracle"

    def __init__(self, truth: InstanceMesh | ObjectBoxes, config: OracleConfig) -> None:
        self._truth = truth
        self._config = config
        self._projector: MeshProjector | BoxProjector
        if isinstance(truth, InstanceMesh):
            self._projector = MeshProjector(truth, config)
            digest = array_digest(truth.vertices, truth.triangles, truth.instance_of_triangle)
        else:
            self._projector = BoxProjector(truth, config)
            digest = _digest_of_boxes(truth)
        names = [f"{key}={truth.class_of_instance[key]}" for key in sorted(truth.class_of_instance)]
        self.digest = content_key(
            "oracle",
            config.model_dump_json(),
            package_digest(*SOURCES),
            digest,
            *truth.labels.names,
            *names,
        )

    def segment(self, frame: Frame) -> Regions:
        instance = self._projector.instance_image(frame)
        ids, counts = np.unique(instance, return_counts=True)
        of_class = self._truth.class_of_instance
        kept = [int(i) for i, n in zip(ids, counts, strict=True) if n >= self._config.min_pixels and int(i) in of_class]
        names = [self._truth.labels.name_of(of_class[i]) for i in kept]
        masks = [instance == i for i in kept]
        known = sorted({self._truth.labels.name_of(c) for c in of_class.values()})
        masks, names = disturb(masks, names, known, self._config.noise, frame.index)
        pairs = [(m, n) for m, n in zip(masks, names, strict=True) if np.count_nonzero(m) >= self._config.min_pixels]
        stacked = np.array([m for m, _ in pairs], bool).reshape(len(pairs), *instance.shape)
        return Regions(stacked, mask_boxes(stacked), np.ones(len(pairs), np.float32), tuple(n for _, n in pairs))
