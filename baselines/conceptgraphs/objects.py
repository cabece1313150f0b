"""Objects of ConceptGraphs' map: clouds and boxes, merging, denoising, removing those seen too rarely.

Objects are immutable: a merge creates a new one, so a map can be finished midway.
Source: concept-graphs at commit 5c4da70, ``conceptgraph/slam/utils.py``, whose geometry is Open3D's (from the regions
of an image to clouds: ``filter_gobs``, ``gobs_to_detection_list``), and ``conceptgraph/utils/ious.py``
(``mask_subtract_contained``; overlaps of boxes by PyTorch3D's ``box3d_overlap``). The hyper-parameters
are those of ``configs/slam_pipeline/base.yaml`` and of the README's commands for the SAM-only variant; options that
these commands leave off and that change the method (``use_contain_number``, other similarities) are omitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.geometry import back_project, valid_depth
from su3d_bench.core.types import BoolArray, Detections, Float32Array, Float64Array, Frame, Int64Array, OrientedBox

Metres = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Cosine = Annotated[float, Field(ge=-1, le=1)]
Interval = Annotated[int, Field(ge=-1)]  # processed frames; -1 or 0: never
InstanceScore = Literal["ones", "num-detections", "max-confidence"]

# The sum of both similarities required to join a detection to an object. The two rules are not equivalent: 1.1 in the
# paper is 1.2 in the code only if the cosine is 0.8.
SIM_THRESHOLDS = {"code": 1.2, "paper": 1.1}


class MappingConfig(BaseModel):
    """Settings shared by both variants; names are those of the original's configuration if it has them."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    stride: int = Field(default=5, ge=1)
    # code: overlap + cosine >= 1.2; paper: overlap + (cosine / 2 + 1 / 2) >= 1.1 (its equation for phi_sem).
    association: Literal["code", "paper"] = "code"
    sim_threshold: float | None = None  # overrides the threshold of the rule
    # overlap: share of the detection's points near the object; iou: of axis-aligned boxes, the default that the
    # original's commands override.
    spatial_sim_type: Literal["overlap", "iou"] = "overlap"
    phys_bias: float = Field(default=0.0, ge=-1, le=1)
    mask_area_threshold: int = Field(default=25, ge=0)  # pixels; the original uses at least 10
    mask_conf_threshold: Fraction = 0.95  # of SAM's predicted IoU
    # Used instead if a profile's scores have a different scale (Detections.score_scale); 0: all regions stay.
    other_scale_conf_threshold: Fraction = 0.0
    max_bbox_area_ratio: Fraction = 0.5
    min_points_threshold: int = Field(default=16, ge=0)  # the original uses at least 5
    # Gaussian noise on every coordinate, "to avoid colinearity": 4 mm in the code, there from an unseeded generator,
    # here from the scene's seed. 0: none.
    noise_m: float = Field(default=0.004, ge=0, allow_inf_nan=False)
    downsample_voxel_size: Metres = 0.025
    dbscan_remove_noise: bool = True
    dbscan_eps: Metres = 0.1
    dbscan_min_points: int = Field(default=10, ge=1)
    denoise_interval: Interval = 20
    filter_interval: Interval = -1
    merge_interval: Interval = 20
    obj_min_points: int = Field(default=0, ge=0)
    obj_min_detections: int = Field(default=3, ge=0)
    merge_overlap_thresh: float = Field(default=0.7, ge=0, le=1)  # 0: no overlap merge
    merge_visual_sim: Cosine = 0.8
    merge_text_sim: Cosine = 0.8
    # The original has no scores, but instance AP needs them. ones: as assumed by readers of its maps.
    instance_score: InstanceScore = "ones"

    @property
    def association_threshold(self) -> float:
        """Minimum similarity at which a detection joins an object."""
        return SIM_THRESHOLDS[self.association] if self.sim_threshold is None else self.sim_threshold

    @property
    def score_caveat(self) -> str:
        """The caveat on the instances' scores."""
        if self.instance_score == "ones":
            return "the original has no scores: 1 for every object"
        what = {"num-detections": "number of detections", "max-confidence": "largest detection score"}
        return f"the original has no scores: each object's {what[self.instance_score]}"


