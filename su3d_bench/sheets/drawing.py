"""Drafts as pictures: the best frame of the object, the map around it and its place in the room."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from su3d_bench.reports.frame_views import best_view, mask_in_frame
from su3d_bench.reports.heat_scales import Scale, scale_stops, similarity_colours
from su3d_bench.reports.item_picture import (
    LOW_HEIGHT,
    PHOTO_WIDTH,
    ZOOM_WIDTH,
    ItemParts,
    Panel,
    compose,
    marked_place,
    png_bytes,
)
from su3d_bench.reports.map_views import DrawnMap, MapView, drawn_map, pale
from su3d_bench.reports.pictures import instance_colours
from su3d_bench.reports.reasoning_picture import project
from su3d_bench.sheets.drafts import Draft
from su3d_bench.sheets.items import SheetKind
from su3d_bench.sheets.run_source import RunSource
from su3d_bench.types import BoolArray, Float64Array, Frame, Instances, UInt8Array

ANSWER_COLOUR, OTHER_COLOUR = (222, 74, 22), (32, 98, 196)  # those of reasoning_picture
PALE_SHARE = 0.3


class Artist:
    """Draws the items of a run, one scene after another; what a scene's items share is made once."""

    def __init__(self, source: RunSource, kind: SheetKind, scale: Scale = "paper") -> None:
        self._source, self._kind, self._scale = source, kind, scale
        self._map = lru_cache(maxsize=len(source.methods))(self._make_map)

    def draw(self, draft: Draft) -> bytes:
        """The PNG of a draft."""
        return png_bytes(self.picture(draft))

    def picture(self, draft: Draft) -> UInt8Array:
        """The picture (h, 960, 3) of a draft."""
        shown = self._map(draft.scene, draft.methods[0])
        members = shown.drawn.members(draft.rows)
        photo, eye = self._photo(draft, shown)
        best = max(shown.corners, key=lambda view: int(view.shows(members).sum()))
        colours = self._colours(draft, shown)
        map_view = Panel(self._map_title(), shown.drawn.paint(best, colours), best.shows(members))
        place_colours = pale(shown.colours, PALE_SHARE)
        place_colours[list(draft.others)] = OTHER_COLOUR
        place_colours[list(draft.rows)] = ANSWER_COLOUR
        above = shown.drawn.paint(shown.above, place_colours)
        eye_xy = None if eye is None else project(shown.above.camera, eye[None])[0]
        ring = marked_place(above, shown.above.shows(members), _inside(eye_xy, above))
        place = Panel("its place, from above" + (" (arrow: from the camera)" if eye is not None else ""), ring)
        scale = scale_stops(self._scale) if draft.similarity is not None else None
        return compose(ItemParts(draft.title, photo, map_view, place, scale))

    def _map_title(self) -> str:
        return {
            "retrieval": "similarity of everything in the map to the text",
            "annotation": "the map around it, the outlined mask in red",
            "reasoning": "the map: red what the answer names, blue what it was held against",
        }[self._kind]

    def _colours(self, draft: Draft, shown: _ShownMap) -> UInt8Array:
        if draft.similarity is not None:
            return similarity_colours(draft.similarity, self._scale)
        colours = pale(shown.colours, 0.45)
        colours[list(draft.others)] = OTHER_COLOUR
        colours[list(draft.rows)] = ANSWER_COLOUR
        return colours

    def _photo(self, draft: Draft, shown: _ShownMap) -> tuple[Panel | None, Float64Array | None]:
        """The frame that shows the object best, and where its camera was."""
        wanted = draft.rows or draft.others
        if not wanted:
            return None, None
        frames = self._source.frames(draft.scene, draft.methods[0])
        is_member = np.zeros(len(shown.instances.points), np.bool_)
        for row in wanted:
            is_member[shown.instances.mask(row)] = True
        points = shown.instances.points[is_member]
        view = best_view(frames, points)
        if view is None:
            return None, None
        frame: Frame = frames[view.frame]
        bounds = np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float64)
        mask = _at_full_size(mask_in_frame(frame, shown.tree, is_member, bounds), frame)
        what = "outlined: what was found" if self._kind == "retrieval" else "outlined: what is spoken of"
        return Panel(what, frame.rgb, mask), frame.camera_to_world[:3, 3]

    def _make_map(self, scene: str, method: str) -> _ShownMap:
        return _ShownMap(self._source.instances(scene, method))


class _ShownMap:
    """A map with its views and the tree of its points."""

    def __init__(self, instances: Instances) -> None:
        from scipy.spatial import KDTree

        self.instances = instances
        self.drawn: DrawnMap = drawn_map(instances)
        above = self.drawn.cameras(ZOOM_WIDTH, LOW_HEIGHT)[0]
        corners = self.drawn.cameras(PHOTO_WIDTH, LOW_HEIGHT)[1:]
        self.above: MapView = self.drawn.view(above)
        self.corners: tuple[MapView, ...] = tuple(self.drawn.view(camera) for camera in corners)
        self.colours = np.array(instance_colours(instances.names), np.uint8).reshape(-1, 3)
        self.tree: Any = KDTree(instances.points, balanced_tree=False, compact_nodes=False)


def _at_full_size(mask: BoolArray, frame: Frame) -> BoolArray:
    """The mask at the size of the colour image, small gaps of the map closed."""
    import cv2

    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    height, width = frame.rgb.shape[:2]
    full: BoolArray = cv2.resize(closed, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return full


def _inside(place: Float64Array | None, picture: UInt8Array) -> Float64Array | None:
    """``place`` where it is in the picture."""
    if place is None or not np.isfinite(place).all():
        return None
    height, width = picture.shape[:2]
    return place if 0 <= place[0] < width and 0 <= place[1] < height else None
