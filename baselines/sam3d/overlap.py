"""SAM3D's bidirectional group overlap: merges two clouds with one group id per point, and many in a tree.

Follows ``sam3d.py`` and ``util.py`` of Pointcept/SegmentAnything3D at 2aaa8c9, including quirks, with two differences.
The point kept in a voxel is its first one in the cloud (a stable sort); the original sorts unstably, so there
it depends on the processor and the NumPy version. Matching uses a grid instead of all pairs of points, with the
same float32 distances and the same choice in ties.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array

NO_GROUP = -1
PAIR_RADIUS_VOXELS = 1.5  # the search radius in util.py's callers: 1.5 * voxel_size
SURFACE_CELL_M = 0.15  # side of the grid's cells for searches over large distances; does not affect results
MAX_EXTENT_M = 1e6  # beyond it, float32 cannot number the cells of a centimetre grid


@dataclass(frozen=True)
class GroupedCloud:
    """``points`` (N, 3) float64 m and the ``group`` (N,) of each, NO_GROUP for none.

    ``views`` (V,) numbers masks of images, and ``view_group`` (V,) the group into which each was merged.
    """

    points: Float64Array
    group: Int64Array
    view_group: Int64Array
    views: Int64Array

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def n_groups(self) -> int:
        return int(np.count_nonzero(_sizes(self.group)))


@dataclass(frozen=True)
class Pairs:
    """Matched points: ``query`` (P,), each at most once, and the nearest point of the other cloud, ``other`` (P,)."""

    query: Int64Array
    other: Int64Array


@dataclass(frozen=True)
class MergeRules:
    """Side of a voxel in metres, the overlap that joins two groups, and the minimum points of a group."""

    voxel_m: float = 0.05
    ratio: float = 0.5
    min_points: int = 50


@dataclass(frozen=True)
class Relabelled:
    """``group`` (N,) after counting overlaps; the former group b is now ``id_of_group[b]``."""

    group: Int64Array
    id_of_group: Int64Array


def first_of_voxels(points: Float64Array, voxel_m: float) -> Int64Array:
    """Index of the first point of each voxel, in the order of the voxels' FNV-64 keys."""
    if not len(points):
        return np.zeros(0, np.int64)
    with np.errstate(invalid="ignore"):  # a cloud with NaN is excluded when merging, not here
        cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0)
    keys = np.full(len(points), 14695981039346656037, np.uint64)  # offset basis and prime of FNV-64
    for axis in range(3):
        # The product comes before the xor, which is FNV-1; the original calls it FNV-1A.
        keys *= np.uint64(1099511628211)
        keys ^= cells[:, axis].astype(np.uint64)
    # Neighbours in an image share voxels: only the first of a run of equal keys can be the first in its voxel.
    runs = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    return np.asarray(runs[np.unique(keys[runs], return_index=True)[1]], np.int64)


def voxelise(cloud: GroupedCloud, voxel_m: float) -> GroupedCloud:
    """One point per voxel, the first; groups that lose their last point lose their views, ids are unchanged."""
    kept = first_of_voxels(cloud.points, voxel_m)
    return _with_views_of_present(replace(cloud, points=cloud.points[kept], group=cloud.group[kept]))


def drop_small_groups(group: Int64Array, min_points: int) -> Int64Array:
    """Replaces every id with fewer than ``min_points`` points by NO_GROUP.

    >>> drop_small_groups(np.array([4, 4, 2, -1, 4]), 2).tolist()
    [4, 4, -1, -1, 4]
    """
    sizes = np.append(_sizes(group), 0)  # the last one is that of NO_GROUP
    return np.where(sizes[group] < min_points, NO_GROUP, group)


def renumber(group: Int64Array) -> Int64Array:
    """Ids 0, 1, 2, ... in the order of the old ones; NO_GROUP is unchanged.

    >>> renumber(np.array([7, -1, 3, 7])).tolist()
    [1, -1, 0, 1]
    """
    return _numbers_of(group)[group]


def nearest_points(
    queries: Float64Array | Float32Array, points: Float64Array | Float32Array, cap_m: float, cell_m: float
) -> tuple[Int64Array, Float32Array]:
    """Index of the nearest point of each query and its distance in metres; -1 and infinity beyond ``cap_m``.

    Distances are float32, of float32 coordinates, as on the original's GPU; ties go to the lowest index.
    ``cell_m``, the side of the grid's cells, does not affect results.
    """
    index, squared = np.full(len(queries), -1, np.int64), np.full(len(queries), np.inf, np.float32)
    if len(queries) and len(points):
        from su3d_bench.baselines.sam3d import kernels as kernels

        wanted, given = _float32(queries), _float32(points)
        starts = np.zeros((1 << (len(given) - 1).bit_length()) + 1, np.int64)
        order, members = np.empty(len(given), np.int64), np.empty_like(given)
        kernels.fill(given, cell_m, starts, order, members)
        lower, upper = given.min(axis=0).astype(np.float64), given.max(axis=0).astype(np.float64)
        kernels.nearest(wanted, cap_m, cell_m, starts, order, members, lower, upper, index, squared)
    return index, np.sqrt(squared)


