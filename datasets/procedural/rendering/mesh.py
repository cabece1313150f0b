"""The geometry of a room: placed objects as one triangle mesh with texture coordinates and baked light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import Float32Array, Float64Array, Int32Array
from su3d_bench.datasets.procedural.items import Light, Placed
from su3d_bench.datasets.procedural.materials import Material
from su3d_bench.datasets.procedural.shapes import Shape, rotation
from su3d_bench.numerics.open3d_core import compiled_open3d

LIGHT_SPACING_M = 0.13  # between the points at which light is computed
AMBIENT = 0.42
OCCLUSION_REACH_M = 0.8


@dataclass(frozen=True)
class Patches:
    """Every quad of a room: corners, normals and texture coordinates (Q, 4, 3), object and material rows (Q,)."""

    corners: Float64Array
    normals: Float64Array
    texture: Float64Array
    object_id: Int32Array
    material: Int32Array
    materials: Float32Array


@dataclass(frozen=True)
class SceneMesh:
    """Input of ray casting and shading; all per vertex except the three arrays of triangles."""

    vertices: Float32Array
    normals: Float32Array
    texture: Float32Array
    light: Float32Array
    triangles: Int32Array
    instance_of_triangle: Int32Array
    material_of_triangle: Int32Array
    materials: Float32Array
    lights: Float32Array


def gather_patches(placed: Sequence[Placed]) -> Patches:
    """All parts in world coordinates; textures stay in object coordinates."""
    corners, normals, texture, ids, rows = [], [], [], [], []
    materials: list[Material] = []
    for piece in placed:
        turn = rotation("z", piece.yaw).T
        for part in piece.item.parts:
            shape = _wound(part.shape)
            corners.append(shape.quads @ turn + piece.position)
            normals.append(shape.normals @ turn)
            texture.append(shape.quads)
            ids.append(np.full(len(part.shape.quads), piece.id, np.int32))
            rows.append(np.full(len(part.shape.quads), len(materials), np.int32))
            materials.append(part.material)
    return Patches(
        np.concatenate(corners),
        np.concatenate(normals),
        np.concatenate(texture),
        np.concatenate(ids),
        np.concatenate(rows),
        np.stack([material.row() for material in materials]),
    )


def _wound(shape: Shape) -> Shape:
    """The shape with the corners of every quad counter-clockwise seen from outside."""
    quads = shape.quads
    crossed = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    inside_out = (crossed * shape.normals.mean(axis=1)).sum(axis=1) < 0
    order = np.where(inside_out[:, None], np.array([0, 3, 2, 1]), np.array([0, 1, 2, 3]))[..., None]
    return Shape(np.take_along_axis(quads, order, 1), np.take_along_axis(shape.normals, order, 1))


@dataclass(frozen=True)
class Grid:
    """Patches cut into cells: ``rows`` (V, 3) of quad, u, v; ``faces`` (F, 4) of vertex indices; owner of each face."""

    rows: Float64Array
    faces: Int32Array
    quad_of_face: Int32Array


def cut(patches: Patches, longest_m: float) -> Grid:
    """Each quad as a grid of cells with edges no longer than ``longest_m``."""
    n_u = _n_cells(patches.corners, ((0, 1), (3, 2)), longest_m)
    n_v = _n_cells(patches.corners, ((0, 3), (1, 2)), longest_m)
    n_points, n_faces = (n_u + 1) * (n_v + 1), n_u * n_v
    quad, at = _places(n_points)
    rows = np.column_stack([quad, at // (n_v + 1)[quad] / n_u[quad], at % (n_v + 1)[quad] / n_v[quad]])
    quad, at = _places(n_faces)
    step = n_v[quad] + 1
    base = (np.cumsum(n_points) - n_points)[quad] + at // n_v[quad] * step + at % n_v[quad]
    faces = np.stack([base, base + step, base + step + 1, base + 1], axis=1).astype(np.int32)
    return Grid(rows, faces, quad.astype(np.int32))


def _n_cells(quads: Float64Array, edges: Sequence[tuple[int, int]], longest_m: float) -> NDArray[np.int64]:
    """Number of cells (Q,) along the longer of two opposite edges, given by their corners."""
    steps = [(quads[:, start] - quads[:, end]) ** 2 for start, end in edges]
    longest = np.max([step[:, 0] + step[:, 1] + step[:, 2] for step in steps], axis=0)
    return np.asarray(np.maximum(1, np.ceil(np.sqrt(longest) / longest_m - 1e-6)), np.int64)


def _places(counts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The group of each element, for groups of ``counts`` elements, and its position in the group."""
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - (np.cumsum(counts) - counts)[group]


