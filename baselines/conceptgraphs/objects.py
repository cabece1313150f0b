"""The objects of ConceptGraphs' map: merging two, denoising, dropping what was seen too rarely, overlap merging.

Objects never change: a merge makes a new one, so that a map can be finished midway.
Source: concept-graphs at commit 5c4da70, ``conceptgraph/slam/utils.py``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from su3d_bench.baselines.conceptgraphs.boxes import extents_of_boxes, shared_volume
from su3d_bench.baselines.conceptgraphs.clouds import voxel_average
from su3d_bench.baselines.conceptgraphs.config import MappingConfig
from su3d_bench.baselines.conceptgraphs.regions import box_of, cleaned
from su3d_bench.core.types import Float64Array, OrientedBox

LEAST_AFTER_DENOISING = 4  # points; with fewer the object stays as it was


@dataclass(frozen=True)
class Sighting:
    """One detection of an object: where it is found again, and what perception said of it."""

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
        """Detections merged into it; those of an object that was merged twice count twice, as in the original."""
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
        """The corners (3,) of a box beyond which nothing is nearer than ``radius_m``; its margin covers rounding."""
        low, high = self.extent
        return low - 1.001 * radius_m, high + 1.001 * radius_m

    @cached_property
    def extent(self) -> tuple[Float64Array, Float64Array]:
        """The least and the largest coordinates (3,) of its points."""
        return self.points.min(axis=0), self.points.max(axis=0)


def unit(vector: Float64Array) -> Float64Array:
    """``vector`` scaled to length 1; zeros stay."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0 else vector


def merged(into: MapObject, other: MapObject, config: MappingConfig, *, with_dbscan: bool) -> MapObject:
    """``into`` with ``other``; each feature weighs as many detections as it had before the merge."""
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
    """``item`` averaged anew and reduced to its largest cluster."""
    points = cleaned(item.points, config)
    if len(points) < LEAST_AFTER_DENOISING:
        return item
    return replace(item, points=points, box=box_of(points, config))


def seen_enough(objects: Sequence[MapObject], config: MappingConfig) -> list[MapObject]:
    """The objects of enough points and detections."""
    return [
        item
        for item in objects
        if len(item.points) >= config.obj_min_points and item.n_detections >= config.obj_min_detections
    ]


def overlap_ratios(objects: Sequence[MapObject], radius_m: float) -> Float64Array:
    """The share (N, N) of object i's points nearer than ``radius_m`` to a point of object j.

    0 on the diagonal and where the axis-aligned extents of the two boxes share no volume.
    """
    extents = extents_of_boxes([item.box for item in objects])
    has_shared_volume = shared_volume(extents, extents) > 0
    np.fill_diagonal(has_shared_volume, False)
    ratios = np.zeros((len(objects), len(objects)))
    for i in np.flatnonzero(has_shared_volume.any(axis=1)).tolist():
        points = objects[i].points
        # By the longest axis, so that a wall is not gone through from end to end for each of the things along it.
        axis = int(np.argmax(np.ptp(points, axis=0)))
        points = points[np.argsort(points[:, axis])]
        along = points[:, axis].copy()
        for j in np.flatnonzero(has_shared_volume[i]).tolist():
            low, high = objects[j].reach(radius_m)
            beside = points[slice(*np.searchsorted(along, (low[axis], high[axis])))]
            ratios[i, j] = objects[j].n_near(beside, radius_m) / len(points)
    return ratios


def merge_overlapping(objects: Sequence[MapObject], config: MappingConfig) -> list[MapObject]:
    """The objects after those that lie in another that looks like them went into it.

    Pairs go by falling ratio; of equal ratios the last by (i, j) first, which is what the original's reversed sort
    gives where its sort keeps the order of equals. As in the original, ratios are not computed anew after a merge, and
    an object that has gone into another can go into a second one too.
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
        # cosines: the features are of length 1, or all zeros
        looks_alike = result[i].feature @ result[j].feature > config.merge_visual_sim
        is_called_alike = result[i].text_feature @ result[j].text_feature > config.merge_text_sim
        if looks_alike and is_called_alike and is_kept[j]:
            result[j] = merged(result[j], result[i], config, with_dbscan=True)
            is_kept[i] = False
    return [item for item, stays in zip(result, is_kept, strict=True) if stays]
