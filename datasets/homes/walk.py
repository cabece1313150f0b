"""Trajectories of a hand-held camera and of a robot's camera through a home that show everything in it.

Medians between consecutive updates of real and published trajectories, which the constants below follow:

| trajectory | stride | translation | rotation |
|---|---|---|---|
| Replica, NICE-SLAM's poses, the first 300 of one scene | 40 / 5 | 33 cm / 4.6 cm | 25 / 3.1 degrees |
| Replica room0, all 2000 frames, poses by Open3D's RGB-D odometry | 40 / 5 | 45 cm / 6.2 cm | 12 / 1.7 degrees |
| TUM fr1/desk, hand-held, ground truth at 30 frames per second | 40 / 10 | 53 cm / 16 cm | 24 / 8.5 degrees |

Sources: ``traj.txt`` of github.com/langsungn/MonoGS at 30507a6, ``poses.txt`` of
github.com/lzw-super/concept_graph_mine at a80d09d, ``groundtruth.txt`` of the TUM RGB-D benchmark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.datasets.procedural.items import Box
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh, caster
from su3d_bench.datasets.procedural.trajectory import (
    PITCHES,
    YAWS,
    along_loop,
    backtrack,
    camera_poses,
    even_loop,
    grid_graph,
    inside_view,
    largest_part,
    low_furniture_cost,
    smooth_through,
    sphere_directions,
)
from su3d_bench.numerics.open3d_core import compiled_open3d

FRAMES_PER_SECOND = 30.0
SHORTEST_S = 40.0  # a walk with fewer frames passes through the whole home all the same, with longer steps
REACH_M = 2.5  # from the path to every free place: half of the 5 m to which depth cameras are accurate
OPEN_M = 0.25  # stops are at least this far from the edge of the free cells, not in corners
MAX_STOPS = 14
ROUNDED = 0.85  # length of a path with rounded corners over that of the same path on the grid
KNOT_M = 0.35  # path between two chosen views: at a walking speed, about the 0.7 s of a head turn and a look
CLEAR_M = 0.3  # from anything at the camera's height; 0.22 where a home is too narrow for that
REVISIT_DEG = 60.0  # least turn between the first and the last view, which are at one place


@dataclass(frozen=True)
class Carrier:
    """How a camera moves: height in metres, cruising speed in m/s, speed of turns in degrees/s.

    ``swing`` is the change of direction between two views at which another view is worth half; ``looks`` the number
    of views at a stop, which takes about ``stop_s``; ``pitches`` those to choose from. ``faces_path``: the camera
    looks where it drives, and turns at stops.
    """

    height: tuple[float, float]
    speed: float
    turn: float
    swing: float
    looks: tuple[int, int]
    stop_s: float
    pitches: tuple[float, ...]
    faces_path: bool


CARRIERS = {
    "person": Carrier((1.44, 1.66), 0.42, 60.0, 30.0, (0, 3), 2.0, PITCHES, False),
    "robot": Carrier((0.5, 0.9), 0.42, 45.0, 30.0, (0, 3), 4.5, (5.0,), True),
}


@dataclass(frozen=True)
class _Knots:
    """Places (K,) along the path at which a view is chosen: metres from the start, whether the camera moves there,
    direction of the path in degrees, metres of height, cruising speed from there in m/s."""

    arc: Float64Array
    moving: BoolArray
    heading: Float64Array
    height: Float64Array
    speed: Float64Array


def walk_home(
    mesh: SceneMesh, free: BoolArray, cell_m: float, origin: Float64Array, boxes: Sequence[Box], n_structure: int,
    n_frames: int, rng: np.random.Generator, carrier: Literal["person", "robot"],
) -> Float64Array:  # fmt: skip
    """Camera-to-world poses (n_frames, 4, 4) with OpenCV axes, z up: a round through all parts of the home.

    ``free`` (X, Y) are the cells where the camera may be, one connected region; cell (0, 0) has its corner at
    ``origin``. ``n_structure`` is the last object id of the bare home, which views need not show.
    """
    kind = CARRIERS[carrier]
    level = kind.height if not kind.faces_path else (float(rng.uniform(*kind.height)),) * 2
    field = _Field(_clear_cells(free, cell_m, origin, boxes, level), cell_m, origin)
    duration = max(n_frames / FRAMES_PER_SECOND, SHORTEST_S)
    path, stops = _round_trip(field, boxes, kind, duration)
    knots = _place_knots(path, stops, kind, level, rng)
    yaw, pitch = _choose_views(mesh, path, knots, kind, n_structure)

    steps = np.diff(knots.arc) / knots.speed[:-1], np.hypot(np.diff(yaw), np.diff(pitch)) / kind.turn
    pause = np.where(knots.moving[:-1] | knots.moving[1:], 0.2, rng.uniform(0.6, 1.4, len(knots.arc) - 1))
    at = np.concatenate([[0.0], np.cumsum(np.maximum.reduce([*steps, pause]))])
    at *= duration / at[-1]
    time: Float64Array = np.arange(n_frames) * (duration / n_frames)
    arc, height = smooth_through(at, knots.arc, time), smooth_through(at, knots.height, time)
    position = np.column_stack([along_loop(path, arc / knots.arc[-1]), height])
    turned = np.column_stack([smooth_through(at, yaw, time), smooth_through(at, pitch, time), np.zeros(n_frames)])
    if carrier == "person":
        moved, rotated = _shake(rng, time, np.gradient(arc, time) if n_frames > 1 else np.zeros(n_frames))
        position += moved * np.clip(field.clearance(position[:, :2]) / 0.045, 0, 1)[:, None]
        turned += rotated
    return camera_poses(position, *turned.T)


def _shake(rng: np.random.Generator, time: Float64Array, speed: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Metres (N, 3) and degrees (N, 3: yaw, pitch, roll) by which steps, slow drift and tremor move a held camera.

    Root mean squares per band are those of the TUM sequence fr1/desk: 4 mm and 0.7 degrees around the step
    frequency, 0.1 mm and 0.1 degrees at 6 to 12 Hz, the band of physiological tremor (Lakie et al. 2015). Slow
    motion is intended in part: about half of its 17 mm and 2 degrees there. Steps fade with the speed.
    """
    pace = np.clip(speed / 0.5, 0.0, 1.0)[:, None]
    total = np.zeros((len(time), 6))
    for low, high, millimetres, degrees, share in (
        (0.3, 0.9, 5.0, 1.0, np.ones_like(pace)),
        (1.6, 2.0, 4.0, 0.7, 0.2 + 0.8 * pace),  # people make 2 steps per second (MacDougall and Moore 2005)
        (6.0, 12.0, 0.1, 0.1, np.ones_like(pace)),
    ):
        size = np.repeat([millimetres / 1000, degrees], 3) * np.sqrt(2 / 3)
        for _ in range(3):
            wave = np.sin(2 * np.pi * rng.uniform(low, high, 6) * time[:, None] + rng.uniform(0, 2 * np.pi, 6))
            total += share * size * wave
    return total[:, :3], total[:, 3:]


