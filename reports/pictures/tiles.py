"""Contact sheets: many small tiles on a page, each some lines of text over photographs and a plan, things outlined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.core.types import BoolArray, Float64Array, UInt8Array
from su3d_bench.reports.pictures.canvas import drawable
from su3d_bench.reports.pictures.items import (
    GREY,
    INK,
    PANEL,
    PAPER,
    Tag,
    draw_outline,
    draw_tags,
    fitted,
    font,
    window_around,
    write_line,
)

Shade = tuple[int, int, int]
WIDTH, COLUMNS, MARGIN, GAP = 1600, 2, 10, 6  # pixels
STRIP_HEIGHT = 240  # of the photographs of a tile on a sheet
HEAD_SIZE, TEXT_SIZE, LINE = 14, 17, 21
MOST_LINES = 2  # of each text; what is longer ends in dots
MOST_FIRST = 0.6  # of the width for the first of two photographs
TAG_DROP = 13  # pixels from the top of a thing to where its tag would be put 30 above it
RULE, PALE, EDGE = (200, 200, 196), (232, 232, 228), (196, 196, 192)
PLAN_WIDTH = 0.85  # of its height
SEGMENT_GAP = 18  # pixels between two texts of one line


@dataclass(frozen=True)
class Mark:
    """A thing in a photograph: ``mask`` (h, w), and what stands beside its outline."""

    label: str
    mask: BoolArray
    shade: Shade
    line: int = 2


@dataclass(frozen=True)
class Photo:
    """``picture`` (h, w, 3); where there is a ``focus`` (h, w), the part around it is shown, ``least_share`` high."""

    picture: UInt8Array
    marks: tuple[Mark, ...]
    focus: BoolArray | None = None
    least_share: float = 0.0


@dataclass(frozen=True)
class Plan:
    """Things from above: ``boxes`` (N, 2, 2) of all of them, metres, and of those that are ``marked`` label and shade.

    ``marked`` leads from the row of a box to what is written at it.
    """

    boxes: Float64Array
    marked: Mapping[int, tuple[str, Shade]]


@dataclass(frozen=True)
class Line:
    text: str
    shade: Shade = INK


@dataclass(frozen=True)
class Tile:
    """``head`` says which it is, ``title`` stands out, and ``lines`` lie between it and the photographs."""

    head: str
    title: str
    lines: tuple[Line, ...]
    photos: tuple[Photo, ...]
    plan: Plan | None = None


def contact_sheet(tiles: Sequence[Tile]) -> UInt8Array:
    """The page (h, 1600, 3) of some tiles, two in a row; rows are as high as their texts want."""
    from PIL import Image, ImageDraw

    wide = (WIDTH - MARGIN * (COLUMNS + 1)) // COLUMNS
    rows = [tiles[k : k + COLUMNS] for k in range(0, len(tiles), COLUMNS)]
    heads = [max(_text_height(tile, wide) for tile in row) for row in rows]
    page = Image.new("RGB", (WIDTH, sum(heads) + len(rows) * (STRIP_HEIGHT + 2 * MARGIN) + MARGIN), PAPER)
    draw = ImageDraw.Draw(page)
    top = MARGIN
    for row, head in zip(rows, heads, strict=True):
        for k, tile in enumerate(row):
            left = MARGIN + k * (wide + MARGIN)
            _write_texts(draw, tile, (left, top), wide)
            strip = picture_strip(tile, (wide, STRIP_HEIGHT))
            page.paste(Image.fromarray(strip), (left, top + head))
        top += head + STRIP_HEIGHT + MARGIN
        draw.line((MARGIN, top, WIDTH - MARGIN, top), fill=RULE)
        top += MARGIN
    return np.asarray(page, np.uint8).copy()


def picture_strip(tile: Tile, size: tuple[int, int]) -> UInt8Array:
    """Photographs of a tile and its plan (h, w, 3) side by side within ``size`` (width, height), things outlined."""
    from PIL import Image, ImageDraw

    width, height = size
    strip = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(strip)
    if tile.plan is not None:
        plan_width = round(PLAN_WIDTH * height)
        width -= plan_width + GAP
        _draw_plan(draw, tile.plan, (width + GAP, 0), (plan_width, height))
    if not tile.photos:
        draw.rectangle((0, 0, width - 1, height), fill=PANEL)
        write_line(draw, (20, 20), "no frame shows anything of this", 16, GREY)
    left = 0
    for k, photo in enumerate(tile.photos):
        most = (width - left) if k == len(tile.photos) - 1 else round(MOST_FIRST * width)
        shown, tags = _drawn(photo, (most, height))
        strip.paste(Image.fromarray(shown), (left, 0))
        draw_tags(draw, tags, (left, 0), (shown.shape[1], shown.shape[0]))
        left += shown.shape[1] + GAP
    return np.asarray(strip, np.uint8).copy()


def _draw_plan(draw: Any, plan: Plan, at: tuple[int, int], size: tuple[int, int]) -> None:
    """The boxes from above with a bar of a metre, y up."""
    draw.rectangle((at[0], at[1], at[0] + size[0] - 1, at[1] + size[1] - 1), fill=PAPER, outline=EDGE)
    if not len(plan.boxes):
        return
    low, high = plan.boxes[:, 0].min(axis=0), plan.boxes[:, 1].max(axis=0)
    inner = np.array(size) - 2 * MARGIN
    scale = float((inner / np.maximum(high - low, 1e-3)).min())
    corner = np.array(at) + MARGIN + (inner - scale * (high - low)) / 2
    tags = []
    for row in sorted(range(len(plan.boxes)), key=lambda row: row in plan.marked):
        (x0, y0), (x1, y1) = plan.boxes[row]
        left, right = (corner[0] + scale * (x - low[0]) for x in (x0, x1))
        top, bottom = (corner[1] + scale * (high[1] - y) for y in (y1, y0))
        if row not in plan.marked:
            draw.rectangle((left, top, right, bottom), fill=PALE, outline=EDGE)
            continue
        label, shade = plan.marked[row]
        draw.rectangle((left, top, max(right, left + 3), max(bottom, top + 3)), outline=shade, width=3)
        # below the box: a tag is put 30 above its place
        tags.append(Tag(label, ((left + right) / 2 - at[0]) / size[0], (bottom - at[1] + 34) / size[1], shade))
    draw_tags(draw, tuple(tags), at, size)
    draw.line((at[0] + 6, at[1] + 20, at[0] + 6 + scale, at[1] + 20), fill=INK, width=2)
    write_line(draw, (at[0] + 6, at[1] + 4), "1 m", 11, INK)


def _drawn(photo: Photo, most: tuple[int, int]) -> tuple[UInt8Array, tuple[Tag, ...]]:
    """A photograph, or the part of it that counts, as large as fits, and the tags of what is outlined."""
    part = slice(None), slice(None)
    if photo.focus is not None:
        part = window_around(photo.focus, most[0] / most[1], photo.least_share * photo.picture.shape[0])
    picture = photo.picture[part]
    scale = min(most[0] / picture.shape[1], most[1] / picture.shape[0])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    shown = np.ascontiguousarray(fitted(picture, size))
    tags = []
    for mark in photo.marks:
        mask = mark.mask[part]
        if mask.any():
            draw_outline(shown, mask, mark.line, mark.shade, halo=2)
            rows, columns = np.nonzero(mask)
            x, y = (columns.min() + columns.max() + 1) / 2 / mask.shape[1], rows.min() / mask.shape[0]
            tags.append(Tag(mark.label, float(x), float(y) + TAG_DROP / size[1], mark.shade))
    return shown, tuple(reversed(tags))  # those that were drawn last, over the others, choose their places first


@dataclass(frozen=True)
class _Piece:
    """A text at pixels ``x`` of a line."""

    text: str
    size: int
    shade: Shade
    is_bold: bool = False
    x: int = 0


def _texts(tile: Tile, wide: int) -> list[list[_Piece]]:
    """What stands in each line over the pictures; short texts share one."""
    texts = [[_Piece(tile.head, HEAD_SIZE, GREY)]]
    texts += [[_Piece(line, TEXT_SIZE, INK, True)] for line in _wrapped(tile.title, TEXT_SIZE, True, wide)]
    end = wide + 1
    for line in tile.lines:
        parts = _wrapped(line.text, HEAD_SIZE, False, wide)
        length = round(font(HEAD_SIZE, False).getlength(parts[0]))
        if len(parts) == 1 and end + SEGMENT_GAP + length <= wide:
            texts[-1].append(_Piece(parts[0], HEAD_SIZE, line.shade, x=end + SEGMENT_GAP))
            end += SEGMENT_GAP + length
        else:
            texts += [[_Piece(part, HEAD_SIZE, line.shade)] for part in parts]
            end = round(font(HEAD_SIZE, False).getlength(parts[-1]))
    return texts


def _text_height(tile: Tile, wide: int) -> int:
    return LINE * len(_texts(tile, wide)) + GAP


def _write_texts(draw: Any, tile: Tile, at: tuple[int, int], wide: int) -> None:
    for k, pieces in enumerate(_texts(tile, wide)):
        for piece in pieces:
            place = at[0] + piece.x, at[1] + LINE * k
            write_line(draw, place, piece.text, piece.size, piece.shade, piece.is_bold)


def _wrapped(text: str, size: int, is_bold: bool, wide: int) -> list[str]:
    """``text`` in lines that are ``wide`` at most, two of them."""
    lines = [""]
    for word in drawable(printable(text, 2000)).split(" "):
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font(size, is_bold).getlength(longer) > wide:
            lines.append(word)
        else:
            lines[-1] = longer
    if len(lines) > MOST_LINES:
        lines = [*lines[: MOST_LINES - 1], f"{lines[MOST_LINES - 1]} ..."]
    return [_clipped(line, size, is_bold, wide) for line in lines]


def _clipped(line: str, size: int, is_bold: bool, wide: int) -> str:
    """A line that is ``wide`` at most, though one word of it were longer."""
    if font(size, is_bold).getlength(line) <= wide:
        return line
    while line and font(size, is_bold).getlength(f"{line}...") > wide:
        line = line[: -max(1, len(line) // 16)]
    return f"{line}..."