def at_rows(values: Float64Array, rows: Float64Array) -> Float64Array:
    """Values at (quad, u, v) rows, interpolated from the quads' four corners."""
    quad, u, v = rows[:, 0].astype(np.int64), rows[:, 1:2], rows[:, 2:]
    near = values[quad, 0] * (1 - u) + values[quad, 1] * u
    far = values[quad, 3] * (1 - u) + values[quad, 2] * u
    return np.asarray(near * (1 - v) + far * v)


def merge_equal(keys: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Index of the first of each group of equal rows, and the group of every row."""
    primes = np.array([73856093, 19349663, 83492791, 2654435761, 40503, 97531, 1000003][: keys.shape[1]], np.int64)
    with np.errstate(over="ignore"):
        mixed = (keys * primes).sum(axis=1) * np.int64(-7046029254386353131)
        mixed ^= (keys * primes[::-1]).sum(axis=1) << np.int64(17)
    _, first, group = np.unique(mixed, return_index=True, return_inverse=True)
    return first, group.reshape(-1)


def build_mesh(patches: Patches, lights: Sequence[Light], exposure: float) -> SceneMesh:
    """The render mesh, with light computed by ray casting against itself."""
    grid = cut(patches, LIGHT_SPACING_M)
    points = at_rows(patches.corners, grid.rows)
    normals = at_rows(patches.normals, grid.rows)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    texture = at_rows(patches.texture, grid.rows)
    triangles, quad = triangles_of(grid, points)
    light = _bake(grid, patches, points, normals, triangles, lights, exposure)
    sources = np.array([[*source.position, max(source.colour)] for source in lights], np.float32)
    return SceneMesh(
        points.astype(np.float32), normals.astype(np.float32), texture.astype(np.float32), light,
        triangles.astype(np.int32), patches.object_id[quad], patches.material[quad], patches.materials, sources,
    )  # fmt: skip


def unlit_mesh(patches: Patches) -> SceneMesh:
    """The surface alone, in the dark: for depth, objects and trajectories, which need not wait for the light."""
    grid = cut(patches, np.inf)
    points = at_rows(patches.corners, grid.rows)
    normals, texture = at_rows(patches.normals, grid.rows), at_rows(patches.texture, grid.rows)
    triangles, quad = triangles_of(grid, points)
    dark = np.zeros((len(points), 3), np.float32)
    return SceneMesh(
        points.astype(np.float32), normals.astype(np.float32), texture.astype(np.float32), dark,
        triangles.astype(np.int32), patches.object_id[quad], patches.material[quad], patches.materials,
        np.zeros((0, 4), np.float32),
    )  # fmt: skip


def triangles_of(grid: Grid, points: Float64Array) -> tuple[Int32Array, Int32Array]:
    """Two triangles (T, 3) of each face, unless they are empty, and their quads (T,)."""
    faces = grid.faces.astype(np.int32)
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    quad = np.concatenate([grid.quad_of_face, grid.quad_of_face])
    a, b, c = (points[triangles[:, k]] for k in range(3))
    solid = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-10
    return triangles[solid], quad[solid]


def caster(vertices: Float32Array, triangles: Int32Array) -> object:
    """An Open3D ray-casting scene of one mesh; ``primitive_ids`` are rows of ``triangles``."""
    o3d = compiled_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(vertices)),
        o3d.core.Tensor(np.ascontiguousarray(triangles.astype(np.uint32))),
    )
    return scene


def _bake(
    grid: Grid, patches: Patches, points: Float64Array, normals: Float64Array, triangles: Int32Array,
    lights: Sequence[Light], exposure: float,
) -> Float32Array:  # fmt: skip
    """Light (V, 3) at every vertex: soft shadows of the lights, and a sky whose visibility is sampled nearby."""
    quad = grid.rows[:, 0].astype(np.int64)
    keys = np.concatenate([np.round(points * 2000), np.round(normals * 20), patches.object_id[quad, None]], axis=1)
    first, group = merge_equal(keys.astype(np.int64))
    where, facing = points[first], normals[first]
    scene = caster(points.astype(np.float32), triangles)
    start = off_surface(where, facing, patches.corners[quad[first]].mean(axis=1))
    total = np.zeros((len(first), 3))
    for source in lights:
        total += _direct(scene, start, facing, source)[:, None] * np.array(source.colour)
    share = open_sky(scene, start, facing)
    up = 0.86 + 0.14 * facing[:, 2:]
    total += AMBIENT * (0.4 + 0.6 * share[:, None]) * up * np.array([1.0, 0.985, 0.96])
    total = fill_buried(total, share == 0, group[triangles])
    total *= exposure / np.percentile(total.mean(axis=1), 70)
    return total[group].astype(np.float32)


def off_surface(where: Float64Array, facing: Float64Array, middle: Float64Array) -> Float64Array:
    """Starts of rays: above the surface, and away from the edges of a quad with this ``middle``."""
    inward = middle - where
    far = np.linalg.norm(inward, axis=1, keepdims=True)
    return np.asarray(where + facing * 0.004 + inward * np.minimum(0.1, 0.015 / np.maximum(far, 1e-9)))


def fill_buried(light: Float64Array, buried: NDArray[np.bool_], triangles: NDArray[np.intp]) -> Float64Array:
    """Light of vertices inside another solid, taken from their neighbours, so that darkness does not bleed out."""
    turned = triangles[:, [1, 2, 0]]
    tail, head = np.concatenate([triangles, turned]).ravel(), np.concatenate([turned, triangles]).ravel()
    filled, unknown = light.copy(), buried.copy()
    for _ in range(10):
        use = unknown[tail] & ~unknown[head]
        count = np.bincount(tail[use], minlength=len(light))
        reached = count > 0
        for k in range(3):
            value = np.bincount(tail[use], weights=filled[head[use], k], minlength=len(light))
            filled[reached, k] = value[reached] / count[reached]
        unknown &= ~reached
    return filled


DISC = np.array([[0.0, 0.0, 0.0], [0.8, 0.3, -0.5], [-0.7, 0.5, 0.4], [0.1, -0.85, 0.5], [-0.2, 0.4, -0.85]])


def _direct(scene: object, start: Float64Array, facing: Float64Array, light: Light) -> Float64Array:
    received = np.zeros(len(start))
    for offset in DISC:
        away = np.array(light.position) + light.radius * offset - start
        distance = np.linalg.norm(away, axis=1)
        cosine = (facing * away).sum(axis=1) / distance
        lit = np.flatnonzero(cosine > 0.01)
        if not len(lit):
            continue
        rays = np.concatenate([start[lit], away[lit]], axis=1).astype(np.float32)
        free = ~blocked(scene, rays, 0.985)
        falloff = 1.0 / (1.0 + (distance[lit] / 1.9) ** 2)
        received[lit] += np.where(free, (0.15 + 0.85 * cosine[lit]) * falloff, 0.0)
    return received / len(DISC)


def open_sky(scene: object, start: Float64Array, facing: Float64Array) -> Float64Array:
    """Share of a few fixed directions around the normal that are unobstructed nearby."""
    helper = np.where(np.abs(facing[:, 2:]) < 0.9, np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0]]))
    side = np.cross(facing, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    over = np.cross(facing, side)
    free = np.zeros(len(start))
    slants = [(0.35, 3, 0.2), (0.75, 5, 0.0)]
    n = sum(count for _, count, _ in slants)
    for sine, count, phase in slants:
        for k in range(count):
            angle = 2 * np.pi * (k / count + phase)
            ray = facing * np.sqrt(1 - sine**2) + sine * (side * np.cos(angle) + over * np.sin(angle))
            rays = np.concatenate([start, ray * OCCLUSION_REACH_M], axis=1).astype(np.float32)
            free += ~blocked(scene, rays, 1.0)
    return free / n


def blocked(scene: object, rays: Float32Array, far: float) -> NDArray[np.bool_]:
    o3d = compiled_open3d()
    hit = scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=far)  # type: ignore[attr-defined]
    return np.asarray(hit.numpy(), bool)
