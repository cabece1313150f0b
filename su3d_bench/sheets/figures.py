"""The figures of the paper from a run: similarity to texts, maps by label n and n', answers with their objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array, Frame, UInt8Array
from su3d_bench.metrics.questions.score import labels_n
from su3d_bench.questions.model import rank_all
from su3d_bench.questions.solver import built_in
from su3d_bench.reports.pictures.canvas import ROOM_SURFACES, Scale, class_colours, similarity_colours
from su3d_bench.reports.pictures.figures import Cell, GridRow
from su3d_bench.reports.pictures.items import Tag, seen_in
from su3d_bench.reports.pictures.maps import DrawnMap, MapView, drawn_map, pale
from su3d_bench.sheets.drawing import ANSWER_COLOUR, OTHER_COLOUR, tags_at
from su3d_bench.sheets.sources import RunSource

CELL_WIDTH, CELL_HEIGHT = 720, 500  # pixels of one picture
SMALLER = 4  # times, of the views in which the corner is chosen
UNSEEN = 225
Labels = Sequence[str]


class Figures:
    """Rows and columns of a figure; maps and views are made once for each scene."""

    def __init__(
        self, source: RunSource, *, with_photo: bool = False, view: Literal["corner", "above"] = "corner"
    ) -> None:
        self._source, self._with_photo, self._view = source, with_photo, view

    @property
    def columns(self) -> list[str]:
        """Titles of the columns of similarity and reasoning."""
        return [*(["the scene"] if self._with_photo else []), *self._source.methods]

    def similarity(self, texts: Sequence[str], encoder: Encoder, scale: Scale) -> list[GridRow]:
        """A row a scene and text: each instance in the colour of its similarity, a column a method."""
        rows = []
        for scene in self._source.scenes:
            maps = self._maps(scene)
            ranked = [rank_all(shown.instances, texts, encoder) for shown in maps]
            for k, text in enumerate(texts):
                best = [ranking[k].order[:1].tolist() for ranking in ranked]
                views = self._views(maps, best[0])
                cells = [
                    Cell(shown.paint(view, similarity_colours(ranking[k].similarity, scale)))
                    for shown, view, ranking in zip(maps, views, ranked, strict=True)
                ]
                rows.append(
                    GridRow(f'"{printable(text, 90)}"', scene, (*self._photo(scene, maps[0], views[0]), *cells))
                )
        return rows

    def labels(self) -> tuple[list[str], list[GridRow]]:
        """Titles of the columns, and a row a scene: the map by label n and by label n' of each method."""
        titles = [*(["the scene"] if self._with_photo else [])]
        titles += [f"{method}: label {what}" for method in self._source.methods for what in ("n", "n'")]
        rows = []
        for scene in self._source.scenes:
            maps = self._maps(scene)
            views = self._views(maps, [])
            cells: list[Cell] = []
            for method, shown, view in zip(self._source.methods, maps, views, strict=True):
                own: Labels = labels_n(shown.instances)
                refined = self._source.refined(scene, method)
                both = [own, own if refined is None else np.where(refined.is_kept, refined.names, "").tolist()]
                palette = class_colours(list(dict.fromkeys(name for names in both for name in names if name)))
                palette[""] = (UNSEEN, UNSEEN, UNSEEN)  # without a name, or left out under label n'
                for names in both:
                    colours = np.array([palette[name] for name in names], np.uint8).reshape(-1, 3)
                    cells.append(Cell(shown.paint(view, colours), _name_tags(shown, view, names, colours)))
            rows.append(GridRow(scene, "", (*self._photo(scene, maps[0], views[0]), *cells)))
        return titles, rows

    def reasoning(self, questions: Sequence[str], encoder: Encoder | None) -> list[GridRow]:
        """A row a scene and question, a column a method: what its answer names, and what that was held against."""
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
                photo = self._photo(scene, maps[0], views[0])
                rows.append(GridRow(printable(question, 160), scene, (*photo, *cells)))
        return rows

    def _maps(self, scene: str) -> list[DrawnMap]:
        return [drawn_map(self._source.instances(scene, method)) for method in self._source.methods]

    def _views(self, maps: Sequence[DrawnMap], wanted: Sequence[int]) -> list[MapView]:
        """One camera for all ``maps``, chosen in the first: from above, or the corner that shows most of ``wanted``."""
        first = maps[0]
        place = 0
        if self._view == "corner":
            members = first.members(wanted)
            small = [first.view(camera) for camera in first.cameras(CELL_WIDTH // SMALLER, CELL_HEIGHT // SMALLER)[1:]]
            place = 1 + int(np.argmax([view.shows(members).sum() for view in small]))
        camera = first.cameras(CELL_WIDTH, CELL_HEIGHT)[place]
        chosen = first.view(camera)
        return [chosen, *(MapView(camera, other.view(camera).view, chosen.box) for other in maps[1:])]

    def _photo(self, scene: str, shown: DrawnMap, view: MapView) -> tuple[Cell, ...]:
        """The map in the colours that the frames saw, where it is asked for."""
        if not self._with_photo:
            return ()
        frames = self._source.frames(scene)
        return (Cell(shown.paint_points(view, seen_colours(frames, shown.instances.points[shown.rows]))),)


def seen_colours(frames: Sequence[Frame], points: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> UInt8Array:
    """The colour (N, 3) of each point in the last frame that sees it; grey where none does."""
    colours = np.full((len(points), 3), UNSEEN, np.uint8)
    places: Float64Array = points.astype(np.float64)
    for frame in frames:
        columns, rows, is_seen = seen_in(frame, places)
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
    """The names of the largest things that are seen; surfaces of the room go without."""
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
