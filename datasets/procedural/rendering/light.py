"""Light of a home, baked at the vertices: sun through windows, sky light, lamps, and what surfaces reflect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int64Array
from su3d_bench.datasets.procedural.items import Light
from su3d_bench.datasets.procedural.rendering.mesh import (
    _DISC,
    Grid,
    Patches,
    SceneMesh,
    _blocked,
    _fill_buried,
    _open_sky,
    at_rows,
    caster,
    cut,
    merge_equal,
)
from su3d_bench.numerics.open3d_core import compiled_open3d

SUNNY_SPACING_M = 0.014  # in sunlit cells: the edge of a patch of sunlight is one pixel wide at 5 m in 640 columns
SUN_BLUR = 0.009  # tangent of the half-width of the penumbra: the sun has 0.0047, the rest hides the cells
PANE_GAP_M = 0.03  # rays to a window end this far before its plane: the pane does not shade
SEE_THROUGH = 0.3  # parts that let this much light pass, or emit this much, cast no shadow
NEAREST_LAMP_M2 = 0.3  # squared distance added to that of a lamp, which is no point
BOUNCE_SPACING_M = 0.1  # between points at which reflected light is gathered: it varies slowly
N_BOUNCE, N_GATHERS, N_NEIGHBOURS = 24, 3, 8  # rays per point; bounces; points averaged (so 192 rays)
SUN_PIECE_M = 0.4  # a patch of sunlight is replaced by lamps this far apart
AMBIENT = 0.03  # of the mean light, for what three bounces miss
NARROW = 0.55  # of reflected light reaches a crevice, which is smaller than the spacing of the points
GOLDEN = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Sun:
    """``direction`` unit vector towards the sun; ``colour`` linear RGB times power."""

    direction: tuple[float, float, float]
    colour: tuple[float, float, float]


@dataclass(frozen=True)
class Window:
    """A rectangle in the plane of a wall: half edges ``u`` and ``v`` in m, ``sky`` linear RGB times power."""

    centre: tuple[float, float, float]
    u: tuple[float, float, float]
    v: tuple[float, float, float]
    sky: tuple[float, float, float]

    def points(self) -> Float64Array:
        """Six points (6, 3) that stand for its area; none on a bar in the middle."""
        at = np.array([(a, b) for a in (-0.5, 0.5) for b in (-0.67, 0.05, 0.67)])
        return np.asarray(self.centre + at @ np.array([self.u, self.v]))


def lit_mesh(
    patches: Patches, lights: Sequence[Light], sun: Sun | None, windows: Sequence[Window], exposure: float,
    spacing_m: float = 0.06,
) -> SceneMesh:  # fmt: skip
    """The render mesh of a home; light is scaled so that its 70th percentile is ``exposure``."""
    grid = cut(patches, spacing_m)
    points, normals = at_rows(patches.corners, grid.rows), _unit(at_rows(patches.normals, grid.rows))
    quad = grid.rows[:, 0].astype(np.int64)
    keys = np.concatenate([np.round(points * 2000), np.round(normals * 20), patches.object_id[quad, None]], axis=1)
    first, group = merge_equal(keys.astype(np.int64))
    triangles, owner = _triangles(grid, points)
    passes = np.maximum(patches.materials[:, 9], patches.materials[:, 17]) > SEE_THROUGH
    solid = ~passes[patches.material[owner]]
    scene: Any = caster(points.astype(np.float32), triangles[solid])
    where, facing = points[first], normals[first]
    start = _off_surface(where, facing, patches.corners[quad[first]].mean(axis=1))
    sunlight = _sunlight(scene, start, facing, sun, windows)
    direct = _lamplight(scene, start, facing, lights) + _skylight(scene, start, facing, windows)
    buried = _is_buried(scene, start, facing, points, triangles[solid])
    reflected = _reflected(
        scene, start, facing, direct, sunlight, buried, patches.object_id[quad[first]],
        group[triangles[solid]], _mean_albedo(patches)[patches.material[owner[solid]]], points, triangles[solid],
    )  # fmt: skip
    soft = _fill_buried(direct + reflected, buried, group[triangles])
    scale = exposure / np.percentile((soft + sunlight)[~buried].mean(axis=1), 70)
    sunny = (sunlight.max(axis=1) > 0)[group][grid.faces].any(axis=1)
    cells = cut(replace(patches, corners=points[grid.faces[sunny]]), SUNNY_SPACING_M)  # sunlit faces, cut again
    quads_of_cells = grid.quad_of_face[sunny][cells.rows[:, 0].astype(np.int64)]
    added = at_rows(grid.rows[grid.faces[sunny]], cells.rows)
    added[:, 0] = quads_of_cells  # exactly
    near = at_rows(patches.corners, added), _unit(at_rows(patches.normals, added))
    start = _off_surface(*near, patches.corners[quads_of_cells].mean(axis=1))
    sharp = at_rows(soft[group][grid.faces[sunny]], cells.rows) + _sunlight(scene, start, near[1], sun, windows)
    merged = Grid(
        np.concatenate([grid.rows, added]),
        np.concatenate([grid.faces[~sunny], cells.faces + np.int32(len(points))]),
        np.concatenate([grid.quad_of_face[~sunny], grid.quad_of_face[sunny][cells.quad_of_face]]),
    )
    points, normals = np.concatenate([points, near[0]]), np.concatenate([normals, near[1]])
    triangles, owner = _triangles(merged, points)
    light = np.concatenate([(soft + sunlight)[group], sharp]) * scale
    sources = [[*lamp.position, min(1.5, max(lamp.colour) * scale)] for lamp in lights]
    sources += [[*point, min(1.5, max(window.sky) * scale) / 3] for window in windows for point in window.points()]
    return SceneMesh(
        points.astype(np.float32), normals.astype(np.float32), at_rows(patches.texture, merged.rows).astype(np.float32),
        light.astype(np.float32), triangles.astype(np.int32), patches.object_id[owner],
        patches.material[owner], patches.materials, np.array(sources, np.float32).reshape(-1, 4),
    )  # fmt: skip


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))


def _triangles(grid: Grid, points: Float64Array) -> tuple[Any, Any]:
    """Two triangles (T, 3) of each face that are not empty, and their quads (T,)."""
    triangles = np.concatenate([grid.faces[:, [0, 1, 2]], grid.faces[:, [0, 2, 3]]])
    quad = np.concatenate([grid.quad_of_face, grid.quad_of_face])
    solid = np.linalg.norm(_crossed(points, triangles), axis=1) > 1e-10
    return triangles[solid], quad[solid]


def _crossed(points: Float64Array, triangles: Any) -> Float64Array:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def _off_surface(where: Float64Array, facing: Float64Array, middle: Float64Array) -> Float64Array:
    """Starts of rays: above the surface, and away from the edges of its quad."""
    inward = middle - where
    far = np.linalg.norm(inward, axis=1, keepdims=True)
    return np.asarray(where + facing * 0.004 + inward * np.minimum(0.1, 0.015 / np.maximum(far, 1e-9)))


def _sunlight(
    scene: Any, start: Float64Array, facing: Float64Array, sun: Sun | None, windows: Sequence[Window]
) -> Float64Array:
    """Sunlight (V, 3): where rays towards the sun cross a window and nothing blocks them before it."""
    share = np.zeros(len(start))
    if sun is None:
        return np.zeros((len(start), 3))
    towards = np.array(sun.direction)
    side = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
    side, over = side / np.linalg.norm(side), np.cross(towards, side / np.linalg.norm(side))
    for turn in 2 * np.pi * np.arange(5) / 5:
        ray = towards + SUN_BLUR * (np.cos(turn) * side + np.sin(turn) * over)
        cosine = facing @ ray
        for window in windows:
            centre, u, v = (np.array(value) for value in (window.centre, window.u, window.v))
            plane = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
            steep = float(ray @ plane)
            if abs(steep) < 0.02:
                continue
            far = (centre - start) @ plane / steep
            across = start + far[:, None] * ray - centre
            inside = (np.abs(across @ u) < u @ u) & (np.abs(across @ v) < v @ v)
            lit = np.flatnonzero(inside & (far > 0) & (cosine > 0))
            reach = np.maximum(far[lit] - PANE_GAP_M / abs(steep), 0.0)
            free = ~_blocked(scene, _rays(start[lit], ray * reach[:, None]), 1.0)
            share[lit] += np.where(free, cosine[lit], 0.0) / 5
    return share[:, None] * np.array(sun.colour)


def _rays(start: Float64Array, along: Float64Array) -> Float32Array:
    return np.concatenate([start, along], axis=1).astype(np.float32)


def _skylight(scene: Any, start: Float64Array, facing: Float64Array, windows: Sequence[Window]) -> Float64Array:
    total = np.zeros((len(start), 3))
    for window in windows:
        plane = np.cross(window.u, window.v)
        area = 4 * float(np.linalg.norm(plane)) / 6
        plane /= np.linalg.norm(plane)
        for point in window.points():
            away = point - start
            height = np.abs(away @ plane)
            square = (away**2).sum(axis=1)
            form = area * (facing * away).sum(axis=1) * height / (square * (np.pi * square + area))
            lit = np.flatnonzero(form > 2e-4)
            before = np.maximum(1 - PANE_GAP_M / np.maximum(height[lit], 1e-6), 0.0)
            free = ~_blocked(scene, _rays(start[lit], away[lit] * before[:, None]), 1.0)
            total[lit[free]] += form[lit[free], None] * np.array(window.sky)
    return total


def _lamplight(scene: Any, start: Float64Array, facing: Float64Array, lights: Sequence[Light]) -> Float64Array:
    total = np.zeros((len(start), 3))
    for light in lights:
        for offset in _DISC:
            away = np.array(light.position) + light.radius * offset - start
            square = (away**2).sum(axis=1)
            received = (facing * away).sum(axis=1) / (np.sqrt(square) * (square + NEAREST_LAMP_M2) * len(_DISC))
            lit = np.flatnonzero(received > 2e-3)
            free = ~_blocked(scene, _rays(start[lit], away[lit]), 0.985)
            total[lit[free]] += received[lit[free], None] * np.array(light.colour)
    return total


def _first_hits(scene: Any, rays: Float32Array) -> Int64Array:
    """The triangle that each ray hits, or -1."""
    hit = scene.cast_rays(compiled_open3d().core.Tensor(rays))["primitive_ids"].numpy()
    return np.where(hit == np.uint32(0xFFFFFFFF), -1, hit.astype(np.int64))


def _is_buried(
    scene: Any, start: Float64Array, facing: Float64Array, points: Float64Array, triangles: Any
) -> BoolArray:
    """Whether a point lies inside a solid: what lies straight ahead is seen from behind."""
    hit = _first_hits(scene, _rays(start, facing))
    return np.asarray((hit >= 0) & ((_crossed(points, triangles)[hit] * facing).sum(axis=1) > 0))


def _mean_albedo(patches: Patches) -> Float64Array:
    return 0.65 * patches.materials[:, 1:4].astype(np.float64) + 0.35 * patches.materials[:, 4:7]


def _reflected(
    scene: Any, start: Float64Array, facing: Float64Array, direct: Float64Array, sunlight: Float64Array,
    buried: BoolArray, owner: Any, corners: Any, albedo: Float64Array, points: Float64Array, triangles: Any,
) -> Float64Array:  # fmt: skip
    """Light (V, 3) that arrives from other surfaces, gathered at some of the points and averaged around each.

    ``corners`` are the rows of ``direct`` at the corners of ``triangles``, which have a mean ``albedo`` each. Patches
    of sunlight are too small and bright for so few rays: their light is that of lamps on them.
    """
    keys = np.column_stack([np.round(start / BOUNCE_SPACING_M), np.round(facing * 1.5), owner]).astype(np.int64)
    open_points = np.flatnonzero(~buried)
    chosen = open_points[merge_equal(keys[open_points])[0]]
    out = facing[chosen]
    side = np.cross(out, np.where(np.abs(out[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
    side = _unit(side)
    over, k = np.cross(out, side), np.arange(N_BOUNCE)
    turn = GOLDEN * (k + np.arange(len(chosen))[:, None] * 0.37)  # every point has the set of directions in a turn
    sine = np.sqrt((k + 0.5) / N_BOUNCE)[None, :, None]
    around = side[:, None] * np.cos(turn)[..., None] + over[:, None] * np.sin(turn)[..., None]
    along = (out[:, None] * np.sqrt(1 - sine**2) + sine * around).reshape(-1, 3)
    hit = _first_hits(scene, _rays(np.repeat(start[chosen], N_BOUNCE, axis=0), along))
    crossed = _crossed(points, triangles)
    seen = (hit >= 0) & ((crossed[hit] * along).sum(axis=1) < 0)
    from_sun = np.zeros((len(chosen), 3))
    for at, normal, area, power in _sunlit_patches(points, triangles, crossed, albedo * sunlight[corners].mean(axis=1)):
        away = at + 0.01 * normal - start[chosen]
        square = (away**2).sum(axis=1)
        form = np.maximum(-away @ normal, 0.0) * (out * away).sum(axis=1) / (square * (np.pi * square + area))
        lit = np.flatnonzero(form * power.max() > 1e-3)
        free = ~_blocked(scene, _rays(start[chosen[lit]], away[lit]), 0.99)
        from_sun[lit[free]] += form[lit[free], None] * power
    tree = cKDTree(np.column_stack([start[chosen], 0.5 * out]))
    far, near = tree.query(np.column_stack([start, 0.5 * facing]), min(N_NEIGHBOURS, len(chosen)), workers=-1)
    weight = 1.0 / (far.reshape(len(start), -1) ** 2 + BOUNCE_SPACING_M**2)
    weight /= weight.sum(axis=1, keepdims=True)
    received = np.zeros_like(direct)
    for _ in range(N_GATHERS):
        sent = albedo * (direct + received)[corners].mean(axis=1)
        gathered = from_sun + np.where(seen[:, None], sent[hit], 0.0).reshape(-1, N_BOUNCE, 3).mean(axis=1)
        received = np.einsum("vk,vkc->vc", weight, gathered[near.reshape(len(start), -1)])
        received += AMBIENT * direct[chosen].mean(axis=0)
    return received * (NARROW + (1 - NARROW) * _open_sky(scene, start, facing)[:, None])


def _sunlit_patches(
    points: Float64Array, triangles: Any, crossed: Float64Array, sent: Float64Array
) -> list[tuple[Float64Array, Float64Array, float, Float64Array]]:
    """Centre, normal, area and power of the surface that sends sunlight on, in pieces of ``SUN_PIECE_M``."""
    lit = np.flatnonzero(sent.max(axis=1) > 0)
    area = np.linalg.norm(crossed[lit], axis=1) / 2
    normal, centre = crossed[lit] / (2 * area[:, None]), points[triangles[lit]].mean(axis=1)
    keys = np.column_stack([np.round(centre / SUN_PIECE_M), np.round(normal)]).astype(np.int64)
    first, group = merge_equal(keys)
    values = np.column_stack([area, centre * area[:, None], normal * area[:, None], sent[lit] * area[:, None]])
    sums = np.column_stack([np.bincount(group, value, len(first)) for value in values.T])
    centres, normals = sums[:, 1:4] / sums[:, :1], _unit(sums[:, 4:7])
    return list(zip(centres, normals, sums[:, 0].tolist(), sums[:, 7:], strict=True))
