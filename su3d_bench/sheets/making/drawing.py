"""Drafts as pictures: the best frame of the object, and its place in the room as the frames saw it.

Of a map nothing is drawn but what is judged: the rest of it would give its method away.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn, Protocol

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray, Float64Array, Frame, UInt8Array
from su3d_bench.reports.pictures.items import (
    CAP_M,
    LOW_HEIGHT,
    PHOTO_WIDTH,
    ZOOM_WIDTH,
    ItemParts,
    Panel,
    Tag,
    best_view,
    compose,
    mask_in_frame,
    png_bytes,
)
from su3d_bench.reports.pictures.map_views import MapView, cameras_of, pale, view_of
from su3d_bench.reports.pictures.maps import thinned_rows
from su3d_bench.reports.pictures.render import colour
from su3d_bench.reports.pictures.scene_look import seen_points
from su3d_bench.runs.executors.local import Event, Report, run_inline, run_processes
from su3d_bench.sheets.items import SheetKind
from su3d_bench.sheets.making.drafts import Draft
from su3d_bench.sheets.making.run_source import mask_digest

ANSWER_COLOUR, OTHER_COLOUR = (222, 74, 22), (32, 98, 196)  # those of reasoning_picture
SEEN_POINTS = 1_500_000  # of all frames together, before they are thinned: floors are seen at a low angle
ROOM_SHARE, PLACE_SHARE = 0.75, 0.5  # of the room's colours, so that what is judged stands out
ROOM_PHOTOS = 6  # of the room, for answers that name nothing
ROOM_TITLES: Mapping[SheetKind, str] = {
    "retrieval": "the room, what was found in red",
    "annotation": "the room, the mask in red",
    "reasoning": "the room: red what the answer names, blue what it was held against",
    "questions": "the room: red what the answer names, blue what it was held against",
}
OUTLINED: Mapping[SheetKind, str] = {
    "retrieval": "what was found",
    "annotation": "the mask",
    "reasoning": "what the answer names",
    "questions": "what the answer names",
}


class PictureSource(Protocol):
    """Maps and frames of scenes; ``opener`` opens the same in another process."""

    @property
    def opener(self) -> Callable[[], PictureSource]: ...

    @property
    def instances(self) -> Callable[[str, str], Instances]: ...

    def frames(self, scene: str) -> Sequence[Frame]: ...


class Artist:
    """Draws the items of a run, one scene after another; what a scene's items share is made once."""

    def __init__(self, source: PictureSource) -> None:
        self._source = source
        self._maps: dict[bytes, _ShownMap] = {}

    def draw(self, draft: Draft) -> bytes:
        """The PNG of a draft."""
        return png_bytes(self.picture(draft))

    def picture(self, draft: Draft) -> UInt8Array:
        """The picture (h, 960, 3) of a draft."""
        shown = self._map(draft.scene, draft.methods[0])
        room, members = shown.room, shown.members(draft.rows)
        photo, eye = self._photo(draft, shown)
        best = max(room.corners, key=lambda view: int(view.shows(members).sum()))
        room_view = Panel(
            ROOM_TITLES[draft.kind] if draft.rows or draft.others else "the room",
            colour(best.shown, _coloured(draft, shown, ROOM_SHARE)),
            best.shows(members),
            _tags(draft, shown.instances, best),
            line=2,
        )
        place = Panel(
            ("its place, from above" if draft.rows else "from above")
            + (" (arrow: from the camera)" if eye is not None and draft.rows else ""),
            colour(room.above.shown, _coloured(draft, shown, PLACE_SHARE)),
            tags=_tags(draft, shown.instances, room.above),
            ring=_ring(draft, shown),
            eye=None if eye is None else _inside(room.above.project(eye[None])[0]),
        )
        photos = self._room_photos(draft) if photo is None else ()
        return compose(ItemParts(draft.title, photo, room_view, place, photos))

    def _room_photos(self, draft: Draft) -> tuple[UInt8Array, ...]:
        """Some of the frames, spread over the walk, where an answer names nothing that could be outlined."""
        if draft.rows:
            return ()
        frames = self._source.frames(draft.scene)
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(ROOM_PHOTOS, len(frames))).astype(np.int64))
        return tuple(frames[k].rgb for k in chosen)

    def _photo(self, draft: Draft, shown: _ShownMap) -> tuple[Panel | None, Float64Array | None]:
        """The frame that shows the object best, and where its camera was."""
        wanted = draft.rows or draft.others
        if not wanted:
            return None, None
        photo = shown.photo(wanted, self._source.frames(draft.scene))
        if photo is None:
            return None, None
        title = OUTLINED[draft.kind] if draft.rows else "what the answer was held against"
        return Panel(f"outlined: {title}", photo.frame.rgb, photo.mask), photo.frame.camera_to_world[:3, 3]

    def _map(self, scene: str, method: str) -> _ShownMap:
        """What is shown of a map; that of another method where it has the same masks."""
        instances = self._source.instances(scene, method)
        key = mask_digest(instances, range(len(instances)))
        if key not in self._maps:
            if any(scene != known.room.scene for known in self._maps.values()):
                self._maps.clear()
            rooms = [known.room for known in self._maps.values()]
            self._maps[key] = _ShownMap(rooms[0] if rooms else _Room(scene, self._source.frames(scene)), instances)
        return self._maps[key]