class _Field:
    """Free cells of a home and their distances to the others."""

    def __init__(self, free: BoolArray, cell_m: float, origin: Float64Array) -> None:
        from scipy.ndimage import distance_transform_edt

        self.free, self.cell_m, self.origin = free, cell_m, np.asarray(origin, np.float64)
        self.cells = np.argwhere(free)
        self.points = self.origin + (self.cells + 0.5) * cell_m
        self._fine_m = cell_m / 4
        fine = np.pad(np.kron(free, np.ones((4, 4), bool)), 1)
        self._distance = np.asarray(distance_transform_edt(fine)) * self._fine_m

    def clearance(self, points: Float64Array) -> Float64Array:
        """Metres (N,) from points (N, 2) to the nearest cell that is not free, at least; 0 or less in such a cell."""
        from scipy.ndimage import map_coordinates

        at = (points - self.origin).T / self._fine_m + 0.5
        return np.asarray(map_coordinates(self._distance, at, order=1)) - 0.75 * self._fine_m


def _clear_cells(
    free: BoolArray, cell_m: float, origin: Float64Array, boxes: Sequence[Box], level: tuple[float, float]
) -> BoolArray:
    """The largest part of ``free`` away from everything at the camera's height."""
    points = (np.moveaxis(np.indices(free.shape), 0, -1) + 0.5) * cell_m + origin
    part = free
    for margin in (CLEAR_M, 0.22):
        near = np.zeros(free.shape, bool)
        for box in boxes:
            if box.high[2] > level[0] - margin and box.low[2] < level[1] + margin:
                near |= ((points > box.low[:2] - margin) & (points < box.high[:2] + margin)).all(axis=-1)
        part = largest_part(free & ~near)
        if 2 * part.sum() >= free.sum():
            break
    return part


