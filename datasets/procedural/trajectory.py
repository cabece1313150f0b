"""A smooth hand-held trajectory through a room that shows everything in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.datasets.procedural.items import Box
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh, caster
from su3d_bench.numerics.open3d_core import compiled_open3d

CELL_M = 0.1
CLEAR_M = 0.32  # minimum distance of the camera to anything at its height
FRAMES_PER_VIEW = 40  # one chosen view in every 40 frames, the stride of OpenSU3D on Replica
YAWS, PITCHES = 24, (-38.0, -24.0, -10.0, 8.0)
HALF_WIDTH, HALF_HEIGHT = 0.8 * 0.8, 0.6 * 0.8  # tangents of the inner part of a 640x480 image with f = 400


def walk(mesh: SceneMesh, boxes: Sequence[Box], room: tuple[float, float, float], n_structure: int, n_frames: int,
         rng: np.random.Generator) -> Float64Array:  # fmt: skip
    """Camera-to-world poses (n_frames, 4, 4) with OpenCV axes.

    ``n_structure`` is the last object id of the bare room (walls, floor, ceiling), which views need not show.
    """
    path = _loop(_free_cells(boxes, room), boxes, rng)
    n_views = min(n_frames, max(10, n_frames // FRAMES_PER_VIEW))
    at = np.linspace(0.0, 1.0, n_views, endpoint=False)
    height = rng.uniform(1.32, 1.72, n_views)
    stations = np.column_stack([along_loop(path, at), height])
    yaw, pitch = _choose_views(mesh, stations, n_structure)
    time = np.arange(n_frames) / max(n_frames, 1)
    smooth_height = smooth_through(at, height, time)
    wobble = _wobble(rng, n_frames)
    position = np.column_stack([along_loop(path, time), smooth_height]) + wobble[:, :3] * 0.008
    return camera_poses(
        position,
        smooth_through(at, yaw, time) + 0.5 * wobble[:, 3],
        smooth_through(at, pitch, time) + 0.5 * wobble[:, 4],
        1.2 * wobble[:, 5],
    )


def _free_cells(boxes: Sequence[Box], room: tuple[float, float, float]) -> BoolArray:
    """Cells (X, Y) whose centre keeps its distance from walls and from objects at camera height."""
    nx, ny = int(room[0] / CELL_M), int(room[1] / CELL_M)
    x, y = np.meshgrid((np.arange(nx) + 0.5) * CELL_M, (np.arange(ny) + 0.5) * CELL_M, indexing="ij")
    for margin in (0.55, 0.4):
        free = (x > margin) & (x < room[0] - margin) & (y > margin) & (y < room[1] - margin)
        for box in boxes:
            if box.high[2] > 0.95 and box.low[2] < 1.95:
                near = (x > box.low[0] - CLEAR_M) & (x < box.high[0] + CLEAR_M)
                free &= ~(near & (y > box.low[1] - CLEAR_M) & (y < box.high[1] + CLEAR_M))
        if free.sum() > 40:
            return largest_part(free)
    return largest_part(free)


def largest_part(free: BoolArray) -> BoolArray:
    from scipy.ndimage import label

    parts, n = label(free)
    assert n > 0, "a room without free floor"
    sizes = np.bincount(parts.ravel())[1:]
    return np.asarray(parts == 1 + int(sizes.argmax()))


def _loop(free: BoolArray, boxes: Sequence[Box], rng: np.random.Generator) -> Float64Array:
    """A closed smooth path (N, 2) m through distant free cells, preferably over bare floor."""
    cells = np.argwhere(free)
    points = (cells.astype(np.float64) + 0.5) * CELL_M
    chosen = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmax())]
    distance = np.full(len(points), np.inf)
    for _ in range(6):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(distance.argmax()))
    middle = points[chosen].mean(axis=0)
    turn = np.arctan2(*(points[chosen] - middle).T[::-1])
    order = [chosen[int(k)] for k in np.argsort(turn, kind="stable")]
    if rng.random() < 0.5:
        order.reverse()
    steps = _shortest_paths(free, cells, low_furniture_cost(points, boxes), order)
    raw = points[steps]
    for sigma in (0.45, 0.3, 0.2, 0.1):
        smoothed = _blur_loop(even_loop(raw), sigma)
        index = np.clip((smoothed / CELL_M).astype(int), 0, np.array(free.shape) - 1)
        if free[index[:, 0], index[:, 1]].all():
            return smoothed
    return even_loop(raw)


def low_furniture_cost(points: Float64Array, boxes: Sequence[Box]) -> Float64Array:
    cost = np.ones(len(points))
    for box in boxes:
        if box.high[2] > 0.2 and box.low[2] < 1.0:
            inside = ((points > box.low[:2] - 0.15) & (points < box.high[:2] + 0.15)).all(axis=1)
            cost[inside] = 4.0
    return cost


def _shortest_paths(free: BoolArray, cells: NDArray[np.intp], cost: Float64Array, order: Sequence[int]) -> list[int]:
    """Cell indices along the cheapest path through all ``order`` stops and back to the first."""
    from scipy.sparse.csgraph import dijkstra

    graph = grid_graph(free, cells, cost)
    way: list[int] = []
    for start, end in zip(order, [*order[1:], order[0]], strict=True):
        before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)[1]
        way.extend(backtrack(before, start, end))
    return way


def grid_graph(free: BoolArray, cells: NDArray[np.intp], cost: Float64Array) -> Any:
    """Sparse graph of the 8-connected free ``cells`` (N, 2); an edge weighs its length in cells times its cost."""
    from scipy.sparse import coo_matrix

    index = np.full(free.shape, -1)
    index[tuple(cells.T)] = np.arange(len(cells))
    padded = np.pad(index, 1, constant_values=-1)
    rows, columns, weights = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        other = padded[cells[:, 0] + 1 + dx, cells[:, 1] + 1 + dy]
        here = np.flatnonzero(other >= 0)
        rows.append(here)
        columns.append(other[here])
        weights.append(np.hypot(dx, dy) * (cost[here] + cost[other[here]]) / 2)
    edges = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    return coo_matrix(edges, (len(cells),) * 2).tocsr()


def backtrack(before: NDArray[np.int32], start: int, end: int) -> list[int]:
    """The path of ``before`` (predecessors towards ``start``) from ``start`` to ``end``, which it leaves out."""
    leg = [end]
    while leg[-1] != start:
        leg.append(int(before[leg[-1]]))
    return leg[:0:-1]


def closed_loop(loop: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The loop with its first point once more at the end, and metres (N + 1,) from the start to each point."""
    closed = np.concatenate([loop, loop[:1]])
    return closed, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])


