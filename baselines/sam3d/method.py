"""SAM3D: masks of single images, merged bottom-up into groups of one cloud by overlap only.

Yang, Wu, He, Zhao, Liu, "SAM3D: Segment Anything in 3D Scenes", 2023, and its code, Pointcept/SegmentAnything3D at
2aaa8c9. The original has no features, classes or scores; additions for open-vocabulary protocols are ours
and named so: one feature per group, and score 1.0 for all.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.baselines.sam3d import overlap
from su3d_bench.baselines.sam3d.overlap import NO_GROUP, GroupedCloud
from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.core.files.state import check_range, read_state, write_state
from su3d_bench.core.geometry import back_project, valid_depth
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.maps import Instances
from su3d_bench.core.system.timing import Timer
from su3d_bench.core.types import (
    BoolArray,
    Detections,
    Float32Array,
    Float64Array,
    Frame,
    Int64Array,
    PerceptionNeeds,
    SceneInfo,
    Surface,
)
from su3d_bench.metrics.matching.transfer import masks_of_partition, select

logger = logging.getLogger(__name__)
Metres = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SAM3DConfig(BaseModel):
    """Every hyper-parameter of SAM3D; the defaults are those of its code."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    stride: int = Field(default=20, ge=1)  # --frame_skip of the original's export
    voxel_m: Metres = 0.05  # --voxel_size
    overlap_ratio: float = Field(default=0.5, ge=0, le=1)  # cal_group's default, changed by no caller
    min_group_points: int = Field(default=50, ge=0)  # --th: points below which a group is dropped at the end
    merge_min_points: int = Field(default=50, ge=0)  # the same before each merge; 50 regardless of --th
    # "tree" merges neighbouring frames, then neighbouring pairs, ... at the end; "incremental" merges every
    # frame into the map immediately, as for SAM3D on a stream.
    merge_schedule: Literal["tree", "incremental"] = "tree"
    max_distance_m: Metres = 0.6  # vertices farther from every merged point have no group
    snap_to_segments: bool = False  # pcd_ensemble: groups snap to the mesh's over-segmentation
    snap_min_vertices: int = Field(default=20, ge=0)  # vertices, in pcd_ensemble
    features: Literal["mean-of-views", "largest-view"] = "mean-of-views"  # ours

    @property
    def rules(self) -> overlap.MergeRules:
        """Parameters of merging two clouds."""
        return overlap.MergeRules(self.voxel_m, self.overlap_ratio, self.merge_min_points)


@dataclass(frozen=True)
class _View:
    """One mask of one image, with its pixels that have a depth and are not painted over."""

    frame_index: int
    detection: int
    n_pixels: int
    feature: Float32Array
    name: str
    caption: str
    score: float


