"""The scene cloud on a torch device: the answers of ``VoxelMap``, to the last bit; imported only when one is asked for.

Voxels, blocks and the lists of points are those of ``voxel_map.py``, but blocks are found by a search in their sorted
keys and a view is worked on as a whole. Every number is made by single float64 operations in the order of
``voxel_map.py``, each rounded as IEEE 754 says, so that a GPU gives the bits that the CPU gives.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, Int32Array, Int64Array
from su3d_bench.opensu3d.config import Density
from su3d_bench.opensu3d.voxel_map import checked_points, doubled

ABSENT = -1
VOXELS = 512  # of a block
NO_BLOCK = 0  # the row of heads that stays empty, for blocks that are not there
BITS = 21  # of a block's coordinate in its key, counted from the block of the first point
REACH = 1 << (BITS - 1)
LARGEST_KEY = (1 << 63) - 1  # stands behind all keys, so that a search always ends at one
LARGEST_ROW = (1 << 31) - 1
NEVER = (1 << 63) - 1  # born after all points
AT_ONCE = {"cpu": 1 << 14, "cuda": 1 << 18}  # queries; their neighbours fill the cache of a core, or 1 GB of a GPU


class _View(NamedTuple):
    """Queries with their voxels, and ``rows`` of heads of the 27 blocks about theirs, from ``place`` on."""

    points: Tensor
    voxels: Tensor
    rows: Tensor
    place: Tensor


class _Found(NamedTuple):
    """Of each query the squared distance ``best`` so far, the point in ``answer`` and when that was ``born``."""

    best: Tensor
    answer: Tensor
    born: Tensor


class DeviceVoxelMap:
    """``VoxelMap`` on ``device``; arrays of the host go in and come out."""

    def __init__(self, eps: float, device: str, density: Density = "scene") -> None:
        self.eps = eps
        self.density = density
        self._device = torch.device(device)
        # A tensor of the device: by a plain number, torch multiplies with the reciprocal, which rounds otherwise.
        self._side = torch.tensor(eps, dtype=torch.float64, device=self._device)
        self._points = self._empty((1 << 12, 3), torch.float64)
        self._ids = self._empty((1 << 12,), torch.int32)
        self._born = self._empty((1 << 12,), torch.int64)
        self._following = self._empty((1 << 12,), torch.int32)
        self._heads = self._full((1 << 6) * VOXELS, ABSENT, torch.int32)
        self._keys = self._full(1, LARGEST_KEY, torch.int64)
        self._rows = self._full(1, NO_BLOCK, torch.int64)
        self._origin = self._full(3, 0, torch.int64)
        self._n_points = 0
        self._n_given = 0

    def __len__(self) -> int:
        return self._n_points

    @property
    def n_blocks(self) -> int:
        """Number of occupied blocks of 8x8x8 voxels."""
        return len(self._keys) - 1

    @property
    def n_bytes(self) -> int:
        """What the tensors take, their spare room included."""
        return sum(tensor.nbytes for tensor in vars(self).values() if isinstance(tensor, Tensor))

    @property
    def points(self) -> Float64Array:
        """Points (N, 3) in the order of their index; a copy."""
        return np.asarray(self._points[: len(self)].cpu().numpy().copy(), np.float64)

    @property
    def by_age(self) -> Int64Array:
        """Index of each point (N,), the one that came first before all others."""
        return np.asarray(torch.argsort(self._born[: len(self)]).cpu().numpy(), np.int64)

    @property
    def ids(self) -> Int32Array:
        """Instance id of each point, NO_INSTANCE for none; a copy."""
        return np.asarray(self._ids[: len(self)].cpu().numpy().copy(), np.int32)

    def ids_of(self, indices: Int64Array) -> Int32Array:
        """Instance id of each point (N,) of the map, NO_INSTANCE for index -1."""
        at = self._up(indices)
        ids = torch.where(at >= 0, self._ids[at.clamp(min=0)], 0)
        return np.asarray(ids.cpu().numpy(), np.int32)

    def nearest(self, queries: Float64Array) -> Int64Array:
        """Index of the nearest point strictly within eps of each query, -1 where there is none; ties: the oldest."""
        queries = checked_points(queries)
        absent = np.full(len(queries), ABSENT, np.int64)
        if len(self) == 0:
            return absent
        points = self._up(queries)
        at_once = AT_ONCE[self._device.type]
        parts = [self._nearest(points[first : first + at_once]) for first in range(0, len(points), at_once)]
        return np.asarray(torch.cat(parts).cpu().numpy(), np.int64) if parts else absent

    def count_inside(self, lower: Float64Array, upper: Float64Array, wanted: Int32Array) -> Int64Array:
        """Number of points of each wanted id inside the closed box from ``lower`` to ``upper``."""
        if len(wanted) == 0 or len(self) == 0:
            return np.zeros(len(wanted), np.int64)
        n_ids = int(wanted.max()) + 1
        first, last = (
            self._up(np.floor(np.asarray(corner) / self.eps).astype(np.int64) >> 3) for corner in (lower, upper)
        )
        blocks = _unpacked(self._keys[:-1]) + self._origin
        rows = self._rows[:-1][((blocks >= first) & (blocks <= last)).all(dim=1)]
        low, high = self._up(np.asarray(lower, np.float64)), self._up(np.asarray(upper, np.float64))
        counts = self._full(n_ids, 0, torch.int64)
        at = _present(self._heads.view(-1, VOXELS)[rows].flatten())
        while len(at):
            points, ids = self._points[at], self._ids[at]
            inside = ((points >= low) & (points <= high)).all(dim=1) & (ids < n_ids)
            counts += torch.bincount(ids[inside], minlength=n_ids)
            at = _present(self._following[at])
        return np.asarray(counts[self._up(wanted.astype(np.int64))].cpu().numpy(), np.int64)

    def insert(self, points: Float64Array, ids: Int32Array) -> Int64Array:
        """Adds points in order; gives the map index that each took, -1 where it was left out, as ``VoxelMap`` does."""
        points = checked_points(points)
        if len(points) == 0:
            return np.zeros(0, np.int64)
        of_points = self._points, self._ids, self._born, self._following
        self._points, self._ids, self._born, self._following = (
            _with_room(part, len(self) + len(points)) for part in of_points
        )
        new_points, new_ids = self._up(points), self._up(np.ascontiguousarray(ids, np.int32))
        slots = self._slots(new_points)
        if self.density == "all":
            placed = self._append(new_points, new_ids, slots)
        else:
            placed = self._fill(new_points, new_ids, slots)
        if self.density == "scene":
            self._replace(new_points, new_ids, slots, placed)
        self._n_given += len(points)
        return np.asarray(placed.cpu().numpy(), np.int64)

    def _nearest(self, points: Tensor) -> Tensor:
        best = torch.full((len(points),), self.eps * self.eps, dtype=torch.float64, device=self._device)
        found = _Found(best, self._full(len(points), ABSENT, torch.int64), self._full(len(points), NEVER, torch.int64))
        view = self._view(points)
        every = torch.arange(len(points), device=self._device)
        self._lower(view, every, torch.zeros_like(view.voxels), found)
        gaps = _squared_gaps(points, view.voxels, self._side)
        self._look_around(view, every, gaps[:, :, 1:4], found)
        # Where a query lies on the border of its voxel, up to rounding, the second voxel can hold a point within eps.
        on_border = (gaps[:, :, [0, 4]].amin(dim=(1, 2)) <= best).nonzero()[:, 0]
        if len(on_border):
            self._look_around(view, on_border, gaps[on_border], found)
        return found.answer

    def _view(self, points: Tensor) -> _View:
        voxels = self._voxels(points)
        distinct, place = _distinct(self._packed(voxels >> 3))
        near = torch.arange(-1, 2, device=self._device)
        around = torch.stack(torch.meshgrid(near, near, near, indexing="ij"), dim=-1).view(1, 27, 3)
        rows = self._rows_of(_packed_relative(_unpacked(distinct)[:, None] + around))
        rows[distinct < 0] = NO_BLOCK
        return _View(points, voxels, rows.view(-1), place * 27)

    def _look_around(self, view: _View, queries: Tensor, gaps: Tensor, found: _Found) -> None:
        """Looks where ``gaps`` (Q, 3, S) to the voxels about ``queries`` (Q,) leave room for a nearer point."""
        x, y, z = gaps.unbind(1)
        bounds = (x[:, :, None, None] + y[:, None, :, None]) + z[:, None, None, :]
        row, *steps = (bounds <= found.best[queries][:, None, None, None]).nonzero(as_tuple=True)
        step = torch.stack(steps, dim=1) - gaps.shape[2] // 2
        is_other = (step != 0).any(dim=1)
        self._lower(view, queries[row[is_other]], step[is_other], found)

    def _lower(self, view: _View, query: Tensor, step: Tensor, found: _Found) -> None:
        """Lowers what was ``found`` to the nearest points in voxels ``step`` (P, 3) from a query's."""
        own = view.voxels[query]
        voxel = own + step
        row = view.rows[view.place[query] + _number((voxel >> 3) - (own >> 3) + 1, 3)]
        at = self._heads[row * VOXELS + _number(voxel & 7, 8)]
        while len(at):
            query, at = query[at >= 0], _present(at)
            offset = view.points[query] - self._points[at]
            offset *= offset
            squared = (offset[:, 0] + offset[:, 1]) + offset[:, 2]
            nearest = found.best.scatter_reduce(0, query, squared, "amin")
            found.born[nearest < found.best] = NEVER
            # At eps itself nothing matches: best starts there, and stays unless a point lies nearer.
            wins = (squared == nearest[query]) & (squared < self.eps * self.eps)
            of_winner, winner = query[wins], at[wins]
            found.born.scatter_reduce_(0, of_winner, self._born[winner], "amin")
            is_oldest = self._born[winner] == found.born[of_winner]
            found.answer[of_winner[is_oldest]] = winner[is_oldest]
            found.best.copy_(nearest)
            at = self._following[at]

    def _slots(self, points: Tensor) -> Tensor:
        """Where the head of each point's voxel stands; blocks that are missing are made."""
        voxels = self._voxels(points)
        blocks = voxels >> 3
        if len(self) == 0:
            self._origin = blocks[0].clone()
        keys = self._packed(blocks)
        distinct, place = _distinct(keys)
        if bool((distinct < 0).any()):
            far = points[(keys < 0).nonzero()[0, 0]].tolist()
            raise DataError(
                f"point cloud: a point lies at {far} m; on a device, a map with eps {self.eps} m reaches "
                f"{(REACH - 2) * 8 * self.eps:.0f} m from its first point; use device cpu"
            )
        missing = distinct[self._rows_of(distinct) == NO_BLOCK]
        if len(missing):
            self._add_blocks(missing)
        return self._rows_of(distinct)[place] * VOXELS + _number(voxels & 7, 8)

    def _fill(self, new_points: Tensor, new_ids: Tensor, slots: Tensor) -> Tensor:
        """Adds the first point of each voxel that is free; gives the index that each point took, ABSENT for none."""
        is_free = self._heads[slots] < 0
        order = torch.arange(len(slots), dtype=torch.int32, device=self._device)
        is_first = is_free.clone()
        is_first[is_free] = self._is_lowest(slots[is_free], order[is_free])
        index = torch.arange(len(self), len(self) + int(is_first.sum()), dtype=torch.int32, device=self._device)
        self._heads[slots[is_first]] = index
        new = slice(len(self), len(self) + len(index))
        self._points[new], self._ids[new], self._following[new] = new_points[is_first], new_ids[is_first], ABSENT
        self._born[new] = self._n_given + order[is_first].long()
        self._n_points += len(index)
        placed = self._full(len(slots), ABSENT, torch.int64)
        placed[is_first] = index.long()
        return placed

    def _replace(self, new_points: Tensor, new_ids: Tensor, slots: Tensor, placed: Tensor) -> None:
        """Lets new points take the voxels that are held, as if one came after the other; enters them into ``placed``.

        A point of no instance takes a voxel until the first of an instance holds it; the last to take it stays.
        """
        holder = self._heads[slots].long()
        order = torch.arange(len(slots), dtype=torch.int32, device=self._device)
        is_instance = new_ids != 0
        first_instance = self._lowest(slots, torch.where(is_instance, order, LARGEST_ROW))
        rows = (is_instance | ((self._ids[holder] == 0) & (order < first_instance))).nonzero()[:, 0]
        is_last = self._is_lowest(slots[rows], -order[rows])
        self._heads[slots] = holder.int()
        placed[rows] = holder[rows]
        rows = rows[is_last]
        at = holder[rows]
        self._points[at], self._ids[at], self._born[at] = new_points[rows], new_ids[rows], self._n_given + rows

    def _is_lowest(self, slots: Tensor, order: Tensor) -> Tensor:
        """Whether each entry has the lowest ``order`` of its slot; the heads there are overwritten."""
        return self._lowest(slots, order) == order

    def _lowest(self, slots: Tensor, order: Tensor) -> Tensor:
        """The lowest ``order`` of each entry's slot; the heads there are overwritten."""
        self._heads[slots] = LARGEST_ROW
        self._heads.scatter_reduce_(0, slots, order, "amin")
        return self._heads[slots]

    def _append(self, new_points: Tensor, new_ids: Tensor, slots: Tensor) -> Tensor:
        """Adds all points, each at the head of its voxel's list; gives their indices."""
        index = torch.arange(len(self), len(self) + len(slots), dtype=torch.int32, device=self._device)
        ordered, order = torch.sort(slots, stable=True)
        entered, following = index[order], self._heads[ordered]
        is_same = ordered[1:] == ordered[:-1]
        following[1:] = torch.where(is_same, entered[:-1], following[1:])
        self._following[entered.long()] = following
        is_last = torch.cat([~is_same, torch.ones(1, dtype=torch.bool, device=self._device)])
        self._heads[ordered[is_last]] = entered[is_last]
        new = slice(len(self), len(self) + len(slots))
        self._points[new], self._ids[new] = new_points, new_ids
        self._born[new] = self._n_given + torch.arange(len(slots), device=self._device)
        self._n_points += len(slots)
        return index.long()

    def _voxels(self, points: Tensor) -> Tensor:
        return torch.floor(points / self._side).long()

    def _packed(self, blocks: Tensor) -> Tensor:
        return _packed_relative(blocks - self._origin)

    def _rows_of(self, keys: Tensor) -> Tensor:
        """The row of heads of each key, NO_BLOCK where there is no such block."""
        at = torch.searchsorted(self._keys, keys)
        return torch.where(self._keys[at] == keys, self._rows[at], NO_BLOCK)

    def _add_blocks(self, keys: Tensor) -> None:
        """Enters blocks of new ``keys`` (K,), which ascend."""
        first = self.n_blocks + 1
        self._heads = _with_room(self._heads, (first + len(keys)) * VOXELS)
        rows = torch.arange(first, first + len(keys), device=self._device)
        at = torch.searchsorted(self._keys, keys) + torch.arange(len(keys), device=self._device)
        is_old = torch.ones(len(self._keys) + len(keys), dtype=torch.bool, device=self._device)
        is_old[at] = False
        merged = []
        for old, new in ((self._keys, keys), (self._rows, rows)):
            both = self._empty((len(is_old),), torch.int64)
            both[is_old], both[at] = old, new
            merged.append(both)
        self._keys, self._rows = merged

    def _up(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.require(array, requirements=["C", "W"])).to(self._device)

    def _empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=self._device)

    def _full(self, n: int, value: int, dtype: torch.dtype) -> Tensor:
        return torch.full((n,), value, dtype=dtype, device=self._device)


