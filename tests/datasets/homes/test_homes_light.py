"""Light and renderer of homes, in an empty box with a window, a screen and a mirror."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.procedural.items import Item, Light, Part, Placed
from su3d_bench.datasets.procedural.materials import Material, Texture
from su3d_bench.datasets.procedural.rendering.light import Sun, Window, lit_mesh
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh, gather_patches
from su3d_bench.datasets.procedural.rendering.render import Renderer
from su3d_bench.datasets.procedural.rendering.sampled import SampledRenderer
from su3d_bench.datasets.procedural.shapes import Shape, box

WHITE = Material(Texture.PLAIN, (0.7, 0.7, 0.7), (0.7, 0.7, 0.7), gloss=0.0)
RED = replace(WHITE, a=(0.6, 0.05, 0.05), b=(0.6, 0.05, 0.05))
SIZE = 64, 48
LAMP = Light((1.5, 1.5, 2.2), (1.0, 1.0, 1.0), 0.1)
SOUTH = Window((1.5, 0.0, 1.5), (0.5, 0.0, 0.0), (0.0, 0.0, 0.5), (0.5, 0.5, 0.5))
SUN = Sun((0.0, -0.8, 0.6), (8.0, 8.0, 8.0))


def _placed(*things: tuple[Shape, Material]) -> list[Placed]:
    return [
        Placed(k + 1, Item("thing", "white", "stone", "medium", (Part(*thing),), (), np.ones(3)), 0.0, np.zeros(3))
        for k, thing in enumerate(things)
    ]


def _mesh(*things: tuple[Shape, Material], sun: Sun | None = None, west: Material = WHITE) -> SceneMesh:
    """A room of 3 x 3 x 2.5 m with ids 1 to 6 for west, east, south, north, floor and ceiling, and ``things``."""
    room = box(0, 3, 0, 3, 0, 2.5)
    faces = [(Shape(room.quads[k : k + 1], -room.normals[k : k + 1]), west if k == 0 else WHITE) for k in range(6)]
    return lit_mesh(gather_patches(_placed(*faces, *things)), [LAMP], sun, [SOUTH], 0.6, 0.12)


def _view(position: tuple[float, float, float], yaw: float) -> Float64Array:
    """A level camera; it looks along +x, turned counter-clockwise by ``yaw`` degrees."""
    turn = np.deg2rad(yaw)
    pose = np.eye(4)
    pose[:3, 2] = np.cos(turn), np.sin(turn), 0
    pose[:3, 0] = np.sin(turn), -np.cos(turn), 0
    pose[:3, 1] = 0, 0, -1
    pose[:3, 3] = position
    return pose


def _light_at(mesh: SceneMesh, x: float, y: float, z: float) -> Float64Array:
    return np.asarray(mesh.light[np.linalg.norm(mesh.vertices - [x, y, z], axis=1).argmin()], np.float64)


@pytest.fixture(scope="module")
def furnished() -> SceneMesh:
    table = box(1.2, 1.8, 0.9, 1.5, 0.7, 0.75), replace(RED, texture=Texture.CHECKS, scale=0.1, gloss=0.5, wear=0.5)
    pane = box(0.8, 0.82, 1, 2, 0.5, 1.5), replace(WHITE, clear=0.8, gloss=0.9)
    return _mesh(table, pane)


def test_sun_shines_through_the_window_and_not_behind_a_screen() -> None:
    screen = box(1.5, 2.2, 0.5, 0.52, 0.0, 2.4), WHITE
    mesh = _mesh(screen, sun=SUN)
    lit, shaded, beside = (_light_at(mesh, x, 1.9, 0.0).mean() for x in (1.2, 1.8, 0.7))
    assert lit > 2.5 * max(shaded, beside)  # the ray from (1.2, 1.9, 0) crosses the window at a height of 1.4 m
    assert _light_at(mesh, 1.2, 2.8, 0.0).mean() < lit / 2.5  # and from y = 2.8 above its upper edge


def test_red_wall_reddens_a_white_one() -> None:
    for west, ratio in ((WHITE, 1.0), (RED, 1.08)):
        red, green, _ = _light_at(_mesh(west=west), 0.3, 3.0, 1.2)
        assert red / green == pytest.approx(1.0, abs=0.01) if ratio == 1.0 else red / green > ratio


def test_colour_of_an_edge_lies_between_its_sides() -> None:
    mesh = _mesh((box(2.0, 2.1, 1.0, 1.5, 0.0, 2.5), RED))
    image = SampledRenderer(mesh, *SIZE).render(_view((0.5, 1.53, 1.3), 0.0))
    row = image.rgb[24].astype(int)
    edge = int(np.flatnonzero(np.diff(image.instance[24] == 7))[0])
    sides, mixed = (row[edge - 2, 1], row[edge + 3, 1]), row[edge : edge + 2, 1]
    assert ((mixed > min(sides) + 3) & (mixed < max(sides) - 3)).any()


def test_depth_and_ids_are_those_of_the_plain_renderer(furnished: SceneMesh) -> None:
    pose = _view((2.8, 0.3, 1.4), 140.0)
    plain, sampled = Renderer(furnished, *SIZE).render(pose), SampledRenderer(furnished, *SIZE).render(pose)
    assert plain.depth_m.tobytes() == sampled.depth_m.tobytes()
    assert plain.instance.tobytes() == sampled.instance.tobytes()


def test_mirror_shows_what_the_mirrored_camera_sees() -> None:
    ball = box(1.5, 1.9, 1.2, 1.7, 1.0, 1.5), replace(RED, texture=Texture.CHECKS, b=(0.1, 0.1, 0.6), scale=0.2)
    mesh = _mesh(ball, west=replace(WHITE, a=(1, 1, 1), b=(1, 1, 1), mirror=1.0))
    image = SampledRenderer(mesh, *SIZE).render(_view((1.0, 2.4, 1.3), 210.0))
    mirrored = image.rgb.astype(int)
    kept = mesh.instance_of_triangle != 1  # the camera behind the mirror looks through it
    names = "triangles", "instance_of_triangle", "material_of_triangle"
    without = replace(mesh, **{name: getattr(mesh, name)[kept] for name in names})
    direct = SampledRenderer(without, *SIZE).render(_view((-1.0, 2.4, 1.3), -30.0)).rgb[:, ::-1].astype(int)
    glass = image.instance == 1
    assert glass.mean() > 0.3
    assert np.median(np.abs(mirrored - direct)[glass]) < 6
    assert np.ptp(mirrored[glass][:, 2]) > 60  # the box is in it


def test_threads_do_not_change_the_image(furnished: SceneMesh) -> None:
    first, second = (SampledRenderer(furnished, *SIZE, threads=n).render(_view((2.8, 0.3, 1.4), 140.0)) for n in (1, 4))
    assert first.rgb.tobytes() == second.rgb.tobytes()