def _float32(points: Float64Array | Float32Array) -> Float32Array:
    """The points in the form used by the search; ``DataError`` if they do not fit a centimetre grid."""
    if not np.abs(points).max() <= MAX_EXTENT_M:  # written so that NaN fails too
        raise DataError(f"merging clouds: a point is beyond {MAX_EXTENT_M:.0e} m or is not finite; check the poses")
    return np.ascontiguousarray(points, np.float32)


def match_pairs(queries: Float64Array, points: Float64Array, radius_m: float) -> Pairs:
    """Each query with a point nearer than ``radius_m``, and its nearest one."""
    index, distance = nearest_points(queries, points, radius_m, radius_m * 1.001)
    matched = np.flatnonzero((index >= 0) & (distance < np.float32(radius_m)))
    return Pairs(matched, index[matched])


def cal_group(other: Int64Array, group: Int64Array, pairs: Pairs, ratio: float) -> Relabelled:
    """The ids of ``group`` after matching with ``other``: groups that overlap enough take the other's id.

    Ids of ``group`` are first shifted beyond those of ``other``. A point without a group takes the group of its pair
    (even NO_GROUP) and does not count. Each group is compared with the group of ``other`` with which it shares most
    pairs (the first encountered in a tie) and joins it if the shared pairs are at least ``ratio`` of the smaller of
    the two, in float32.

    >>> cal_group(np.array([0, 0, 1]), np.array([0, 0, -1, 1]), Pairs(np.array([0, 1, 2]), np.array([1, 0, 2])), 0.5)
    Relabelled(group=array([0, 0, 1, 3]), id_of_group=array([0, 3]))
    """
    n_other, n_group = _sizes(other), _sizes(group)
    id_of_group = np.arange(len(n_group)) + len(n_other)
    mine, theirs = group[pairs.query], other[pairs.other]
    counted = (mine != NO_GROUP) & (theirs != NO_GROUP)
    keys = mine[counted] * len(n_other) + theirs[counted]
    keys, met, shared = np.unique(keys, return_index=True, return_counts=True)
    row, column = np.divmod(keys, max(len(n_other), 1))
    order = np.lexsort((met, -shared, row))
    rows, best = np.unique(row[order], return_index=True)
    best = order[best]
    smaller = np.minimum(n_other[column[best]], n_group[rows]).astype(np.float32)
    joins = shared[best].astype(np.float32) / smaller >= np.float32(ratio)
    id_of_group[rows[joins]] = column[best][joins]
    relabelled = np.append(id_of_group, NO_GROUP)[group]  # NO_GROUP is the last
    inherits = mine == NO_GROUP
    relabelled[pairs.query[inherits]] = theirs[inherits]
    return Relabelled(relabelled, id_of_group)


def merge(first: GroupedCloud, second: GroupedCloud, rules: MergeRules, timer: StageTimer) -> GroupedCloud | None:
    """Both clouds merged by bidirectional group overlap; if one contains a NaN, the other; if both do, None.

    The second call of ``cal_group`` shifts the ids of ``first`` beyond those of ``second``: a match of the first
    call survives only if the second finds it too, counted after the first. Small groups are dropped, also from a cloud
    that is not merged. The result is voxelised after numbering, so ids may be missing.
    """
    with timer.stage("merge"):
        first, second = without_small_groups(first, rules.min_points), without_small_groups(second, rules.min_points)
        valid = [cloud for cloud in (first, second) if not np.isnan(cloud.points).any()]
        if len(valid) < 2:
            return valid[0] if valid else None
    radius_m = PAIR_RADIUS_VOXELS * rules.voxel_m
    with timer.stage("match"):
        pairs_of_second = match_pairs(second.points, first.points, radius_m)
        pairs_of_first = match_pairs(first.points, second.points, radius_m)
    with timer.stage("merge"):
        of_second = cal_group(first.group, second.group, pairs_of_second, rules.ratio)
        of_first = cal_group(of_second.group, first.group, pairs_of_first, rules.ratio)
        merged = numbered(_joined(first, second, of_first, of_second))
    with timer.stage("voxelise"):
        return voxelise(merged, rules.voxel_m)


