"""Whether pictures of annotation sheets tell methods apart: items of several methods for the same asked things.

What may tell is cut out: the zone of the answer itself, which is its region in each view, the closer look, the ring and
the arrow, its words. What is left is held against a picture in which no map has a part, and put before a classifier.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageDraw
from threadpoolctl import threadpool_limits

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import BoolArray, Float64Array, UInt8Array
from su3d_bench.numerics.statistics import holm
from su3d_bench.questions.language_solver import built_in
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
from su3d_bench.reports.pictures.map_views import MapView, pale
from su3d_bench.reports.pictures.render import OVERSAMPLING, colour
from su3d_bench.sheets.items import SheetKind
from su3d_bench.sheets.making.drafts import (
    Draft,
    annotation_drafts,
    questions_of,
    reasoning_drafts,
    retrieval_drafts,
)
from su3d_bench.sheets.making.drawing import Artist
from su3d_bench.sheets.making.run_source import RunSource
from su3d_bench.sheets.making.shown_room import PLACE_SHARE, ROOM_SHARE

SMALLER = 4  # times, of the pictures that are compared
LINE = 9  # pixels on either side of a region that its outline takes
ALPHA = 0.05
TOP = MARGIN + TITLE_LINE + 6  # below a title of one line
LOW = TOP + CAPTION + TOP_HEIGHT + MARGIN
RIGHT = MARGIN + PHOTO_WIDTH + MARGIN
Thing = tuple[str, str]  # scene, and what is asked in it
Drafts = dict[Thing, dict[str, Draft]]  # of each thing the draft of each method


@dataclass(frozen=True)
class Look:
    """A picture (h, w, 3) without its title, and the zone (h, w) of the answer, both made ``SMALLER``."""

    picture: UInt8Array
    zone: BoolArray


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


def look_at(picture: UInt8Array, zone: BoolArray) -> Look:
    """Both at a fraction of their size; a pixel that holds any of the zone is of it."""
    size = picture.shape[1] // SMALLER, picture.shape[0] // SMALLER
    cut = tuple(slice(SMALLER * side) for side in size[::-1])
    small: Any = cv2.resize(picture[cut], size, interpolation=cv2.INTER_AREA)
    share: Any = cv2.resize(np.ascontiguousarray(zone[cut]).view(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)
    return Look(small, share > 0)  # of 16 pixels one is still 16 of 255


def features_of(look: Look, zone: BoolArray) -> Float64Array:
    """What a classifier is shown of a picture outside ``zone``: the picture made small, colours, edges, file size."""
    left = ~zone
    picture = look.picture * left[:, :, None]
    grey = picture.astype(np.float32) @ np.full(3, 1 / 3, np.float32)
    small: Any = cv2.resize(grey, (30, 26), interpolation=cv2.INTER_AREA)
    seen = picture[left]
    red, green, blue = (seen >> 6).T
    colours = np.bincount(16 * red + 4 * green + blue, minlength=64) / max(1, len(seen))
    both = left[1:, 1:] & left[:-1, 1:] & left[1:, :-1]
    down, across = (np.abs(np.diff(grey, axis=axis))[: len(grey) - 1, : grey.shape[1] - 1] for axis in (0, 1))
    edges = [float(one[both].mean()) for one in (down, across)] + [
        float((one[both] > 20).mean()) for one in (down, across)
    ]
    means = seen.mean(axis=0)
    return np.concatenate([small.ravel(), colours, edges, means, [len(zlib.compress(picture.tobytes(), 1))]])


def p_of_telling(pairs: Sequence[tuple[str, Look, Look]]) -> float | None:
    """How probable it is by chance to tell two methods apart as well as a logistic regression does; None untested.

    ``pairs``: scene, and the looks of both methods at one asked thing. Trained on every other scene, the model says
    which of the two is which: were they exchangeable, each pair of a scene would be a toss. The least p of the scenes,
    corrected for their number. What both methods share tells nothing and is left out.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    unlike = [(scene, a, b, a.zone | b.zone) for scene, a, b in pairs if a is not b]
    shown = [(scene, features_of(a, zone), features_of(b, zone)) for scene, a, b, zone in unlike]
    scenes, found = sorted({scene for scene, *_ in shown}), []
    for held_out in scenes:
        train = [(a, b) for scene, a, b in shown if scene != held_out]
        test = [(a, b) for scene, a, b in shown if scene == held_out and not np.array_equal(a, b)]
        if not train or not test:
            continue
        model = make_pipeline(StandardScaler(), LogisticRegression(C=0.1, max_iter=500))
        with threadpool_limits(1):  # so few rows: threads would only wait for each other
            model.fit(np.array([one for pair in train for one in pair]), [0, 1] * len(train))
        lead = model.decision_function([b for _, b in test]) - model.decision_function([a for a, _ in test])
        found.append(_p_of_tosses(int((lead > 0).sum()), len(test)))
    return min(1.0, len(found) * min(found)) if found else None


def _p_of_tosses(n_right: int, n: int) -> float:
    """Of so many tosses so many heads or more."""
    from scipy.stats import binom

    return float(binom.sf(n_right - 1, n, 0.5))


Looks = Mapping[Thing, Mapping[str, Look]]


def pairs_of(looks: Looks, one: str, other: str) -> list[tuple[str, Look, Look]]:
    """What both methods show for the same asked things."""
    return [(thing[0], shown[one], shown[other]) for thing, shown in looks.items() if {one, other} <= shown.keys()]


def methods_in(looks: Looks) -> list[str]:
    """The methods of which something is shown."""
    return sorted({method for shown in looks.values() for method in shown})


def told_apart(looks_of: Mapping[str, Looks]) -> dict[tuple[str, str, str], float | None]:
    """For each kind and pair of its methods Holm's p that the pictures are no better told apart than by chance."""
    names = [(kind, *pair) for kind, looks in looks_of.items() for pair in combinations(methods_in(looks), 2)]
    raw = [p_of_telling(pairs_of(looks_of[kind], one, other)) for kind, one, other in names]
    return dict(zip(names, holm(raw), strict=True))


def all_looks(
    artist: Artist, drafts: Drafts, check: Callable[[Draft, UInt8Array, UInt8Array, BoolArray], None]
) -> Looks:
    """The looks of all drafts; ``check`` sees of each the picture, the one without a map, and the answer's zone."""
    looks: dict[Thing, dict[str, Look]] = {}
    drawn: dict[int, Look] = {}  # an item of several methods is drawn once
    onlooker = Onlooker(artist)
    for thing, of_method in drafts.items():
        for method, draft in of_method.items():
            if id(draft) not in drawn:
                parts = artist.parts(draft)
                picture, zone = untitled(parts), onlooker.zone_of(draft, parts)
                check(draft, picture, onlooker.without_answer(draft, parts), zone)
                drawn[id(draft)] = look_at(picture, zone)
            looks.setdefault(thing, {})[method] = drawn[id(draft)]
    return looks
