"""From the regions of one image to clouds in the world: which regions count, what is cut out of them, where they lie.

Source: concept-graphs at commit 5c4da70, ``conceptgraph/slam/utils.py`` (``filter_gobs``, ``gobs_to_detection_list``)
and ``conceptgraph/utils/ious.py`` (``mask_subtract_contained``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from su3d_bench.baselines.conceptgraphs.clouds import bounding_box, largest_cluster, voxel_average
from su3d_bench.baselines.conceptgraphs.config import MappingConfig
from su3d_bench.core.geometry import back_project, valid_depth
from su3d_bench.core.types import BoolArray, Detections, Float32Array, Float64Array, Frame, OrientedBox

LEAST_MASK_AREA = 10  # pixels, whatever the configuration says
LEAST_POINTS = 5  # likewise
LEAST_VOLUME = 1e-6  # m^3 of the box of a detection
MOST_OF_CONTAINER = 0.7  # th2: a box that covers more of the other is no part of it
LEAST_OF_CONTAINED = 0.8  # th1


@dataclass(frozen=True)
class LiftedRegion:
    """One region in the world: the row ``detection`` of the frame's detections, its cloud (N, 3) m and its box."""

    detection: int
    points: Float64Array
    box: OrientedBox


def kept_regions(detections: Detections, is_background: BoolArray, config: MappingConfig) -> NDArray[np.intp]:
    """Rows of the regions that are large and sure enough; background may be as large as it is."""
    if not len(detections):
        return np.zeros(0, np.intp)
    image_area = detections.masks.shape[1] * detections.masks.shape[2]
    boxes = detections.boxes.astype(np.float64)
    box_areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    is_published = detections.score_scale == "published"
    least_score = np.float32(config.mask_conf_threshold if is_published else config.own_scale_conf_threshold)
    is_kept = detections.masks.sum(axis=(1, 2)) >= max(config.mask_area_threshold, LEAST_MASK_AREA)
    is_kept &= is_background | (box_areas <= config.max_bbox_area_ratio * image_area)
    is_kept &= detections.scores >= least_score
    return np.flatnonzero(is_kept)


def subtract_contained(boxes: Float32Array, masks: BoolArray) -> BoolArray:
    """``masks`` (K, H, W) without those of the boxes that each box contains.

    Box i contains box j where j covers less than 0.7 of i and i covers more than 0.8 of j. In the order of i, then j,
    each with what the steps before have left: what was cut out of a mask is not cut out of another by it.
    """
    corners = boxes.astype(np.float64)
    areas = (corners[:, 2] - corners[:, 0]) * (corners[:, 3] - corners[:, 1])
    low = np.maximum(corners[:, None, :2], corners[None, :, :2])
    high = np.minimum(corners[:, None, 2:], corners[None, :, 2:])
    shared = np.maximum(high - low, 0).prod(axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):  # a box without area is neither container nor contained
        share = shared / areas[:, None]
    result = masks.copy()
    for i, j in np.argwhere((share < MOST_OF_CONTAINER) & (share.T > LEAST_OF_CONTAINED)):
        result[i] &= ~result[j]
    return result


def lift(
    frame: Frame, rows: NDArray[np.intp], masks: BoolArray, config: MappingConfig, seed: int
) -> Iterator[LiftedRegion]:
    """The regions ``rows`` of a frame, whose masks (K, H, W) are given in their order, those too small left out."""
    if not len(rows):
        return
    has_depth = valid_depth(frame.depth_m, 0.0, np.inf)
    points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, has_depth)
    row_of_pixel = np.cumsum(has_depth.ravel()) - 1
    noise = np.random.default_rng([seed, frame.index])
    to_world = frame.camera_to_world[:3, :3]
    for detection, mask in zip(rows, masks, strict=True):
        cloud = points[row_of_pixel[np.flatnonzero(mask & has_depth)]]
        if len(cloud) < max(config.min_points_threshold, LEAST_POINTS):
            continue
        if config.noise_m > 0:
            cloud = cloud + noise.normal(0.0, config.noise_m, cloud.shape) @ to_world.T
        cloud = cleaned(cloud, config)
        box = box_of(cloud, config)
        if box.sizes.prod() >= LEAST_VOLUME:
            yield LiftedRegion(int(detection), cloud, box)


def cleaned(points: Float64Array, config: MappingConfig) -> Float64Array:
    """``points`` averaged by voxel, then without what does not hang together with most of them."""
    points = voxel_average(points, config.downsample_voxel_size)
    if not config.dbscan_remove_noise:
        return points
    return largest_cluster(points, config.dbscan_eps, config.dbscan_min_points)


def box_of(points: Float64Array, config: MappingConfig) -> OrientedBox:
    """The box of a cloud: oriented where the similarity is the overlap of points, else along the world's axes."""
    return bounding_box(points, oriented=config.spatial_sim_type == "overlap")
