"""The free floor of a home on a grid: where a person or a robot can stand, and whether it is one region."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.datasets.homes.layout import Layout
from su3d_bench.datasets.homes.solids import Solids

BODY_M = (0.04, 1.9)  # heights in which things are in the way: above rugs, below the head of a tall person
THIN_M = 0.02  # of a wall on the grid, where it counts as an obstacle
MARGIN_M = 0.2  # of the grid around the home


class FloorGrid:
    """Cells of ``cell_m``; ``origin``: the corner of cell (0, 0). A disc of ``radius_m`` may be centred where free."""

    def __init__(self, layout: Layout, cell_m: float, radius_m: float) -> None:
        x0, x1, y0, y1 = layout.rect
        self.cell_m, self.radius_m = cell_m, radius_m
        self.origin = np.array([x0, y0]) - MARGIN_M
        shape = np.ceil((np.array([x1, y1]) + MARGIN_M - self.origin) / cell_m).astype(int)
        self.centres = (np.moveaxis(np.indices(tuple(shape.tolist())), 0, -1) + 0.5) * cell_m + self.origin
        self.taken = np.ones(shape, np.int16)
        self.low_ceiling = np.zeros(shape, bool)
        for room in layout.rooms:
            inside = room.contains(self.centres)
            self.taken[inside] = 0
            self.low_ceiling |= inside & (room.ceiling(self.centres) < BODY_M[1])
        if layout.doorway is not None:
            a, b, c, d = layout.doorway
            x, y = self.centres[..., 0], self.centres[..., 1]
            self.taken[(x > a - cell_m) & (x < b + cell_m) & (y > c - cell_m) & (y < d + cell_m)] = 0
        for room in layout.rooms:
            for wall in room.walls:
                hole = layout.hole(wall) or (wall.length, wall.length)
                for start, end in ((0.0, hole[0]), (hole[1], wall.length)):
                    self._mark_wall(wall.point(start, 0.0), wall.point(end, -THIN_M))

    def _mark_wall(self, a: Float64Array, b: Float64Array) -> None:
        half = np.abs(b - a)[None] / 2
        self.mark(Solids((a + b)[None] / 2, half, np.zeros(1), np.array([[0.0, BODY_M[1]]])))

    def mark(self, solids: Solids, by: int = 1) -> None:
        """Count ``by`` in the cells that are nearer to the solids than the radius."""
        in_the_way = (solids.z[:, 0] < BODY_M[1]) & (solids.z[:, 1] > BODY_M[0])
        solids = solids.chosen(in_the_way)
        low = ((solids.centre - solids.reach - self.radius_m - self.origin) / self.cell_m).astype(int).clip(0)
        high = ((solids.centre + solids.reach + self.radius_m - self.origin) / self.cell_m).astype(int) + 2
        for k, yaw in enumerate(solids.yaw):
            window = slice(low[k, 0], high[k, 0]), slice(low[k, 1], high[k, 1])
            away = self.centres[window] - solids.centre[k]
            cos, sin = np.cos(yaw), np.sin(yaw)
            u = np.maximum(np.abs(away[..., 0] * cos + away[..., 1] * sin) - solids.half[k, 0], 0.0)
            v = np.maximum(np.abs(away[..., 1] * cos - away[..., 0] * sin) - solids.half[k, 1], 0.0)
            self.taken[window] += (by * (u * u + v * v < self.radius_m**2)).astype(np.int16)

    def regions(self) -> tuple[Float64Array, list[float]]:
        """Labels of the connected free regions, 0 where not free; the areas in m2 of labels 1, 2, ..."""
        from scipy.ndimage import label

        labels, n = label(self.taken == 0)
        areas = np.bincount(labels.ravel(), minlength=n + 1)[1:] * self.cell_m**2
        return labels, areas.tolist()

    def main_region(self) -> BoolArray:
        """Cells of the largest free region."""
        labels, areas = self.regions()
        return np.asarray(labels == 1 + int(np.argmax(areas))) if areas else np.zeros(labels.shape, bool)

    def at(self, point: Float64Array) -> tuple[int, int]:
        i, j = ((point - self.origin) / self.cell_m).astype(int)
        return int(i), int(j)
