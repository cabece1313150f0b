"""A map as seen from above and from two corners, rendered once and then coloured any number of times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.reports.pictures import DRAWN_SPACING_M, NO_INSTANCE, Cloud, thinned
from su3d_bench.reports.render import OVERSAMPLING, Camera, View, colour, render, room_bounds, view_cameras
from su3d_bench.types import BoolArray, Instances, Int32Array, Int64Array, UInt8Array

PALE_GREY = 232


@dataclass(frozen=True)
class MapView:
    """One view of a map; ``point`` of ``view`` are rows of the drawn points, ``camera`` is at twice the size."""

    camera: Camera
    view: View

    def shows(self, is_member: BoolArray) -> BoolArray:
        """Where the view shows a point of those that ``is_member`` marks: (h, w) of the picture."""
        seen = np.append(is_member, False)[self.view.point]
        return seen[::OVERSAMPLING, ::OVERSAMPLING] | seen[1::OVERSAMPLING, 1::OVERSAMPLING]


@dataclass(frozen=True)
class DrawnMap:
    """A map thinned for drawing: ``rows`` of its points that are drawn, ``owner`` the smallest instance of each."""

    instances: Instances
    rows: Int32Array
    owner: Int32Array

    def members(self, instance_rows: Sequence[int]) -> BoolArray:
        """Which drawn points belong to any of these instances."""
        is_member = np.zeros(len(self.instances.points), np.bool_)
        for k in instance_rows:
            is_member[self.instances.mask(int(k))] = True
        members: BoolArray = is_member[self.rows]
        return members

    def view(self, camera: Camera) -> MapView:
        # 2.6: no gaps in a surface whose points lie up to two cells apart, as pictures.py draws it
        return MapView(camera, render(self.instances.points[self.rows], 2.6 * DRAWN_SPACING_M, camera))

    def cameras(self, width: int, height: int) -> tuple[Camera, Camera, Camera]:
        """From above and from two opposite corners, for pictures of this size."""
        return view_cameras(room_bounds(self.instances.points), width, height)

    def paint(self, view: MapView, colours: UInt8Array) -> UInt8Array:
        """The picture of a view, instance k in ``colours[k]``."""
        palette = np.concatenate([colours.reshape(-1, 3), np.array([NO_INSTANCE], np.uint8)])
        return colour(view.view, palette[self.owner])


def drawn_map(instances: Instances) -> DrawnMap:
    """The map of ``instances`` thinned to what a picture shows; of masks that overlap, the smaller one is seen."""
    owner = np.full(len(instances.points), -1, np.int32)
    sizes: Int64Array = np.diff(instances.indptr)
    for k in np.argsort(-sizes, kind="stable"):
        owner[instances.mask(int(k))] = k
    rows = thinned(Cloud(instances.points, np.arange(len(instances.points), dtype=np.int32))).owner
    return DrawnMap(instances, rows, owner[rows])


def pale(colours: UInt8Array, share: float) -> UInt8Array:
    """``colours`` with this share of them left, the rest a light grey."""
    return np.rint(share * colours.astype(np.float64) + (1 - share) * PALE_GREY).astype(np.uint8)
