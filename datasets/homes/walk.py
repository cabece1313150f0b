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

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.datasets.procedural import trajectory
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh

Pair = tuple[Float64Array, Float64Array]
Range = tuple[float, float]
FRAMES_PER_SECOND = 30.0
SHORTEST_S = 40.0  # a walk with fewer frames passes through the whole home anyway, with longer steps
REACH_M = 2.5  # from the path to every free place: half of the 5 m to which depth cameras are accurate
OPEN_M = 0.25  # stops are at least this far from the edge of the free cells, not in corners
MAX_STOPS, ROUNDED = 14, 0.85  # ROUNDED: length of a path with rounded corners over that of the path on the grid
KNOT_M = 0.35  # path between two chosen views: at a walking speed, about the 0.7 s of a head turn and a look
REVISIT_DEG = 60.0  # least turn between the first and the last view, which are at one place


@dataclass(frozen=True)
class Carrier:
    """How a camera moves: height in metres, cruising speed in m/s, speed of turns in degrees/s.

    ``swing`` is the change of direction between two views at which another view is worth half; ``looks`` the number
    of views at a stop, which takes about ``stop_s``; ``pitches`` those to choose from. ``faces_path``: the camera
    looks where it drives, and turns at stops.
    """

    height: Range
    speed: float
    turn: float
    swing: float
    looks: tuple[int, int]
    stop_s: float
    pitches: tuple[float, ...]
    faces_path: bool


CARRIERS = {
    "person": Carrier((1.44, 1.66), 0.42, 60.0, 30.0, (0, 3), 2.0, trajectory.PITCHES, False),
    "robot": Carrier((0.5, 0.9), 0.42, 45.0, 30.0, (0, 3), 4.5, (5.0,), True),
}


class _Knots(NamedTuple):
    """Places (K,) along the path at which a view is chosen: metres from the start, whether the camera moves there,
    direction of the path in degrees, metres of height, cruising speed from there in m/s."""

    arc: Float64Array
    moving: BoolArray
    heading: Float64Array
    height: Float64Array
    speed: Float64Array


def walk_home(
    mesh: SceneMesh, free: BoolArray, cell_m: float, origin: Float64Array, n_structure: int, n_frames: int,
    rng: np.random.Generator, carrier: Literal["person", "robot"],
) -> Float64Array:  # fmt: skip
    """Camera-to-world poses (n_frames, 4, 4) with OpenCV axes, z up: a round through all parts of the home.

    ``free`` (X, Y) are the cells where the camera may be, one connected region; cell (0, 0) has its corner at
    ``origin``. ``n_structure`` is the last object id of the bare home, which views need not show.
    """
    kind = CARRIERS[carrier]
    level = kind.height if not kind.faces_path else (float(rng.uniform(*kind.height)),) * 2
    field = _Field(free, cell_m, origin)
    duration = max(n_frames / FRAMES_PER_SECOND, SHORTEST_S)
    path, stops = _round_trip(field, kind, duration)
    knots = _place_knots(path, stops, kind, level, rng)
    yaw, pitch = _choose_views(mesh, path, knots, kind, n_structure)

    steps = np.diff(knots.arc) / knots.speed[:-1], np.hypot(np.diff(yaw), np.diff(pitch)) / kind.turn
    pause = np.where(knots.moving[:-1] | knots.moving[1:], 0.2, rng.uniform(0.6, 1.4, len(knots.arc) - 1))
    at = np.concatenate([[0.0], np.cumsum(np.maximum.reduce([*steps, pause]))])
    at *= duration / at[-1]
    time = np.linspace(0.0, duration, n_frames, endpoint=False, dtype=np.float64)
    values = knots.arc, knots.height, yaw, pitch, np.zeros(len(at))
    arc, height, *turn = (trajectory.smooth_through(at, value, time) for value in values)
    position = np.column_stack([trajectory.along_loop(path, arc / knots.arc[-1]), height])
    turned = np.column_stack(turn)
    if carrier == "person":
        moved, rotated = _shake(rng, time, np.gradient(arc, time) if n_frames > 1 else np.zeros(n_frames))
        position += moved * np.clip(field.clearance(position[:, :2]) / 0.045, 0, 1)[:, None]
        turned += rotated
    return trajectory.camera_poses(position, *turned.T)


