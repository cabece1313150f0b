"""Contact sheets of a sample of questions, on which anyone sees in minutes whether they and their answers are right."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import StoreError, printable
from su3d_bench.core.files.atomic import make_folder, remove_file, write_bytes, write_text
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array, UInt8Array
from su3d_bench.formats.tables.csv_text import csv_lines
from su3d_bench.questions.audit import AuditedQuestion, Things
from su3d_bench.questions.scene_map import MapObject
from su3d_bench.questions.sight import looked_at
from su3d_bench.questions.truths import fullest_truth
from su3d_bench.reports.pictures.items import owners_in_frame, png_bytes
from su3d_bench.reports.pictures.tiles import Line, Mark, Photo, Plan, Shade, Tile, contact_sheet, picture_strip
from su3d_bench.reports.sheet.audit_page import audit_page
from su3d_bench.sheets.judging.answers import MOST_CHARACTERS
from su3d_bench.sheets.judging.audit_scores import COLUMNS, FILE, read_verdicts
from su3d_bench.sheets.making.shown_room import at_full_size

PER_SHEET = 12
PICTURES = "pictures"  # folder of the photographs that the page shows
STRIP = (1280, 400)  # of such a picture
GREEN, BLUE, ORANGE = (0, 140, 60), (20, 90, 225), (214, 104, 0)
GOOD_SHARE = 0.1  # of an image from which a larger view of a thing tells no more
PLAIN_SHARE = 0.01  # of an image from which a closer look at it does for a better frame
OTHERS_WEIGHT = 0.5  # of all that is called like an answer, beside 1 for each thing that is in question
GAP = 9  # every second pixel: a thing behind the slats of blinds has one outline and not forty
LEAST_GAIN = 0.25  # of the view of one thing, for which a second frame is shown and not the first one closer
WIDE_SHARE, CLOSE_SHARE = 0.5, 0.15  # of an image's height that a second frame, and a closer look, shows at least
FILLED_SHARE = 0.5  # of an image's height or width that things fill, so that a closer look would show the same again
ELSEWHERE_M, ELSEWHERE_COSINE = 0.5, 0.9  # between two cameras, or their directions, of which one shows another side


def make_audit(
    questions: Sequence[AuditedQuestion],
    dataset_of: Callable[[str], tuple[Any, str]],
    out: Path,
    *,
    per_sheet: int = PER_SHEET,
    progress: Callable[[str], None] = lambda scene: None,
) -> list[Path]:
    """Write sheets, page and table of ``questions`` into ``out``; the paths of the sheets.

    ``dataset_of`` leads from the address of a scene to its dataset and name. Raises ``StoreError`` where verdicts stand
    in the table that would be replaced.
    """
    table = out / FILE
    earlier = read_verdicts(table) if table.is_file() else []
    if any(row.verdict for row in earlier):
        raise StoreError(f"{printable(str(table), 200)}: holds verdicts; choose another --out, or remove it")
    make_folder(out / PICTURES)
    photographer: _Photographer | None = None
    tiles: list[Tile] = []
    names = []
    sheets: list[Path] = []
    for k, question in enumerate(questions):
        if photographer is None or photographer.scene != question.scene:
            photographer = _Photographer(question.scene, *dataset_of(question.scene))
            progress(question.scene)
        tiles.append(_tile(k + 1, question, photographer))
        names.append(_picture_name(k + 1))
        write_bytes(out / PICTURES / names[-1], png_bytes(picture_strip(tiles[-1], STRIP), is_true=True))
        if len(tiles) == per_sheet or k == len(questions) - 1:
            sheets.append(out / _sheet_name(len(sheets) + 1))
            write_bytes(sheets[-1], png_bytes(contact_sheet(tiles), is_true=True))
            tiles = []
    rows: list[list[str | int]]
    rows = [[k, one.scene, one.kind, one.text, one.answer, "", ""] for k, one in enumerate(questions, 1)]
    write_text(table, csv_lines([COLUMNS, *(map(_short, row) for row in rows)]))
    entries = [
        (k, one.scene, one.kind, one.text, [(line.text, line.shade) for line in _lines(one)], f"{PICTURES}/{name}")
        for k, (one, name) in enumerate(zip(questions, names, strict=True), 1)
    ]
    write_text(out / "index.html", audit_page(entries))
    for k in range(1, len(earlier) + 1):  # of the audit that stood here; a sheet has one question at least
        if k > len(names):
            remove_file(out / PICTURES / _picture_name(k))
        if k > len(sheets):
            remove_file(out / _sheet_name(k))
    return sheets


def _picture_name(number: int) -> str:
    return f"{number:03d}.png"


def _sheet_name(number: int) -> str:
    return f"sheet-{number:02d}.png"


def _short(cell: str | int) -> str | int:
    """A cell that is read again."""
    return printable(cell, MOST_CHARACTERS) if isinstance(cell, str) else cell


def _tile(number: int, question: AuditedQuestion, photographer: _Photographer) -> Tile:
    head = f"{number}   {question.scene}   {question.kind}"
    lines = _lines(question)
    unseen = photographer.unseen((*question.right, *question.held))
    if unseen:
        lines = (*lines, Line(f"in none of {photographer.n_frames} frames: {_shown(unseen)}", (180, 0, 0)))
    return Tile(head, question.text, lines, photographer.photos(question), _plan(question))


def _shaded(question: AuditedQuestion) -> list[tuple[MapObject, Shade]]:
    """What is outlined, and how: what answers comes last, over the rest."""
    groups = ((question.others, ORANGE), (question.held, BLUE), (question.right, GREEN))
    return [(thing, shade) for things, shade in groups for thing in things]


def _plan(question: AuditedQuestion) -> Plan:
    """The boxes of the scene from above."""
    row_of = {thing.id: row for row, thing in enumerate(question.room.objects)}
    boxes = np.array([thing.box[:, :2] for thing in question.room.objects], np.float64).reshape(-1, 2, 2)
    return Plan(boxes, {row_of[thing.id]: (f"#{thing.id}", shade) for thing, shade in _shaded(question)})


def _lines(question: AuditedQuestion) -> tuple[Line, ...]:
    lines = [Line(f"answer: {question.answer}", GREEN)]
    if question.held:
        lines.append(Line(f"held against: {_shown(question.held)}", BLUE))
    if question.others:
        lines.append(Line(f"no answer: {_shown(question.others)}", ORANGE))
    return tuple(lines)


def _shown(things: Things) -> str:
    return ", ".join(thing.shown for thing in things)


@dataclass(frozen=True)
class _Seen:
    """A frame's colours and pose, and whose every second pixel of it is (h, w): a place among the ids, 0 for nobody."""

    rgb: UInt8Array
    camera_to_world: Float64Array
    owners: Int64Array