def even_loop(loop: Float64Array) -> Float64Array:
    """The closed polyline at steps of 2 cm."""
    closed, length = closed_loop(loop)
    at = np.linspace(0.0, length[-1], max(8, int(length[-1] / 0.02)), endpoint=False)
    return np.column_stack([np.interp(at, length, closed[:, k]) for k in range(2)])


def _blur_loop(loop: Float64Array, sigma_m: float) -> Float64Array:
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(loop, sigma_m / 0.02, axis=0, mode="wrap"))


def along_loop(loop: Float64Array, share: Float64Array) -> Float64Array:
    closed, length = closed_loop(loop)
    return np.column_stack([np.interp(share * length[-1], length, closed[:, k]) for k in range(2)])


def smooth_through(at: Float64Array, values: Float64Array, time: Float64Array) -> Float64Array:
    """A monotone cubic through (at, values); constant after the last one."""
    from scipy.interpolate import PchipInterpolator

    if len(at) < 2:
        return np.full(len(time), values[0])
    return np.asarray(PchipInterpolator(at, values, extrapolate=False)(np.minimum(time, at[-1])))


def _wobble(rng: np.random.Generator, n_frames: int) -> Float64Array:
    """Six slow hand-shake signals, each about -1..1, at 30 frames per second."""
    time = np.arange(n_frames)[:, None] / 30.0
    total = np.zeros((n_frames, 6))
    for hertz, weight in ((0.35, 0.6), (0.9, 0.3), (1.7, 0.1)):
        total += weight * np.sin(2 * np.pi * hertz * rng.uniform(0.8, 1.2, 6) * time + rng.uniform(0, 2 * np.pi, 6))
    return total


def camera_poses(position: Float64Array, yaw: Float64Array, pitch: Float64Array, roll: Float64Array) -> Float64Array:
    y, p, r = np.deg2rad(yaw), np.deg2rad(pitch), np.deg2rad(roll)
    forward = np.stack([np.cos(p) * np.cos(y), np.cos(p) * np.sin(y), np.sin(p)], axis=1)
    right = np.stack([np.sin(y), -np.cos(y), np.zeros_like(y)], axis=1)
    down = np.cross(forward, right)
    poses = np.tile(np.eye(4), (len(position), 1, 1))
    poses[:, :3, 0] = right * np.cos(r)[:, None] + down * np.sin(r)[:, None]
    poses[:, :3, 1] = down * np.cos(r)[:, None] - right * np.sin(r)[:, None]
    poses[:, :3, 2], poses[:, :3, 3] = forward, position
    return poses


def _choose_views(mesh: SceneMesh, stations: Float64Array, n_structure: int) -> tuple[Float64Array, Float64Array]:
    """Yaw and pitch (degrees, yaw unwrapped) at each station, chosen to show every object repeatedly and well."""
    candidates = candidate_views(PITCHES)
    shares, near = visible_shares(mesh, stations, candidates, n_structure)

    def smoother(view: int, picked: NDArray[np.intp], score: Float64Array) -> Float64Array:
        for neighbour in (view - 1, view + 1):
            if 0 <= neighbour < len(picked) and picked[neighbour] >= 0:
                swing = turn_between(candidates[:, 0], candidates[picked[neighbour], 0])
                score = score * np.clip(1.35 - swing / 100.0, 0.02, 1.0)
        return score

    picked = pick_views(shares, near, smoother)
    yaw = np.rad2deg(np.unwrap(np.deg2rad(candidates[picked, 0])))
    return yaw, candidates[picked, 1]


