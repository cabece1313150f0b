"""Trajectories through homes: where the camera may go, how it moves, what it shows."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pytest

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.datasets.homes.statistics import motion, view_statistics
from su3d_bench.datasets.homes.walk import walk_home
from su3d_bench.datasets.procedural.items import Box
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh, caster
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.numerics.open3d_core import compiled_open3d

CELL_M, ORIGIN = 0.1, np.array([-1.0, 0.5])
HEIGHT_M = 2.5
Name = Literal["two rooms", "L"]
Carrier = Literal["person", "robot"]


class Home(NamedTuple):
    mesh: SceneMesh
    free: BoolArray

    n_structure: int


def _box(x0: float, y0: float, z0: float, x1: float, y1: float, z1: float) -> Box:
    shift = np.append(ORIGIN, 0.0)
    return Box(np.array([x0, y0, z0]) + shift, np.array([x1, y1, z1]) + shift)


@cache
def _home(name: Name, carrier: Carrier) -> Home:
    """Solid walls and a row of objects; two rooms of 4 x 4 m joined by a door of 0.8 m, or an L of 7 x 5 m."""
    if name == "two rooms":
        width, depth = 8.2, 4.0
        inner = [_box(4.0, 0.0, 0.0, 4.2, 1.2, HEIGHT_M), _box(4.0, 2.0, 0.0, 4.2, 4.0, HEIGHT_M)]
    else:
        width, depth = 7.0, 5.0
        inner = [_box(3.0, 2.4, 0.0, 7.0, 5.0, HEIGHT_M)]
    shell = [_box(0, 0, -0.1, width, depth, 0), _box(0, 0, HEIGHT_M, width, depth, HEIGHT_M + 0.1),
             _box(-0.1, 0, 0, 0, depth, HEIGHT_M), _box(width, 0, 0, width + 0.1, depth, HEIGHT_M),
             _box(0, -0.1, 0, width, 0, HEIGHT_M), _box(0, depth, 0, width, depth + 0.1, HEIGHT_M)]  # fmt: skip
    things = [_box(x, y, 0.0, x + 0.3, y + 0.3, z) for x, z in ((0.3, 0.5), (1.6, 1.7), (2.5, 0.8)) for y in (0.1, 1.9)]
    things += [_box(width - 0.5 - k, 0.1, 0.0, width - 0.2 - k, 0.4, 0.6 + 0.2 * k) for k in range(3)]
    solids = [*shell, *inner, *things]
    shape = round(width / CELL_M), round(depth / CELL_M)
    points = (np.moveaxis(np.indices(shape), 0, -1) + 0.5) * CELL_M + ORIGIN
    free = np.ones(shape, bool)
    for solid in [
        *shell[2:],
        *inner,
        *(thing for thing in things if thing.high[2] > (0.9 if carrier == "person" else 0.2)),
    ]:
        free &= ~((points > solid.low[:2] - 0.3) & (points < solid.high[:2] + 0.3)).all(axis=-1)
    return Home(_mesh(solids), free, len(shell) + len(inner))


def _mesh(solids: list[Box]) -> SceneMesh:
    """Boxes as triangles, ids from 1; without anything to shade."""
    corner = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)])
    quads = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    faces = np.array([[q[a] for a in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))])
    vertices = np.concatenate([solid.low + corner * (solid.high - solid.low) for solid in solids]).astype(np.float32)
    triangles = np.concatenate([faces + 8 * k for k in range(len(solids))]).astype(np.int32)
    ids = np.repeat(np.arange(1, len(solids) + 1, dtype=np.int32), len(faces))
    nothing = np.zeros((len(vertices), 3), np.float32)
    rows = np.zeros(len(triangles), np.int32)
    return SceneMesh(vertices, nothing, nothing, nothing, triangles, ids, rows, nothing[:1], nothing[:1])


@cache
def _walk(name: Name, carrier: Carrier, n_frames: int = 1600, seed: int = 0) -> Float64Array:
    home, rng = _home(name, carrier), np.random.default_rng(seed)
    return walk_home(home.mesh, home.free, CELL_M, ORIGIN, home.n_structure, n_frames, rng, carrier)


def _yaw(poses: Float64Array) -> Float64Array:
    return np.rad2deg(np.arctan2(poses[:, 1, 2], poses[:, 0, 2]))


@pytest.mark.parametrize("carrier", ["person", "robot"])
@pytest.mark.parametrize("name", ["two rooms", "L"])
def test_camera_stays_in_free_cells_and_away_from_surfaces(name: Name, carrier: Carrier) -> None:
    home, poses = _home(name, carrier), _walk(name, carrier)
    cell = np.floor((poses[:, :2, 3] - ORIGIN) / CELL_M).astype(int)
    assert home.free[cell[:, 0], cell[:, 1]].all()
    points = compiled_open3d().core.Tensor(poses[:, :3, 3].astype(np.float32))
    distance = caster(home.mesh.vertices, home.mesh.triangles).compute_distance(points)  # type: ignore[attr-defined]
    assert distance.numpy().min() > 0.2


@pytest.mark.parametrize("carrier", ["person", "robot"])
@pytest.mark.parametrize("n_frames", [40, 1600])
def test_camera_passes_the_door_and_comes_back(carrier: Carrier, n_frames: int) -> None:
    beyond = _walk("two rooms", carrier, n_frames)[:, 0, 3] > ORIGIN[0] + 4.2
    assert 0.2 < beyond.mean() < 0.8
    assert (np.diff(beyond.astype(int)) != 0).sum() >= 2


@pytest.mark.parametrize("name", ["two rooms", "L"])
def test_all_parts_of_the_home_are_reached(name: Name) -> None:
    home, poses = _home(name, "person"), _walk(name, "person")
    points = (np.argwhere(home.free) + 0.5) * CELL_M + ORIGIN
    distance = np.linalg.norm(points[:, None] - poses[None, ::20, :2, 3], axis=2).min(axis=1)
    assert distance.max() < 2.5 + CELL_M


def test_person_and_robot_hold_the_camera_differently() -> None:
    person, robot = _walk("L", "person"), _walk("L", "robot")
    assert 1.4 <= person[:, 2, 3].min() < person[:, 2, 3].max() <= 1.7
    assert np.median(person[:, 2, 2]) < -0.1  # looks slightly down
    assert 0.5 <= robot[0, 2, 3] <= 0.9
    assert np.ptp(robot[:, 2, 3]) == 0
    assert np.abs(robot[:, 2, 0]).max() < 1e-12  # no roll
    assert np.abs(person[:, 2, 0]).max() > 0.01
    jerk = [np.abs(np.diff(poses[:, :3, 3], 3, axis=0)).mean() for poses in (person, robot)]
    assert jerk[0] > 2 * jerk[1]
    for poses in (person, robot):
        turn = poses[:, :3, :3]
        np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turn.shape), atol=1e-12)
        assert (turn[:, 2, 1] < 0).all()  # the image is upright: its y axis points down


@pytest.mark.parametrize("carrier", ["person", "robot"])
def test_camera_stops_to_look_around_and_comes_back_to_look_elsewhere(carrier: Carrier) -> None:
    poses = _walk("two rooms", carrier)
    place, yaw = poses[:, :2, 3], _yaw(poses)
    slow = np.linalg.norm(place[15:] - place[:-15], axis=1) < 0.04  # in half a second
    assert 0.05 < slow.mean() < 0.7
    assert np.abs(np.diff(np.unwrap(yaw, period=360)))[: len(slow)][slow].sum() > 45
    some, turns = place[::10], yaw[::10]
    apart = np.linalg.norm(some[:, None] - some[None], axis=2)
    later = np.subtract.outer(np.arange(len(some)), np.arange(len(some))) >= 30  # 10 seconds
    other = np.abs((np.subtract.outer(turns, turns) + 180) % 360 - 180) >= 45
    assert ((apart < 0.3) & later & other).any()


@pytest.mark.parametrize("carrier", ["person", "robot"])
def test_updates_move_as_far_as_those_of_real_trajectories(carrier: Carrier) -> None:
    translation_m, rotation_deg = motion(_walk("two rooms", carrier)[::40])
    assert 0.25 < np.median(translation_m) < 0.6
    assert 8 < np.median(rotation_deg) < 40


def test_same_random_numbers_give_the_same_bytes() -> None:
    home, again = _home("L", "person"), np.random.default_rng(0)
    poses = walk_home(home.mesh, home.free, CELL_M, ORIGIN, home.n_structure, 1600, again, "person")
    assert poses.tobytes() == _walk("L", "person").tobytes()
    assert poses.tobytes() != _walk("L", "person", seed=1).tobytes()


@pytest.mark.parametrize("n_frames", [1, 8, 80])
@pytest.mark.parametrize("carrier", ["person", "robot"])
def test_few_frames_show_the_same_home_in_longer_steps(carrier: Carrier, n_frames: int) -> None:
    poses = _walk("L", carrier, n_frames)
    assert poses.shape == (n_frames, 4, 4)
    assert np.isfinite(poses).all()
    if n_frames > 1:
        assert np.ptp(poses[:, 0, 3]) > 2.0


def test_statistics_count_what_the_views_of_a_room_show() -> None:
    rooms = Rooms(Path("/nowhere"), Rooms.Options(n_frames=80, width=320, height=240))
    known = view_statistics(rooms, "bathroom7", 8)
    assert (known["frames"], known["updates"]) == (80, 10)
    mount = rooms.built("bathroom7").mount
    assert known["instances"] == sum(how != "room" for how in mount.values())
    assert 0 < known["instances_per_view"] < known["instances"]
    assert 3 <= known["updates_per_instance"] <= 10
    metres, degrees = motion(rooms.trajectory("bathroom7")[::8])
    assert known["translation_cm"] == pytest.approx(100 * np.median(metres))
    assert known["rotation_deg"] == pytest.approx(np.median(degrees))
