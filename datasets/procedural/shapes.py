"""Solid shapes made of quadrilaterals: boxes, surfaces of revolution, tubes, sheets; metres, outward normals.

The corners of a quad are in order around it; a quad with two equal corners is a triangle. Every shape is closed or
two-sided, so back faces are never drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from su3d_bench.core.types import Float64Array

CREASE = np.cos(np.deg2rad(38.0))  # profile bends sharper than this are edges, others are smooth


@dataclass(frozen=True)
class Shape:
    """``quads`` (Q, 4, 3) corner positions and ``normals`` (Q, 4, 3) unit vectors."""

    quads: Float64Array
    normals: Float64Array

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
        return Shape(self.quads + np.array([x, y, z]), self.normals)

    def turned(self, axis: str, degrees: float) -> Shape:
        """Rotated about a coordinate axis through the origin, counter-clockwise seen from its tip."""
        matrix = rotation(axis, degrees)
        return Shape(self.quads @ matrix.T, self.normals @ matrix.T)

    def tapered(self, factor: float) -> Shape:
        """x and y shrunk linearly with height, to ``factor`` at the top; normals as they are."""
        quads = self.quads.copy()
        low, high = quads[..., 2].min(), quads[..., 2].max()
        quads[..., :2] *= 1.0 + (factor - 1.0) * (quads[..., 2:] - low) / max(high - low, 1e-9)
        return Shape(quads, self.normals)

    def stretched(self, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> Shape:
        scale = np.array([x, y, z])
        normals = self.normals / scale
        return Shape(self.quads * scale, normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def rotation(axis: str, degrees: float) -> Float64Array:
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    if axis == "x":
        return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    if axis == "y":
        return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])


def join(shapes: Sequence[Shape]) -> Shape:
    return Shape(np.concatenate([s.quads for s in shapes]), np.concatenate([s.normals for s in shapes]))


_CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_FACE_NORMALS = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], np.float64)


def box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float) -> Shape:
    low, high = np.array([x0, y0, z0]), np.array([x1, y1, z1])
    corners = low + _CUBE * (high - low)
    return Shape(corners[_FACES], np.repeat(_FACE_NORMALS[:, None, :], 4, axis=1))


def block(width: float, depth: float, height: float, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
    """A box centred at (x, y) that stands on height ``z``."""
    return box(x - width / 2, x + width / 2, y - depth / 2, y + depth / 2, z, z + height)


def soft_block(
    width: float, depth: float, height: float, x: float = 0.0, y: float = 0.0, z: float = 0.0, radius: float = 0.03
) -> Shape:
    """A box with rounded edges, centred at (x, y), standing on height ``z``."""
    half = np.array([width, depth, height]) / 2
    radius = min(radius, float(half.min()) * 0.98)
    shapes = []
    for axis in range(3):
        u_axis, v_axis = (axis + 1) % 3, (axis + 2) % 3
        u, v = _rounded_steps(half[u_axis], radius), _rounded_steps(half[v_axis], radius)
        for side in (-1.0, 1.0):
            grid = np.empty((len(u), len(v), 3))
            grid[..., axis] = side * half[axis]
            grid[..., u_axis], grid[..., v_axis] = u[:, None], v[None, :]
            inner = np.clip(grid, -(half - radius), half - radius)
            normals = grid - inner
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
            shapes.append(_from_grid(inner + radius * normals, normals))
    return join(shapes).moved(x, y, z + half[2])


def _rounded_steps(half: float, radius: float) -> Float64Array:
    rim = np.array([1.0, 0.58, 0.27, 0.0]) * radius
    steps: Float64Array = np.unique(np.concatenate([-(half - radius) - rim, half - radius + rim]).round(9))
    return steps


def _from_grid(points: Float64Array, normals: Float64Array) -> Shape:
    def corners(grid: Float64Array) -> Float64Array:
        return np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2).reshape(-1, 4, 3)

    quads = corners(points)
    crossed = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    keep = np.linalg.norm(crossed, axis=1) > 1e-12
    return Shape(quads[keep], corners(normals)[keep])


def _grid_normals(points: Float64Array) -> Float64Array:
    du, dv = np.gradient(points, axis=0), np.gradient(points, axis=1)
    crossed = np.cross(du, dv)
    normals: Float64Array = crossed / np.maximum(np.linalg.norm(crossed, axis=-1, keepdims=True), 1e-12)
    return normals


def lathe(profile: Sequence[tuple[float, float]], segments: int | None = None) -> Shape:
    """The profile (radius, height) rotated about z; it runs from the axis at the bottom up the outside, down inside."""
    points = np.array(profile, np.float64)
    largest = points[:, 0].max()
    n = segments or int(np.clip(2 * round(np.pi * largest / 0.022), 10, 28))
    angle = np.linspace(0, 2 * np.pi, n + 1)
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    steps = np.diff(points, axis=0)
    steps /= np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
    out = np.stack([steps[:, 1], -steps[:, 0]], axis=1)
    breaks = [0, *[i for i in range(1, len(steps)) if steps[i - 1] @ steps[i] < CREASE], len(steps)]
    shapes = []
    for start, end in pairwise(breaks):
        ring = points[start : end + 1]
        lean = np.stack([out[max(start, i - 1)] + out[min(end - 1, i)] for i in range(start, end + 1)])
        lean /= np.maximum(np.linalg.norm(lean, axis=1, keepdims=True), 1e-12)
        shapes.append(_from_grid(_revolve(ring, turn), _revolve(lean, turn)))
    return join(shapes)


def _revolve(rings: Float64Array, turn: Float64Array) -> Float64Array:
    plane = rings[None, :, :1] * turn[:, None, :]
    height = np.broadcast_to(rings[None, :, 1:], (len(turn), len(rings), 1))
    return np.concatenate([plane, height], axis=2)


def ellipsoid(rx: float, ry: float, rz: float) -> Shape:
    """Centred at the origin."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 11 if max(rx, ry, rz) < 0.15 else 17)
    profile = [(max(0.0, float(np.cos(a))), float(np.sin(a))) for a in angles]
    segments = int(np.clip(2 * round(np.pi * max(rx, ry) / 0.03), 12, 32))
    return lathe(profile, segments).stretched(rx, ry, rz)


