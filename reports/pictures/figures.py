"""A figure of a paper: pictures in rows and columns, with all words as text that can be searched and edited."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.core.files.atomic import make_folder, write_bytes
from su3d_bench.core.types import UInt8Array
from su3d_bench.reports.pictures.canvas import Canvas, drawable, figure_bytes, hex_of, paper
from su3d_bench.reports.pictures.items import Tag

FORMATS = ("pdf", "png", "svg")
CELL_WIDTH_IN, TITLE_IN, ROW_IN, LEGEND_IN, GAP_IN = 2.4, 0.28, 0.26, 0.42, 0.08
LEGEND_WIDTH_IN = 2.6
DPI = 200  # of pictures within the figure
CAPTION_IN, CAPTION_LINE, CAPTION_LINES = 0.13, 47, 3  # height of a line, its characters, how many of them
MOST_ROW_TITLE, MOST_TAGS = 110, 40
FEW_TAGS, AWAY = 6, 0.11  # so few names stand beside what they name, this share of the height away
INK, GREY = "#1a1a1a", "#606060"


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
        title = printable(row.title, min(MOST_ROW_TITLE, room))
        page.text(GAP_IN, top + 0.03, title, 8.5, colour=INK, weight="bold")
        if len(title) + len(row.note) < room:
            page.text(width - GAP_IN, top + 0.04, printable(row.note, 60), 7, colour=GREY, ha="right")
        for c, cell in enumerate(row.cells):
            left = GAP_IN + c * (CELL_WIDTH_IN + GAP_IN)
            page.cell(left, top + ROW_IN, cell_height, cell)
            for k, line in enumerate(captions[r][c]):
                page.text(left, top + ROW_IN + cell_height + 0.02 + CAPTION_IN * k, line, 6.5, colour=GREY)
    if scale is not None:
        page.scale(height - LEGEND_IN + 0.06, scale)
    return figure_bytes(page.figure, suffix, DPI)


def _caption_lines(row: GridRow) -> list[list[str]]:
    """The lines below each picture of a row; what does not fit ends in dots."""
    return [
        textwrap.wrap(printable(cell.caption, 1000), CAPTION_LINE, max_lines=CAPTION_LINES, placeholder=" ...")
        for cell in row.cells
    ]


def _covers(taken: Sequence[tuple[float, float, float]], x: float, row: float, half: float) -> bool:
    """Whether a name of this half width would cover one of those that stand there."""
    return any(abs(row - other[1]) < 0.045 and abs(x - other[0]) < half + other[2] for other in taken)


class _Page(Canvas):
    """A figure of a paper, measured in inches."""

    def cell(self, x: float, y: float, cell_height: float, cell: Cell) -> None:
        axes = self.axes(x, y, CELL_WIDTH_IN, cell_height)
        axes.imshow(cell.picture, interpolation="nearest")
        height, width = cell.picture.shape[:2]
        taken: list[tuple[float, float, float]] = []
        is_beside = len(cell.tags) <= FEW_TAGS
        for tag in cell.tags[:MOST_TAGS]:
            text = drawable(printable(tag.text, 24))
            half = 0.011 * len(text) + 0.01
            row = tag.y + (AWAY if tag.y < 2 * AWAY else -AWAY) if is_beside else tag.y
            while is_beside and _covers(taken, tag.x, row, half) and 0 < row < 0.95:
                row += 0.05
            if _covers(taken, tag.x, row, half):
                continue  # a name that covers another tells nothing
            taken.append((tag.x, row, half))
            shade = hex_of(tag.colour)
            if is_beside:
                places = [tag.x * width] * 2, [tag.y * height, row * height]
                axes.plot(*places, color=shade, linewidth=0.7, marker="o", markersize=1.4, markevery=[0])
            box = paper(shade, 0.12, 0.88, linewidth=0.5)
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
        self.text(left, y + 0.14, "least similar", 7, colour=GREY)
        self.text(left + LEGEND_WIDTH_IN, y + 0.14, "most similar", 7, colour=GREY, ha="right")