def candidate_views(pitches: Sequence[float]) -> Float64Array:
    """Yaw and pitch in degrees (C, 2) of views all around."""
    return np.array([(360.0 * k / YAWS, p) for k in range(YAWS) for p in pitches])


def turn_between(first: Any, second: Any) -> Float64Array:
    """The angle (0..180) between directions in degrees."""
    return np.asarray(np.abs((first - second + 180) % 360 - 180))


def pick_views(
    shares: Float64Array, near: Float64Array, weigh: Callable[[int, NDArray[np.intp], Float64Array], Float64Array]
) -> NDArray[np.intp]:
    """A candidate (V,) for each view, such that together they show every object repeatedly and well.

    ``weigh`` receives a view, the candidates picked so far (-1: none yet) and the scores (C,) of the view's
    candidates, and returns the scores that decide.
    """
    n_views = len(shares)
    picked = np.full(n_views, -1)
    for sweep in range(3):
        for view in range(n_views):
            others = np.delete(np.arange(n_views), view)[:view] if sweep == 0 else np.delete(np.arange(n_views), view)
            seen = shares[others, picked[others]].sum(axis=0) if len(others) else np.zeros(shares.shape[2])
            score = shares[view] @ (1.0 / (0.25 + seen) ** 1.5) - 1.5 * near[view]
            picked[view] = int(weigh(view, picked, score).argmax())
    return picked


def _sphere() -> tuple[Float64Array, Float64Array]:
    """Unit directions (N, 3) all around and the solid angle of each."""
    turn = (np.arange(96) + 0.5) * 2 * np.pi / 96
    rise = np.deg2rad(np.linspace(-80, 50, 44))
    t, r = (grid.ravel() for grid in np.meshgrid(turn, rise, indexing="ij"))
    weight: Float64Array = np.cos(r) * (2 * np.pi / 96) * np.deg2rad(130 / 43)
    return np.stack([np.cos(r) * np.cos(t), np.cos(r) * np.sin(t), np.sin(r)], axis=1), weight


def _inside_view(candidates: Float64Array, directions: Float64Array) -> Float64Array:
    poses = camera_poses(np.zeros((len(candidates), 3)), candidates[:, 0], candidates[:, 1], np.zeros(len(candidates)))
    local = np.einsum("nd,cdk->cnk", directions, poses[:, :3, :3])
    ahead = local[..., 2] > 0.05
    z = np.where(ahead, local[..., 2], 1.0)
    inside = ahead & (np.abs(local[..., 0] / z) < HALF_WIDTH) & (np.abs(local[..., 1] / z) < HALF_HEIGHT)
    return np.asarray(inside, np.float64)


def visible_shares(
    mesh: SceneMesh, stations: Float64Array, candidates: Float64Array, n_structure: int
) -> tuple[Float64Array, Float64Array]:
    """How well each candidate view of each station shows each object (S, C, O; 0..1), how much is too near (S, C)."""
    o3d = compiled_open3d()
    directions, weight = _sphere()
    inside = _inside_view(candidates, directions)
    rays = np.empty((len(stations), len(directions), 6), np.float32)
    rays[..., :3], rays[..., 3:] = stations[:, None], directions
    answer = caster(mesh.vertices, mesh.triangles).cast_rays(o3d.core.Tensor(rays.reshape(-1, 6)))  # type: ignore[attr-defined]
    t = answer["t_hit"].numpy()
    hit = np.isfinite(t)
    ids = np.where(hit, mesh.instance_of_triangle[np.where(hit, answer["primitive_ids"].numpy(), 0)], 0)
    ids, t = ids.reshape(len(stations), -1), t.reshape(len(stations), -1)
    n_objects = int(mesh.instance_of_triangle.max()) + 1
    shares = np.zeros((len(stations), len(inside), n_objects))
    near = np.zeros((len(stations), len(inside)))
    row, best = np.arange(len(directions)), np.zeros(n_objects)
    for k in range(len(stations)):
        table = np.zeros((len(directions), n_objects))
        table[row, ids[k]] = weight * np.interp(t[k], [0.4, 0.7, 2.5, 5.0], [0.2, 1.0, 1.0, 0.3])
        shares[k] = inside @ table
        best = np.maximum(best, table.sum(axis=0))
        near[k] = inside @ ((t[k] < 0.6) * weight)
    shares = np.clip(shares / np.clip(0.5 * best, 0.002, 0.3), 0, 1)  # half of the best view is a good view
    shares[:, :, 0] = 0.0
    shares[:, :, 1 : n_structure + 1] *= 0.25
    return shares, near