def tube(path: Sequence[tuple[float, float, float]], radius: float, sides: int = 8) -> Shape:
    """A round bar along a polyline, with flat ends."""
    points = np.array(path, np.float64)
    tangents = np.gradient(points, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    reference = np.array([0.31, 0.17, 0.93]) if np.abs(tangents[:, 2]).mean() < 0.8 else np.array([0.93, 0.31, 0.17])
    side = np.cross(tangents, reference)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    over = np.cross(tangents, side)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[None, :, None]
    around = side[:, None, :] * np.cos(angle) + over[:, None, :] * np.sin(angle)
    wall = _from_grid((points[:, None, :] + radius * around).swapaxes(0, 1), around.swapaxes(0, 1))
    caps = []
    for end, sign in ((0, -1.0), (len(points) - 1, 1.0)):
        rim = points[end] + radius * around[end]
        disc = np.stack([np.broadcast_to(points[end], rim.shape), rim], axis=1)
        normals = np.broadcast_to(sign * tangents[end], disc.shape)
        caps.append(_from_grid(disc, normals))
    return join([wall, *caps])


def sheet(points: Float64Array, thickness: float = 0.006) -> Shape:
    """A two-sided sheet through a grid (U, V, 3) of points; front is where du x dv points."""
    normals = _grid_normals(points)
    offset = normals * thickness / 2
    return join([_from_grid(points + offset, normals), _from_grid(points - offset, -normals)])


def loft(sections: Sequence[Sequence[float]], power: float = 2.0, sides: int = 24) -> Shape:
    """A skin over level sections (z, centre x, centre y, radius x, radius y) with flat ends.

    A section is an ellipse at ``power`` 2, nearly a rectangle from 5 on.
    """
    rows = np.array(sections, np.float64)
    angle = 2 * np.pi * np.arange(-1, sides + 2) / sides
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None, :]
    plane = rows[None, :, 1:3] + rows[None, :, 3:] * np.sign(unit) * np.abs(unit) ** (2 / power)
    height = np.broadcast_to(rows[None, :, 0], (len(angle), len(rows)))[..., None]
    grid = np.concatenate([plane, height], axis=2)
    shapes = [_from_grid(grid[1:-1], _grid_normals(grid)[1:-1])]
    for end, up in ((0, -1.0), (len(rows) - 1, 1.0)):
        rim = grid[1:-1, end]
        centre = np.broadcast_to(rows[end, [1, 2, 0]], rim.shape)
        shapes.append(_from_grid(np.stack([centre, rim], axis=1), np.full((len(rim), 2, 3), (0.0, 0.0, up))))
    return join(shapes)