MIN_CLUSTER = 5  # points; a smaller largest cluster is not trusted and the whole cloud is kept
MIN_FOR_ORIENTED_BOX = 4  # points that span a volume


def voxel_average(points: Float64Array, voxel_m: float) -> Float64Array:
    """The mean point (V, 3) of each occupied voxel, ordered by the voxels' first points.

    The grid starts half a voxel below the cloud's minimum, as in Open3D's ``voxel_down_sample``: it moves with
    the cloud, so averaging a cloud again changes it.
    """
    if not len(points):
        return points
    from su3d_bench.baselines.conceptgraphs.kernels import means_of_cells

    averaged: Float64Array = means_of_cells(points, points.min(axis=0) - voxel_m / 2, voxel_m)
    return averaged


def density_clusters(points: Float64Array, eps_m: float, min_points: int) -> Int64Array:
    """DBSCAN's cluster (N,) of each point, -1 for none; the labels of Open3D's ``cluster_dbscan``."""
    from su3d_bench.numerics import clusters

    return clusters.density_clusters(points, eps_m, min_points, holds_eps=False)


def largest_cluster(points: Float64Array, eps_m: float, min_points: int) -> Float64Array:
    """The points of the largest DBSCAN cluster; all points if no cluster has at least five.

    Ties go to the cluster whose first point comes first, as with Python's ``Counter``.
    """
    labels = density_clusters(points, eps_m, min_points)
    distinct, first, sizes = np.unique(labels[labels >= 0], return_index=True, return_counts=True)
    if not len(distinct) or sizes.max() < MIN_CLUSTER:
        return points
    largest = np.flatnonzero(sizes == sizes.max())
    is_inside: BoolArray = labels == distinct[largest[np.argmin(first[largest])]]
    return points[is_inside]


def bounding_box(points: Float64Array, *, oriented: bool) -> OrientedBox:
    """The box around ``points``: along the principal axes of their convex hull, otherwise along the world's axes."""
    if oriented and len(points) >= MIN_FOR_ORIENTED_BOX:
        import open3d as o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        try:
            box = cloud.get_oriented_bounding_box(robust=True)
            return OrientedBox(np.array(box.center), np.array(box.extent), np.array(box.R))
        except RuntimeError:  # Qhull found no volume even after joggling
            pass
    low, high = points.min(axis=0), points.max(axis=0)
    return OrientedBox((low + high) / 2, high - low, np.eye(3))


# The faces of PyTorch3D's boxes in our corner order, where bit i of a corner is its side along axis i: PyTorch3D's
# corners 0..7 are 0, 2, 6, 4, 1, 3, 7, 5 here.
FACES = np.array([[0, 2, 6, 4], [4, 6, 7, 5], [0, 2, 3, 1], [0, 4, 5, 1], [2, 6, 7, 3], [1, 3, 7, 5]])
COPLANAR_M = 1e-4  # PyTorch3D's tolerance


@dataclass(frozen=True)
class Extents:
    """Axis-aligned boxes: ``low`` and ``high`` (N, 3) in metres."""

    low: Float64Array
    high: Float64Array


def grown(boxes: Sequence[OrientedBox], least_side_m: float) -> list[OrientedBox]:
    """``boxes`` with shorter sides extended to ``least_side_m`` about the centre."""
    return [OrientedBox(box.centre, np.maximum(box.sizes, least_side_m), box.rotation) for box in boxes]


def extents_of_boxes(boxes: Sequence[OrientedBox]) -> Extents:
    """The axis-aligned extents of oriented boxes."""
    centres = np.array([box.centre for box in boxes]).reshape(-1, 3)
    reach = np.array([np.abs(box.rotation) @ box.sizes / 2 for box in boxes]).reshape(-1, 3)
    return Extents(centres - reach, centres + reach)


def extents_of_clouds(clouds: Sequence[Float64Array]) -> Extents:
    """The axis-aligned extents of non-empty clouds."""
    low, high = [cloud.min(axis=0) for cloud in clouds], [cloud.max(axis=0) for cloud in clouds]
    return Extents(np.array(low).reshape(-1, 3), np.array(high).reshape(-1, 3))


def shared_volume(a: Extents, b: Extents) -> Float64Array:
    """Intersection volumes (A, B) of axis-aligned boxes."""
    low = np.maximum(a.low[:, None], b.low[None])
    high = np.minimum(a.high[:, None], b.high[None])
    volume: Float64Array = np.maximum(high - low, 0).prod(axis=2)
    return volume