def _with_room(tensor: Tensor, n: int) -> Tensor:
    """``tensor``, doubled until it has ``n`` rows; the new ones are ABSENT."""
    n_new = doubled(len(tensor), n) - len(tensor)
    return torch.cat([tensor, tensor.new_full((n_new, *tensor.shape[1:]), ABSENT)]) if n_new else tensor


def _present(at: Tensor) -> Tensor:
    return at[at >= 0].long()


def _distinct(keys: Tensor) -> tuple[Tensor, Tensor]:
    """The different keys, ascending, and the place of each among them; neighbours in an image mostly share one."""
    runs, run = torch.unique_consecutive(keys, return_inverse=True)
    distinct, place = torch.unique(runs, return_inverse=True)
    return distinct, place[run]


def _packed_relative(blocks: Tensor) -> Tensor:
    """The key of block coordinates (..., 3), -1 where one is out of reach."""
    x, y, z = (blocks + REACH).unbind(-1)
    keys = (x << 2 * BITS) | (y << BITS) | z
    return torch.where((blocks.abs() < REACH - 1).all(dim=-1), keys, ABSENT)


def _unpacked(keys: Tensor) -> Tensor:
    """The block coordinates (N, 3) of ``keys``."""
    mask = (1 << BITS) - 1
    return torch.stack([keys >> 2 * BITS, (keys >> BITS) & mask, keys & mask], dim=-1) - REACH


def _number(digits: Tensor, base: int) -> Tensor:
    """The numbers (N,) of three digits (N, 3) in ``base``."""
    x, y, z = digits.unbind(1)
    return (x * base + y) * base + z


def _squared_gaps(points: Tensor, voxels: Tensor, side: Tensor) -> Tensor:
    """Of each axis, squared distances (N, 3, 5) from a point to the voxels 2 below to 2 above its own, rounded down.

    The margins are those of ``voxel_map.py``, so that no voxel is passed over for rounding.
    """
    below, above = points - voxels * side, (voxels + 1) * side - points
    gaps = torch.stack([below + side, below, torch.zeros_like(below), above, above + side], dim=-1)
    gaps = (gaps * (1.0 - 1e-9) - (points.abs() * 1e-15)[:, :, None]).clamp(min=0.0)
    return gaps * gaps