def _shake(rng: np.random.Generator, time: Float64Array, speed: Float64Array) -> Pair:
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
        for hertz, phase in zip(rng.uniform(low, high, (3, 6)), rng.uniform(0, 2 * np.pi, (3, 6)), strict=True):
            total += share * size * np.sin(2 * np.pi * hertz * time[:, None] + phase)
    return total[:, :3], total[:, 3:]


class _Field:
    """The free cells, and distances in them."""

    def __init__(self, free: BoolArray, cell_m: float, origin: Float64Array) -> None:
        from scipy.ndimage import distance_transform_edt

        points = (np.moveaxis(np.indices(free.shape), 0, -1) + 0.5) * cell_m + origin
        self.free, self.cell_m, self.origin = free, cell_m, origin
        self.cells, self.points = np.argwhere(free), points[free]
        self._fine_m = cell_m / 4
        fine = np.pad(np.kron(free, np.ones((4, 4), bool)), 1)
        self._distance = np.asarray(distance_transform_edt(fine)) * self._fine_m

    def clearance(self, points: Float64Array) -> Float64Array:
        """Metres (N,) from points (N, 2) to the nearest cell that is not free, at least; 0 or less in such a cell."""
        from scipy.ndimage import map_coordinates

        at = (points - self.origin).T / self._fine_m + 0.5
        return np.asarray(map_coordinates(self._distance, at, order=1)) - 0.75 * self._fine_m


def _round_trip(field: _Field, kind: Carrier, duration: float) -> Pair:
    """A closed path (N, 2) through all parts of the home, and its stops in metres from its start."""
    from scipy.sparse.csgraph import dijkstra

    points, clear = field.points, field.clearance(field.points)
    cost = 1.0 + (clear < 0.15)
    weights = np.asarray(cost, np.float64), np.ones(len(points))
    graph, plain = (trajectory.grid_graph(field.free, field.cells, weight) for weight in weights)
    open_floor = np.where(clear > min(OPEN_M, 0.9 * clear.max()), 1.0, 1e-3)
    chosen = [int((((points - points.mean(axis=0)) ** 2).sum(axis=1) * open_floor).argmax())]
    found: list[tuple[Float64Array, NDArray[np.int32]]] = []  # from each chosen stop: distances, predecessors
    best, loop, first = np.inf, points[:1], [0]
    for _ in range(min(MAX_STOPS, len(points))):
        found.append(dijkstra(graph, directed=False, indices=chosen[-1], return_predecessors=True))
        distance = np.stack([cells for cells, _ in found])
        order = _tour(distance[:, chosen])
        legs = [trajectory.backtrack(found[a][1], chosen[a], chosen[b]) for a, b in pairwise([*order, 0])]
        way = [cell for leg in legs for cell in leg] or chosen[:1]
        lasts = ROUNDED * trajectory.closed_loop(points[way])[1][-1] / kind.speed + kind.stop_s * len(order)
        aside = dijkstra(plain, directed=False, indices=way, min_only=True).max() * field.cell_m
        mismatch = abs(lasts - duration) + 30.0 * max(0.0, aside - REACH_M)
        if len(order) > 1 and mismatch < best:
            best, loop, first = mismatch, points[way], [0, *np.cumsum([len(leg) for leg in legs])[:-1]]
        chosen.append(int((distance.min(axis=0) * open_floor).argmax()))
    along, path = trajectory.closed_loop(loop)[1], trajectory.even_loop(loop)
    at_stop = np.round(along[first] / along[-1] * len(path)).astype(int)
    path = _relaxed(path, field)
    arc = trajectory.closed_loop(path)[1]
    return path, np.append(arc[at_stop], arc[-1])


