"""Ground-truth detections: masks projected from the annotated mesh or the object boxes, with optional noise."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.digests import package_digest
from su3d_bench.core.english import with_article
from su3d_bench.core.geometry import back_project
from su3d_bench.core.interfaces import Encoder, RegionPerception, StageTimer
from su3d_bench.core.types import (
    BoolArray,
    Detections,
    Float32Array,
    Frame,
    InstanceMesh,
    Int32Array,
    Int64Array,
    ObjectBoxes,
    PerceptionNeeds,
    Regions,
    UInt8Array,
)
from su3d_bench.numerics.open3d_core import compiled_open3d
from su3d_bench.perception.cache import (
    CODE,
    FrameCache,
    RegionsOnDemand,
    array_digest,
    cached_regions,
    content_key,
    mask_boxes,
    region_under,
)
from su3d_bench.perception.detections import Assembler


class OracleNoise(BaseModel):
    """Noise added to the oracle's masks and names; all values are 0 (no noise) by default.

    Applied in this order: drop a mask; merge it with a touching one; split it by a line through its centre; erode or
    dilate the remaining masks by whole pixels (a dilated mask may overlap its neighbour); change its name to another
    class of the scene.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: int = Field(default=0, ge=0)
    erode_px: int = Field(default=0, ge=0)
    dilate_px: int = Field(default=0, ge=0)
    drop_probability: float = Field(default=0.0, ge=0, le=1)
    merge_probability: float = Field(default=0.0, ge=0, le=1)
    split_probability: float = Field(default=0.0, ge=0, le=1)
    flip_probability: float = Field(default=0.0, ge=0, le=1)


Region = tuple[BoolArray, str]


def apply_noise(
    masks: list[BoolArray], names: list[str], known: list[str], noise: OracleNoise, frame_index: int
) -> tuple[list[BoolArray], list[str]]:
    """``masks`` and ``names`` with ``noise`` applied; ``known`` are the candidate names of a flip."""
    generator = np.random.default_rng([noise.seed, frame_index])
    regions = list(zip(masks, names, strict=True))
    is_kept = generator.random(len(regions)) >= noise.drop_probability
    regions = _merge([regions[k] for k in np.flatnonzero(is_kept)], noise.merge_probability, generator)
    regions = _split(regions, noise.split_probability, generator)
    masks = [mask for mask, _ in regions]
    if noise.erode_px or noise.dilate_px:
        masks = [_resize(mask, noise.erode_px, noise.dilate_px) for mask in masks]
    return masks, _flip([name for _, name in regions], known, noise.flip_probability, generator)


def _merge(regions: list[Region], probability: float, generator: np.random.Generator) -> list[Region]:
    """Each drawn mask is merged into the largest touching mask, with the name of the larger of the two."""
    is_drawn = generator.random(len(regions)) < probability
    merged = dict(enumerate(regions))
    for k in np.flatnonzero(is_drawn).tolist():
        mask, name = merged[k]
        grown = _resize(mask, 0, 2)
        sizes = {j: np.count_nonzero(near) for j, (near, _) in merged.items() if j != k and np.any(grown & near)}
        if sizes:
            other = max(sizes, key=lambda j: sizes[j])
            near, near_name = merged[other]
            merged[other] = near | mask, name if np.count_nonzero(mask) > sizes[other] else near_name
            del merged[k]
    return list(merged.values())


def _split(regions: list[Region], probability: float, generator: np.random.Generator) -> list[Region]:
    is_drawn = generator.random(len(regions)) < probability
    angles = generator.random(len(regions)) * math.pi
    pieces: list[Region] = []
    for (mask, name), drawn, angle in zip(regions, is_drawn, angles, strict=True):
        if not drawn or not mask.any():
            pieces.append((mask, name))
            continue
        v, u = np.nonzero(mask)
        side = (u - u.mean()) * math.cos(angle) + (v - v.mean()) * math.sin(angle) > 0
        first = np.zeros_like(mask)
        first[v[side], u[side]] = True
        pieces += [(first, name), (mask & ~first, name)]
    return pieces


def _resize(mask: BoolArray, erode_px: int, dilate_px: int) -> BoolArray:
    import cv2

    image: UInt8Array = mask.astype(np.uint8)
    if erode_px:
        image = np.asarray(cv2.erode(image, _disc(erode_px), borderType=cv2.BORDER_REPLICATE), np.uint8)
    if dilate_px:
        image = np.asarray(cv2.dilate(image, _disc(dilate_px)), np.uint8)
    return image.astype(bool)


def _disc(radius: int) -> UInt8Array:
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return np.asarray(u**2 + v**2 <= radius**2, np.uint8)


def _flip(names: list[str], known: list[str], probability: float, generator: np.random.Generator) -> list[str]:
    is_drawn = generator.random(len(names)) < probability
    picks = generator.random(len(names))
    flipped = []
    for name, drawn, pick in zip(names, is_drawn, picks, strict=True):
        others = [other for other in known if other != name]
        flipped.append(others[int(pick * len(others))] if drawn and others else name)
    return flipped


if TYPE_CHECKING:
    import open3d


