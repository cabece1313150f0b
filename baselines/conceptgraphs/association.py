"""How alike a frame's detections and the map's objects are, and which detection joins which object.

Source: concept-graphs at commit 5c4da70, ``conceptgraph/slam/mapping.py`` and ``compute_overlap_matrix_2set``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.baselines.conceptgraphs.boxes import (
    are_coplanar,
    axis_aligned_iou,
    extents_of_boxes,
    extents_of_clouds,
    grown,
    oriented_iou,
)
from su3d_bench.baselines.conceptgraphs.config import MappingConfig
from su3d_bench.baselines.conceptgraphs.objects import MapObject
from su3d_bench.core.types import Float64Array, Int64Array

LEAST_SIDE_M = 0.02  # thinner boxes are grown to it before they are intersected
LEAST_IOU = 1e-6
NEW_OBJECT = -1


def box_iou(detections: Sequence[MapObject], objects: Sequence[MapObject]) -> Float64Array:
    """IoU (M, N) of the boxes, sides below 2 cm grown.

    Where one box of the frame or the map is not flat-sided enough for PyTorch3D, that of the clouds' axis-aligned
    extents for all pairs, as the original does on PyTorch3D's error.
    """
    of_detections = grown([item.box for item in detections], LEAST_SIDE_M)
    of_objects = grown([item.box for item in objects], LEAST_SIDE_M)
    if are_coplanar([*of_detections, *of_objects]):
        return oriented_iou(of_detections, of_objects)
    return axis_aligned_iou(
        extents_of_clouds([item.points for item in detections]), extents_of_clouds([item.points for item in objects])
    )


def overlap_similarity(detections: Sequence[MapObject], objects: Sequence[MapObject], voxel_m: float) -> Float64Array:
    """The share (M, N) of each detection's points nearer than ``voxel_m`` to the object; 0 where boxes do not meet."""
    similarity = np.zeros((len(detections), len(objects)))
    for i, j in np.argwhere(box_iou(detections, objects) >= LEAST_IOU):
        similarity[i, j] = objects[j].share_near(detections[i].points, voxel_m)
    return similarity


def geometric_similarity(
    detections: Sequence[MapObject], objects: Sequence[MapObject], config: MappingConfig
) -> Float64Array:
    """s_geo (M, N) of the configured kind, 0..1."""
    if config.spatial_sim_type == "overlap":
        return overlap_similarity(detections, objects, config.downsample_voxel_size)
    return axis_aligned_iou(
        extents_of_boxes([item.box for item in detections]), extents_of_boxes([item.box for item in objects])
    )


def semantic_similarity(
    detections: Sequence[MapObject], objects: Sequence[MapObject], config: MappingConfig
) -> Float64Array:
    """s_sem (M, N): the cosine as the code has it, or the paper's phi_sem = cosine / 2 + 1 / 2."""
    cosine: Float64Array = (
        np.stack([item.feature for item in detections]) @ np.stack([item.feature for item in objects]).T
    )
    return cosine if config.association == "code" else cosine / 2 + 0.5


def total_similarity(
    detections: Sequence[MapObject], objects: Sequence[MapObject], config: MappingConfig
) -> Float64Array:
    """(1 + b) s_geo + (1 - b) s_sem (M, N) with the physical bias b, which is 0 in every published command."""
    geometric = geometric_similarity(detections, objects, config)
    semantic = semantic_similarity(detections, objects, config)
    return (1 + config.phys_bias) * geometric + (1 - config.phys_bias) * semantic


def assign(similarity: Float64Array, threshold: float) -> Int64Array:
    """The object (M,) that each detection joins: the most similar one at ``threshold`` or above, else NEW_OBJECT.

    Several detections may join one object; the first of equally similar objects wins.

    >>> assign(np.array([[1.3, 1.2], [1.1, 1.19], [1.0, 1.2]]), 1.2).tolist()
    [0, -1, 1]
    """
    best: Int64Array = np.argmax(similarity, axis=1)
    is_alike = similarity[np.arange(len(best)), best] >= threshold
    return np.where(is_alike, best, NEW_OBJECT)
