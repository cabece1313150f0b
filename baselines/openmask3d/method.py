"""OpenMask3D: class-agnostic 3D proposals, each described by crops of the few views that show it best.

It is bound to its proposals: what no proposal covers is never found, what one merges stays merged.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from su3d_bench.baselines.openmask3d.features import FeatureMeans, crop_boxes, prompted_mask
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
from su3d_bench.core.interfaces import MethodAbout, SceneTools, StageTimer
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Detections, Float64Array, Frame, PerceptionNeeds, SceneInfo

Pixels = Annotated[int, Field(ge=2, le=65536)]


class OpenMask3DConfig(ProposalConfig):
    """Hyper-parameters of views, prompts and crops with the names and values of the original's ScanNet200 run.

    The masks are Mask3D's where ``proposals_folder`` names them.

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


class OpenMask3D:
    """OpenMask3D: 3D proposals of Mask3D's kind, described by CLIP features of their five best views."""

    name = "openmask3d"
    Config: type[OpenMask3DConfig] = OpenMask3DConfig
    about = MethodAbout(
        paper="Takmaz et al.: OpenMask3D: Open-Vocabulary 3D Instance Segmentation, NeurIPS 2023",
        source="https://github.com/OpenMask3D/openmask3d, commit 3bc3fc5",
        licence="MIT",
        needs=("a mesh of the scan", "Mask3D's exported masks; without them weight-free proposals from the mesh"),
        status="projection, view selection, crops and means are tested on hand-worked values, its file formats on made "
        "files; segments equal those of ScanNet's program on made meshes; run beside the original program on one made "
        "room with the same masks: the same views, 72 of 72 crops; Mask3D's score of a part is a mean of its heat map, "
        "which exports do not hold; no figure of the paper has been reproduced",
    )

    needs_surface = True  # its proposals lie on the scan's mesh

    def __init__(self, config: OpenMask3DConfig | None = None) -> None:
        self.config = config or self.Config()
        self.finish_costs: dict[str, float | int] = {}  # frames read again and views looked at by the last ``finish``

    @property
    def needs(self) -> PerceptionNeeds:
        """No detections: it prompts for masks itself, where its proposals lie."""
        return PerceptionNeeds(masks="none", true_proposals=self.config.kind == "oracle")

    @property
    def caveat(self) -> str | None:
        return self.config.caveat

    @property
    def inputs(self) -> Mapping[str, str]:
        """Digest of the proposals' files."""
        return self.config.inputs

    @property
    def n_points(self) -> int:
        return len(self.proposals.points)

    @property
    def map_bytes(self) -> int:
        """What the proposals take: their points, masks and scores."""
        proposals = self.proposals
        arrays = (proposals.points, proposals.indptr, proposals.indices, proposals.scores)
        return sum(array.nbytes for array in arrays)

    @property
    def n_instances(self) -> int:
        return len(self.proposals)

    def receive_tools(self, tools: SceneTools) -> None:
        """The frames to look at again, the mesh, and perception on demand."""
        self._tools = tools

    def start(self, scene: SceneInfo) -> None:
        """Makes or reads the proposals."""
        self.proposals = make_proposals(self.config, self._tools, scene.dataset, scene.scene)
        self.finish_costs = {}
        self._scene = scene
        self._views = MaskViews(len(self.proposals), self.config.top_k)
        self._frame_indices: list[int] = []

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Enters the frame among the views of the masks it shows; costs what the mesh and the masks are large."""
        with timer.stage("project"):
            pixels = self._visible(frame)
        with timer.stage("select"):
            counts = count_pixels(pixels, self.proposals, frame.depth_m.size)
            self._views.add(len(self._frame_indices), counts)
        self._frame_indices.append(frame.index)

    def finish(self) -> Instances:
        """The proposals with the mean feature of their best views so far; changes nothing.

        The chosen frames are read again, once each and in order.
        """
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

    def _look(self, mask: int, frame: Frame, visible: np.ndarray, means: FeatureMeans) -> int:
        """Adds the features of the crops of one view of ``mask``; 0 where its prompts find nothing."""
        config, regions = self.config, self._tools.regions
        pixels = pixels_of_mask(visible, self.proposals.mask(mask), frame.depth_m.shape[1])
        # Each view has a generator of its own, so that neither other masks nor an earlier finish move its prompts.
        rng = np.random.default_rng([self._scene.seed, mask, frame.index])
        seen = prompted_mask(regions, frame, pixels, config.num_random_rounds, config.num_selected_points, rng)
        if seen is None:
            return 0
        boxes = crop_boxes(seen, config.num_of_levels, config.multi_level_expansion_ratio)
        means.add(mask, regions.encode_regions(frame, seen, boxes))
        return 1

    def _instances(self, features: Float64Array) -> Instances:
        proposals, views = self.proposals, self._views
        k = len(proposals)
        is_view = views.positions != NO_VIEW
        frame_of = np.append(np.array(self._frame_indices, np.int32), np.int32(-1))
        # In the order of their number of pixels; of a view no detection is known but the mask itself.
        rows = np.stack([frame_of[views.positions], np.broadcast_to(np.arange(k)[:, None], is_view.shape)], axis=-1)
        return Instances.of(
            proposals.points,
            proposals,
            None if self.config.confidence == "ones" else proposals.scores,
            features.astype(np.float32),
            views=[rows[mask, is_view[mask]].tolist() for mask in range(k)],
            ids=range(1, k + 1),
        )


# Views, prompts, crops and features are OpenMask3D's. Source of what differs: Segment3D's evaluation script at commit
# 1861478.
class OpenMask3DSegment3DConfig(OpenMask3DConfig):
    """OpenMask3D's settings with Segment3D's for proposals: 400 queries, and parts by density instead of by gaps."""

    part_eps_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.05  # general.dbscan_eps
    part_min_points: int = Field(default=5, ge=1)  # general.dbscan_min_points
    part_most_dropped: int = Field(default=15, ge=0)
    part_kept_share: Annotated[float, Field(gt=0, le=1)] = 0.8  # general.topk_per_image
    surface_most: int = Field(default=400, ge=1, le=100_000)  # queries of the evaluation script
    surface_min_points: int = Field(default=16, ge=1)  # more than what part_most_dropped drops
    # SAM cuts objects into parts and parts of parts; so of two nested proposals more stay beside each other.
    surface_same_iou: Annotated[float, Field(gt=0, le=1)] = 0.8


class OpenMask3DSegment3D(OpenMask3D):
    """OpenMask3D with Segment3D's proposals: many fine parts, small and weak ones dropped."""

    name = "openmask3d-segment3d"
    Config = OpenMask3DSegment3DConfig
    about = MethodAbout(
        paper="Huang et al.: Segment3D: Learning Fine-Grained Class-Agnostic 3D Segmentation without Manual Labels, "
        "ECCV 2024, with the features of OpenMask3D (NeurIPS 2023)",
        source="https://github.com/LeapLabTHU/Segment3D, commit 1861478; "
        "https://github.com/OpenMask3D/openmask3d, commit 3bc3fc5",
        licence="Apache-2.0 (Segment3D); MIT (OpenMask3D)",
        needs=("a mesh of the scan", "Segment3D's exported masks; without them weight-free proposals from the mesh"),
        status="as openmask3d; connected parts, dropped ones and the kept share are tested on hand-worked values; no "
        "public file of these proposals was found; Segment3D's score of a part is a mean of its heat map, "
        "which exports do not hold: parts keep the score of their mask; no figure has been reproduced",
    )