class OracleConfig(BaseModel):
    """Parameters for projecting the ground truth into a frame.

    A pixel takes the instance of the surface hit by its ray if that surface is within ``depth_tolerance_m`` of the
    measured depth. Pixels that hit nothing, or another surface, take the instance of the nearest labelled pixel within
    ``fill_px`` whose depth is within the tolerance, because scanned surfaces have small holes. Instances with fewer
    than ``min_pixels`` are dropped.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    depth_tolerance_m: float = Field(default=0.05, gt=0)
    fill_px: int = Field(default=3, ge=0)
    min_pixels: int = Field(default=100, ge=1)  # 10x10 pixels, the minimum for a crop
    prompt: str = Field(default="{} in a scene", pattern=r"\{\}")  # its text feature is used for a region
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
    """Instance images of objects with known boxes: a measured point belongs to the smallest box that contains it."""

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
    """Regions of the visible parts of the ground-truth instances, named by class, with score 1."""

    name = "oracle"

    def __init__(self, truth: InstanceMesh | ObjectBoxes, config: OracleConfig) -> None:
        self._truth = truth
        self._config = config
        self._earlier: tuple[int, OracleSegmenter] | None = None
        self._projector: MeshProjector | BoxProjector
        if isinstance(truth, InstanceMesh):
            self._projector = MeshProjector(truth, config)
            digest = array_digest(truth.vertices, truth.triangles, truth.instance_of_triangle)
            if truth.earlier is not None:
                self._earlier = truth.first_frame, OracleSegmenter(truth.earlier, config)
                digest = content_key(digest, self._earlier[1].digest, str(truth.first_frame))
        else:
            self._projector = BoxProjector(truth, config)
            digest = _digest_of_boxes(truth)
        names = [f"{key}={truth.class_of_instance[key]}" for key in sorted(truth.class_of_instance)]
        self.digest: str = content_key(
            "oracle",
            config.model_dump_json(),
            package_digest(*CODE),
            digest,
            *truth.labels.names,
            *names,
        )

    def segment(self, frame: Frame) -> Regions:
        if self._earlier is not None and frame.index < self._earlier[0]:
            return self._earlier[1].segment(frame)
        instance = self._projector.instance_image(frame)
        ids, counts = np.unique(instance, return_counts=True)
        of_class = self._truth.class_of_instance
        kept = [int(i) for i, n in zip(ids, counts, strict=True) if n >= self._config.min_pixels and int(i) in of_class]
        names = [self._truth.labels.name_of(of_class[i]) for i in kept]
        masks = [instance == i for i in kept]
        known = sorted({self._truth.labels.name_of(c) for c in of_class.values()})
        masks, names = apply_noise(masks, names, known, self._config.noise, frame.index)
        pairs = [(m, n) for m, n in zip(masks, names, strict=True) if np.count_nonzero(m) >= self._config.min_pixels]
        stacked = np.array([m for m, _ in pairs], bool).reshape(len(pairs), *instance.shape)
        return Regions(stacked, mask_boxes(stacked), np.ones(len(pairs), np.float32), tuple(n for _, n in pairs))


ORACLE_CAVEAT = "oracle perception: masks and names come from the ground truth; a ceiling, not a result"


class OraclePerception:
    """The ground truth seen from the frame; features are those of the class names, equal at every ratio."""

    profile = "oracle"
    caveat: str | None = ORACLE_CAVEAT

    def __init__(
        self, config: OracleConfig, truth: InstanceMesh | ObjectBoxes, encoder: Encoder, cache: FrameCache
    ) -> None:
        self.encoder = encoder
        self.segmenter = OracleSegmenter(truth, config)
        self._prompt = config.prompt
        self._cache = cache
        self._assembler = Assembler(encoder, cache)
        self.digest = content_key(self.profile, self.segmenter.digest, encoder.digest)

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        regions = cached_regions(self.segmenter, frame, self._cache, True, timer)
        assert regions.names is not None
        with timer.stage("encode"):
            features = self.features_of(regions.names)
        mean = features.astype(np.float64).sum(axis=0)
        length = float(np.linalg.norm(mean))
        whole = (mean / length if length > 0 else mean).astype(np.float32)
        known = dict.fromkeys(needs.crop_ratios, features)
        return self._assembler.assemble(frame, regions, needs, timer, known=known, global_feature=whole)

    def regions(self) -> RegionPerception:
        return OracleRegions(self)

    def features_of(self, names: tuple[str, ...]) -> Float32Array:
        """The features (K, D) of class names in the prompt."""
        prompts = [self._prompt.replace("{}", with_article(name)) for name in names]
        rows = [self._assembler.text_features([prompt]) for prompt in prompts]  # one by one: independent
        return np.array(rows, np.float32).reshape(len(names), self.encoder.dim)


class OracleRegions(RegionsOnDemand):
    """``RegionPerception`` from ground truth: the instance under the points, its name feature for every crop."""

    def __init__(self, oracle: OraclePerception) -> None:
        super().__init__(oracle.segmenter.segment, oracle.encoder)
        self._features_of = oracle.features_of

    def encode_regions(self, frame: Frame, mask: BoolArray, boxes: Int64Array) -> Float32Array:
        """The name feature of the instance with most of ``mask``; zeros if there is none."""
        regions = self._regions(frame)
        rows, columns = np.nonzero(mask)
        best, _ = region_under(regions.masks, np.stack([columns, rows], axis=1))
        if best < 0:
            return np.zeros((len(boxes), self.dim), np.float32)
        assert regions.names is not None
        return np.repeat(self._features_of((regions.names[best],)), len(boxes), axis=0)
