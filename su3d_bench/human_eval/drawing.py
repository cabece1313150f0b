"""Pictures of drafts (the best frame of the object and its position in the room), and printable figures of a run.

Only the judged part of a map is drawn, since the rest would reveal its method. An instance is transferred to points of
the room with one distance for all maps, so density, noise and completeness of the map are not visible.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NoReturn

import numpy as np

from su3d_bench.core.errors import DataError, printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, UInt8Array
from su3d_bench.human_eval.drafts import Draft
from su3d_bench.human_eval.items import SHEET_KINDS
from su3d_bench.human_eval.sources import RunSource, mask_digest
from su3d_bench.metrics.questions.score import labels_n
from su3d_bench.questions.model import rank_all
from su3d_bench.questions.solver import built_in
from su3d_bench.reports.pictures import items
from su3d_bench.reports.pictures.canvas import ROOM_SURFACES, Scale, class_colours, colour, similarity_colours
from su3d_bench.reports.pictures.figures import Cell, GridRow
from su3d_bench.reports.pictures.items import LOW_HEIGHT, PHOTO_WIDTH, ZOOM_WIDTH, ItemParts, Panel, Tag
from su3d_bench.reports.pictures.maps import DrawnMap, MapView, cameras_of, drawn_map, pale, thinned_rows, view_of
from su3d_bench.reports.pictures.scene import evenly, seen_points
from su3d_bench.runs.executors import Event, Report, run_inline, run_processes

ANSWER_COLOUR, OTHER_COLOUR = (222, 74, 22), (32, 98, 196)  # those of reasoning_picture
SEEN_POINTS = 1_500_000  # of all frames together, before thinning: floors are seen at a low angle
ROOM_SHARE, PLACE_SHARE = 0.75, 0.5  # of the room's colours, so that the judged objects are highlighted
# A map's points may be 5 cm from the surfaces in the frames, and 5 cm apart. Points of neighbours within that reach are
# removed again, except within the width of a drawn point, as a tolerance for noise.
REACH_M, BACK_M = items.CAP_M, 0.035


@dataclass(frozen=True)
class Region:
    """Location of an instance: ``is_member`` (N,) of the room's points; ``points`` (M, 3) are these in world
    coordinates.

    If no frame sees it, ``is_member`` is all false and ``points`` are those of its map.
    """

    is_member: BoolArray
    points: Float32Array

    @property
    def centre(self) -> Float64Array:
        """The centre (3,) of the points; NaN without points."""
        if not len(self.points):
            return np.full(3, np.nan)
        middle: Float64Array = self.points.mean(axis=0, dtype=np.float64)
        return middle


class ShownRoom:
    """A scene in the colours of its frames, from above and from two corners; identical for all methods."""

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

    def region(self, points: Float32Array) -> Region:
        """The region of an instance with these ``points`` (M, 3), independent of their number and order."""
        is_member = np.zeros(len(self.points), np.bool_)
        if len(points) and len(self.points):
            margin = REACH_M + BACK_M
            low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
            near = np.flatnonzero(((self.points >= low) & (self.points <= high)).all(axis=1))
            reached = _within(points, self.points[near], REACH_M)
            kept = ~_within(self.points[near[~reached]], self.points[near[reached]], BACK_M)
            is_member[near[reached][kept]] = True
        return Region(is_member, self.points[is_member] if is_member.any() else points)

    def union(self, regions: Sequence[Region]) -> Region:
        """The union of ``regions``."""
        is_member = np.zeros(len(self.points), np.bool_)
        for region in regions:
            is_member |= region.is_member
        points = np.concatenate([np.zeros((0, 3), np.float32), *(one.points for one in regions)])
        return Region(is_member, self.points[is_member] if is_member.any() else points)

    def photo(self, region: Region) -> tuple[Frame, BoolArray] | None:
        """The frame that shows the region best, and its mask (h, w); None if no frame shows it."""
        if not region.is_member.any():
            return None
        view = items.best_view(self.frames, region.points)
        if view is None:
            return None
        frame = self.frames[view.frame]
        bounds = np.stack([region.points.min(axis=0), region.points.max(axis=0)]).astype(np.float64)
        return frame, at_full_size(items.mask_in_frame(frame, self.tree, region.is_member, bounds), frame.rgb)


def _within(these: Float32Array, of: Float32Array, distance_m: float) -> BoolArray:
    """Whether each point of ``of`` (N, 3) has one of ``these`` within ``distance_m``."""
    from scipy.spatial import KDTree

    if not len(these) or not len(of):
        return np.zeros(len(of), np.bool_)
    tree: Any = KDTree(these, balanced_tree=False, compact_nodes=False)
    distances, _ = tree.query(of, distance_upper_bound=distance_m)
    is_within: BoolArray = np.isfinite(distances)
    return is_within


def at_full_size(mask: BoolArray, rgb: UInt8Array) -> BoolArray:
    """The mask resized to the colour image ``rgb``, with gaps of less than 3 pixels closed."""
    import cv2

    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    height, width = rgb.shape[:2]
    full: BoolArray = cv2.resize(closed, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return full


ROOM_PHOTOS = 6  # photos of the room, for answers that name no object


class Artist:
    """Draw the items of a run scene by scene; data shared by the items of a scene is computed once."""

    def __init__(self, source: RunSource) -> None:
        self._source = source
        self._room: ShownRoom | None = None
        self._regions: dict[bytes, Region] = {}
        self._photos: dict[bytes, tuple[Frame, BoolArray] | None] = {}

    def draw(self, draft: Draft) -> bytes:
        """The JPEG of a draft."""
        return items.jpeg_bytes(items.compose(self.parts(draft)))

    def parts(self, draft: Draft) -> ItemParts:
        """The content of the picture of a draft: only the regions of ``rows`` and ``others`` of its map."""
        room = self.room(draft.scene)
        answer, other = (room.union([self._region(draft, row) for row in rows]) for rows in (draft.rows, draft.others))
        photo, eye = self._photo(draft, room)
        best = max(room.corners, key=lambda view: int(view.shows(answer.is_member).sum()))
        room_view = Panel(
            SHEET_KINDS[draft.kind].room if draft.rows or draft.others else "the room",
            colour(best.shown, _coloured(room, answer, other, ROOM_SHARE)),
            best.shows(answer.is_member),
            self._tags(draft, best),
            line=2,
        )
        ring = _ring(draft, room, answer)
        stands_at = None if eye is None else _inside(room.above.project(eye[None])[0])
        has_arrow = ring is not None and stands_at is not None
        place = Panel(
            ("position, from above" if draft.rows else "from above")
            + (" (arrow: from the camera)" if has_arrow else ""),
            colour(room.above.shown, _coloured(room, answer, other, PLACE_SHARE)),
            tags=self._tags(draft, room.above),
            ring=ring,
            eye=stands_at,
        )
        photos = self._room_photos(draft) if photo is None else ()
        return ItemParts(draft.title, photo, room_view, place, photos)

    def room(self, scene: str) -> ShownRoom:
        """The scene as seen in its frames."""
        if self._room is None or self._room.scene != scene:
            self._room = ShownRoom(scene, self._source.frames(scene))
            self._regions.clear()
            self._photos.clear()
        return self._room

    def _region(self, draft: Draft, row: int) -> Region:
        """The region of an instance of the draft's map; equal masks share one region."""
        instances = self._map(draft)
        key = mask_digest(instances, (row,))
        if key not in self._regions:
            self._regions[key] = self.room(draft.scene).region(instances.points[instances.mask(row)])
        return self._regions[key]

    def _map(self, draft: Draft) -> Instances:
        """The map whose rows a draft names."""
        if draft.points is not None:
            return Instances.of(draft.points, [np.arange(len(draft.points))])
        return self._source.instances(draft.scene, draft.methods[0])

    def _room_photos(self, draft: Draft) -> tuple[UInt8Array, ...]:
        """Frames spread over the sequence, for answers without objects to outline."""
        if draft.rows:
            return ()
        frames = self._source.frames(draft.scene)
        return tuple(frames[k].rgb for k in evenly(len(frames), ROOM_PHOTOS))

    def _photo(self, draft: Draft, room: ShownRoom) -> tuple[Panel | None, Float64Array | None]:
        """The frame that shows the object best, and its camera position."""
        wanted = draft.rows or draft.others
        if not wanted:
            return None, None
        key = mask_digest(self._map(draft), wanted)
        if key not in self._photos:
            self._photos[key] = room.photo(room.union([self._region(draft, row) for row in wanted]))
        shown = self._photos[key]
        if shown is None:
            return None, None
        frame, mask = shown
        title = SHEET_KINDS[draft.kind].outlined if draft.rows else "reference objects"
        return Panel(f"outlined: {title}", frame.rgb, mask), frame.camera_to_world[:3, 3]

    def _tags(self, draft: Draft, view: MapView) -> tuple[Tag, ...]:
        """The names of the objects in an answer, at their positions."""
        if not draft.names:
            return ()
        rows = tuple(dict.fromkeys((*draft.rows, *draft.others)))
        places = np.array([self._region(draft, row).centre for row in rows]).reshape(-1, 3)
        shades = [ANSWER_COLOUR if row in draft.rows else OTHER_COLOUR for row in rows]
        return tags_at(places, view, [draft.names[row] for row in rows], shades)