def _joined(first: GroupedCloud, second: GroupedCloud, of_first: Relabelled, of_second: Relabelled) -> GroupedCloud:
    """Both clouds concatenated, with the views of both.

    A group may consist of points that inherited an id without a mask; its views are then those of the group of
    ``first`` that the id came from.
    """
    group = np.concatenate([of_first.group, of_second.group])
    view_group = np.concatenate([of_first.id_of_group[first.view_group], of_second.id_of_group[second.view_group]])
    has_no_view = _is_present(group, 1 + max(int(ids.max(initial=NO_GROUP)) for ids in (view_group, first.view_group)))
    has_no_view[view_group] = False
    orphaned = has_no_view[first.view_group]
    return GroupedCloud(
        np.concatenate([first.points, second.points]),
        group,
        np.concatenate([view_group, first.view_group[orphaned]]),
        np.concatenate([first.views, second.views, first.views[orphaned]]),
    )


def merge_regions(clouds: Sequence[GroupedCloud], rules: MergeRules, timer: StageTimer) -> GroupedCloud | None:
    """All clouds merged pairwise in a binary tree: [0, 1], [2, 3], ...; an odd last one passes unchanged.

    None if every cloud contains a NaN; the original never ends then.
    """
    left = list(clouds)
    while len(left) > 1:
        left = next_level(left, rules, timer)
    return left[0] if left and not np.isnan(left[0].points).any() else None


def next_level(clouds: Sequence[GroupedCloud], rules: MergeRules, timer: StageTimer) -> list[GroupedCloud]:
    """The next level of the tree: neighbours merged, an odd last one unchanged, None dropped."""
    merged = [merge(clouds[i], clouds[i + 1], rules, timer) for i in range(0, len(clouds) - 1, 2)]
    odd = clouds[len(clouds) - len(clouds) % 2 :]
    return [cloud for cloud in (*merged, *odd) if cloud is not None]


def groups_on_surface(cloud: GroupedCloud, vertices: Float32Array, cap_m: float) -> Int64Array:
    """The group (V,) of the point nearest to each vertex, NO_GROUP beyond ``cap_m``."""
    index, distance = nearest_points(vertices, cloud.points, cap_m, SURFACE_CELL_M)
    is_near = (index >= 0) & (distance <= np.float32(cap_m))
    return np.where(is_near, np.append(cloud.group, NO_GROUP)[index], NO_GROUP)


def ensemble(group: Int64Array, segments: Int32Array | Int64Array, min_points: int, ratio: float) -> Int64Array:
    """The groups (V,) snapped to ``segments`` (V,): each segment takes the group with which it shares enough vertices.

    Groups of fewer than ``min_points`` vertices are ignored. A segment without a group gets a new id:
    its number shifted beyond the groups'.
    """
    groups = renumber(drop_small_groups(group, min_points))
    numbers, rank = np.unique(segments, return_inverse=True)
    every = np.arange(len(groups))
    joined = cal_group(groups, rank.astype(np.int64), Pairs(every, every), ratio).group
    n_groups = int(groups.max(initial=NO_GROUP)) + 1
    return np.where(joined < n_groups, joined, numbers[np.maximum(joined - n_groups, 0)].astype(np.int64) + n_groups)


def without_small_groups(cloud: GroupedCloud, min_points: int) -> GroupedCloud:
    """The cloud with small groups replaced by NO_GROUP, and without their views."""
    return _with_views_of_present(replace(cloud, group=drop_small_groups(cloud.group, min_points)))


def numbered(cloud: GroupedCloud) -> GroupedCloud:
    """The cloud with its groups renumbered."""
    number_of = _numbers_of(cloud.group)
    cloud = _with_views_of_present(cloud)
    return replace(cloud, group=number_of[cloud.group], view_group=number_of[cloud.view_group])


def _with_views_of_present(cloud: GroupedCloud) -> GroupedCloud:
    members = _is_present(cloud.group, int(cloud.view_group.max(initial=-1)) + 1)[cloud.view_group]
    return replace(cloud, view_group=cloud.view_group[members], views=cloud.views[members])


def _sizes(group: Int64Array) -> Int64Array:
    """Points of each id from 0 to the highest."""
    return np.bincount(group + 1, minlength=1)[1:]


def _is_present(group: Int64Array, n_ids: int) -> BoolArray:
    """Whether each id has a point, for at least ``n_ids`` ids."""
    sizes = _sizes(group)
    return np.append(sizes, np.zeros(max(n_ids - len(sizes), 0), sizes.dtype)) > 0


def _numbers_of(group: Int64Array) -> Int64Array:
    """The new number of each id, followed by NO_GROUP, where index -1 finds it."""
    is_present = _sizes(group) > 0
    return np.append(np.where(is_present, np.cumsum(is_present) - 1, NO_GROUP), NO_GROUP)