@dataclass(frozen=True)
class _Photo:
    """A frame and where it shows what is outlined (h, w)."""

    frame: Frame
    mask: BoolArray


class _Room:
    """A scene in the colours that its frames saw, from above and from two corners: the same for every method."""

    def __init__(self, scene: str, frames: Sequence[Frame]) -> None:
        self.scene = scene
        seen, rgb = seen_points(frames, SEEN_POINTS)
        rows = thinned_rows(seen)
        self.points, self.colours = seen[rows], rgb[rows]
        self.above: MapView = view_of(self.points, cameras_of(self.points, ZOOM_WIDTH, LOW_HEIGHT)[0])
        corners = cameras_of(self.points, PHOTO_WIDTH, LOW_HEIGHT)[1:]
        self.corners: tuple[MapView, ...] = tuple(view_of(self.points, camera) for camera in corners)


class _ShownMap:
    """A map within its room, and the tree of its points."""

    def __init__(self, room: _Room, instances: Instances) -> None:
        from scipy.spatial import KDTree

        self.room, self.instances = room, instances
        self._tree: Any = KDTree(instances.points, balanced_tree=False, compact_nodes=False)
        _, self._nearest = self._tree.query(room.points, distance_upper_bound=CAP_M)
        self._photos: dict[tuple[tuple[int, ...], tuple[int, ...]], _Photo | None] = {}

    def members(self, rows: Sequence[int]) -> BoolArray:
        """Which points of the room lie at these instances."""
        is_member = np.zeros(len(self.instances.points) + 1, np.bool_)  # the last: near no point of the map
        for row in rows:
            is_member[self.instances.mask(row)] = True
        members: BoolArray = is_member[self._nearest]
        return members

    def photo(self, rows: tuple[int, ...], frames: Sequence[Frame]) -> _Photo | None:
        """The best of ``frames`` to see these instances in, found once; None where none shows them."""
        key = rows, tuple(frame.index for frame in frames)
        if key not in self._photos:
            self._photos[key] = self._best_photo(rows, frames)
        return self._photos[key]

    def _best_photo(self, rows: tuple[int, ...], frames: Sequence[Frame]) -> _Photo | None:
        is_member = np.zeros(len(self.instances.points), np.bool_)
        for row in rows:
            is_member[self.instances.mask(row)] = True
        points = self.instances.points[is_member]
        view = best_view(frames, points)
        if view is None:
            return None
        frame = frames[view.frame]
        bounds = np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float64)
        return _Photo(frame, at_full_size(mask_in_frame(frame, self._tree, is_member, bounds), frame.rgb))


def _coloured(draft: Draft, shown: _ShownMap, share: float) -> UInt8Array:
    """The colours of the room's points, what is judged and what it was held against in strong ones."""
    colours = pale(shown.room.colours, share)
    colours[shown.members(draft.others)] = OTHER_COLOUR
    colours[shown.members(draft.rows)] = ANSWER_COLOUR
    return colours