def _coloured(room: ShownRoom, answer: Region, other: Region, share: float) -> UInt8Array:
    """The colours of the room's points; judged and reference objects are highlighted."""
    colours = pale(room.colours, share)
    colours[other.is_member] = OTHER_COLOUR
    colours[answer.is_member] = ANSWER_COLOUR
    return colours


def tags_at(
    places: Float64Array, view: MapView, names: Sequence[str], shades: Sequence[tuple[int, int, int]]
) -> tuple[Tag, ...]:
    """A name at each of ``places`` (N, 3) in front of the camera."""
    return tuple(
        Tag(name, float(x), float(y), shade)
        for name, shade, (x, y) in zip(names, shades, view.project(places), strict=True)
        if np.isfinite([x, y]).all()
    )


def _ring(draft: Draft, room: ShownRoom, answer: Region) -> tuple[float, float, float] | None:
    """A circle around the outlined object, from above; none for several objects, which have names."""
    if len(draft.rows) != 1 or draft.names or not len(answer.points):
        return None
    low, high = room.above.project(np.percentile(answer.points, [2, 98], axis=0).astype(np.float64))
    x, y = (low + high) / 2
    return float(x), float(y), float(0.6 * np.abs(high - low).max())


def _inside(place: Float64Array) -> tuple[float, float] | None:
    """``place`` in pixel coordinates."""
    x, y = float(place[0]), float(place[1])
    return (x, y) if 0 <= x <= 1 and 0 <= y <= 1 else None


Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SceneDrafts:
    """The work of one process: the drafts of one scene by index."""

    opener: Callable[[], RunSource]
    drafts: Mapping[int, Draft]