def axis_aligned_iou(a: Extents, b: Extents) -> Float64Array:
    """IoU (A, B) of axis-aligned boxes; the original adds 1e-10 m^3 to the union.

    >>> unit, moved = np.zeros((1, 3)), np.array([[0.5, 0.0, 0.0]])
    >>> round(float(axis_aligned_iou(Extents(unit, unit + 1), Extents(moved, moved + 1))[0, 0]), 6)
    0.333333
    """
    shared = shared_volume(a, b)
    volume_a, volume_b = (a.high - a.low).prod(axis=1), (b.high - b.low).prod(axis=1)
    iou: Float64Array = shared / (volume_a[:, None] + volume_b[None] - shared + 1e-10)
    return iou


def oriented_iou(a: Sequence[OrientedBox], b: Sequence[OrientedBox]) -> Float64Array:
    """IoU (A, B) of oriented boxes, exact up to rounding; all sides must be longer than 0."""
    from su3d_bench.baselines.conceptgraphs import kernels as kernels

    shared = kernels.intersection_volumes(*_arrays(a), *_arrays(b))
    volume_a = np.array([box.sizes.prod() for box in a])
    volume_b = np.array([box.sizes.prod() for box in b])
    iou: Float64Array = shared / (volume_a[:, None] + volume_b[None] - shared)
    return iou


def are_coplanar(boxes: Sequence[OrientedBox]) -> bool:
    """Whether PyTorch3D accepts ``boxes``: the corners of each face are coplanar in single precision.

    Boxes far from the origin fail by rounding; at building scale none does. As in PyTorch3D the distances of
    the six faces' fourth corners are summed with signs, so those of opposite faces may cancel.
    """
    if not boxes:
        return True
    corners = np.array([box.corners for box in boxes]).astype(np.float32)
    first, second, third, fourth = np.moveaxis(corners[:, FACES], 2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = _unit(np.cross(_unit(second - first), _unit(third - first)))
        off = ((fourth - first) * normals).sum(axis=(1, 2), dtype=np.float32)
    return bool((np.abs(off) < COPLANAR_M).all())


def _unit(vectors: np.typing.NDArray[np.float32]) -> np.typing.NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: np.typing.NDArray[np.float32] = vectors / np.maximum(lengths, np.float32(1e-12))
    return unit


def _arrays(boxes: Sequence[OrientedBox]) -> tuple[Float64Array, Float64Array, Float64Array]:
    centres = np.array([box.centre for box in boxes], np.float64).reshape(-1, 3)
    halves = np.array([box.sizes for box in boxes], np.float64).reshape(-1, 3) / 2
    rotations = np.array([box.rotation for box in boxes], np.float64).reshape(-1, 3, 3)
    return centres, halves, rotations


MIN_MASK_AREA = 10  # pixels, regardless of the configuration
MIN_POINTS = 5  # likewise
MIN_VOLUME = 1e-6  # m^3 of the box of a detection
MAX_CONTAINER_SHARE = 0.7  # th2: a box covering more of the other is not part of it
MIN_CONTAINED_SHARE = 0.8  # th1


@dataclass(frozen=True)
class LiftedRegion:
    """One region in the world: the row ``detection`` of the frame's detections, its cloud (N, 3) m and its box."""

    detection: int
    points: Float64Array
    box: OrientedBox


def kept_regions(detections: Detections, is_background: BoolArray, config: MappingConfig) -> NDArray[np.intp]:
    """Rows of the regions that are large and certain enough; background may have any size."""
    if not len(detections):
        return np.zeros(0, np.intp)
    image_area = detections.masks.shape[1] * detections.masks.shape[2]
    boxes = detections.boxes.astype(np.float64)
    box_areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    is_published = detections.score_scale == "published"
    least_score = np.float32(config.mask_conf_threshold if is_published else config.other_scale_conf_threshold)
    is_kept = detections.masks.sum(axis=(1, 2)) >= max(config.mask_area_threshold, MIN_MASK_AREA)
    is_kept &= is_background | (box_areas <= config.max_bbox_area_ratio * image_area)
    is_kept &= detections.scores >= least_score
    return np.flatnonzero(is_kept)


def subtract_contained(boxes: Float32Array, masks: BoolArray) -> BoolArray:
    """``masks`` (K, H, W) minus those of contained boxes.

    Box i contains box j if j covers less than 0.7 of i and i covers more than 0.8 of j. In the order of i, then j,
    using the results of previous steps: pixels already cut from a mask are not cut from another by it.
    """
    corners = boxes.astype(np.float64)
    areas = (corners[:, 2] - corners[:, 0]) * (corners[:, 3] - corners[:, 1])
    low = np.maximum(corners[:, None, :2], corners[None, :, :2])
    high = np.minimum(corners[:, None, 2:], corners[None, :, 2:])
    shared = np.maximum(high - low, 0).prod(axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):  # a box without area neither contains nor is contained
        share = shared / areas[:, None]
    result = masks.copy()
    for i, j in np.argwhere((share < MAX_CONTAINER_SHARE) & (share.T > MIN_CONTAINED_SHARE)):
        result[i] &= ~result[j]
    return result


def lift(
    frame: Frame, rows: NDArray[np.intp], masks: BoolArray, config: MappingConfig, seed: int
) -> Iterator[LiftedRegion]:
    """The regions ``rows`` of a frame, whose masks (K, H, W) are in the same order; too small ones are dropped."""
    if not len(rows):
        return
    has_depth = valid_depth(frame.depth_m, 0.0, np.inf)
    points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, has_depth)
    row_of_pixel = np.cumsum(has_depth.ravel()) - 1
    noise = np.random.default_rng([seed, frame.index])
    to_world = frame.camera_to_world[:3, :3]
    for detection, mask in zip(rows, masks, strict=True):
        cloud = points[row_of_pixel[np.flatnonzero(mask & has_depth)]]
        if len(cloud) < max(config.min_points_threshold, MIN_POINTS):
            continue
        if config.noise_m > 0:
            cloud = cloud + noise.normal(0.0, config.noise_m, cloud.shape) @ to_world.T
        cloud = cleaned(cloud, config)
        box = box_of(cloud, config)
        if box.sizes.prod() >= MIN_VOLUME:
            yield LiftedRegion(int(detection), cloud, box)


