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

CELL_WIDTH_IN, TITLE_IN, ROW_IN, LEGEND_IN, GAP_IN = 2.4, 0.28, 0.26, 0.42, 0.08
LEGEND_WIDTH_IN = CELL_WIDTH_IN  # that of a figure of one column
DPI = 200  # of pictures within the figure
CAPTION_IN, CAPTION_LINE, CAPTION_LINES = 0.13, 47, 3  # line height, characters per line, number of lines
MAX_ROW_TITLE, MAX_TAGS = 110, 40
FEW_TAGS, AWAY = 6, 0.11  # up to so many names are placed this fraction of the height away from their objects
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


def draw_grid(path: Path, columns: Sequence[str], rows: Sequence[GridRow], scale: UInt8Array | None) -> None:
    """Write the figure as PDF, PNG or SVG by the suffix of ``path``; ``scale`` (256, 3): colour bar of similarity."""
    canvas.figure_format(path)
    aspect = max(cell.picture.shape[0] / cell.picture.shape[1] for row in rows for cell in row.cells)
    cell_height = CELL_WIDTH_IN * aspect
    width = len(columns) * (CELL_WIDTH_IN + GAP_IN) + GAP_IN
    captions = [_caption_lines(row) for row in rows]
    tops = [TITLE_IN]
    for lines in captions:
        tops.append(tops[-1] + ROW_IN + cell_height + CAPTION_IN * max(map(len, lines), default=0) + GAP_IN)
    height = tops[-1] + (LEGEND_IN if scale is not None else 0.1)
    page = _Page(width, height, per_inch=1, dpi=DPI)
    for c, title in enumerate(columns):
        left = GAP_IN + c * (CELL_WIDTH_IN + GAP_IN)
        heading = textwrap.shorten(printable(title, 60), 34, placeholder="...")
        page.text(left + CELL_WIDTH_IN / 2, 0.06, heading, 9, colour=INK, ha="center")
    for r, row in enumerate(rows):
        top = tops[r]
        room = int(width * 13)
        title = printable(row.title, min(MAX_ROW_TITLE, room))
        page.text(GAP_IN, top + 0.03, title, 8.5, colour=INK, weight="bold")
        if len(title) + len(row.note) < room:
            page.text(width - GAP_IN, top + 0.04, printable(row.note, 60), 7, colour=SOFT_INK, ha="right")
        for c, cell in enumerate(row.cells):
            left = GAP_IN + c * (CELL_WIDTH_IN + GAP_IN)
            page.cell(left, top + ROW_IN, cell_height, cell)
            for k, line in enumerate(captions[r][c]):
                page.text(left, top + ROW_IN + cell_height + 0.02 + CAPTION_IN * k, line, 6.5, colour=SOFT_INK)
    if scale is not None:
        page.scale(height - LEGEND_IN + 0.06, scale)
    canvas.write_figure(page.figure, path, DPI)


def _caption_lines(row: GridRow) -> list[list[str]]:
    """Return the caption lines below each picture of a row; longer captions are truncated."""
    return [
        textwrap.wrap(printable(cell.caption, 1000), CAPTION_LINE, max_lines=CAPTION_LINES, placeholder=" ...")
        for cell in row.cells
    ]


def _covers(taken: Sequence[tuple[float, float, float]], x: float, row: float, half: float) -> bool:
    """Whether a name of this half width would overlap a placed one."""
    return any(abs(row - other[1]) < 0.045 and abs(x - other[0]) < half + other[2] for other in taken)


class _Page(canvas.Canvas):
    """A figure for a paper, measured in inches."""

    def cell(self, x: float, y: float, cell_height: float, cell: Cell) -> None:
        axes = self.axes(x, y, CELL_WIDTH_IN, cell_height)
        axes.imshow(cell.picture, interpolation="nearest")
        height, width = cell.picture.shape[:2]
        taken: list[tuple[float, float, float]] = []
        is_beside = len(cell.tags) <= FEW_TAGS
        for tag in cell.tags[:MAX_TAGS]:
            text = canvas.drawable(printable(tag.text, 24))
            half = 0.011 * len(text) + 0.01
            row = tag.y + (AWAY if tag.y < 2 * AWAY else -AWAY) if is_beside else tag.y
            while is_beside and _covers(taken, tag.x, row, half) and 0 < row < 0.95:
                row += 0.05
            if _covers(taken, tag.x, row, half):
                continue  # overlapping names are unreadable
            taken.append((tag.x, row, half))
            shade = canvas.hex_of(tag.colour)
            if is_beside:
                places = [tag.x * width] * 2, [tag.y * height, row * height]
                axes.plot(*places, color=shade, linewidth=0.7, marker="o", markersize=1.4, markevery=[0])
            box = canvas.paper(shade, 0.12, 0.88, linewidth=0.5)
            axes.text(
                tag.x * width, row * height, text, fontsize=4.6, color=INK, ha="center", va="center", bbox=box,
                parse_math=False, clip_on=True,
            )  # fmt: skip
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)

    def scale(self, y: float, scale: UInt8Array) -> None:
        left = (self.width - LEGEND_WIDTH_IN) / 2
        axes = self.axes(left, y, LEGEND_WIDTH_IN, 0.11)
        axes.imshow(scale[None], aspect="auto")
        self.text(left, y + 0.14, "least similar", 7, colour=SOFT_INK)
        self.text(left + LEGEND_WIDTH_IN, y + 0.14, "most similar", 7, colour=SOFT_INK, ha="right")