def draw_all(
    source: RunSource,
    drafts: Sequence[Draft],
    jobs: int,
    progress: Progress = lambda n_done, n: None,
) -> list[bytes]:
    """The pictures of ``drafts`` in order, ``jobs`` scenes in parallel; the bytes do not depend on ``jobs``."""
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
    """The JPEG of each draft of one scene by index."""
    artist = Artist(unit.opener())
    pictures = {}
    for place, draft in unit.drafts.items():
        pictures[place] = artist.draw(draft)
        report(Event(draft.scene, "pictures", len(pictures), len(unit.drafts)))
    return pictures


def _lost(unit: SceneDrafts, how: str) -> NoReturn:
    scene = next(iter(unit.drafts.values())).scene
    raise DataError(f"{scene}: the drawing process {how}; try --jobs 1")


CELL_WIDTH, CELL_HEIGHT = 720, 500  # pixels of one picture
SMALLER = 4  # downscaling factor of the views used to choose the corner
UNSEEN = 225
Labels = Sequence[str]


class Figures:
    """Rows and columns of a figure; maps and views are computed once per scene."""

    def __init__(
        self, source: RunSource, *, with_photo: bool = False, view: Literal["corner", "above"] = "corner"
    ) -> None:
        self._source, self._with_photo, self._view = source, with_photo, view

    @property
    def columns(self) -> list[str]:
        """Column titles of the similarity and reasoning figures."""
        return [*(["the scene"] if self._with_photo else []), *self._source.methods]

    def similarity(self, texts: Sequence[str], encoder: Encoder, scale: Scale) -> list[GridRow]:
        """One row per scene and text, one column per method; instances are coloured by similarity."""
        rows = []
        for scene in self._source.scenes:
            maps = self._maps(scene)
            ranked = [rank_all(shown.instances, texts, encoder) for shown in maps]
            for k, text in enumerate(texts):
                best = [ranking[k].order[:1].tolist() for ranking in ranked]
                views = self._views(maps, best[0])
                cells = self._photo(scene, maps[0], views[0])
                for shown, view, ranking in zip(maps, views, ranked, strict=True):
                    cells.append(Cell(shown.paint(view, similarity_colours(ranking[k].similarity, scale))))
                rows.append(GridRow(f'"{printable(text, 90)}"', scene, tuple(cells)))
        return rows

    def labels(self) -> tuple[list[str], list[GridRow]]:
        """Column titles, and one row per scene: the map of each method by label n and by label n'."""
        titles = [f"{method}: label {what}" for method in self._source.methods for what in ("n", "n'")]
        titles = [*(["the scene"] if self._with_photo else []), *titles]
        rows = []
        for scene in self._source.scenes:
            maps = self._maps(scene)
            views = self._views(maps, [])
            cells = self._photo(scene, maps[0], views[0])
            for method, shown, view in zip(self._source.methods, maps, views, strict=True):
                own: Labels = labels_n(shown.instances)
                refined = self._source.refined(scene, method)
                both = [own, own if refined is None else np.where(refined.is_kept, refined.names, "").tolist()]
                palette = class_colours(list(dict.fromkeys(name for names in both for name in names if name)))
                palette[""] = (UNSEEN, UNSEEN, UNSEEN)  # without a name, or excluded under label n'
                for names in both:
                    colours = np.array([palette[name] for name in names], np.uint8).reshape(-1, 3)
                    cells.append(Cell(shown.paint(view, colours), _name_tags(shown, view, names, colours)))
            rows.append(GridRow(scene, "", tuple(cells)))
        return titles, rows

    def reasoning(self, questions: Sequence[str], encoder: Encoder | None) -> list[GridRow]:
        """One row per scene and question, one column per method: answer objects and reference objects."""
        rows = []
        for scene in self._source.scenes:
            maps = self._maps(scene)
            for question in questions:
                cells, views = [], self._views(maps, [])
                for k, (method, shown) in enumerate(zip(self._source.methods, maps, strict=True)):
                    a_map = self._source.scene_map(scene, method)
                    answer = built_in(encoder)(a_map, [question])[0]
                    row_of = {thing.id: thing.row for thing in a_map.objects}
                    rows_of = [[row_of[number] for number in ids] for ids in (answer.object_ids, answer.reference_ids)]
                    view = self._views([shown], [*rows_of[0], *rows_of[1]])[0]
                    views[k] = view
                    names = {thing.row: thing.shown for thing in a_map.objects}
                    cells.append(replace(_answer_cell(shown, view, rows_of, names), caption=answer.text))
                cells = [*self._photo(scene, maps[0], views[0]), *cells]
                rows.append(GridRow(printable(question, 160), scene, tuple(cells)))
        return rows

    def _maps(self, scene: str) -> list[DrawnMap]:
        return [drawn_map(self._source.instances(scene, method)) for method in self._source.methods]

    def _views(self, maps: Sequence[DrawnMap], wanted: Sequence[int]) -> list[MapView]:
        """One camera for all ``maps``, chosen for the first: from above, or the corner showing most of ``wanted``."""
        first = maps[0]
        place = 0
        if self._view == "corner":
            members = first.members(wanted)
            small = [first.view(camera) for camera in first.cameras(CELL_WIDTH // SMALLER, CELL_HEIGHT // SMALLER)[1:]]
            place = 1 + int(np.argmax([view.shows(members).sum() for view in small]))
        camera = first.cameras(CELL_WIDTH, CELL_HEIGHT)[place]
        chosen = first.view(camera)
        return [chosen, *(MapView(camera, other.view(camera).view, chosen.box) for other in maps[1:])]

    def _photo(self, scene: str, shown: DrawnMap, view: MapView) -> list[Cell]:
        """The map in the colours of the frames, if requested."""
        if not self._with_photo:
            return []
        frames = self._source.frames(scene)
        return [Cell(shown.paint_points(view, seen_colours(frames, shown.instances.points[shown.rows])))]


def seen_colours(frames: Sequence[Frame], points: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> UInt8Array:
    """The colour (N, 3) of each point in the last frame that sees it; grey if none does."""
    colours = np.full((len(points), 3), UNSEEN, np.uint8)
    places: Float64Array = points.astype(np.float64)
    for frame in frames:
        columns, rows, is_seen = items.seen_in(frame, places)
        colours[is_seen] = frame.rgb[rows[is_seen].astype(np.int64), columns[is_seen].astype(np.int64)]
    return colours


def _answer_cell(shown: DrawnMap, view: MapView, rows_of: Sequence[Sequence[int]], names: dict[int, str]) -> Cell:
    instances = shown.instances
    colours = pale(np.array([(150, 150, 150)] * len(instances), np.uint8).reshape(-1, 3), 0.4)
    tags = []
    for rows, shade in ((rows_of[1], OTHER_COLOUR), (rows_of[0], ANSWER_COLOUR)):
        colours[list(rows)] = shade
        tags += _tags_of(instances, view, rows, [names[row] for row in rows], [shade] * len(rows))
    return Cell(shown.paint(view, colours), tuple(reversed(tags)))


def _name_tags(shown: DrawnMap, view: MapView, names: Labels, colours: UInt8Array) -> tuple[Tag, ...]:
    """The names of the largest visible objects, without walls, floors and ceilings."""
    sizes = shown.instances.sizes
    seen = set(shown.owner[view.view.point[view.view.point >= 0]].tolist())
    largest = [int(k) for k in np.argsort(-sizes, kind="stable") if int(k) in seen]
    rows = [k for k in largest if names[k] and names[k] not in ROOM_SURFACES]
    shades = [(int(red), int(green), int(blue)) for red, green, blue in colours[rows]]
    return tuple(_tags_of(shown.instances, view, rows, [names[row] for row in rows], shades))


def _tags_of(
    instances: Instances, view: MapView, rows: Sequence[int], names: Labels, shades: Sequence[tuple[int, int, int]]
) -> list[Tag]:
    places = instances.centroids[list(rows)].astype(np.float64).reshape(-1, 3)
    tags = tags_at(places, view, names, shades)
    return [tag for tag in tags if 0 < tag.x < 1 and 0 < tag.y < 1]
