"""Light of a home, baked at the vertices: sun through windows, sky light, lamps, and what surfaces reflect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import BoolArray
from su3d_bench.datasets.procedural.items import Light
from su3d_bench.datasets.procedural.rendering import mesh as base
from su3d_bench.numerics.open3d_core import compiled_open3d

Floats = NDArray[Any]  # float32 where a vector per point is enough
Vector = tuple[float, float, float]
SUNNY_SPACING_M = 0.014  # in sunlit cells: the edge of a patch of sunlight is one pixel wide at 5 m in 640 columns
SUN_BLUR = 0.009  # tangent of the half-width of the penumbra: the sun has 0.0047, the rest hides the cells
PANE_GAP_M = 0.03  # rays to a window end this far before its plane: the pane does not shade
SEE_THROUGH = 0.3  # parts that let this much light pass, or emit this much, cast no shadow
N_SKY = 10  # points on a window
FAINT = 5e-3  # light per area below which no shadow is computed: a lamp 7 m away
LAMP_M2 = 0.3  # squared distance added to that of a lamp, which is no point
BOUNCE_SPACING_M = 0.1  # between points at which reflected light is gathered: it varies slowly
N_BOUNCE, N_GATHERS, N_NEIGHBOURS = 20, 3, 5  # rays per point; bounces; points averaged (so 100 rays)
SUN_PIECE_M = 0.5  # a patch of sunlight is replaced by lamps this far apart
SMALL_PIECE = 0.01  # of the sunlight that arrives: smaller pieces are left out
AMBIENT = 0.03  # of the mean light, for what three bounces miss
NARROW = 0.55  # of reflected light reaches a crevice, which is smaller than the spacing of the points
GOLDEN = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Sun:
    """``direction`` unit vector towards the sun; ``colour`` linear RGB times power: a few times that of the sky."""

    direction: Vector
    colour: Vector


@dataclass(frozen=True)
class Window:
    """A rectangle in the plane of a wall: half edges ``u`` and ``v`` in m, ``sky`` linear RGB times power."""

    centre: Vector
    u: Vector
    v: Vector
    sky: Vector

    @property
    def points(self) -> Floats:
        """Points (N_SKY, 3) that stand for its area, at irregular heights so that no slat hides them all."""
        k = np.arange(1, N_SKY + 1)
        at = 2 * np.column_stack([0.7549 * k % 1, 0.5698 * k % 1]) - 1  # Roberts' quasi-random sequence
        return np.asarray(self.centre + 0.95 * at @ np.array([self.u, self.v]))


def lit_mesh(
    patches: base.Patches, lights: Sequence[Light], sun: Sun | None, windows: Sequence[Window], exposure: float,
    spacing_m: float = 0.1,
) -> base.SceneMesh:  # fmt: skip
    """The render mesh of a home; light is scaled so that its 70th percentile is ``exposure``."""
    from su3d_bench.datasets.procedural.rendering.sampled_kernels import wear_off

    grid = base.cut(patches, spacing_m)
    points: Floats = base.at_rows(patches.corners, grid.rows)
    normals = _unit(base.at_rows(patches.normals, grid.rows))
    quad = grid.rows[:, 0].astype(np.int64)
    keys = np.concatenate([np.round(points * 250), np.round(normals * 5), patches.object_id[quad, None]], axis=1)
    first, group = base.merge_equal(keys.astype(np.int64))
    triangles, owner = base.triangles_of(grid, points)
    passes = np.maximum(patches.materials[:, 9], patches.materials[:, 17]) > SEE_THROUGH
    solid = ~passes[patches.material[owner]]
    facing: Floats = normals[first].astype(np.float32)
    start: Floats = base.off_surface(points[first], facing, patches.corners[quad[first]].mean(axis=1))
    start = start.astype(np.float32)
    room = _Room(base.caster(points.astype(np.float32), triangles[solid]), points[triangles[solid]])
    sunlight, direct = room.sunlight(start, facing, sun, windows), np.zeros((len(start), 3))
    for light in lights:
        for point in np.array(light.position) + light.radius * base.DISC:
            share = room.shine(start, facing, point, None, np.pi * LAMP_M2, 0.01) / (LAMP_M2 * len(base.DISC))
            direct += share[:, None] * np.array(light.colour)
    for window in windows:
        plane = np.cross(window.u, window.v)
        for point in window.points:
            share = room.shine(start, facing, point, plane, 4 * float(np.linalg.norm(plane)) / N_SKY, PANE_GAP_M)
            direct += share[:, None] * np.array(window.sky)
    ahead = room.first_hits(start, facing)
    buried = (ahead >= 0) & ((room.crossed[ahead] * facing).sum(axis=1) > 0)  # sees the inside of a solid
    colours = patches.materials.astype(np.float64)[patches.material[owner[solid]]]
    albedo = 0.65 * colours[:, 1:4] + 0.35 * colours[:, 4:7]
    objects, corners = patches.object_id[quad[first]], group[triangles[solid]]
    direct += room.reflected(start, facing, direct, sunlight, buried, objects, corners, albedo)
    soft = base.fill_buried(direct, buried, group[triangles])
    scale = exposure / np.percentile((soft + sunlight)[~buried].mean(axis=1), 70)
    sunny = (sunlight.max(axis=1) > 0)[group][grid.faces].any(axis=1)  # these faces are cut again
    cells = base.cut(replace(patches, corners=points[grid.faces[sunny]]), SUNNY_SPACING_M)
    quads_of_cells = grid.quad_of_face[sunny][cells.rows[:, 0].astype(np.int64)]
    rows = base.at_rows(grid.rows[grid.faces[sunny]], cells.rows)
    rows[:, 0] = quads_of_cells  # exactly
    near, up = base.at_rows(patches.corners, rows), _unit(base.at_rows(patches.normals, rows))
    start = base.off_surface(near, up, patches.corners[quads_of_cells].mean(axis=1))
    sharp = base.at_rows(soft[group][grid.faces[sunny]], cells.rows) + room.sunlight(start, up, sun, windows)
    merged = base.Grid(
        np.concatenate([grid.rows, rows]),
        np.concatenate([grid.faces[~sunny], cells.faces + np.int32(len(points))]),
        np.concatenate([grid.quad_of_face[~sunny], grid.quad_of_face[sunny][cells.quad_of_face]]),
    )
    points, normals = np.concatenate([points, near]), np.concatenate([normals, up])
    triangles, owner = base.triangles_of(merged, points)
    baked = np.concatenate([(soft + sunlight)[group], sharp]) * scale
    sources = [[*lamp.position, min(1.5, max(lamp.colour) * scale)] for lamp in lights]
    sources += [[*point, min(1.5, max(window.sky) * scale) / 2] for window in windows for point in window.points[::4]]
    texture = base.at_rows(patches.texture, merged.rows).astype(np.float32)
    baked = baked.astype(np.float32)
    wear_off(texture, patches.material[merged.rows[:, 0].astype(np.int64)], patches.materials, baked)
    return base.SceneMesh(
        points.astype(np.float32), normals.astype(np.float32), texture, baked, triangles,
        patches.object_id[owner], patches.material[owner], patches.materials,
        np.array(sources, np.float32).reshape(-1, 4),
    )  # fmt: skip


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9))


class _Room:
    """What casts shadows: ``corners`` (T, 3, 3) of triangles, and their ray-casting ``scene``."""

    def __init__(self, scene: Any, corners: Floats) -> None:
        self.scene, self.corners = scene, corners
        self.crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def is_free(self, start: Floats, along: Floats) -> BoolArray:
        return ~base.blocked(self.scene, np.concatenate([start, along], axis=1).astype(np.float32), 1.0)

    def first_hits(self, start: Floats, along: Floats) -> Any:
        """The triangle that each ray hits, or -1."""
        rays = compiled_open3d().core.Tensor(np.concatenate([start, along], axis=1).astype(np.float32))
        return self.scene.cast_rays(rays)["primitive_ids"].numpy().astype(np.int32)

    def shine(
        self, start: Floats, facing: Floats, point: Floats, plane: Floats | None, area: float,
        gap_m: float,
    ) -> Floats:  # fmt: skip
        """Form factors of a piece of ``area`` m2 that lies in ``plane`` or, without one, faces everywhere."""
        cosine = facing @ np.asarray(point, start.dtype) - np.einsum("vk,vk->v", facing, start)
        ahead = np.flatnonzero(cosine > 0)
        away = np.asarray(point, start.dtype) - start[ahead]
        square = np.einsum("vk,vk->v", away, away) + 1e-9
        height = np.sqrt(square) if plane is None else np.abs(away @ _unit(plane).astype(start.dtype))
        form = area * cosine[ahead] * height / (square * (np.pi * square + area))
        bright = form > FAINT * area
        lit, form, before = ahead[bright], form[bright], np.maximum(1 - gap_m / height[bright], 0.0)
        free = self.is_free(start[lit], away[bright] * before[:, None])
        return np.bincount(lit[free], form[free], len(start))

    def sunlight(self, start: Floats, facing: Floats, sun: Sun | None, windows: Sequence[Window]) -> Floats:
        """Sunlight (V, 3): where rays towards the sun cross a window and nothing blocks them before it."""
        received = np.zeros((len(start), 3))
        if sun is None:
            return received
        side = _unit(np.cross(sun.direction, np.eye(3)[np.argmin(np.abs(sun.direction))]))
        for turn in 2 * np.pi * np.arange(5) / 5:
            ray = sun.direction + SUN_BLUR * (np.cos(turn) * side + np.sin(turn) * np.cross(sun.direction, side))
            for window in windows:
                u, v, plane = np.array(window.u), np.array(window.v), _unit(np.cross(window.u, window.v))
                steep = float(ray @ plane) or 1e-9
                far = (np.array(window.centre) - start) @ plane / steep
                across = start + far[:, None] * ray - window.centre
                inside = (np.abs(across @ u) < u @ u) & (np.abs(across @ v) < v @ v)
                lit = np.flatnonzero(inside & (far > 0) & (facing @ ray > 0))
                reach = np.maximum(far[lit] - PANE_GAP_M / abs(steep), 0.0)
                lit = lit[self.is_free(start[lit], ray * reach[:, None])]
                received[lit] += (facing[lit] @ ray)[:, None] / 5 * np.array(sun.colour)
        return received

    def reflected(
        self, start: Floats, facing: Floats, direct: Floats, sunlight: Floats,
        buried: BoolArray, objects: Any, corners: Any, albedo: Floats,
    ) -> Floats:  # fmt: skip
        """Light (V, 3) that arrives from other surfaces, gathered at some of the points and averaged around each.

        ``corners`` are the rows of ``direct`` at the corners of the triangles, which have a mean ``albedo`` each.
        Patches of sunlight are too small and bright for so few rays: their light is that of lamps on them.
        """
        keys = np.column_stack([np.round(start / BOUNCE_SPACING_M), np.round(facing * 1.2), objects]).astype(np.int64)
        chosen = np.flatnonzero(~buried)
        chosen = chosen[base.merge_equal(keys[chosen])[0]]
        out, k = facing[chosen], np.arange(N_BOUNCE)
        side = _unit(np.cross(out, np.where(np.abs(out[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])))
        turn = np.float32(GOLDEN) * (k + np.arange(len(chosen))[:, None] * 0.37)[..., None]  # all have the set, turned
        sine = np.sqrt((k + 0.5) / N_BOUNCE)[None, :, None]
        around = side[:, None] * np.cos(turn) + np.cross(out, side)[:, None] * np.sin(turn)
        along = (out[:, None] * np.sqrt(1 - sine**2) + sine * around).reshape(-1, 3).astype(np.float32)
        hit = self.first_hits(np.repeat(start[chosen], N_BOUNCE, axis=0), along)
        seen = (hit >= 0) & ((self.crossed[hit] * along).sum(axis=1) < 0)
        from_sun = np.zeros((len(chosen), 3))
        for at, plane, area, power in self.sunlit_pieces(albedo * sunlight[corners].mean(axis=1)):
            from_sun += self.shine(start[chosen], out, at, plane, area, 0.01)[:, None] * power / area
        from scipy.spatial import cKDTree

        tree = cKDTree(np.column_stack([start[chosen], 0.5 * out]))
        far, near = tree.query(np.column_stack([start, 0.5 * facing]), range(1, N_NEIGHBOURS + 1), eps=0.3, workers=-1)
        weight = 1.0 / (far**2 + BOUNCE_SPACING_M**2)
        weight /= weight.sum(axis=1, keepdims=True)
        received = np.zeros_like(direct)
        for _ in range(N_GATHERS):
            sent = albedo * (direct + received)[corners].mean(axis=1)
            gathered = from_sun + np.where(seen[:, None], sent[hit], 0.0).reshape(-1, N_BOUNCE, 3).mean(axis=1)
            received = np.einsum("vk,vkc->vc", weight, gathered[near]) + AMBIENT * direct[chosen].mean(axis=0)
        return received * (NARROW + (1 - NARROW) * base.open_sky(self.scene, start, facing)[:, None])

    def sunlit_pieces(self, sent: Floats) -> list[tuple[Floats, Floats, float, Floats]]:
        """Centre, normal, area and power of the surface that sends sunlight on, in pieces of ``SUN_PIECE_M``."""
        lit = np.flatnonzero(sent.max(axis=1) > 0)
        area, centre = np.linalg.norm(self.crossed[lit], axis=1, keepdims=True) / 2, self.corners[lit].mean(axis=1)
        keys = np.column_stack([np.round(centre / SUN_PIECE_M), np.round(_unit(self.crossed[lit]))]).astype(np.int64)
        first, group = base.merge_equal(keys)
        values = np.column_stack([area, centre * area, self.crossed[lit], sent[lit] * area])
        sums = np.column_stack([np.bincount(group, value, len(first)) for value in values.T])
        normals = _unit(sums[:, 4:7])
        centres = sums[:, 1:4] / sums[:, :1] + 0.01 * normals
        power = sums[:, 7:].sum(axis=1)
        kept = power > SMALL_PIECE * power.sum()
        return list(zip(centres[kept], normals[kept], sums[kept, 0].tolist(), sums[kept, 7:], strict=True))
