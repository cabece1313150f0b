"""OpenMask3D: class-agnostic 3D proposals, each described by crops of the few views that show it best.

It depends on its proposals: objects without a proposal are never found, merged ones stay merged. Selection of views,
prompted masks, crops at levels and their mean: openmask3d/mask_features_computation/utils.py,
features_extractor.py and openmask3d/data/load.py at commit 3bc3fc5.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from su3d_bench.baselines.openmask3d.proposals import SOURCE, ProposalConfig, digest_of_folder, make_proposals
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import MethodAbout, RegionPerception, SceneTools, StageTimer
from su3d_bench.core.maps import Instances, Proposals
from su3d_bench.core.types import (
    BoolArray,
    Detections,
    Float32Array,
    Float64Array,
    Frame,
    Int32Array,
    Int64Array,
    PerceptionNeeds,
    SceneInfo,
)
from su3d_bench.perception.cache import mask_boxes


def prompted_mask(
    regions: RegionPerception, frame: Frame, pixels: Int64Array, n_rounds: int, n_points: int, rng: np.random.Generator
) -> BoolArray | None:
    """The mask (H, W) with the highest score in ``n_rounds``, each prompted by ``n_points`` random ones of ``pixels``.

    The first in a tie; None if every round is empty or has score 0, where the original stops with an error.
    """
    best, best_score = None, 0.0
    for _ in range(n_rounds):
        mask, score = regions.mask_at(frame, pixels[rng.choice(len(pixels), min(n_points, len(pixels)), replace=False)])
        if score > best_score and mask.any():
            best, best_score = mask, score
    return best


def crop_boxes(mask: BoolArray, n_levels: int, growth: float) -> Int64Array:
    """Boxes (n_levels, 4), x0 y0 x1 y1, right and bottom exclusive, of a non-empty mask.

    Level 0 is tight; level l is larger on every side by l times the floor of the growth times the side, clipped.

    >>> mask = np.zeros((40, 60), bool); mask[10:35, 5:24] = True
    >>> crop_boxes(mask, 3, 0.1).tolist()  # 19 x 25: steps of 1 and 2
    [[5, 10, 24, 35], [4, 8, 25, 37], [3, 6, 26, 39]]
    """
    x0, y0, x1, y1 = mask_boxes(mask[None])[0].astype(np.int64).tolist()
    step_x, step_y = int((x1 - x0) * growth), int((y1 - y0) * growth)
    steps = np.arange(n_levels)[:, None] * np.array([-step_x, -step_y, step_x, step_y])
    height, width = mask.shape
    return np.asarray(np.clip(np.array([x0, y0, x1, y1]) + steps, 0, [width, height, width, height]), np.int64)


NO_VIEW = -1


def swapped_intrinsics(intrinsics: Float64Array, resolution: tuple[int, int], height: int, width: int) -> Float64Array:
    """OpenMask3D's version of ``intrinsics`` (3, 3) at ``resolution`` (height, width) for images of another size.

    The focal lengths are scaled by a floored width over the height, and by the width; each centre by the other axis's
    factor: this is a bug of the original, which shifts the centre by about a pixel.

    >>> colour = np.array([[1170.0, 0, 648], [0, 1170, 484], [0, 0, 1]])
    >>> swapped_intrinsics(colour, (968, 1296), 480, 640).round(2).tolist()
    [[577.75, 0.0, 320.98], [0.0, 577.78, 238.82], [0.0, 0.0, 1.0]]
    """
    full_height, full_width = resolution
    scaled = np.array(intrinsics, np.float64)
    scaled[0, 0] *= np.floor(width * full_height / full_width) / full_height
    scaled[1, 1] *= width / full_width
    scaled[0, 2] *= (height - 1) / (full_height - 1)
    scaled[1, 2] *= (width - 1) / (full_width - 1)
    return scaled


def as_openmask3d(frame: Frame, resolution: tuple[int, int]) -> Float64Array:
    """The intrinsics that OpenMask3D would use for ``frame`` if it were downsampled from ``resolution``.

    The camera at full resolution is the frame's, scaled up per axis, with centres between corner pixels.
    """
    height, width = frame.depth_m.shape
    full_height, full_width = resolution
    full = np.array(frame.intrinsics, np.float64)
    full[0, 0] *= full_width / width
    full[1, 1] *= full_height / height
    full[0, 2] *= (full_width - 1) / (width - 1)
    full[1, 2] *= (full_height - 1) / (height - 1)
    return swapped_intrinsics(full, resolution, height, width)


def visible_pixels(
    points: Float32Array, frame: Frame, intrinsics: Float64Array, depth_tolerance_m: float
) -> Int32Array:
    """The pixel (V,), row * width + column, at which each point is visible; -1 if it is not.

    A pixel is the projection truncated toward zero, so -0.9 is in pixel 0. A point is visible if its depth
    differs from the image's by at most ``depth_tolerance_m``. As in the original, negative depth is not excluded:
    at a hole of the depth image (depth 0), a point within the tolerance of the camera plane is visible,
    on either side; one exactly in the plane falls on the first pixel.
    """
    from su3d_bench.baselines.openmask3d.kernels import project

    projection = intrinsics @ np.linalg.inv(frame.camera_to_world)[:3]
    pixels: Int32Array = project(points, projection, frame.depth_m, depth_tolerance_m)
    return pixels


class MaskViews:
    """The ``k`` views of each mask with the most pixels so far; ties go to the earlier view.

    ``positions`` (K, k) are positions of frames in the order of ``add``, -1 if there are fewer; ``n_pixels`` (K, k).
    The original sorts unstably: its choice among equal views depends on NumPy and the machine.
    """

    def __init__(self, n_masks: int, k: int) -> None:
        self.positions = np.full((n_masks, k), NO_VIEW, np.int32)
        self.n_pixels = np.zeros((n_masks, k), np.int64)

    def add(self, position: int, n_pixels: Int64Array) -> None:
        """Add the view ``position``, later than all before, in which each mask covers ``n_pixels`` (K,)."""
        if not self.positions.size:
            return
        better = np.flatnonzero(n_pixels > self.n_pixels[:, -1])
        counts = np.column_stack([self.n_pixels[better], n_pixels[better]])
        views = np.column_stack([self.positions[better], np.full(len(better), position, np.int32)])
        order = np.argsort(-counts, axis=1, kind="stable")[:, :-1]
        self.n_pixels[better] = np.take_along_axis(counts, order, axis=1)
        self.positions[better] = np.take_along_axis(views, order, axis=1)


def count_pixels(pixels: Int32Array, proposals: Proposals, n_image: int) -> Int64Array:
    """Number of distinct ``pixels`` (V,), of ``n_image`` in total, that each mask covers (K,)."""
    from su3d_bench.baselines.openmask3d.kernels import count_distinct

    counts: Int64Array = count_distinct(pixels, proposals.indptr, proposals.indices, n_image)
    return counts


def pixels_of_mask(pixels: Int32Array, members: Int32Array, width: int) -> Int64Array:
    """The distinct pixels (P, 2), x y, of the points ``members``, row by row."""
    seen = np.unique(pixels[members])
    seen = seen[seen >= 0].astype(np.int64)
    return np.stack([seen % width, seen // width], axis=1)


Pixels = Annotated[int, Field(ge=2, le=65536)]


class OpenMask3DConfig(ProposalConfig):
    """Hyper-parameters of views, prompts and crops, named and set as in the original's ScanNet200 run.

    The masks are Mask3D's if ``proposals_folder`` contains them.

    ``intrinsics``: ``as-is`` projects with the frame's own; ``openmask3d`` with the original's scaling,
    as if frames had been downsampled from ``intrinsic_resolution`` (height, width): its centre is about a pixel off.
    ``confidence``: 1 for every mask, as in the original's evaluation, or the score of its ``proposal``.
    """

    stride: int = Field(default=10, ge=1)  # openmask3d.frequency
    top_k: int = Field(default=5, ge=1, le=1000)
    vis_threshold: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.2  # m
    num_random_rounds: int = Field(default=10, ge=1, le=1000)
    num_selected_points: int = Field(default=5, ge=1, le=1000)
    num_of_levels: int = Field(default=3, ge=1, le=100)
    multi_level_expansion_ratio: Annotated[float, Field(ge=0, le=10)] = 0.1
    intrinsics: Literal["as-is", "openmask3d"] = "as-is"
    intrinsic_resolution: Annotated[tuple[Pixels, Pixels], Field(strict=False)] = (968, 1296)
    confidence: Literal["ones", "proposal"] = "ones"


class OpenMask3D:
    """OpenMask3D: 3D proposals as from Mask3D, described by CLIP features of their five best views."""

    name = "openmask3d"
    Config: type[OpenMask3DConfig] = OpenMask3DConfig
    about = MethodAbout(
        paper="Takmaz et al.: OpenMask3D: Open-Vocabulary 3D Instance Segmentation, NeurIPS 2023",
        source="https://github.com/OpenMask3D/openmask3d, commit 3bc3fc5",
        licence="MIT",
        needs=("a mesh of the scan", "Mask3D's exported masks; without them geometric proposals from the mesh"),
        status="projection, view choice, crops and means are tested on hand-worked values, file formats on synthetic "
        "files; segments match ScanNet's program on synthetic meshes; compared with the original on a generated "
        "room with the same masks: the same views, 72 of 72 crops; Mask3D's score of a part is a mean of its heat map, "
        "which exports lack; no results of the paper have been reproduced",
    )

    needs_surface = True  # its proposals are on the scan's mesh

    def __init__(self, config: OpenMask3DConfig | None = None) -> None:
        self.config = config or self.Config()
        self.finish_costs: dict[str, float | int] = {}  # frames read again and views used by the last ``finish``

    @property
    def needs(self) -> PerceptionNeeds:
        """No detections: it prompts for masks itself, at its proposals."""
        return PerceptionNeeds(masks="none", true_proposals=self.config.kind == "oracle")

    @property
    def caveat(self) -> str | None:
        """The caveat on results from these proposals."""
        return SOURCE if self.config.kind == "surface" else None

    @property
    def inputs(self) -> Mapping[str, str]:
        """Digest of the proposals' files, which are not part of the configuration."""
        folder = self.config.proposals_folder
        return {} if folder is None else {"proposals": digest_of_folder(folder)}

    @property
    def n_points(self) -> int:
        return len(self.proposals.points)

    @property
    def map_bytes(self) -> int:
        """Bytes of the proposals: points, masks and scores."""
        proposals = self.proposals
        arrays = (proposals.points, proposals.indptr, proposals.indices, proposals.scores)
        return sum(array.nbytes for array in arrays)

    @property
    def n_instances(self) -> int:
        return len(self.proposals)

    def receive_tools(self, tools: SceneTools) -> None:
        """Access to frames for reading again, and perception on demand."""
        self._tools = tools

    def start(self, scene: SceneInfo) -> None:
        """Creates or reads the proposals."""
        shared, key = self._tools.shared, f"{self.name} {self.config.model_dump_json()}"
        if key not in shared:
            shared[key] = make_proposals(self.config, scene, self._tools.true_proposals)
        self.proposals = shared[key]
        self.finish_costs = {}
        self._scene = scene
        self._views = MaskViews(len(self.proposals), self.config.top_k)
        self._frame_indices: list[int] = []

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Adds the frame to the views of its visible masks; cost grows with mesh and masks."""
        with timer.stage("project"):
            pixels = self._visible(frame)
        with timer.stage("select"):
            counts = count_pixels(pixels, self.proposals, frame.depth_m.size)
            self._views.add(len(self._frame_indices), counts)
        self._frame_indices.append(frame.index)

    def finish(self) -> Instances:
        """The proposals with the mean feature of their best views so far; changes nothing.

        The plain mean of the unit features of all crops of a mask, not normalized; zeros without a
        crop. The selected frames are read again, once each and in order.
        """
        start = time.perf_counter()
        k = len(self.proposals)
        sums, n_crops = np.zeros((k, self._tools.regions.dim)), np.zeros(k, np.int64)
        chosen = np.unique(self._views.positions[self._views.positions != NO_VIEW])
        n_views = 0
        for position in chosen.tolist():
            frame = self._frame_again(position)
            pixels = self._visible(frame)
            for mask in np.flatnonzero((self._views.positions == position).any(axis=1)).tolist():
                features = self._view_features(mask, frame, pixels)
                sums[mask] += features.astype(np.float64).sum(axis=0)
                n_crops[mask] += len(features)
                n_views += len(features) > 0
        self.finish_costs = {
            "n_frames_again": len(chosen),
            "n_views": n_views,
            "look_ms": round((time.perf_counter() - start) * 1e3, 3),
        }
        return self._instances(sums / np.maximum(n_crops, 1)[:, None])

    def _visible(self, frame: Frame) -> np.ndarray:
        config = self.config
        exact = config.intrinsics == "as-is"
        intrinsics = frame.intrinsics if exact else as_openmask3d(frame, config.intrinsic_resolution)
        return visible_pixels(self.proposals.points, frame, intrinsics, config.vis_threshold)

    def _frame_again(self, position: int) -> Frame:
        frame = self._tools.frames[position]
        if frame.index != self._frame_indices[position]:
            raise DataError(
                f"{self._scene.dataset}/{self._scene.scene}: update {position} was frame "
                f"{self._frame_indices[position]}, read again it is frame {frame.index}; the scene has changed"
            )
        return frame

    def _view_features(self, mask: int, frame: Frame, visible: np.ndarray) -> Float32Array:
        """The features of the crops of one view of ``mask``; none if its prompts find nothing."""
        config, regions = self.config, self._tools.regions
        pixels = pixels_of_mask(visible, self.proposals.mask(mask), frame.depth_m.shape[1])
        # Each view has its own generator, so its prompts do not depend on other masks or an earlier finish.
        rng = np.random.default_rng([self._scene.seed, mask, frame.index])
        seen = prompted_mask(regions, frame, pixels, config.num_random_rounds, config.num_selected_points, rng)
        if seen is None:
            return np.zeros((0, regions.dim), np.float32)
        boxes = crop_boxes(seen, config.num_of_levels, config.multi_level_expansion_ratio)
        return regions.encode_regions(frame, seen, boxes)

    def _instances(self, features: Float64Array) -> Instances:
        proposals, views = self.proposals, self._views
        k = len(proposals)
        is_view = views.positions != NO_VIEW
        frame_of = np.append(np.array(self._frame_indices, np.int32), np.int32(-1))
        # Ordered by number of pixels; the only known detection of a view is the mask itself.
        rows = np.stack([frame_of[views.positions], np.broadcast_to(np.arange(k)[:, None], is_view.shape)], axis=-1)
        return Instances.of(
            proposals.points,
            proposals,
            None if self.config.confidence == "ones" else proposals.scores,
            features.astype(np.float32),
            views=[rows[mask, is_view[mask]].tolist() for mask in range(k)],
            ids=range(1, k + 1),
        )


# Views, prompts, crops and features are OpenMask3D's. Source of differences: Segment3D's evaluation script at commit
# 1861478.
class OpenMask3DSegment3DConfig(OpenMask3DConfig):
    """OpenMask3D's settings with Segment3D's for proposals: 400 queries, and parts by density instead of gaps."""

    part_eps_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.05  # general.dbscan_eps
    part_min_points: int = Field(default=5, ge=1)  # general.dbscan_min_points
    part_max_dropped: int = Field(default=15, ge=0)
    part_kept_share: Annotated[float, Field(gt=0, le=1)] = 0.8  # general.topk_per_image
    surface_max: int = Field(default=400, ge=1, le=100_000)  # queries of the evaluation script
    surface_min_points: int = Field(default=16, ge=1)  # more than part_max_dropped
    # SAM splits objects into parts and parts of parts; so more nested proposals are kept.
    surface_duplicate_iou: Annotated[float, Field(gt=0, le=1)] = 0.8


class OpenMask3DSegment3D(OpenMask3D):
    """OpenMask3D with Segment3D's proposals: many fine parts; small and weak ones are dropped."""

    name = "openmask3d-segment3d"
    Config = OpenMask3DSegment3DConfig
    about = MethodAbout(
        paper="Huang et al.: Segment3D: Learning Fine-Grained Class-Agnostic 3D Segmentation without Manual Labels, "
        "ECCV 2024, with the features of OpenMask3D (NeurIPS 2023)",
        source="https://github.com/LeapLabTHU/Segment3D, commit 1861478; "
        "https://github.com/OpenMask3D/openmask3d, commit 3bc3fc5",
        licence="Apache-2.0 (Segment3D); MIT (OpenMask3D)",
        needs=("a mesh of the scan", "Segment3D's exported masks; without them geometric proposals from the mesh"),
        status="as openmask3d; connected parts, dropped ones and the kept share are tested on hand-worked values; no "
        "public file of these proposals was found; Segment3D's score of a part is a mean of its heat map, "
        "which exports lack: parts keep the score of their mask; no results have been reproduced",
    )