def puff(width: float, height: float, thickness: float, n: int = 13) -> Shape:
    """A filled cushion in the x-z plane, centred at the origin, thickest in the middle, with pinched corners."""
    t = np.linspace(-1, 1, n)
    t = np.sign(t) * (1 - (1 - np.abs(t)) ** 1.35)
    u, v = np.meshgrid(t, t, indexing="ij")
    fat = (np.clip(1 - u**4, 0, 1) * np.clip(1 - v**4, 0, 1)) ** 0.5
    pinch = 1 - 0.07 * (np.abs(u) * np.abs(v)) ** 0 * (1 - np.abs(v) ** 2), 1 - 0.07 * (1 - np.abs(u) ** 2)
    x, z = u * width / 2 * pinch[0], v * height / 2 * pinch[1]
    shapes = []
    for side in (-1.0, 1.0):
        grid = np.stack([x, side * (fat * thickness / 2 + 0.002), z], axis=-1)
        shapes.append(_from_grid(grid, _grid_normals(grid) * (1.0 if side < 0 else -1.0)))
    return join(shapes)


def leaf(length: float, width: float, droop: float) -> Shape:
    """A pointed leaf that grows from the origin along y, rising and then drooping."""
    t = np.linspace(0, 1, 6)
    half = width / 2 * np.sin(np.pi * np.clip(t * 0.93 + 0.05, 0, 1)) ** 0.8
    v = np.linspace(-1, 1, 3)
    y = np.repeat((length * t * (1 - 0.25 * droop * t))[:, None], 3, axis=1)
    z = length * (0.55 * t - droop * t**2)[:, None] + 0.12 * width * np.abs(v)[None, :] * np.sin(np.pi * t)[:, None]
    return sheet(np.stack([v[None, :] * half[:, None], y, z], axis=-1), 0.004)


def prism(outline: Sequence[tuple[float, float]], length: float, along: str = "y") -> Shape:
    """A polygon (x, z) seen from the front, ``length`` deep and centred; along "x": (y, z); "z": (x, y), from z = 0.

    Bends of the outline below the crease angle are smooth. Raises ``ValueError`` if the outline crosses itself.
    """
    points = np.array(outline, np.float64)
    if _area(points) < 0:
        points = points[::-1]
    edge = np.roll(points, -1, axis=0) - points
    edge /= np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    out = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    before = np.roll(out, 1, axis=0)
    is_smooth = (out * before).sum(axis=1) > CREASE
    mean = out + before
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    start = np.where(is_smooth[:, None], mean, out)
    end = np.where(np.roll(is_smooth, -1)[:, None], np.roll(mean, -1, axis=0), out)
    following = np.roll(points, -1, axis=0)
    sides = [
        np.stack([_raised(points, 0), _raised(following, 0), _raised(following, length), _raised(points, length)], 1)
    ]
    normals = [np.stack([_raised(start, 0), _raised(end, 0), _raised(end, 0), _raised(start, 0)], 1)]
    triangles = points[_ears(points)]
    for level, up in ((0.0, -1.0), (length, 1.0)):
        cap = np.stack([_raised(triangles[:, k], level) for k in (0, 1, 2, 2)], axis=1)
        sides.append(cap)
        normals.append(np.broadcast_to(np.array([0.0, 0.0, up]), cap.shape))
    shape = Shape(np.concatenate(sides), np.concatenate(normals))
    if along == "z":
        return shape
    upright = shape.moved(z=-length / 2).turned("x", 90.0)
    return upright if along == "y" else upright.turned("z", 90.0)


def _raised(points: Float64Array, z: float) -> Float64Array:
    return np.column_stack([points, np.full(len(points), z)])


def _area(points: Float64Array) -> float:
    following = np.roll(points, -1, axis=0)
    return float((points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum() / 2)


def _ears(points: Float64Array) -> list[list[int]]:
    """Triangles of a counter-clockwise simple polygon, by cutting off its ears."""
    left, triangles = list(range(len(points))), []
    while len(left) > 3:
        for k in range(len(left)):
            ear = [left[k - 1], left[k], left[(k + 1) % len(left)]]
            a, b, c = points[ear]
            others = points[[i for i in left if i not in ear]]
            sides = [_cross(b - a, others - a), _cross(c - b, others - b), _cross(a - c, others - c)]
            if _cross(b - a, c - a) > -1e-15 and not (np.min(sides, axis=0) > 1e-12).any():
                triangles.append(ear)
                left.remove(ear[1])
                break
        else:
            raise ValueError("the outline crosses itself")
    return [*triangles, left]


def _cross(u: Float64Array, v: Float64Array) -> Float64Array:
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def bounds(shapes: Sequence[Shape]) -> tuple[Float64Array, Float64Array]:
    corners = np.concatenate([s.quads.reshape(-1, 3) for s in shapes])
    return corners.min(axis=0), corners.max(axis=0)