class _Photographer:
    """Knows of every thing of a scene how large each of some frames shows it, and outlines it there."""

    def __init__(self, scene: str, dataset: Any, name: str) -> None:
        from scipy.spatial import KDTree

        self.scene = scene
        truth: GroundTruth = fullest_truth(dataset, name)
        tree: Any = KDTree(truth.points, balanced_tree=False, compact_nodes=False)
        ids = np.unique(truth.instance[truth.instance > 0])
        owner = np.where(truth.instance > 0, np.searchsorted(ids, truth.instance) + 1, 0).astype(np.int64)
        self._place_of = {instance: place for place, instance in enumerate(ids.tolist(), 1)}
        self._seen = [
            _Seen(frame.rgb, frame.camera_to_world, owners_in_frame(frame, tree, owner))
            for frame in looked_at(dataset, name)
        ]
        self.n_frames = len(self._seen)
        n = len(ids) + 1
        counts = [np.bincount(seen.owners.ravel(), minlength=n) / seen.owners.size for seen in self._seen]
        share: Float64Array = np.array(counts, np.float64).reshape(len(self._seen), n)
        self._good, self._plain = (_views(share, enough) for enough in (GOOD_SHARE, PLAIN_SHARE))

    def unseen(self, things: Things) -> Things:
        """Those of ``things`` that are in no frame."""
        return tuple(thing for thing in things if not self._views_of(thing, self._good).any())

    def photos(self, question: AuditedQuestion) -> tuple[Photo, ...]:
        """The frame that shows most of a question's things, and another one for the rest, or the first one closer."""
        views, plain = (self._weighted(question, table) for table in (self._good, self._plain))
        if not len(views) or not views.any():
            return ()
        first = int(views.sum(axis=1).argmax())
        gains, larger = (np.maximum(table - table[first], 0.0).sum(axis=1) for table in (plain, views))
        whole = Photo(self._seen[first].rgb, self._marks(first, question))
        focus = self._focus(whole, question)
        second = int((gains + larger / 2).argmax())
        if gains[second] < LEAST_GAIN and focus is not None:
            spans = [np.ptp(np.flatnonzero(focus.any(axis=axis))) / focus.shape[1 - axis] for axis in (0, 1)]
            is_filled = max(spans) >= FILLED_SHARE
            elsewhere = [k for k in range(self.n_frames) if is_filled and self._is_elsewhere(first, k)]
            second = max(elsewhere, key=lambda k: float(views[k].sum()), default=first)
            if views[second].sum() < views[first].sum() / 2 or second == first:
                return whole, Photo(whole.picture, whole.marks, focus, CLOSE_SHARE)
        marks = self._marks(second, question)
        return whole, Photo(self._seen[second].rgb, marks, _union(marks), WIDE_SHARE)

    def _focus(self, photo: Photo, question: AuditedQuestion) -> BoolArray | None:
        """What a closer look is at: both ends of a relation, or everything that is compared."""
        related = {f"#{thing.id}" for thing in (*question.right, *question.held)}
        focus = _union([mark for mark in photo.marks if question.held and mark.label in related])
        return _union(photo.marks) if focus is None else focus

    def _is_elsewhere(self, one: int, other: int) -> bool:
        """Whether two frames were taken from different places, or in different directions."""
        a, b = (self._seen[k].camera_to_world for k in (one, other))
        is_far = float(np.linalg.norm(a[:3, 3] - b[:3, 3])) > ELSEWHERE_M
        return is_far or float(a[:3, 2] @ b[:3, 2]) < ELSEWHERE_COSINE

    def _weighted(self, question: AuditedQuestion, table: Float64Array) -> Float64Array:
        """How well each frame (rows) shows each thing (columns), by how much the thing matters; all of a room alike."""
        wanted = (*question.right, *question.held)
        if not wanted and not question.others:
            return table[:, 1:]
        columns = [self._views_of(thing, table) for thing in wanted]
        weight = OTHERS_WEIGHT / max(1, len(question.others))
        columns += [weight * self._views_of(thing, table) for thing in question.others]
        return np.stack(columns, axis=1)

    def _views_of(self, thing: MapObject, table: Float64Array) -> Float64Array:
        """Its column of ``table``; zeros where the truth has no points of it."""
        place = self._place_of.get(thing.id, 0)
        return table[:, place] if place else np.zeros(self.n_frames)

    def _marks(self, place: int, question: AuditedQuestion) -> tuple[Mark, ...]:
        seen = self._seen[place]
        return tuple(
            Mark(f"#{thing.id}", at_full_size(seen.owners == place, seen.rgb, GAP), shade, 3 if shade == GREEN else 2)
            for thing, shade in _shaded(question)
            if (place := self._place_of.get(thing.id, 0))
        )


def _views(share: Float64Array, enough: float) -> Float64Array:
    """How well each frame (rows) shows each thing, 0 to 1: 1 as well as any does, or from ``enough`` of an image on."""
    best = np.minimum(share.max(axis=0, initial=0.0), enough)
    views: Float64Array = np.sqrt(np.minimum(share / np.where(best > 0, best, 1.0), 1.0))
    return views


def _union(marks: Sequence[Mark]) -> BoolArray | None:
    masks = [mark.mask for mark in marks if mark.mask.any()]
    return np.logical_or.reduce(masks) if masks else None
