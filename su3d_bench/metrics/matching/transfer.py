"""Masks and values of predicted points transferred to the points of the ground truth."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.geometry import voxel_coordinates
from su3d_bench.core.maps import Instances, Masks, Partition, starts_of
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array, IntArray
from su3d_bench.metrics.matching.nearest import Points, are_same_points, nearest
from su3d_bench.metrics.matching.rows import first_rows

COVERAGE_RADII_M = (0.025, 0.05, 0.1)


def reduce_to_voxels(points: Points, masks: Masks, voxel_m: float) -> Int64Array:
    """Ascending indices of the points that remain if each mask, and the background, keeps its first point per voxel."""
    voxel = voxel_coordinates(points, voxel_m)
    background = np.ones(len(points), bool)
    background[masks.indices] = False
    outside = np.flatnonzero(background)
    members = np.concatenate([masks.indices.astype(np.int64), outside])
    owner = np.concatenate([masks.owners, np.full(len(outside), len(masks), np.int64)])
    return np.unique(members[first_rows(np.column_stack([owner, voxel[members]]))])


def transfer_masks(
    points: Points, masks: Masks, targets: Points, cap_m: float | None = None, voxel_m: float = 0.0
) -> Masks:
    """The masks on ``targets``: a target belongs to mask k if the nearest of all ``points`` within the cap does.

    Masks that overlap still overlap; a target whose nearest point is in no mask is in none. On ``points`` themselves
    the masks do not change.

    >>> masks = Masks(np.array([0, 1, 3]), np.array([0, 0, 1]))
    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> moved = transfer_masks(points, masks, np.array([[0.1, 0, 0], [1.9, 0, 0]]))
    >>> moved.indptr.tolist(), moved.indices.tolist()
    ([0, 1, 2], [0, 0])
    """
    if are_same_points(points, targets):
        return masks
    kept = reduce_to_voxels(points, masks, voxel_m) if voxel_m > 0 else np.arange(len(points))
    _, nearest_index = nearest(points[kept], targets, np.inf if cap_m is None else cap_m)
    reached = np.flatnonzero(nearest_index >= 0)
    from scipy.sparse import csr_array

    of_point = csr_array(
        (np.ones(len(masks.indices), np.int8), masks.indices, masks.indptr), shape=(len(masks), len(points))
    ).tocsc()
    moved = of_point[:, kept[nearest_index[reached]]].tocsr()  # column by column, so each row is ascending
    return Masks(moved.indptr.astype(np.int64), reached[moved.indices].astype(np.int32))


def first_owner(masks: Masks, n_points: int) -> Int64Array:
    """For each point the first mask that contains it, -1 if none does.

    >>> first_owner(Masks(np.array([0, 2, 4]), np.array([0, 1, 1, 2])), 4).tolist()
    [0, 0, 1, -1]
    """
    owner = np.full(n_points, -1, np.int64)
    owner[masks.indices[::-1]] = masks.owners[::-1]
    return owner


def transfer_values(
    points: Points, values: Int64Array, rank: Int64Array, targets: Points, wanted: BoolArray, cap_m: float = np.inf
) -> tuple[Int64Array, Float64Array]:
    """Value and distance in metres of the nearest point with a rank, for each wanted target; otherwise -1 and infinity.

    Points of rank -1 and those farther than ``cap_m`` are ignored. At equal distance the lower ``rank`` wins, then the
    lower index. On ``points`` themselves a point with a rank keeps its own value, even if others share its position.

    >>> points = np.array([[0.0, 0, 0], [1, 0, 0]])
    >>> values, distance = transfer_values(
    ...     points, np.array([7, 8]), np.array([0, -1]), points, np.array([True, True])
    ... )
    >>> values.tolist(), distance.tolist()
    ([7, 7], [0.0, 1.0])
    """
    order = np.flatnonzero(rank >= 0)
    order = order[np.argsort(rank[order], kind="stable")]
    value, distance = np.full(len(targets), -1, np.int64), np.full(len(targets), np.inf)
    missing = wanted
    if are_same_points(points, targets):
        own = wanted & (rank >= 0)
        value[own], distance[own] = values[own], 0.0
        missing = wanted & ~own
    rows = np.flatnonzero(missing)
    distance[rows], nearest_index = nearest(points[order], targets[rows], cap_m)
    reached = rows[nearest_index >= 0]
    value[reached] = values[order][nearest_index[nearest_index >= 0]]
    return value, distance


def n_farther(distance: Float64Array) -> Int64Array:
    """The number of distances above each coverage radius.

    >>> n_farther(np.array([0.0, 0.03, 0.2])).tolist()
    [2, 1, 1]
    """
    return np.array([(distance > radius).sum() for radius in COVERAGE_RADII_M], np.int64)


def select(masks: Masks, keep: IntArray) -> Masks:
    """The masks ``keep``, in that order.

    >>> select(Masks(np.array([0, 2, 3]), np.array([4, 5, 6])), np.array([1])).indices.tolist()
    [6]
    """
    return Masks.of_sets([masks.mask(k) for k in keep.tolist()])


def masks_of(prediction: Instances | Partition) -> Masks:
    """The masks of a map on its own points, one per row of features for a partition."""
    if isinstance(prediction, Instances):
        return prediction
    return masks_of_partition(prediction.instance, len(prediction.features))


def masks_of_partition(instance: IntArray, n_instances: int) -> Masks:
    """The masks from one instance id per point, -1 for none.

    >>> masks = masks_of_partition(np.array([1, -1, 0, 1]), 2)
    >>> masks.indptr.tolist(), masks.indices.tolist()
    ([0, 1, 3], [2, 0, 3])
    """
    order = np.flatnonzero(instance >= 0)
    # two-byte integers are sorted in one pass
    order = order[np.argsort(instance[order].astype(np.min_scalar_type(instance.max(initial=0))), kind="stable")]
    sizes = np.bincount(instance[order], minlength=n_instances)
    return Masks(starts_of(sizes), order.astype(np.int32))