def cleaned(points: Float64Array, config: MappingConfig) -> Float64Array:
    """``points`` averaged by voxel, keeping only the largest cluster."""
    points = voxel_average(points, config.downsample_voxel_size)
    if not config.dbscan_remove_noise:
        return points
    return largest_cluster(points, config.dbscan_eps, config.dbscan_min_points)


def box_of(points: Float64Array, config: MappingConfig) -> OrientedBox:
    """The box of a cloud: oriented if the similarity is point overlap, otherwise along the world's axes."""
    return bounding_box(points, oriented=config.spatial_sim_type == "overlap")


MIN_AFTER_DENOISING = 4  # points; with fewer the object is unchanged


@dataclass(frozen=True)
class Sighting:
    """One detection of an object: its frame and position, and what perception reported."""

    frame_index: int
    detection: int
    name: str
    caption: str
    score: float


@dataclass(frozen=True)
class MapObject:
    """An object: its ``number`` in order of creation, cloud (N, 3) m, box, unit features, detections."""

    number: int
    points: Float64Array
    box: OrientedBox
    feature: Float64Array
    text_feature: Float64Array
    sightings: tuple[Sighting, ...]

    @property
    def n_detections(self) -> int:
        """Detections merged into it; those of an object merged twice count twice, as in the original."""
        return len(self.sightings)

    @cached_property
    def tree(self) -> Any:
        """A KD-tree of its points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)

    def share_near(self, points: Float64Array, radius_m: float) -> float:
        """The share of ``points`` nearer than ``radius_m`` to a point of the object."""
        return self.n_near(points, radius_m) / len(points)

    def n_near(self, points: Float64Array, radius_m: float) -> int:
        """How many of ``points`` are nearer than ``radius_m`` to a point of the object."""
        low, high = self.reach(radius_m)
        candidates = points[((points > low) & (points < high)).all(axis=1)]
        distances, _ = self.tree.query(candidates, distance_upper_bound=radius_m, workers=1)
        return int(np.count_nonzero(distances < radius_m))

    def reach(self, radius_m: float) -> tuple[Float64Array, Float64Array]:
        """The corners (3,) of a box outside which nothing is nearer than ``radius_m``; its margin covers rounding."""
        low, high = self.extent
        return low - 1.001 * radius_m, high + 1.001 * radius_m

    @cached_property
    def extent(self) -> tuple[Float64Array, Float64Array]:
        """The least and the largest coordinates (3,) of its points."""
        return self.points.min(axis=0), self.points.max(axis=0)


def unit(vector: Float64Array) -> Float64Array:
    """``vector`` scaled to length 1; zeros are unchanged."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0 else vector