def _tags(draft: Draft, instances: Instances, view: MapView) -> tuple[Tag, ...]:
    """The names of what an answer speaks of, where it is."""
    if not draft.names:
        return ()
    rows = tuple(dict.fromkeys((*draft.rows, *draft.others)))
    shades = [ANSWER_COLOUR if row in draft.rows else OTHER_COLOUR for row in rows]
    return tags_of(instances, view, rows, [draft.names[row] for row in rows], shades)


def tags_of(
    instances: Instances,
    view: MapView,
    rows: Sequence[int],
    names: Sequence[str],
    shades: Sequence[tuple[int, int, int]],
) -> tuple[Tag, ...]:
    """A name at the middle of each of ``rows``, as far as it lies before the camera."""
    places = view.project(instances.centroids[list(rows)].astype(np.float64).reshape(-1, 3))
    return tuple(
        Tag(name, float(x), float(y), shade)
        for name, shade, (x, y) in zip(names, shades, places, strict=True)
        if np.isfinite([x, y]).all()
    )


def _ring(draft: Draft, shown: _ShownMap) -> tuple[float, float, float] | None:
    """Around what is outlined, from above; none around several things, which have names."""
    if len(draft.rows) != 1 or draft.names:
        return None
    points = shown.instances.points[shown.instances.mask(draft.rows[0])]
    if not len(points):
        return None
    low, high = shown.room.above.project(np.percentile(points, [2, 98], axis=0).astype(np.float64))
    x, y = (low + high) / 2
    return float(x), float(y), float(0.6 * np.abs(high - low).max())


def at_full_size(mask: BoolArray, rgb: UInt8Array, gap: int = 3) -> BoolArray:
    """The mask at the size of the colour image ``rgb``, gaps of less than ``gap`` of its pixels closed."""
    import cv2

    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((gap, gap), np.uint8))
    height, width = rgb.shape[:2]
    full: BoolArray = cv2.resize(closed, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return full


def _inside(place: Float64Array) -> tuple[float, float] | None:
    """``place`` where it is in the picture."""
    x, y = float(place[0]), float(place[1])
    return (x, y) if 0 <= x <= 1 and 0 <= y <= 1 else None


Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SceneDrafts:
    """What one process draws: the drafts of one scene by their places among all."""

    opener: Callable[[], PictureSource]
    drafts: Mapping[int, Draft]


def draw_all(
    source: PictureSource,
    drafts: Sequence[Draft],
    jobs: int,
    progress: Progress = lambda n_done, n: None,
) -> list[bytes]:
    """The pictures of ``drafts`` in their order, ``jobs`` scenes at once; the same bytes whatever their number."""
    units = []
    for scene in dict.fromkeys(draft.scene for draft in drafts):
        mine = {k: draft for k, draft in enumerate(drafts) if draft.scene == scene}
        units.append(SceneDrafts(source.opener, mine))
    n_done = 0

    def report(event: Event) -> None:
        nonlocal n_done
        n_done += 1
        progress(n_done, len(drafts))

    if jobs == 1 or len(units) == 1:
        scenes = run_inline(draw_scene, units, report)
    else:
        scenes = run_processes(draw_scene, units, report, jobs=jobs, lost=_lost)
    pictures: dict[int, bytes] = {}
    for drawn in scenes:
        pictures |= drawn
    return [pictures[k] for k in range(len(drafts))]


def draw_scene(unit: SceneDrafts, report: Report) -> dict[int, bytes]:
    """The PNG of each draft of one scene by its place."""
    artist = Artist(unit.opener())
    pictures = {}
    for place, draft in unit.drafts.items():
        pictures[place] = artist.draw(draft)
        report(Event(draft.scene, "pictures", len(pictures), len(unit.drafts)))
    return pictures


def _lost(unit: SceneDrafts, how: str) -> NoReturn:
    scene = next(iter(unit.drafts.values())).scene
    raise DataError(f"{scene}: the process that drew its pictures {how}; try --jobs 1")
