"""The picture of one item of an annotation sheet: photo, zoom, room view and location.

Composed with Pillow: a sheet has hundreds of pictures, and a plotting library takes half a second for each.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.core.geometry import back_project, valid_depth
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, UInt8Array
from su3d_bench.reports.pictures.canvas import drawable

WIDTH, MARGIN, CAPTION = 960, 10, 24
PHOTO_WIDTH, ZOOM_WIDTH = 560, 370
TOP_HEIGHT, LOW_HEIGHT = 420, 320
TITLE_SIZE, TITLE_LINE, MAX_TITLE_LINES = 25, 33, 4  # two lines each for a question and its answer
FIRST_WIDE, REST_WIDE = 60, 88  # characters per title line
MAX_TAGS, MAX_TAG_TEXT, TAG_LINE = 8, 28, 19
OUTLINE, HALO = (255, 64, 200), (255, 255, 255)  # a pink not in any heat scale, on white
INK, GREY, PAPER, PANEL = (26, 26, 26), (96, 96, 96), (255, 255, 255), (244, 244, 242)
ROOM_COLUMNS, ROOM_GAP = 3, 6  # room photos per row, pixels between them
ZOOM_GROWTH = 1.7  # size of the zoomed part relative to the object
JPEG_QUALITY = 92  # with full colour resolution


@dataclass(frozen=True)
class Tag:
    """A name at a position in a picture."""

    text: str
    x: float
    y: float
    colour: tuple[int, int, int]


@dataclass(frozen=True)
class Panel:
    """A picture (h, w, 3) with the ``mask`` (h, w) of the object, and the title above it.

    ``tags``: names, at fractions of width and height. ``ring``: circle around the object, as fractions: centre of width
    and height, radius of width; ``eye``: camera position of the photo, as fractions.
    """

    title: str
    picture: UInt8Array
    mask: BoolArray | None = None
    tags: tuple[Tag, ...] = ()
    ring: tuple[float, float, float] | None = None
    eye: tuple[float, float] | None = None
    line: int = 3


@dataclass(frozen=True)
class ItemParts:
    """The parts of the picture of an item.

    ``title``: lines at the top, the first one large. ``photo``: None if no object is visible; ``room`` then holds
    photos of the room.
    """

    title: tuple[str, ...]
    photo: Panel | None
    room_view: Panel
    place: Panel
    room: tuple[UInt8Array, ...] = ()


def compose(parts: ItemParts) -> UInt8Array:
    """Return the picture (h, 960, 3) of an item."""
    from PIL import Image, ImageDraw

    lines = title_lines(parts.title)
    top = MARGIN + TITLE_LINE * len(lines) + 6
    low = top + CAPTION + TOP_HEIGHT + MARGIN
    page = Image.new("RGB", (WIDTH, low + CAPTION + LOW_HEIGHT + MARGIN), PAPER)
    draw = ImageDraw.Draw(page)
    for k, (text, is_first) in enumerate(lines):
        size, shade = (TITLE_SIZE, INK) if is_first else (TITLE_SIZE - 6, GREY)
        write_line(draw, (MARGIN, MARGIN + TITLE_LINE * k), text, size, shade, is_bold=is_first)
    right = MARGIN + PHOTO_WIDTH + MARGIN
    if parts.photo is not None:
        _place(page, draw, parts.photo, (MARGIN, top), (PHOTO_WIDTH, TOP_HEIGHT))
        _place(page, draw, zoomed(parts.photo), (right, top), (ZOOM_WIDTH, TOP_HEIGHT))
    else:
        _place_room(page, draw, parts.room, top)
    _place(page, draw, parts.room_view, (MARGIN, low), (PHOTO_WIDTH, LOW_HEIGHT))
    _place(page, draw, parts.place, (right, low), (ZOOM_WIDTH, LOW_HEIGHT))
    return np.asarray(page, np.uint8).copy()


def _place_room(page: Any, draw: Any, photos: tuple[UInt8Array, ...], top: int) -> None:
    """Draw photos of the room if there is no object to outline."""
    if not photos:
        box = (MARGIN, top + CAPTION, WIDTH - MARGIN, top + CAPTION + TOP_HEIGHT)
        draw.rectangle(box, fill=PANEL)
        write_line(draw, (MARGIN + 20, top + CAPTION + 20), "no frame shows this object", 18, GREY)
        return
    wide = (WIDTH - 2 * MARGIN - (ROOM_COLUMNS - 1) * ROOM_GAP) // ROOM_COLUMNS
    n_rows = -(-len(photos) // ROOM_COLUMNS)
    high = (TOP_HEIGHT - (n_rows - 1) * ROOM_GAP) // n_rows
    for k, photo in enumerate(photos):
        row, column = divmod(k, ROOM_COLUMNS)
        at = (MARGIN + column * (wide + ROOM_GAP), top + row * (high + ROOM_GAP))
        _place(page, draw, Panel("no object to outline; photos of the room" if k == 0 else "", photo), at, (wide, high))


def zoomed(photo: Panel) -> Panel:
    """Return the part of a photo around the object, with the aspect ratio of its panel."""
    assert photo.mask is not None
    part = window_around(photo.mask, ZOOM_WIDTH / TOP_HEIGHT)
    return Panel("zoom", photo.picture[part], photo.mask[part])


def window_around(mask: BoolArray, aspect: float, least_rows: float = 72.0) -> tuple[slice, slice]:
    """Return rows and columns of an image part around ``mask`` with this aspect ratio; the whole image if empty."""
    height, width = mask.shape
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return slice(0, height), slice(0, width)
    x0, x1, y0, y1 = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
    tall = max((y1 - y0) * ZOOM_GROWTH, (x1 - x0) * ZOOM_GROWTH / aspect, least_rows)
    tall = min(tall, float(height), width / aspect)
    wide = tall * aspect
    left = int(np.clip((x0 + x1 - wide) / 2, 0, width - wide))
    upper = int(np.clip((y0 + y1 - tall) / 2, 0, height - tall))
    return slice(upper, upper + max(1, round(tall))), slice(left, left + max(1, round(wide)))


def outlined(picture: UInt8Array, mask: BoolArray | None, size: tuple[int, int], line: int = 3) -> UInt8Array:
    """Resize ``picture`` to ``size`` (width, height) and outline ``mask``, with a white halo for contrast."""
    shown = fitted(picture, size)
    if mask is not None and mask.any():
        draw_outline(shown, mask, line)
    return shown


def fitted(picture: UInt8Array, size: tuple[int, int]) -> UInt8Array:
    """Resize ``picture`` to ``size`` (width, height)."""
    import cv2

    is_smaller = size[0] < picture.shape[1]
    resized: Any = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_CUBIC)
    result: UInt8Array = resized
    return result


def draw_outline(
    shown: UInt8Array, mask: BoolArray, line: int, colour: tuple[int, int, int] = OUTLINE, halo: int = 3
) -> None:
    """Outline ``mask``, of any resolution, in a picture; ``halo``: extra width of the white line below."""
    import cv2

    size = shown.shape[1], shown.shape[0]
    smooth = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    contours, _ = cv2.findContours((smooth > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(shown, contours, -1, HALO, line + halo, cv2.LINE_AA)
    cv2.drawContours(shown, contours, -1, colour, line, cv2.LINE_AA)


def _draw_ring(shown: UInt8Array, ring: tuple[float, float, float], eye: tuple[float, float] | None) -> None:
    """Draw a ring around the object, and an arrow to it from the camera position of the photo."""
    import cv2

    size = np.array([shown.shape[1], shown.shape[0]])
    middle, radius = np.array(ring[:2]) * size, max(14, round(ring[2] * size[0]))
    if eye is not None:
        start = np.array(eye) * size
        away = middle - start
        length = float(np.linalg.norm(away))
        end = middle - away / max(length, 1.0) * min(radius + 3, length)
        first, last = (tuple(int(v) for v in np.rint(point)) for point in (start, end))
        for shade, width in ((HALO, 5), (INK, 2)):
            tip = min(0.3, 12 / max(length, 1))
            cv2.arrowedLine(shown, first, last, shade, width, cv2.LINE_AA, tipLength=tip)
        cv2.circle(shown, first, 5, INK, -1, cv2.LINE_AA)
    centre = (round(middle[0]), round(middle[1]))
    cv2.circle(shown, centre, radius, HALO, 6, cv2.LINE_AA)
    cv2.circle(shown, centre, radius, OUTLINE, 3, cv2.LINE_AA)


def jpeg_bytes(picture: UInt8Array) -> bytes:
    """Return a JPEG with the colours of ``picture`` (h, w, 3); no block of 8 x 8 pixels depends on others.

    Measured on ``rooms/living0``: 0.20 MB and an error of at most 1 of 255 in flat beige areas. A palette of 256
    colours per scene: 0.13 MB and 15, beige turns pink; a PNG: 0.62 MB and 0.
    """
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=JPEG_QUALITY, subsampling=0, optimize=True)
    return buffer.getvalue()


def _place(page: Any, draw: Any, panel: Panel, at: tuple[int, int], size: tuple[int, int]) -> None:
    from PIL import Image

    write_line(draw, (at[0], at[1] + 3), panel.title, 14, GREY)
    height, width = panel.picture.shape[:2]
    scale = min(size[0] / width, size[1] / height)
    inner = (max(1, round(width * scale)), max(1, round(height * scale)))
    shown = outlined(panel.picture, panel.mask, inner, panel.line)
    if panel.ring is not None:
        _draw_ring(shown, panel.ring, panel.eye)
    corner = (at[0] + (size[0] - inner[0]) // 2, at[1] + CAPTION + (size[1] - inner[1]) // 2)
    page.paste(Image.fromarray(shown), corner)
    draw_tags(draw, panel.tags[:MAX_TAGS], corner, inner)


def draw_tags(draw: Any, tags: tuple[Tag, ...], at: tuple[int, int], size: tuple[int, int]) -> None:
    """Draw names at their positions, moved down where they would overlap."""
    taken: list[tuple[float, float, float]] = []
    for tag in tags:
        text = printable(tag.text, MAX_TAG_TEXT)
        wide = 8.0 * len(text) + 8
        x = float(np.clip(tag.x * size[0] - wide / 2, 2, max(2.0, size[0] - wide - 2)))
        y = float(np.clip(tag.y * size[1] - 30, 2, size[1] - TAG_LINE - 2))
        while any(abs(y - other[1]) < TAG_LINE and x < other[0] + other[2] and other[0] < x + wide for other in taken):
            y += TAG_LINE
        taken.append((x, y, wide))
        if y > size[1] - TAG_LINE:
            continue
        place = (at[0] + round(x), at[1] + round(y))
        box = draw.textbbox(place, text, font=font(13, False))
        draw.rectangle((box[0] - 3, box[1] - 2, box[2] + 3, box[3] + 2), fill=PAPER, outline=tag.colour)
        write_line(draw, place, text, 13, tag.colour)


def title_lines(title: tuple[str, ...]) -> list[tuple[str, bool]]:
    """Return lines and whether each belongs to the large first title; longer titles are truncated."""
    import textwrap

    lines: list[tuple[str, bool]] = []
    for k, text in enumerate(title):
        wide = FIRST_WIDE if k == 0 else REST_WIDE
        wrapped = textwrap.wrap(printable(text, MAX_TITLE_LINES * wide), wide) or [""]
        lines += [(line, k == 0) for line in wrapped]
    if len(lines) > MAX_TITLE_LINES:
        last, is_first = lines[MAX_TITLE_LINES - 1]
        wide = FIRST_WIDE if is_first else REST_WIDE
        lines = [*lines[: MAX_TITLE_LINES - 1], (last[: wide - 3] + "...", is_first)]
    return lines


def write_line(
    draw: Any, at: tuple[int, int], text: str, size: int, shade: tuple[int, ...], is_bold: bool = False
) -> None:
    draw.text(at, drawable(text), font=font(size, is_bold), fill=shade)


@cache
def font(size: int, is_bold: bool) -> Any:
    from matplotlib import get_data_path
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if is_bold else "DejaVuSans.ttf"
    path = Path(get_data_path()) / "fonts" / "ttf" / name
    return ImageFont.truetype(str(path), size, layout_engine=ImageFont.Layout.BASIC)


PROBES = 300  # points per instance that are searched in every frame
NEAR_M, NEAR_SHARE = 0.05, 0.03  # a point is visible if the depth image agrees within this tolerance
GOOD_AREA = 0.08  # image fraction above which a larger view of an object adds nothing
PIXEL_STEP = 2  # subsampling of the depth image for masks
CAP_M = 0.05  # a pixel belongs to the instance of the nearest map point within this distance


@dataclass(frozen=True)
class BestView:
    """``frame``: index in the list of frames; ``seen``: visible fraction of the instance.

    ``box`` (4,): columns and rows x0 y0 x1 y1 of the visible part, in pixels; views are ranked by ``score``.
    """

    frame: int
    seen: float
    box: Float64Array
    score: float


def best_view(frames: Sequence[Frame], points: Float32Array) -> BestView | None:
    """Return the frame that best shows ``points`` (N, 3): most of them, and large; None if none shows any."""
    if not len(points):
        return None
    probes = points[np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)].astype(np.float64)
    best, best_score = None, 0.0
    for k, frame in enumerate(frames):
        columns, rows, is_seen = seen_in(frame, probes)
        if not is_seen.any():
            continue
        height, width = frame.depth_m.shape
        x, y = columns[is_seen], rows[is_seen]
        box = np.array([x.min(), y.min(), x.max() + 1, y.max() + 1])
        area = float((box[2] - box[0]) * (box[3] - box[1])) / (width * height)
        share = float(is_seen.mean())
        score = share**1.5 * min(area / GOOD_AREA, 1.0) ** 0.5
        if score > best_score:
            best, best_score = BestView(k, share, box, score), score
    return best


def seen_in(frame: Frame, points: Float64Array) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return columns and rows (N,) of ``points`` (N, 3) in a frame, and which of them are visible."""
    height, width = frame.depth_m.shape
    in_camera = (points - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, :3]
    depth = np.maximum(in_camera[:, 2], 1e-6)
    columns = in_camera[:, 0] / depth * frame.intrinsics[0, 0] + frame.intrinsics[0, 2]
    rows = in_camera[:, 1] / depth * frame.intrinsics[1, 1] + frame.intrinsics[1, 2]
    is_inside = (in_camera[:, 2] > 0.05) & (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    is_seen: BoolArray = is_inside.copy()
    here = np.flatnonzero(is_inside)
    measured = frame.depth_m[rows[here].astype(np.int64), columns[here].astype(np.int64)]
    is_seen[here] = np.abs(measured - depth[here]) <= NEAR_M + NEAR_SHARE * depth[here]
    return columns, rows, is_seen


def mask_in_frame(frame: Frame, tree: object, is_member: BoolArray, bounds: Float64Array) -> BoolArray:
    """Return the mask (h, w) of the instance in a frame, on every ``PIXEL_STEP``-th pixel.

    ``tree``: ``KDTree`` of the map's points; ``is_member`` (N,): points of the instance, which are within ``bounds``
    (2, 3).
    """
    pixels = np.zeros(frame.depth_m.shape, np.bool_)
    pixels[::PIXEL_STEP, ::PIXEL_STEP] = True
    pixels &= valid_depth(frame.depth_m, 0.0, np.inf)
    places = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels)
    is_near = ((places >= bounds[0] - CAP_M) & (places <= bounds[1] + CAP_M)).all(axis=1)
    mask = np.zeros(frame.depth_m.shape, np.bool_)
    if is_near.any():
        _, nearest = tree.query(places[is_near], distance_upper_bound=CAP_M)  # type: ignore[attr-defined]
        owned = np.append(is_member, False)[nearest]
        rows, columns = np.nonzero(pixels)
        mask[rows[is_near][owned], columns[is_near][owned]] = True
    return mask[::PIXEL_STEP, ::PIXEL_STEP]
