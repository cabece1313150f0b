"""Whether pictures of annotation sheets tell methods apart: items of several methods for the same asked things.

What may tell is cut out: the zone of the answer itself, which is its region in each view, the closer look, the ring and
the arrow, its words. What is left is compared with a picture in which no map has a part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageDraw

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import BoolArray, UInt8Array
from su3d_bench.questions.solver import built_in
from su3d_bench.reports.pictures.canvas import OVERSAMPLING, colour
from su3d_bench.reports.pictures.items import (
    CAPTION,
    LOW_HEIGHT,
    MARGIN,
    MOST_TAGS,
    PHOTO_WIDTH,
    TITLE_LINE,
    TOP_HEIGHT,
    WIDTH,
    ZOOM_WIDTH,
    ItemParts,
    Panel,
    compose,
    draw_tags,
)
from su3d_bench.reports.pictures.maps import MapView, pale
from su3d_bench.sheets.drafts import Draft, annotation_drafts, questions_of, reasoning_drafts, retrieval_drafts
from su3d_bench.sheets.drawing import PLACE_SHARE, ROOM_SHARE, Artist
from su3d_bench.sheets.items import SheetKind
from su3d_bench.sheets.sources import RunSource

LINE = 9  # pixels on either side of a region that its outline takes
TOP = MARGIN + TITLE_LINE + 6  # below a title of one line
LOW = TOP + CAPTION + TOP_HEIGHT + MARGIN
RIGHT = MARGIN + PHOTO_WIDTH + MARGIN
Thing = tuple[str, str]  # scene, and what is asked in it
Drafts = dict[Thing, dict[str, Draft]]  # of each thing the draft of each method


def asked_alike(source: RunSource, encoder: Encoder, kind: SheetKind, per_kind: int, most: int) -> Drafts:
    """At most ``most`` things a scene that are asked of several methods, with what each shows for them.

    In annotation sheets nothing is asked: there a thing is an object of the truth, shown by the largest instance.
    """
    found: Drafts = {}
    for scene in source.scenes:
        of_scene: Drafts = {}
        for thing, draft in _asked(source, scene, encoder, kind, per_kind):
            for method in draft.methods:
                of_scene.setdefault((scene, thing), {}).setdefault(method, draft)
        shared = [(thing, drafts) for thing, drafts in of_scene.items() if len(drafts) > 1]
        # What most methods show something for comes first; of equals the first asked.
        shared.sort(key=lambda one: -sum(bool(draft.rows) for draft in one[1].values()))
        found |= dict(shared[:most])
    return found


def _asked(
    source: RunSource, scene: str, encoder: Encoder, kind: SheetKind, per_kind: int
) -> Iterable[tuple[str, Draft]]:
    """The items of a scene, as sheets have them, and what each is of."""
    if kind == "retrieval":
        source = source.of_methods([method for method in source.methods if source.has_features(scene, method)])
        drafts = retrieval_drafts(source, scene, questions_of(source, scene, None, per_kind), encoder)
        return [(draft.question_id, draft) for draft in drafts]
    source = source.of_methods([method for method in source.methods if source.has_instances(scene, method)])
    if kind == "reasoning":
        drafts = reasoning_drafts(source, scene, None, per_kind, built_in(encoder))
        return [(draft.question_id, draft) for draft in drafts]
    maps = {method: source.instances(scene, method) for method in source.methods}
    rules = source.rules(scene, kind)
    covered = {method: source.covered(scene, rules, instances) for method, instances in maps.items()}
    found = []
    for draft in annotation_drafts(source, scene, sum(map(len, maps.values())), np.random.default_rng(0)):
        of_map = covered[draft.methods[0]]
        assert of_map is not None
        (row,) = draft.rows
        found.append((int(of_map.n_shared[row].max(initial=0)), int(of_map.main_object[row]), draft))
    found.sort(key=lambda one: -one[0])
    return [(str(number), draft) for _, number, draft in found if number > 0]


def untitled(parts: ItemParts) -> UInt8Array:
    """The picture of an item with one empty line of title: its words are the question, or the answer itself."""
    return compose(replace(parts, title=("",)))


class Onlooker:
    """Knows of an artist's rooms how pictures look in which no map has a part."""

    def __init__(self, artist: Artist) -> None:
        self._artist = artist
        self._plain: dict[object, UInt8Array] = {}
        self._corners: dict[int, int] = {}

    def without_answer(self, draft: Draft, parts: ItemParts) -> UInt8Array:
        """The picture as it would be were there no map: the same frame and corner, the same words above the views."""
        room, corner = self._artist.room(draft.scene), self._corner(draft, parts)
        photo, room_photos = parts.photo, tuple(map(id, parts.room))
        key = (
            draft.scene,
            corner,
            photo and (photo.title, id(photo.picture)),
            room_photos,
            parts.room_view.title,
            parts.place.title,
        )
        if key not in self._plain:
            if photo is not None:
                assert any(np.array_equal(photo.picture, frame.rgb) for frame in room.frames)
                photo = Panel(photo.title, photo.picture, np.zeros(photo.picture.shape[:2], np.bool_))
            view = room.corners[corner].shown
            room_view = Panel(parts.room_view.title, colour(view, pale(room.colours, ROOM_SHARE)))
            place = Panel(parts.place.title, colour(room.above.shown, pale(room.colours, PLACE_SHARE)))
            self._plain[key] = compose(ItemParts(("",), photo, room_view, place, parts.room))
        return self._plain[key]

    def zone_of(self, draft: Draft, parts: ItemParts) -> BoolArray:
        """Where (h, w) the picture may show the answer."""
        room = self._artist.room(draft.scene)
        zone = np.zeros((LOW + CAPTION + LOW_HEIGHT + MARGIN, WIDTH), np.bool_)
        if parts.photo is not None and parts.photo.mask is not None:
            zone[TOP : TOP + CAPTION + TOP_HEIGHT, RIGHT : RIGHT + ZOOM_WIDTH] = True
            _put(zone, parts.photo, parts.photo.mask, (MARGIN, TOP), (PHOTO_WIDTH, TOP_HEIGHT))
        member = self._members(draft, (*draft.rows, *draft.others))
        assert room.points.shape == (len(member), 3)
        corner = room.corners[self._corner(draft, parts)]
        _put(zone, parts.room_view, _holds(corner, member), (MARGIN, LOW), (PHOTO_WIDTH, LOW_HEIGHT))
        _put(zone, parts.place, _holds(room.above, member), (RIGHT, LOW), (ZOOM_WIDTH, LOW_HEIGHT))
        return zone

    def _members(self, draft: Draft, rows: Sequence[int]) -> BoolArray:
        room = self._artist.room(draft.scene)
        return room.union([self._artist._region(draft, row) for row in rows]).is_member

    def _corner(self, draft: Draft, parts: ItemParts) -> int:
        """From which corner the room is seen."""
        if id(draft) not in self._corners:
            member = self._members(draft, draft.rows)
            wanted = parts.room_view.mask
            assert wanted is not None
            masks = [view.shows(member) for view in self._artist.room(draft.scene).corners]
            found = next(k for k, mask in enumerate(masks) if np.array_equal(mask, wanted))
            self._corners[id(draft)] = found
        return self._corners[id(draft)]