def _tour(distance: Float64Array) -> list[int]:
    """A short closed order of all places, by cheapest insertion."""
    order = [0]
    for place in range(1, len(distance)):
        extra = [distance[a, place] + distance[place, b] - distance[a, b] for a, b in pairwise([*order, 0])]
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
    path: Float64Array, stops: Float64Array, kind: Carrier, level: Range, rng: np.random.Generator
) -> _Knots:
    """Knots every ``KNOT_M`` between stops, and several at a stop, where the camera pans."""
    rows: list[tuple[float, bool, float, float]] = []
    length = stops[-1]
    for start, end in pairwise(stops):
        speed = kind.speed * float(rng.uniform(0.75, 1.25))
        n_looks = int(rng.integers(*kind.looks, endpoint=True))
        rows += [(start, False, start, speed)] * (n_looks if rows else kind.looks[1])
        between = np.linspace(start, end, max(2, int(np.ceil((end - start) / KNOT_M))) + 1)
        inner = min(0.1, (end - start) / 2)
        for arc in between if kind.faces_path else between[1:-1]:
            rows.append((float(arc), True, float(np.clip(arc, start + inner, end - inner)), speed))
    rows += [(length, False, length, kind.speed)] * kind.looks[1]
    arc, moving, aim, speeds = (np.array(column) for column in zip(*rows, strict=True))
    behind, ahead = (trajectory.along_loop(path, np.clip(aim + step, 0, length) / length) for step in (-0.1, 0.1))
    direction = ahead - behind
    heading = np.rad2deg(np.arctan2(direction[:, 1], direction[:, 0]))
    return _Knots(arc, moving, heading, trajectory.smooth_through(stops, rng.uniform(*level, len(stops)), arc), speeds)


def _choose_views(mesh: SceneMesh, path: Float64Array, knots: _Knots, kind: Carrier, n_structure: int) -> Pair:
    """Yaw and pitch (degrees, yaw unwrapped) at each knot, chosen to show every object repeatedly and well."""
    candidates = trajectory.candidate_views(kind.pitches)
    arcs, first, station = np.unique(knots.arc, return_index=True, return_inverse=True)
    stations = np.column_stack([trajectory.along_loop(path, arcs / arcs[-1]), knots.height[first]])
    shares, near = trajectory.visible_shares(mesh, stations, candidates, n_structure)
    turn = trajectory.turn_between(candidates[:, :1], candidates[:, 0])
    aside = trajectory.turn_between(candidates[:, 0], knots.heading[:, None])
    # A person looks around, but seldom backwards while walking.
    ahead = np.clip(1.5 - aside / 120.0, 0.2, 1.0) if not kind.faces_path else aside <= aside.min(axis=1)[:, None]
    prior = np.where(knots.moving[:, None], ahead, 1.0)
    last = len(station) - 1

    def weigh(knot: int, picked: NDArray[np.intp], score: Float64Array) -> Float64Array:
        score = np.maximum(score, 1e-3) * prior[knot]
        for other in (knot - 1, knot + 1):
            if 0 <= other <= last and picked[other] >= 0:
                tilt = candidates[:, 1] - candidates[picked[other], 1]
                score = score / (1.0 + (turn[:, picked[other]] ** 2 + tilt**2) / kind.swing**2)
        if knot in (0, last) and picked[last - knot] >= 0:
            score = np.where(turn[:, picked[last - knot]] < REVISIT_DEG, -1.0, score)
        return np.round(score, 9)  # the last bit may depend on the number of threads

    picked = trajectory.pick_views(shares[station], near[station], weigh)
    yaw = np.where(knots.moving & kind.faces_path, knots.heading, candidates[picked, 0])
    return np.rad2deg(np.unwrap(np.deg2rad(yaw))), candidates[picked, 1]