class SAM3D:
    """Masks of single images merged into groups by how many of their points overlap; features are not used.

    ``finish`` returns the groups so far without changing them.
    """

    name = "sam3d"
    warms_up = True
    finishes_in_fork = True
    Config = SAM3DConfig
    presets: ClassVar[Mapping[str, Mapping[str, object]]] = {
        "incremental": {"merge_schedule": "incremental"},
        "ensemble": {"snap_to_segments": True},
    }
    about = MethodAbout(
        paper="Yang, Wu, He, Zhao, Liu: SAM3D: Segment Anything in 3D Scenes, 2023",
        source="https://github.com/Pointcept/SegmentAnything3D, commit 2aaa8c9",
        licence="none stated in its README",
        needs=("class-agnostic masks", "the scan's mesh if snap_to_segments is on"),
        status=(
            "the merging of clouds, the tree and the ensemble match the original's output on reference inputs to the "
            "last id, with a stable sort in place of its unstable one; compared with the original on one generated "
            "room with the same masks: 503,520 of 503,520 vertices with the stable sort; its unstable one changes 2 "
            "of 39 groups; features of groups and scores are ours"
        ),
    )

    def __init__(self, config: SAM3DConfig | None = None) -> None:
        self.config = config or SAM3DConfig()
        self.finish_costs: dict[str, float | int] = {}  # the tree's stages, because it only merges in ``finish``
        self._clear()

    def _clear(self) -> None:
        self._clouds: list[GroupedCloud] = []  # one per frame, or only the map if incremental
        self._poses: dict[int, tuple[int, Float64Array]] = {}  # of a tree: frame -> its cloud and pose
        self._views: list[_View] = []
        self._surface: Surface | None = None
        self._scene = ""

    @property
    def needs(self) -> PerceptionNeeds:
        """Every region of an image, and the feature of its crop."""
        return PerceptionNeeds(masks="class-agnostic", automatic="sam")

    @property
    def needs_surface(self) -> bool:
        """Only the ensemble needs the scan's segments."""
        return self.config.snap_to_segments

    @property
    def caveat(self) -> str:
        """The original has neither features nor scores, and evaluates on the vertices of ScanNet's meshes."""
        return (
            f"sam3d itself has no features: ours are '{self.config.features}', and every score is 1; its groups "
            "are on the scan's mesh if the dataset has one, otherwise on its merged cloud"
        )

    @property
    def n_points(self) -> int:
        """Points stored: of the map, or of all frames while they wait for the tree."""
        return sum(len(cloud) for cloud in self._clouds)

    @property
    def n_instances(self) -> int:
        """Groups stored: of the map, or of all frames while they wait for the tree."""
        return sum(cloud.n_groups for cloud in self._clouds)

    @property
    def map_bytes(self) -> int:
        """Bytes of points, groups and view numbers, without the views' features."""
        parts = [(cloud.points, cloud.group, cloud.view_group, cloud.views) for cloud in self._clouds]
        return sum(array.nbytes for arrays in parts for array in arrays)

    def start(self, scene: SceneInfo) -> None:
        """Resets the map, and reads the mesh of the new scene if there is one."""
        self._clear()
        self._scene = f"{scene.dataset}/{scene.scene}"
        try:
            self._surface = scene.surface()
        except DataError as error:
            if self.config.snap_to_segments:
                raise DataError(
                    f"{self._scene}: sam3d's ensemble needs the scan's mesh ({error}); set snap_to_segments=false"
                ) from error
            logger.warning("%s: sam3d's groups stay on its own points; no mesh (%s)", self._scene, error)

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Add one image; with ``merge_schedule`` incremental it is merged at once, at cost proportional to the map."""
        detections.check_of(frame)
        n_dimensions = detections.crop_features.shape[2]
        if len(detections) and self._views and n_dimensions != len(self._views[0].feature):
            raise DataError(
                f"frame {frame.index}: features have {n_dimensions} dimensions, those of the map have "
                f"{len(self._views[0].feature)}; use one encoder for all"
            )
        with timer.stage("backproject"):
            pixels = valid_depth(frame.depth_m, 0.0, np.inf)
            points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels)
        with timer.stage("paint"):
            detection = paint(frame, detections.masks)[pixels]
            cloud = self._grouped(points, detection, detections)
        with timer.stage("voxelise"):
            cloud = overlap.voxelise(cloud, self.config.voxel_m)
        if not len(cloud):
            return
        if self.config.merge_schedule == "incremental" and self._clouds:
            merged = overlap.merge(self._clouds[0], cloud, self.config.rules, timer)
            self._clouds = [merged] if merged is not None else []
        else:
            self._poses[frame.index] = len(self._clouds), frame.camera_to_world
            self._clouds.append(cloud)

    def revise(self, poses: Mapping[int, Float64Array]) -> None:
        """Move the clouds of frames rigidly; each keeps the points that its voxels had before."""
        if self.config.merge_schedule == "incremental":
            raise ConfigError("sam3d@incremental: cannot be revised, because its map does not keep frames apart")
        if unknown := [index for index in poses if index not in self._poses]:
            raise ConfigError(f"sam3d: has no points of frame {unknown[0]}, so it cannot be revised")
        for index, pose in poses.items():
            place, before = self._poses[index]
            motion = pose @ np.linalg.inv(before)
            points = self._clouds[place].points @ motion[:3, :3].T + motion[:3, 3]
            self._clouds[place] = replace(self._clouds[place], points=points)
            self._poses[index] = place, pose

    def save_state(self, folder: Path) -> None:
        """Store the clouds, the views, and the scan's mesh."""
        of_frames = {"clouds": self._clouds, "poses": self._poses, "masks": self._views}
        write_state(folder, {**of_frames, "surface": self._surface, "scene": self._scene})

    def load_state(self, folder: Path) -> None:
        """Continue from a stored state."""
        values = read_state(folder, _FORMS, (GroupedCloud, _View, Surface))
        self._clear()
        self._clouds, self._poses, self._views = values["clouds"], values["poses"], values["masks"]
        self._surface, self._scene = values["surface"], str(values["scene"])
        for cloud in self._clouds:
            check_range("views", cloud.views, 0, len(self._views))
            for group in (cloud.group, cloud.view_group):
                check_range("group", group, NO_GROUP, len(cloud) + len(self._views) + 1)
        for place, pose in self._poses.values():
            if not 0 <= place < len(self._clouds) or pose.shape != (4, 4) or not np.isfinite(pose).all():
                raise ValueError("a pose is invalid")
        if self._surface is not None:
            check_range("triangles", self._surface.triangles, 0, len(self._surface.vertices))

    def _grouped(self, points: Float64Array, detection: Int64Array, detections: Detections) -> GroupedCloud:
        """The image's cloud, the last detection's group first; stores each detection as a view."""
        n_masks = len(detections)
        n_pixels = np.bincount(detection + 1, minlength=n_masks + 1)[1:]
        group = overlap.renumber(np.where(detection == NO_GROUP, NO_GROUP, n_masks - 1 - detection))
        visible = np.flatnonzero(n_pixels)[::-1]
        first_view = len(self._views)
        for k in visible.tolist():
            description = detections.names[k], detections.captions[k], float(detections.scores[k])
            self._views.append(
                _View(
                    detections.frame_index,
                    detections.row_of(k),
                    int(n_pixels[k]),
                    detections.crop_features[k, 0],
                    *description,
                )
            )
        rows = np.arange(len(visible))
        return GroupedCloud(points, group, rows, rows + first_view)

    def finish(self) -> Instances:
        """The groups of at least ``min_group_points`` points, on the mesh's vertices, otherwise on the merged cloud.

        A segment of the ensemble without a group has no feature and is not an instance.
        """
        timer = Timer()
        cloud = overlap.merge_regions(self._clouds, self.config.rules, timer)
        if cloud is None:
            logger.warning("%s: sam3d found no valid points in any frame; its map is empty", self._scene)
            cloud = _EMPTY
        cloud = overlap.numbered(overlap.without_small_groups(cloud, self.config.min_group_points))
        points, group = cloud.points.astype(np.float32), cloud.group
        if self._surface is not None:
            points = self._surface.vertices
            with timer.stage("surface"):
                group = overlap.groups_on_surface(cloud, points, self.config.max_distance_m)
            if self.config.snap_to_segments:
                with timer.stage("ensemble"):
                    group, cloud = self._in_segments(group, cloud, self._surface)
        instances = self._instances(points, group, cloud)
        self.finish_costs = {f"{stage}_ms": round(spent, 3) for stage, spent in timer.take().items()}
        return instances

    def _in_segments(self, group: Int64Array, cloud: GroupedCloud, surface: Surface) -> tuple[Int64Array, GroupedCloud]:
        """Groups of the vertices after the ensemble, and the cloud with its views renumbered accordingly."""
        segments = surface.segments
        if segments is None:
            from su3d_bench.baselines.mesh_segments.segments import mesh_segments

            segments = mesh_segments(surface.vertices, surface.triangles)
        large = overlap.without_small_groups(
            GroupedCloud(surface.vertices.astype(np.float64), group, cloud.view_group, cloud.views),
            self.config.snap_min_vertices,
        )
        return overlap.ensemble(
            group, segments, self.config.snap_min_vertices, self.config.overlap_ratio
        ), overlap.numbered(large)

    def _instances(self, points: Float32Array, group: Int64Array, cloud: GroupedCloud) -> Instances:
        ids = np.intersect1d(group, cloud.view_group)
        views = [np.sort(cloud.views[cloud.view_group == key]) for key in ids]
        largest = [max((self._views[v] for v in of), key=lambda view: view.n_pixels) for of in views]
        seen = [[self._views[v] for v in of] for of in views]
        return Instances.of(
            points,
            select(masks_of_partition(group, int(group.max(initial=NO_GROUP)) + 1), ids),
            None,  # the original has no scores
            self._features(views, largest),
            names=tuple(view.name for view in largest),
            captions=tuple(view.caption for view in largest),
            views=[[(view.frame_index, view.detection) for view in each] for each in seen],
            view_names=tuple(view.name for each in seen for view in each),
            view_scores=np.array([view.score for each in seen for view in each], np.float64),
            ids=ids,
        )

    def _features(self, views: Sequence[Int64Array], largest: Sequence[_View]) -> Float32Array:
        """One feature (K, D) per group, normalised: the mean over its views (unweighted), or that of the largest."""
        if self.config.features == "largest-view":
            means = [np.asarray(view.feature, np.float64) for view in largest]
        else:
            means = [np.mean([self._views[v].feature for v in of], axis=0, dtype=np.float64) for of in views]
        features = np.array(means).reshape(len(views), len(self._views[0].feature) if self._views else 0)
        norms = np.linalg.norm(features, axis=1, keepdims=True)
        unit: Float32Array = (features / np.maximum(norms, np.finfo(np.float64).tiny)).astype(np.float32)
        return unit


def paint(frame: Frame, masks: BoolArray) -> Int64Array:
    """The detection (H, W) of each pixel, NO_GROUP outside all masks; the first of overlapping masks is on top."""
    detection = np.full(frame.depth_m.shape, NO_GROUP, np.int64)
    for k in reversed(range(len(masks))):
        detection[masks[k]] = k
    return detection


_FORMS = {
    "points": "f8 N 3", "group": "i8 N", "view_group": "i8 W", "views": "i8 W", "feature": "f4 F",
    "vertices": "f4 M 3", "triangles": "i4 T 3", "segments": "i4 M",
}  # fmt: skip
_NO_IDS = np.zeros(0, np.int64)
_EMPTY = GroupedCloud(np.zeros((0, 3)), _NO_IDS, _NO_IDS, _NO_IDS)