def _holds(view: MapView, member: BoolArray) -> BoolArray:
    """Which pixels (h, w) of a view have anything of ``member``, be it a quarter of one."""
    fine = np.append(member, False)[view.shown.point]
    height, width = (side // OVERSAMPLING * OVERSAMPLING for side in fine.shape)
    held = np.zeros((height // OVERSAMPLING, width // OVERSAMPLING), np.bool_)
    for down in range(OVERSAMPLING):
        for across in range(OVERSAMPLING):
            held |= fine[down:height:OVERSAMPLING, across:width:OVERSAMPLING]
    return held


def differs(picture: UInt8Array, other: UInt8Array | int) -> BoolArray:
    """Where (h, w) any channel of ``picture`` (h, w, 3) is another."""
    red, green, blue = np.moveaxis(picture != other, 2, 0)
    return np.asarray(red | green | blue, np.bool_)


def _put(zone: BoolArray, panel: Panel, mask: BoolArray, at: tuple[int, int], size: tuple[int, int]) -> None:
    """Mark in ``zone`` what a panel shows of ``mask``, with its outline, ring, arrow and names."""
    height, width = panel.picture.shape[:2]
    scale = min(size[0] / width, size[1] / height)
    inner = max(1, round(width * scale)), max(1, round(height * scale))
    shown: Any = (cv2.resize(mask.astype(np.float32), inner, interpolation=cv2.INTER_LINEAR) > 0).astype(np.uint8)
    shown = cv2.dilate(shown, np.ones((2 * LINE + 1, 2 * LINE + 1), np.uint8))
    if panel.ring is not None:
        middle = (round(panel.ring[0] * inner[0]), round(panel.ring[1] * inner[1]))
        cv2.circle(shown, middle, max(14, round(panel.ring[2] * inner[0])), 1, 10)
        if panel.eye is not None:
            start = (round(panel.eye[0] * inner[0]), round(panel.eye[1] * inner[1]))
            cv2.line(shown, start, middle, 1, 26)
            cv2.circle(shown, start, 9, 1, -1)
    x, y = at[0] + (size[0] - inner[0]) // 2, at[1] + CAPTION + (size[1] - inner[1]) // 2
    zone[y : y + inner[1], x : x + inner[0]] |= shown > 0
    if panel.tags:
        names = Image.fromarray(np.zeros((*zone.shape, 3), np.uint8))  # all of it, for their boxes reach over a border
        draw_tags(ImageDraw.Draw(names), panel.tags[:MOST_TAGS], (x, y), inner)
        zone |= differs(np.asarray(names), 0)


def all_checked(
    artist: Artist, drafts: Drafts, check: Callable[[Draft, UInt8Array, UInt8Array, BoolArray], None]
) -> None:
    """``check`` sees of each draft the picture, the one without a map, and the answer's zone."""
    onlooker = Onlooker(artist)
    # an item of several methods is drawn once
    for draft in {id(one): one for of_method in drafts.values() for one in of_method.values()}.values():
        parts = artist.parts(draft)
        check(draft, untitled(parts), onlooker.without_answer(draft, parts), onlooker.zone_of(draft, parts))
