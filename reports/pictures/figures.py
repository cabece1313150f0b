"""A figure of a paper: pictures in rows and columns, with all words as text that can be searched and edited."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.core.files.atomic import make_folder, write_bytes
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.reports.pictures import canvas
from su3d_bench.reports.pictures.items import Tag
from su3d_bench.reports.pictures.maps import SQUARE_M, Cloud, map_cloud, thinned

FORMATS = ("pdf", "png", "svg")
CELL_WIDTH_IN, TITLE_IN, ROW_IN, LEGEND_IN, GAP_IN = 2.4, 0.28, 0.26, 0.42, 0.08
LEGEND_WIDTH_IN = 2.6
DPI = 200  # of pictures within the figure
CAPTION_IN, CAPTION_LINE, CAPTION_LINES = 0.13, 47, 3  # height of a line, its characters, how many of them
MAX_ROW_TITLE, MAX_TAGS = 110, 40
FEW_TAGS, AWAY = 6, 0.11  # so few names stand beside what they name, this share of the height away
INK, SOFT_INK = "#1a1a1a", "#606060"


@dataclass(frozen=True)
class Cell:
    """A picture and the names in it; ``caption`` stands below it."""

    picture: UInt8Array
    tags: tuple[Tag, ...] = ()
    caption: str = ""


@dataclass(frozen=True)
class GridRow:
    """``title`` stands above the row, ``note`` behind it in grey."""

    title: str
    note: str
    cells: tuple[Cell, ...]


def draw_grid(path: Path, columns: Sequence[str], rows: Sequence[GridRow], scale: UInt8Array | None) -> None:
    """Write the figure as PDF, PNG or SVG by the name of ``path``; ``scale`` (256, 3) is the legend of similarity."""
    suffix = path.suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        raise ConfigError(f"--out {printable(str(path), 200)}: unknown form; name a file {', '.join(FORMATS)}")
    from matplotlib import rc_context

    # 42: fonts as TrueType, so that text in a PDF stays text; no salt by time in an SVG
    with rc_context(
        {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "su3d-bench", "font.family": "DejaVu Sans"}
    ):
        content = _figure_bytes(suffix, columns, rows, scale)
    make_folder(path.parent)
    write_bytes(path, content)


def _figure_bytes(suffix: str, columns: Sequence[str], rows: Sequence[GridRow], scale: UInt8Array | None) -> bytes:
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
    return canvas.figure_bytes(page.figure, suffix, DPI)


def _caption_lines(row: GridRow) -> list[list[str]]:
    """The lines below each picture of a row; what does not fit ends in dots."""
    return [
        textwrap.wrap(printable(cell.caption, 1000), CAPTION_LINE, max_lines=CAPTION_LINES, placeholder=" ...")
        for cell in row.cells
    ]


def _covers(taken: Sequence[tuple[float, float, float]], x: float, row: float, half: float) -> bool:
    """Whether a name of this half width would cover one of those that stand there."""
    return any(abs(row - other[1]) < 0.045 and abs(x - other[0]) < half + other[2] for other in taken)


class _Page(canvas.Canvas):
    """A figure of a paper, measured in inches."""

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
                continue  # a name that covers another tells nothing
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
MAX_CHARACTERS = 40  # of a label
FEW = 4  # more boxes than these are drawn with thin lines
PALE = 0.22  # how much of its colour an object keeps that is not spoken of
# The corners of a box, bit i for axis i, that its twelve edges join.
EDGES = tuple((a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1)


@dataclass(frozen=True)
class AnswerRows:
    """Rows of the map that are the answer, and rows that it was held against."""

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
    """Write the picture of an answer: ``names`` label the instances, ``lines`` stand under the ``question``."""
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
    """A colour a row: strong for what is spoken of, pale for the rest; the last one is that of no instance."""
    own = np.array([*canvas.instance_colours(names), canvas.NO_INSTANCE], np.float64)
    pale = PALE * own + (1 - PALE) * 235.0
    for row in spoken_of.rows:
        pale[row] = spoken_of.colour(row)
    return np.rint(pale).astype(np.uint8)


def _two_views(cloud: Cloud, spoken_of: AnswerRows) -> list[tuple[canvas.Camera, canvas.View, str]]:
    """The view from above, and that from the corner where most of what is spoken of is seen."""
    cameras = canvas.view_cameras(canvas.room_bounds(cloud.points), PANEL_WIDTH, PANEL_HEIGHT)
    above, *corners = [(camera, canvas.render(cloud.points, SQUARE_M, camera)) for camera in cameras]
    wanted = np.isin(cloud.owner, spoken_of.rows)
    camera, view = max(corners, key=lambda pair: wanted[pair[1].point[pair[1].point >= 0]].sum())
    return [(*above, "from above"), (camera, view, "from the corner that shows most of it")]


def _draw_spoken_of(
    axes: Any, camera: canvas.Camera, instances: Instances, spoken_of: AnswerRows, names: Sequence[str]
) -> None:
    """Boxes and names of what is spoken of, and a line from each answer to the nearest reference."""
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
    """Where the label of a box goes: above its middle, or as near to that as labels ``placed`` before leave room."""
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