def merged(into: MapObject, other: MapObject, config: MappingConfig, *, with_dbscan: bool) -> MapObject:
    """``into`` merged with ``other``; features are weighted by the number of detections before the merge."""
    points = np.concatenate([into.points, other.points])
    points = cleaned(points, config) if with_dbscan else voxel_average(points, config.downsample_voxel_size)
    n, m = into.n_detections, other.n_detections
    return MapObject(
        number=into.number,
        points=points,
        box=box_of(points, config),
        feature=unit((n * into.feature + m * other.feature) / (n + m)),
        text_feature=unit((n * into.text_feature + m * other.text_feature) / (n + m)),
        sightings=into.sightings + other.sightings,
    )


def denoised(item: MapObject, config: MappingConfig) -> MapObject:
    """``item`` averaged by voxel and reduced to its largest cluster."""
    points = cleaned(item.points, config)
    if len(points) < MIN_AFTER_DENOISING:
        return item
    return replace(item, points=points, box=box_of(points, config))


def seen_enough(objects: Sequence[MapObject], config: MappingConfig) -> list[MapObject]:
    """The objects with enough points and detections."""
    return [
        item
        for item in objects
        if len(item.points) >= config.obj_min_points and item.n_detections >= config.obj_min_detections
    ]


def overlap_ratios(objects: Sequence[MapObject], radius_m: float) -> Float64Array:
    """The share (N, N) of object i's points nearer than ``radius_m`` to a point of object j.

    0 on the diagonal and if the axis-aligned extents of the two boxes do not overlap.
    """
    extents = extents_of_boxes([item.box for item in objects])
    has_shared_volume = shared_volume(extents, extents) > 0
    np.fill_diagonal(has_shared_volume, False)
    ratios = np.zeros((len(objects), len(objects)))
    for i in np.flatnonzero(has_shared_volume.any(axis=1)).tolist():
        points = objects[i].points
        # Sorted along the longest axis, so that a wall is not scanned from end to end for each object along it.
        axis = int(np.argmax(np.ptp(points, axis=0)))
        points = points[np.argsort(points[:, axis])]
        along = points[:, axis].copy()
        for j in np.flatnonzero(has_shared_volume[i]).tolist():
            low, high = objects[j].reach(radius_m)
            beside = points[slice(*np.searchsorted(along, (low[axis], high[axis])))]
            ratios[i, j] = objects[j].n_near(beside, radius_m) / len(points)
    return ratios


def merge_overlapping(objects: Sequence[MapObject], config: MappingConfig) -> list[MapObject]:
    """Merge each object into a similar one that contains it.

    Pairs are processed by descending ratio; ties start with the last (i, j), as in the original's reversed sort
    if it is stable. As in the original, ratios are not updated after a merge, and
    an already merged object can be merged into a second one too.
    """
    if config.merge_overlap_thresh <= 0:
        return list(objects)
    result = list(objects)
    is_kept = np.ones(len(result), np.bool_)
    ratios = overlap_ratios(result, config.downsample_voxel_size)
    rows, columns = np.nonzero(ratios)
    for k in np.argsort(ratios[rows, columns], kind="stable")[::-1]:
        i, j = rows[k], columns[k]
        if ratios[i, j] <= config.merge_overlap_thresh:
            break
        # cosines: features have length 1, or are zero
        looks_alike = result[i].feature @ result[j].feature > config.merge_visual_sim
        is_called_alike = result[i].text_feature @ result[j].text_feature > config.merge_text_sim
        if looks_alike and is_called_alike and is_kept[j]:
            result[j] = merged(result[j], result[i], config, with_dbscan=True)
            is_kept[i] = False
    return [item for item, stays in zip(result, is_kept, strict=True) if stays]