PANEL_WIDTH, PANEL_HEIGHT, MARGIN = 760, 640, 14
LINE_HEIGHT, CHARACTERS_A_LINE, MAX_LINES = 22, 165, 5
ANSWER, REFERENCE = (222, 74, 22), (32, 98, 196)
MAX_LABELS, LABEL_HEIGHT = 14, 20
MAX_CHARACTERS = 40  # per label
FEW = 4  # more boxes than this are drawn with thin lines
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


def draw_reasoning(
    instances: Instances, spoken_of: AnswerRows, names: Sequence[str], path: Path, question: str, lines: Sequence[str]
) -> None:
    """Write the picture of an answer: ``names`` of the instances, ``lines`` shown below the ``question``."""
    names = [canvas.drawable(printable(name, MAX_CHARACTERS)) for name in names]
    written = [part for line in lines for part in textwrap.wrap(printable(line), CHARACTERS_A_LINE)][:MAX_LINES]
    header = 52 + LINE_HEIGHT * len(written)
    width, height = 2 * PANEL_WIDTH + 3 * MARGIN, header + PANEL_HEIGHT + MARGIN
    page = canvas.Canvas(width, height)
    page.text(MARGIN, 14, printable(question, 110), 15, weight="bold")
    for k, line in enumerate(written):
        page.text(MARGIN, 46 + LINE_HEIGHT * k, line, 11, colour=canvas.DARK if k == 0 else canvas.GREY)
    cloud = thinned(map_cloud(instances))
    palette = _palette(names, spoken_of)
    for column, (camera, view, title) in enumerate(_two_views(cloud, spoken_of)):
        left = MARGIN + column * (PANEL_WIDTH + MARGIN)
        axes = page.picture(left, header, PANEL_WIDTH, PANEL_HEIGHT, canvas.colour(view, palette[cloud.owner]))
        _draw_spoken_of(axes, camera, instances, spoken_of, names)
        axes.text(10, PANEL_HEIGHT - 10, title, fontsize=10, color=canvas.GREY, va="bottom")
    page.write(path)


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

    halo = [withStroke(linewidth=3, foreground="white")]
    centres = instances.centroids.astype(np.float64)
    for row in spoken_of.answer[:MAX_LABELS]:
        others = np.array([k for k in spoken_of.reference if k != row and not _touch(instances, k, row)], int)
        if len(others):
            nearest = int(others[np.argmin(np.linalg.norm(centres[others] - centres[row], axis=1))])
            ends = canvas.project(camera, centres[[row, nearest]])
            axes.plot(
                ends[:, 0], ends[:, 1], color=canvas.DARK, linewidth=1.2, linestyle=(0, (4, 3)), path_effects=halo
            )
    placed: list[Float64Array] = []
    edges: dict[str, Any] = (
        {"linewidth": 1.4, "path_effects": halo} if len(spoken_of.rows) <= FEW else {"linewidth": 0.9}
    )
    for row in spoken_of.rows[:MAX_LABELS]:
        shade = canvas.hex_of(spoken_of.colour(row))
        low, high = instances.boxes[row].astype(np.float64)
        corners = np.array([[high[i] if k >> i & 1 else low[i] for i in range(3)] for k in range(8)])
        pixels = canvas.project(camera, corners)
        for a, b in EDGES:
            axes.plot(pixels[[a, b], 0], pixels[[a, b], 1], color=shade, **edges)
        x, y = _free_place(pixels, names[row], placed)
        middle = np.nanmean(pixels, axis=0)
        if not ((pixels[:, 1].min() - 2 * LABEL_HEIGHT <= y) & (y <= pixels[:, 1].max())):
            axes.plot([x, middle[0]], [y, middle[1]], color=shade, linewidth=0.6, alpha=0.6)
        box = canvas.paper(shade, 0.2, 0.92)
        axes.text(x, y, names[row], fontsize=9.5, color=shade, ha="center", va="center", bbox=box, parse_math=False)


def _touch(instances: Instances, a: int, b: int) -> bool:
    low, high = instances.boxes[[a, b], 0].max(axis=0), instances.boxes[[a, b], 1].min(axis=0)
    return bool((low <= high).all())


def _free_place(corners: Float64Array, name: str, placed: list[Float64Array]) -> tuple[float, float]:
    """Return the position of a box's label: above its centre, or as close as labels already ``placed`` allow."""
    half = np.array([4.0 * len(name) + 6.0, LABEL_HEIGHT / 2])
    seen = corners[np.isfinite(corners).all(axis=1)]
    start = np.array([seen[:, 0].mean(), seen[:, 1].min() - 10.0]) if len(seen) else half
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
