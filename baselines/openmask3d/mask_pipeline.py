"""OpenMask3D's way from 3D masks to features: the best views of each mask, looked at again at the end."""

from __future__ import annotations

import time
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from su3d_bench.baselines.openmask3d.features import FeatureMeans, Looking, crop_boxes, prompted_mask
from su3d_bench.baselines.openmask3d.proposals import ProposalConfig, make_proposals
from su3d_bench.baselines.openmask3d.views import (
    NO_VIEW,
    MaskViews,
    as_openmask3d,
    count_pixels,
    pixels_of_mask,
    visible_pixels,
)
from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import SceneTools, StageTimer
from su3d_bench.core.types import Float32Array, Float64Array, Frame, Instances, Int64Array, SceneInfo

Pixels = Annotated[int, Field(ge=2, le=65536)]


class MaskPipelineConfig(ProposalConfig):
    """Hyper-parameters of views, prompts and crops with the names and values of OpenMask3D's configuration.

    ``intrinsics``: ``as-is`` projects with the frame's own; ``openmask3d`` with what the original's scaling would make
    of them, had the frames been reduced from ``intrinsic_resolution`` (height, width): its centre is about a pixel off.
    ``confidence``: 1 for every mask, as the original is evaluated, or the score of its ``proposal``.
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

    @property
    def looking(self) -> Looking:
        """How a view is looked at."""
        return Looking(
            self.num_random_rounds, self.num_selected_points, self.num_of_levels, self.multi_level_expansion_ratio
        )


class MaskPipeline:
    """Counts in each update what each mask shows; ``finish`` reads the chosen frames again, once each and in order."""

    def __init__(self, config: MaskPipelineConfig, tools: SceneTools, scene: SceneInfo) -> None:
        self.proposals = make_proposals(config, tools, scene.dataset, scene.scene)
        self.finish_costs: dict[str, float | int] = {}
        self._config, self._tools, self._scene = config, tools, scene
        self._views = MaskViews(len(self.proposals), config.top_k)
        self._frame_indices: list[int] = []

    def update(self, frame: Frame, timer: StageTimer) -> None:
        """Projects all vertices into the frame and enters it among each mask's views."""
        with timer.stage("project"):
            pixels = self._visible(frame)
        with timer.stage("select"):
            counts = count_pixels(pixels, self.proposals, frame.depth_m.size)
            self._views.add(len(self._frame_indices), counts)
        self._frame_indices.append(frame.index)

    def _visible(self, frame: Frame) -> np.ndarray:
        config = self._config
        exact = config.intrinsics == "as-is"
        intrinsics = frame.intrinsics if exact else as_openmask3d(frame, config.intrinsic_resolution)
        return visible_pixels(self.proposals.points, frame, intrinsics, config.vis_threshold)

    def finish(self) -> Instances:
        """The proposals with the mean feature of their views so far; changes nothing."""
        start = time.perf_counter()
        means = FeatureMeans(len(self.proposals), self._tools.regions.dim)
        chosen = np.unique(self._views.positions[self._views.positions != NO_VIEW])
        n_views = 0
        for position in chosen.tolist():
            frame = self._frame_again(position)
            pixels = self._visible(frame)
            for mask in np.flatnonzero((self._views.positions == position).any(axis=1)).tolist():
                n_views += self._look(mask, frame, pixels, means)
        self.finish_costs = {
            "n_frames_again": len(chosen),
            "n_views": n_views,
            "look_ms": round((time.perf_counter() - start) * 1e3, 3),
        }
        return self._instances(means.means)

    def _frame_again(self, position: int) -> Frame:
        frame = self._tools.frames[position]
        if frame.index != self._frame_indices[position]:
            raise DataError(
                f"{self._scene.dataset}/{self._scene.scene}: update {position} was frame "
                f"{self._frame_indices[position]}, read again it is frame {frame.index}; the scene has changed"
            )
        return frame

    def _look(self, mask: int, frame: Frame, visible: np.ndarray, means: FeatureMeans) -> int:
        """Adds the features of the crops of one view of ``mask``; 0 where its prompts find nothing."""
        config, regions = self._config, self._tools.regions
        pixels = pixels_of_mask(visible, self.proposals.mask(mask), frame.depth_m.shape[1])
        # Each view has a generator of its own, so that neither other masks nor an earlier finish move its prompts.
        rng = np.random.default_rng([self._scene.seed, mask, frame.index])
        seen = prompted_mask(regions, frame, pixels, config.looking, rng)
        if seen is None:
            return 0
        means.add(mask, regions.encode_regions(frame, seen, crop_boxes(seen, config.looking)))
        return 1

    def _instances(self, features: Float64Array) -> Instances:
        proposals, views = self.proposals, self._views
        k = len(proposals)
        is_view = views.positions != NO_VIEW
        frame_of = np.append(np.array(self._frame_indices, np.int32), np.int32(-1))
        # In the order of their number of pixels; of a view no detection is known but the mask itself.
        rows = np.stack([frame_of[views.positions], np.broadcast_to(np.arange(k)[:, None], is_view.shape)], axis=-1)
        boxes, centroids = _extents(proposals.points, proposals.indptr, proposals.indices)
        return Instances(
            points=proposals.points,
            indptr=proposals.indptr,
            indices=proposals.indices,
            scores=np.ones(k) if self._config.confidence == "ones" else proposals.scores,
            features=features.astype(np.float32),
            labels=None,
            names=("",) * k,
            captions=("",) * k,
            boxes=boxes,
            centroids=centroids,
            view_indptr=np.concatenate([[0], np.cumsum(is_view.sum(axis=1))]).astype(np.int64),
            views=rows[is_view].astype(np.int32).reshape(-1, 2),
            ids=np.arange(1, k + 1, dtype=np.int32),
        )


def _extents(points: Float32Array, indptr: Int64Array, indices: np.ndarray) -> tuple[Float32Array, Float32Array]:
    """Corners (K, 2, 3) and centroids (K, 3) of masks; zeros for an empty one."""
    k = len(indptr) - 1
    boxes, centroids = np.zeros((k, 2, 3), np.float32), np.zeros((k, 3), np.float32)
    for mask in range(k):
        members = points[indices[indptr[mask] : indptr[mask + 1]]]
        if len(members):
            boxes[mask] = members.min(axis=0), members.max(axis=0)
            centroids[mask] = members.mean(axis=0, dtype=np.float64)
    return boxes, centroids