def _round_trip(
    field: _Field, boxes: Sequence[Box], kind: Carrier, duration: float
) -> tuple[Float64Array, Float64Array]:
    """A closed path (N, 2) through all parts of the home, and its stops in metres from its start."""
    from scipy.sparse.csgraph import dijkstra

    points = field.points
    clear = field.clearance(points)
    cost = low_furniture_cost(points, boxes) ** (2 if kind.faces_path else 1) + (clear < 0.15)
    graph, plain = (grid_graph(field.free, field.cells, weight) for weight in (cost, np.ones(len(points))))
    open_floor = np.where(clear > min(OPEN_M, 0.9 * clear.max()), 1.0, 1e-3)
    chosen = [int((((points - points.mean(axis=0)) ** 2).sum(axis=1) * open_floor).argmax())]
    nearest = np.full(len(points), np.inf)
    metres: list[Float64Array] = []
    before: list[NDArray[np.int32]] = []
    best, loop, first = np.inf, points[:1], [0]
    for _ in range(min(MAX_STOPS, len(points))):
        cells, way = dijkstra(graph, directed=False, indices=chosen[-1], return_predecessors=True)
        metres.append(cells * field.cell_m)
        before.append(way)
        order = _tour(np.stack(metres)[:, chosen])
        legs = [backtrack(before[a], chosen[a], chosen[b]) for a, b in pairwise([*order, 0])]
        way_cells = [cell for leg in legs for cell in leg]
        steps = points[way_cells]
        nearest = np.minimum(nearest, dijkstra(plain, directed=False, indices=chosen[-1]) * field.cell_m)
        lasts = ROUNDED * _lengths(steps)[-1] / kind.speed + kind.stop_s * len(order)
        aside = dijkstra(plain, directed=False, indices=way_cells or [chosen[0]], min_only=True).max() * field.cell_m
        mismatch = abs(lasts - duration) + 30.0 * max(0.0, aside - REACH_M)
        if len(order) > 1 and mismatch < best:
            best, loop, first = mismatch, steps, [0, *np.cumsum([len(leg) for leg in legs])[:-1]]
        chosen.append(int((nearest * open_floor).argmax()))
    along = _lengths(loop)
    path = even_loop(loop)
    at_stop = np.round(along[first] / along[-1] * len(path)).astype(int)
    path = _relaxed(path, field)
    arc = _lengths(path)
    return path, np.append(arc[at_stop], arc[-1])


