"""A scene as its frames show it, and where in it an answer lies: nothing in it tells of which map the answer is.

An instance becomes points of the room, by one reach for all maps, and from then on its map has no part in the picture:
how dense, how rough and how complete the map around it is cannot be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, UInt8Array
from su3d_bench.reports.pictures.items import (
    CAP_M,
    LOW_HEIGHT,
    PHOTO_WIDTH,
    ZOOM_WIDTH,
    best_view,
    mask_in_frame,
    palette_of,
)
from su3d_bench.reports.pictures.map_views import MapView, cameras_of, pale, view_of
from su3d_bench.reports.pictures.maps import thinned_rows
from su3d_bench.reports.pictures.render import colour
from su3d_bench.reports.pictures.scene_look import evenly, seen_points

ANSWER_COLOUR, OTHER_COLOUR = (222, 74, 22), (32, 98, 196)  # those of reasoning_picture
SEEN_POINTS = 1_500_000  # of all frames together, before they are thinned: floors are seen at a low angle
ROOM_SHARE, PLACE_SHARE = 0.75, 0.5  # of the room's colours, so that what is judged stands out
# A map's points may lie 5 cm from what the frames saw, and 5 cm apart. What that reach takes of the neighbours is given
# back, but for the width of a drawn point, which noise needs.
REACH_M, BACK_M = CAP_M, 0.035
PALETTE_FRAMES = 8  # from which the colours of all pictures of a scene are chosen


@dataclass(frozen=True)
class Region:
    """Where an instance lies: ``is_member`` (N,) of the room's points; ``points`` (M, 3) are these, in the world.

    Where the frames saw nothing of it ``is_member`` is false throughout, and ``points`` are those of its map.
    """

    is_member: BoolArray
    points: Float32Array

    @property
    def centre(self) -> Float64Array:
        """The middle (3,) of what is shown; NaN without a point."""
        if not len(self.points):
            return np.full(3, np.nan)
        middle: Float64Array = self.points.mean(axis=0, dtype=np.float64)
        return middle


class ShownRoom:
    """A scene in the colours that its frames saw, from above and from two corners: the same for every method."""

    def __init__(self, scene: str, frames: Sequence[Frame]) -> None:
        from scipy.spatial import KDTree

        self.scene, self.frames = scene, frames
        seen, rgb = seen_points(frames, SEEN_POINTS)
        rows = thinned_rows(seen)
        self.points, self.colours = seen[rows], rgb[rows]
        self.tree: Any = KDTree(self.points, balanced_tree=False, compact_nodes=False)
        self.above: MapView = view_of(self.points, cameras_of(self.points, ZOOM_WIDTH, LOW_HEIGHT)[0])
        corners = cameras_of(self.points, PHOTO_WIDTH, LOW_HEIGHT)[1:]
        self.corners: tuple[MapView, ...] = tuple(view_of(self.points, camera) for camera in corners)

    @cached_property
    def palette(self) -> UInt8Array:
        """The colours (n, 3) of all pictures of the scene, whatever is outlined in them."""
        photos = [self.frames[k].rgb for k in evenly(len(self.frames), PALETTE_FRAMES)]
        views = [
            colour(view.shown, pale(self.colours, share))
            for view, share in ((self.above, PLACE_SHARE), *((corner, ROOM_SHARE) for corner in self.corners))
        ]
        return palette_of([*photos, *views], (ANSWER_COLOUR, OTHER_COLOUR))

    def region(self, points: Float32Array) -> Region:
        """Where an instance of these ``points`` (M, 3) lies, however many and in whatever order they are."""
        is_member = np.zeros(len(self.points), np.bool_)
        if len(points) and len(self.points):
            margin = REACH_M + BACK_M
            is_near = ((self.points >= points.min(axis=0) - margin) & (self.points <= points.max(axis=0) + margin)).all(
                1
            )
            near = np.flatnonzero(is_near)
            reached = _within(points, self.points[near], REACH_M)
            kept = ~_within(self.points[near[~reached]], self.points[near[reached]], BACK_M)
            is_member[near[reached][kept]] = True
        return Region(is_member, self.points[is_member] if is_member.any() else points)

    def union(self, regions: Sequence[Region]) -> Region:
        """All of ``regions`` as one."""
        is_member = np.zeros(len(self.points), np.bool_)
        for region in regions:
            is_member |= region.is_member
        if is_member.any():
            return Region(is_member, self.points[is_member])
        return Region(is_member, np.concatenate([np.zeros((0, 3), np.float32), *(one.points for one in regions)]))

    def photo(self, region: Region) -> tuple[Frame, BoolArray] | None:
        """The frame that shows the region best, and where (h, w); None where none shows it."""
        if not region.is_member.any():
            return None
        view = best_view(self.frames, region.points)
        if view is None:
            return None
        frame = self.frames[view.frame]
        bounds = np.stack([region.points.min(axis=0), region.points.max(axis=0)]).astype(np.float64)
        return frame, at_full_size(mask_in_frame(frame, self.tree, region.is_member, bounds), frame.rgb)


def _within(these: Float32Array, of: Float32Array, distance_m: float) -> BoolArray:
    """Which points of ``of`` (N, 3) have one of ``these`` within ``distance_m``."""
    from scipy.spatial import KDTree

    if not len(these) or not len(of):
        return np.zeros(len(of), np.bool_)
    tree: Any = KDTree(these, balanced_tree=False, compact_nodes=False)
    distances, _ = tree.query(of, distance_upper_bound=distance_m)
    is_within: BoolArray = np.isfinite(distances)
    return is_within


def at_full_size(mask: BoolArray, rgb: UInt8Array, gap: int = 3) -> BoolArray:
    """The mask at the size of the colour image ``rgb``, gaps of less than ``gap`` of its pixels closed."""
    import cv2

    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((gap, gap), np.uint8))
    height, width = rgb.shape[:2]
    full: BoolArray = cv2.resize(closed, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return full
