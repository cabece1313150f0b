"""A map as seen from above and from two corners, rendered once and then coloured any number of times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from su3d_bench.reports.pictures.colours import NO_INSTANCE
from su3d_bench.reports.pictures.maps import SQUARE_M, map_cloud, thinned_rows
from su3d_bench.reports.pictures.render import (
    OVERSAMPLING,
    Camera,
    View,
    colour,
    project,
    render,
    room_bounds,
    view_cameras,
)

PALE_GREY = 232
RENDERED = 1.5  # times the size of the picture, for the room fills only a part of a view from a corner
BORDER = 4  # pixels around what is drawn


@dataclass(frozen=True)
class MapView:
    """One view of a map; ``point`` of ``view`` are rows of the drawn points, ``camera`` is at twice the size.

    Of it the part ``box`` (x0, y0, x1, y1 in pixels of the picture) is shown.
    """

    camera: Camera
    view: View
    box: tuple[int, int, int, int]

    @cached_property
    def shown(self) -> View:
        """The part of ``view`` that is shown."""
        x0, y0, x1, y1 = (OVERSAMPLING * side for side in self.box)
        part = slice(y0, y1), slice(x0, x1)
        return View(np.ascontiguousarray(self.view.point[part]), np.ascontiguousarray(self.view.shade[part]))

    def shows(self, is_member: BoolArray) -> BoolArray:
        """Where the view shows a point of those that ``is_member`` marks: (h, w) of the picture."""
        point, known = self.shown.point, np.append(is_member, False)
        seen: BoolArray = known[point[::OVERSAMPLING, ::OVERSAMPLING]] | known[point[1::OVERSAMPLING, 1::OVERSAMPLING]]
        return seen

    def project(self, points: Float64Array) -> Float64Array:
        """Columns and rows (N, 2) of world points as shares of the width and height that are shown."""
        x0, y0, x1, y1 = self.box
        shares: Float64Array = (project(self.camera, points) - np.array([x0, y0])) / np.array([x1 - x0, y1 - y0])
        return shares


@dataclass(frozen=True)
class DrawnMap:
    """A map thinned for drawing: ``rows`` of its points that are drawn, ``owner`` the smallest instance of each."""

    instances: Instances
    rows: Int64Array
    owner: Int32Array

    def members(self, instance_rows: Sequence[int]) -> BoolArray:
        """Which drawn points belong to any of these instances."""
        is_member = np.zeros(len(self.instances.points), np.bool_)
        for k in instance_rows:
            is_member[self.instances.mask(int(k))] = True
        members: BoolArray = is_member[self.rows]
        return members

    def view(self, camera: Camera) -> MapView:
        return view_of(self.instances.points[self.rows], camera)

    def cameras(self, width: int, height: int) -> tuple[Camera, Camera, Camera]:
        """From above and from two opposite corners, for views of the shape of this size and at least as large."""
        return cameras_of(self.instances.points, width, height)

    def paint(self, view: MapView, colours: UInt8Array) -> UInt8Array:
        """The picture of a view, instance k in ``colours[k]``."""
        palette = np.concatenate([colours.reshape(-1, 3), np.array([NO_INSTANCE], np.uint8)])
        return self.paint_points(view, palette[self.owner])

    def paint_points(self, view: MapView, colours: UInt8Array) -> UInt8Array:
        """The picture of a view, each drawn point in a colour (N, 3) of its own."""
        return colour(view.shown, colours)


def view_of(points: Float32Array, camera: Camera) -> MapView:
    """What a camera shows of ``points``."""
    view = render(points, SQUARE_M, camera)
    return MapView(camera, view, _filled_part(view, camera.width / camera.height))


def cameras_of(points: Float32Array, width: int, height: int) -> tuple[Camera, Camera, Camera]:
    """From above and from two opposite corners, for views of the shape of this size and at least as large."""
    return view_cameras(room_bounds(points), round(RENDERED * width), round(RENDERED * height))


def drawn_map(instances: Instances) -> DrawnMap:
    """The map of ``instances`` thinned to what a picture shows; of masks that overlap, the smaller one is seen."""
    rows = thinned_rows(instances.points)
    return DrawnMap(instances, rows, map_cloud(instances).owner[rows])


def _filled_part(view: View, aspect: float) -> tuple[int, int, int, int]:
    """The smallest part of a view of that shape, width by height, that holds all that is drawn."""
    height, width = (side // OVERSAMPLING for side in view.point.shape)
    rows, columns = np.nonzero(view.point >= 0)
    if not len(rows):
        return 0, 0, width, height
    left, right = columns.min() / OVERSAMPLING - BORDER, columns.max() / OVERSAMPLING + BORDER
    upper, lower = rows.min() / OVERSAMPLING - BORDER, rows.max() / OVERSAMPLING + BORDER
    tall = min(max(lower - upper, (right - left) / aspect), float(height), width / aspect)
    wide = tall * aspect
    x0 = int(np.clip((left + right - wide) / 2, 0, width - wide))
    y0 = int(np.clip((upper + lower - tall) / 2, 0, height - tall))
    return x0, y0, x0 + int(wide), y0 + int(tall)


def pale(colours: UInt8Array, share: float) -> UInt8Array:
    """``colours`` with this share of them left, the rest a light grey."""
    return np.rint(share * colours.astype(np.float64) + (1 - share) * PALE_GREY).astype(np.uint8)
