"""Figures for papers: pictures in rows and columns, with searchable and editable text."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.reports.pictures import canvas
from su3d_bench.reports.pictures.items import Tag
from su3d_bench.reports.pictures.maps import SQUARE_M, Cloud, map_cloud, thinned

GAP_IN, LEGEND_IN = canvas.GAP_IN, 0.36
CAPTION_LINES = 3
MAX_TAGS = 40
FEW_TAGS, AWAY = 6, 0.11  # up to so many names are placed this fraction of the height away from their objects
# Columns side by side; the others follow below. Pictures with many names are wider.
COLUMNS: dict[canvas.Width, int] = {"8cm": 2, "17cm": 4}
COLUMNS_OF_NAMES: dict[canvas.Width, int] = {"8cm": 1, "17cm": 2}
INK, SOFT_INK = "#1a1a1a", "#606060"


@dataclass(frozen=True)
class Cell:
    """A picture with the names in it and the ``caption`` below it."""

    picture: UInt8Array
    tags: tuple[Tag, ...] = ()
    caption: str = ""


@dataclass(frozen=True)
class GridRow:
    """A row with its ``title`` above and a grey ``note`` after the title."""

    title: str
    note: str
    cells: tuple[Cell, ...]


@canvas.figure_style()
def draw_grid(
    path: Path, columns: Sequence[str], rows: Sequence[GridRow], scale: UInt8Array | None,
    width: canvas.Width = "17cm",
) -> None:  # fmt: skip
    """Write the figure as PDF, PNG or SVG by the suffix of ``path``; ``scale`` (256, 3): colour bar of similarity."""
    canvas.figure_format(path)
    cells = [cell for row in rows for cell in row.cells]
    has_many_names = any(len(cell.tags) > FEW_TAGS for cell in cells)
    side_by_side = min(len(columns), (COLUMNS_OF_NAMES if has_many_names else COLUMNS)[width])
    aspect = max(cell.picture.shape[0] / cell.picture.shape[1] for cell in cells)
    width_in = canvas.WIDTHS_IN[width]
    cell_in = (width_in - GAP_IN * (side_by_side - 1)) / side_by_side
    picture_in, line_in = cell_in * aspect, canvas.LINE_IN
    letters = int(0.88 * width_in * canvas.LETTERS_PER_INCH)  # bold ones are wider
    placed: list[tuple[float, float, str, dict[str, Any]]] = []  # x, y, text and style
    pictures: list[tuple[float, float, Cell]] = []
    y = 0.02
    for row in rows:
        title = textwrap.wrap(canvas.drawable(printable(row.title)), letters, max_lines=3, placeholder=" ...")
        placed += [(0.0, y + line_in * k, line, {"colour": INK, "weight": "bold"}) for k, line in enumerate(title)]
        note = printable(row.note, 60)
        if len(title) == 1 and len(title[0]) + len(note) < letters:
            placed.append((width_in - 0.03, y, note, {"colour": SOFT_INK, "ha": "right"}))
        y += line_in * len(title)
        heading_in = line_in if row is rows[0] or side_by_side < len(columns) else 0.0
        for first in range(0, len(columns), side_by_side):
            group = row.cells[first : first + side_by_side]
            captions = [_caption_lines(cell, cell_in) for cell in group]
            for c, (cell, name, caption) in enumerate(zip(group, columns[first:], captions, strict=False)):
                left = c * (cell_in + GAP_IN)
                heading = textwrap.shorten(
                    printable(name, 60), int(cell_in * canvas.LETTERS_PER_INCH), placeholder="..."
                )
                if heading_in:
                    placed.append((left + cell_in / 2, y, heading, {"colour": INK, "ha": "center"}))
                pictures.append((left, y + heading_in, cell))
                top = y + heading_in + picture_in + 0.02
                placed += [(left, top + line_in * k, line, {"colour": SOFT_INK}) for k, line in enumerate(caption)]
            y += heading_in + picture_in + line_in * max(map(len, captions), default=0) + GAP_IN
    page = _Page(width_in, y + (LEGEND_IN if scale is not None else 0.0), per_inch=1, dpi=canvas.DPI)
    for left, top, text, style in placed:
        page.text(left, top, text, **style)
    for left, top, cell in pictures:
        page.cell((left, top, cell_in, picture_in), cell)
    if scale is not None:
        page.scale(y + 0.06, scale)
    page.write(path)


def _caption_lines(cell: Cell, width_in: float) -> list[str]:
    """Return the lines below a picture; longer captions are truncated."""
    text = canvas.drawable(printable(cell.caption, 1000))
    return textwrap.wrap(text, int(width_in * canvas.LETTERS_PER_INCH), max_lines=CAPTION_LINES, placeholder=" ...")


def _covers(taken: Sequence[tuple[float, float, float]], x: float, row: float, half: float, line: float) -> bool:
    """Whether a name of this half width would overlap a placed one."""
    return any(abs(row - other[1]) < line and abs(x - other[0]) < half + other[2] for other in taken)


class _Page(canvas.Canvas):
    """A figure for a paper, measured in inches."""

    def cell(self, box: tuple[float, float, float, float], cell: Cell) -> None:
        axes = self.axes(*box)
        axes.imshow(cell.picture, interpolation="nearest")
        height, width = cell.picture.shape[:2]
        taken: list[tuple[float, float, float]] = []
        is_beside = len(cell.tags) <= FEW_TAGS
        line = 1.15 * canvas.LINE_IN / box[3]
        for tag in cell.tags[:MAX_TAGS]:
            text = canvas.drawable(printable(tag.text, 24))
            half = (len(text) / canvas.LETTERS_PER_INCH + 0.08) / box[2] / 2
            x = float(np.clip(tag.x, half, max(half, 1 - half)))
            row = tag.y + (AWAY if tag.y < 2 * AWAY else -AWAY) if is_beside else tag.y
            while is_beside and _covers(taken, x, row, half, line) and 0 < row < 0.95:
                row += 0.05
            if _covers(taken, x, row, half, line):
                continue  # overlapping names are unreadable
            taken.append((x, row, half))
            shade = canvas.hex_of(tag.colour)
            if is_beside:
                places = [tag.x * width, x * width], [tag.y * height, row * height]
                axes.plot(*places, color=shade, linewidth=0.7, marker="o", markersize=1.4, markevery=[0])
            box_style = canvas.paper(shade, 0.12, 0.88, linewidth=0.5)
            axes.text(
                x * width, row * height, text, color=INK, ha="center", va="center", bbox=box_style, clip_on=True
            )  # fmt: skip
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)

    def scale(self, y: float, scale: UInt8Array) -> None:
        wide = canvas.WIDTHS_IN["8cm"]
        left = (self.width - wide) / 2
        axes = self.axes(left, y, wide, 0.11)
        axes.imshow(scale[None], aspect="auto")
        self.text(left, y + 0.14, "least similar", colour=SOFT_INK)
        self.text(left + wide, y + 0.14, "most similar", colour=SOFT_INK, ha="right")


PANEL_WIDTH, PANEL_HEIGHT = 760, 640
PANELS_PER_ROW: dict[canvas.Width, int] = {"8cm": 1, "17cm": 2}  # a panel is about 8 cm wide
PIXELS_PER_LETTER, LABEL_HEIGHT = 17, 44  # of a label of 8 pt in such a panel
ANSWER, REFERENCE = (222, 74, 22), (32, 98, 196)
MAX_LABELS, MAX_CHARACTERS = 14, 24  # per label
PALE = 0.22  # fraction of the colour that objects outside the answer keep
# The twelve edges of a box as pairs of corners; bit i of a corner is axis i.
EDGES = tuple((a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1)


@dataclass(frozen=True)
class AnswerRows:
    """Rows of the map that are the answer, and the reference rows that it was compared with."""

    answer: tuple[int, ...]
    reference: tuple[int, ...] = ()

    @property
    def rows(self) -> tuple[int, ...]:
        return tuple(dict.fromkeys((*self.answer, *self.reference)))

    def colour(self, row: int) -> canvas.Colour:
        return ANSWER if row in self.answer else REFERENCE

    def dash(self, row: int) -> str:
        return "-" if row in self.answer else ":"


@canvas.figure_style()
def draw_reasoning(
    instances: Instances, spoken_of: AnswerRows, names: Sequence[str], path: Path, caption: str,
    width: canvas.Width = "17cm",
) -> None:  # fmt: skip
    """Write the picture of an answer; ``names`` of the instances."""
    names = [canvas.drawable(printable(name, MAX_CHARACTERS)) for name in names]
    panels = canvas.Panels(width, PANELS_PER_ROW[width], 2, PANEL_HEIGHT / PANEL_WIDTH, canvas.LINE_IN)
    cloud = thinned(map_cloud(instances))
    palette = _palette(names, spoken_of)
    for k, (camera, view, title) in enumerate(_two_views(cloud, spoken_of)):
        axes = panels.draw(k, title, canvas.colour(view, palette[cloud.owner]))
        _draw_spoken_of(axes, camera, instances, spoken_of, names)
    key = [("solid: answer", ANSWER), ("dotted: compared with", REFERENCE)][: 1 + bool(spoken_of.reference)]
    for (text, shade), left in zip(key, (0.0, 1.1), strict=False):
        panels.page.text(left, panels.bottom, text, colour=canvas.hex_of(shade))
    panels.page.write(path, caption)


def _palette(names: Sequence[str], spoken_of: AnswerRows) -> UInt8Array:
    """Return one colour per row: saturated for answer and reference, pale otherwise; the last: no instance."""
    own = np.array([*canvas.instance_colours(names), canvas.NO_INSTANCE], np.float64)
    pale = PALE * own + (1 - PALE) * 235.0
    for row in spoken_of.rows:
        pale[row] = spoken_of.colour(row)
    return np.rint(pale).astype(np.uint8)


def _two_views(cloud: Cloud, spoken_of: AnswerRows) -> list[tuple[canvas.Camera, canvas.View, str]]:
    """Return the view from above, and the corner view that shows most of answer and reference."""
    cameras = canvas.view_cameras(canvas.room_bounds(cloud.points), PANEL_WIDTH, PANEL_HEIGHT)
    above, *corners = [(camera, canvas.render(cloud.points, SQUARE_M, camera)) for camera in cameras]
    wanted = np.isin(cloud.owner, spoken_of.rows)
    camera, view = max(corners, key=lambda pair: wanted[pair[1].point[pair[1].point >= 0]].sum())
    return [(*above, "from above"), (camera, view, "from the corner with the best view")]


def _draw_spoken_of(
    axes: Any, camera: canvas.Camera, instances: Instances, spoken_of: AnswerRows, names: Sequence[str]
) -> None:
    """Draw boxes and names of answer and reference, and a line from each answer to its nearest reference."""
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.2, foreground="white")]
    centres = instances.centroids.astype(np.float64)
    for row in spoken_of.answer[:MAX_LABELS]:
        others = np.array([k for k in spoken_of.reference if k != row and not _touch(instances, k, row)], int)
        if len(others):
            nearest = int(others[np.argmin(np.linalg.norm(centres[others] - centres[row], axis=1))])
            ends = canvas.project(camera, centres[[row, nearest]])
            axes.plot(
                ends[:, 0], ends[:, 1], color=canvas.DARK, linewidth=0.8, linestyle=(0, (4, 3)), path_effects=halo
            )
    placed: list[Float64Array] = []
    for row in spoken_of.rows[:MAX_LABELS]:
        shade = canvas.hex_of(spoken_of.colour(row))
        low, high = instances.boxes[row].astype(np.float64)
        corners = np.array([[high[i] if k >> i & 1 else low[i] for i in range(3)] for k in range(8)])
        pixels = canvas.project(camera, corners)
        # one line, so that the halo of one edge does not cover another
        ends = np.concatenate([[pixels[a], pixels[b], (np.nan, np.nan)] for a, b in EDGES]).T
        axes.plot(*ends, color=shade, linewidth=0.9, linestyle=spoken_of.dash(row), path_effects=halo)
        x, y = _free_place(pixels, names[row], placed)
        middle = np.nanmean(pixels, axis=0)
        if not ((pixels[:, 1].min() - 2 * LABEL_HEIGHT <= y) & (y <= pixels[:, 1].max())):
            axes.plot([x, middle[0]], [y, middle[1]], color=shade, linewidth=0.6, alpha=0.6)
        box = canvas.paper(shade, 0.2, 0.92)
        axes.text(x, y, names[row], color=shade, ha="center", va="center", bbox=box)


def _touch(instances: Instances, a: int, b: int) -> bool:
    low, high = instances.boxes[[a, b], 0].max(axis=0), instances.boxes[[a, b], 1].min(axis=0)
    return bool((low <= high).all())


def _free_place(corners: Float64Array, name: str, placed: list[Float64Array]) -> tuple[float, float]:
    """Return the position of a box's label: above its centre, or as close as labels already ``placed`` allow."""
    half = np.array([PIXELS_PER_LETTER / 2 * len(name) + 12.0, LABEL_HEIGHT / 2])
    seen = corners[np.isfinite(corners).all(axis=1)]
    start = np.array([seen[:, 0].mean(), seen[:, 1].min() - LABEL_HEIGHT / 2]) if len(seen) else half
    start = np.clip(start, half, [PANEL_WIDTH - half[0], PANEL_HEIGHT - half[1]])
    for step in range(4 * MAX_LABELS):
        down = LABEL_HEIGHT / 2 * (step // 2) * (-1 if step % 2 else 1)
        place = start + np.array([0.0, down])
        is_inside = half[1] <= place[1] <= PANEL_HEIGHT - half[1]
        if is_inside and not any((np.abs(label[:2] - place) < label[2:] + half).all() for label in placed):
            break
    else:
        place = start
    placed.append(np.concatenate([place, half]))
    return float(place[0]), float(place[1])