def _lengths(loop: Float64Array) -> Float64Array:
    """Metres (N + 1,) along a closed path from its first point to each and back to it."""
    steps = np.linalg.norm(np.diff(loop, axis=0, append=loop[:1]), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _tour(metres: Float64Array) -> list[int]:
    """A short closed order of all places, by cheapest insertion."""
    order = [0]
    for place in range(1, len(metres)):
        extra = [metres[a, place] + metres[place, b] - metres[a, b] for a, b in pairwise([*order, 0])]
        order.insert(int(np.argmin(extra)) + 1, place)
    return order


def _relaxed(path: Float64Array, field: _Field) -> Float64Array:
    """The path with its corners rounded (over about 0.3 m) as far as it keeps its distance."""
    clear = field.clearance(path)
    for _ in range(450):
        moved = 0.5 * path + 0.25 * (np.roll(path, 1, axis=0) + np.roll(path, -1, axis=0))
        there = field.clearance(moved)
        accepted = there >= np.minimum(clear, 0.08)
        path, clear = np.where(accepted[:, None], moved, path), np.where(accepted, there, clear)
    return path


def _place_knots(
    path: Float64Array, stops: Float64Array, kind: Carrier, level: tuple[float, float], rng: np.random.Generator
) -> _Knots:
    rows: list[tuple[float, bool, float, float]] = []
    length = stops[-1]
    for start, end in pairwise(stops):
        speed = kind.speed * float(rng.uniform(0.75, 1.25))
        n_looks = int(rng.integers(*kind.looks, endpoint=True)) if rows else kind.looks[1]
        rows += [(start, False, start, speed)] * n_looks
        between = np.linspace(start, end, max(2, int(np.ceil((end - start) / KNOT_M))) + 1)
        inner = min(0.1, (end - start) / 2)
        for arc in between if kind.faces_path else between[1:-1]:
            rows.append((float(arc), True, float(np.clip(arc, start + inner, end - inner)), speed))
    rows += [(length, False, length, kind.speed)] * kind.looks[1]
    arc, moving, aim, speeds = (np.array(column) for column in zip(*rows, strict=True))
    ahead, behind = ((np.clip(aim + step, 0, length) / length) for step in (0.1, -0.1))
    direction = along_loop(path, ahead) - along_loop(path, behind)
    heading = np.rad2deg(np.arctan2(direction[:, 1], direction[:, 0]))
    height = smooth_through(stops, rng.uniform(*level, len(stops)), arc)
    return _Knots(arc, moving, heading, height, speeds)


def _choose_views(
    mesh: SceneMesh, path: Float64Array, knots: _Knots, kind: Carrier, n_structure: int
) -> tuple[Float64Array, Float64Array]:
    """Yaw and pitch (degrees, yaw unwrapped) at each knot, chosen to show every object repeatedly and well."""
    candidates = np.array([(360.0 * k / YAWS, p) for k in range(YAWS) for p in kind.pitches])
    arcs, station = np.unique(knots.arc, return_inverse=True)
    height = knots.height[np.searchsorted(knots.arc, arcs)]
    stations = np.column_stack([along_loop(path, arcs / arcs[-1]), height])
    shares, near = _visible_shares(mesh, stations, candidates, n_structure)
    aside = _turn(candidates[:, 0], knots.heading[:, None])
    # A person looks around, but seldom backwards while walking.
    prior = np.where(knots.moving[:, None], np.clip(1.5 - aside / 120.0, 0.2, 1.0), 1.0)
    if kind.faces_path:
        prior = np.where(knots.moving[:, None], aside <= aside.min(axis=1, keepdims=True), prior)
    last = len(station) - 1
    picked = np.full(last + 1, -1)
    seen = np.zeros(shares.shape[2])
    for _ in range(3):
        for knot, place in enumerate(station):
            if picked[knot] >= 0:
                seen = seen - shares[place, picked[knot]]
            gain = (shares[place] / (0.25 + np.maximum(seen, 0.0)) ** 1.5).sum(axis=1)
            score = np.maximum(gain - 1.5 * near[place], 0.01 * gain) * prior[knot]
            for other in (knot - 1, knot + 1):
                if 0 <= other <= last and picked[other] >= 0:
                    turn = _turn(candidates[:, 0], candidates[picked[other], 0])
                    swing = np.hypot(turn, candidates[:, 1] - candidates[picked[other], 1])
                    score = score / (1.0 + (swing / kind.swing) ** 2)
            if knot in (0, last) and picked[last - knot] >= 0:
                score = np.where(_turn(candidates[:, 0], candidates[picked[last - knot], 0]) < REVISIT_DEG, -1.0, score)
            picked[knot] = int(score.argmax())
            seen = seen + shares[place, picked[knot]]
    yaw = np.where(knots.moving & kind.faces_path, knots.heading, candidates[picked, 0])
    return np.rad2deg(np.unwrap(np.deg2rad(yaw))), candidates[picked, 1]


def _turn(first: Any, second: Any) -> Float64Array:
    """The angle (0..180 degrees) between two directions in degrees."""
    return np.asarray(np.abs((first - second + 180.0) % 360.0 - 180.0))


def _visible_shares(
    mesh: SceneMesh, stations: Float64Array, candidates: Float64Array, n_structure: int
) -> tuple[Float64Array, Float64Array]:
    """How well each candidate view of each station shows each object (S, C, O; 0..1), how much is too near (S, C)."""
    from scipy.sparse import csr_matrix

    o3d = compiled_open3d()
    directions, weight = sphere_directions()
    inside = inside_view(candidates, directions).T
    rays = np.empty((len(stations), len(directions), 6), np.float32)
    rays[..., :3], rays[..., 3:] = stations[:, None], directions
    answer = caster(mesh.vertices, mesh.triangles).cast_rays(o3d.core.Tensor(rays.reshape(-1, 6)))  # type: ignore[attr-defined]
    t = answer["t_hit"].numpy().reshape(len(stations), -1)
    row = np.where(np.isfinite(t), answer["primitive_ids"].numpy().reshape(t.shape), 0)
    ids = np.where(np.isfinite(t), mesh.instance_of_triangle[row], 0)
    value = weight * np.interp(t, [0.4, 0.7, 2.5, 5.0], [0.2, 1.0, 1.0, 0.3])
    n_objects, ray = int(mesh.instance_of_triangle.max()) + 1, np.arange(len(directions))
    tables = [csr_matrix((value[k], (ids[k], ray)), (n_objects, len(ray))) for k in range(len(stations))]
    best = np.max([np.asarray(table.sum(axis=1)).ravel() for table in tables], axis=0)
    shares = np.stack([(table @ inside).T for table in tables])
    shares = np.clip(shares / np.clip(0.5 * best, 0.002, 0.3), 0, 1)  # half of the best view is a good view
    shares[:, :, 0] = 0.0
    shares[:, :, 1 : n_structure + 1] *= 0.25
    near = np.stack([(inside[close] * weight[close, None]).sum(axis=0) for close in t < 0.6])
    return shares, near
