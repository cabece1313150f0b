"""A page for pictures and text, colours for classes, instances and similarities, and point cloud rendering."""

from __future__ import annotations

import io
import itertools
import textwrap
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from su3d_bench.core.compiled import njit
from su3d_bench.core.errors import ConfigError, printable
from su3d_bench.core.files.atomic import make_folder, write_bytes
from su3d_bench.core.types import Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from su3d_bench.metrics.protocols.loading import class_names

Width = Literal["8cm", "17cm"]
WIDTHS_IN: dict[Width, float] = {"8cm": 8 / 2.54, "17cm": 17 / 2.54}  # of one and of two columns of a paper
DPI, SCREEN_DPI = 300, 100
GAP_IN = 0.06  # between pictures
POINTS = 8  # type size of every figure at its printed width
LINE_IN, LETTERS_PER_INCH = 0.15, 14.0  # height of a line of text, and characters per inch of it
DARK, GREY = "#222222", "#666666"
# Of every figure. Fonts are embedded as TrueType, text in an SVG stays text, and a fixed salt makes it reproducible.
STYLE: Any = {
    **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize", "legend.fontsize"), POINTS),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), POINTS),
    **dict.fromkeys(("axes.linewidth", "grid.linewidth", "hatch.linewidth", "patch.linewidth"), 0.6),
    **{"lines.linewidth": 1.0, "lines.markersize": 4, "grid.color": "0.85", "text.parse_math": False},
    **{"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "su3d-bench"},
}
METADATA = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {"Software": None}}  # without dates


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw in the style of every figure; also a decorator."""
    from matplotlib import rc_context

    with rc_context(STYLE):
        yield


class Canvas:
    """A page of ``width`` by ``height`` units, ``per_inch`` units per inch; by default, units are pixels of screens."""

    def __init__(self, width: float, height: float, *, per_inch: float = SCREEN_DPI, dpi: int = SCREEN_DPI) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / per_inch, height / per_inch), dpi=dpi, facecolor="white")
        FigureCanvasAgg(self.figure)

    def text(self, x: float, y: float, text: str, size: float = POINTS, *, colour: str = DARK, **more: Any) -> None:
        """Write ``text``, without math mode, with its upper left corner at this position."""
        style: dict[str, Any] = {"va": "top", "fontsize": size, "color": colour, "parse_math": False} | more
        self.figure.text(x / self.width, 1 - y / self.height, drawable(text), **style)

    def axes(self, x: float, y: float, width: float, height: float) -> Any:
        """Return axes without a frame at this position."""
        box = (x / self.width, 1 - (y + height) / self.height, width / self.width, height / self.height)
        axes = self.figure.add_axes(box)
        axes.set_axis_off()
        return axes

    def picture(self, x: float, y: float, width: float, height: float, pixels: UInt8Array) -> Any:
        """Return axes at this position filled by the picture, in units of its pixels."""
        axes = self.axes(x, y, width, height)
        axes.imshow(pixels, interpolation="nearest", aspect="auto")
        axes.set_xlim(-0.5, pixels.shape[1] - 0.5)
        axes.set_ylim(pixels.shape[0] - 0.5, -0.5)
        return axes

    def write(self, path: Path, caption: str = "") -> None:
        """Write the page as PDF, PNG or SVG by the suffix of ``path``, with its folder."""
        write_figure(self.figure, path, caption)


class Panels:
    """A page of ``n`` pictures of this aspect ratio (height / width), each with a line of text above; in inches."""

    def __init__(self, width: Width, columns: int, n: int, aspect: float, below_in: float = 0.0) -> None:
        self.page_width = WIDTHS_IN[width]
        self.width = (self.page_width - GAP_IN * (columns - 1)) / columns
        self.height = self.width * aspect
        row_in = LINE_IN + self.height + GAP_IN
        self.places = [(k % columns * (self.width + GAP_IN), k // columns * row_in) for k in range(n)]
        self.bottom = row_in * -(-n // columns)
        self.page = Canvas(self.page_width, self.bottom + below_in, per_inch=1, dpi=DPI)

    def draw(self, k: int, title: str, pixels: UInt8Array) -> Any:
        """Return the axes of the ``k``-th picture, in units of its pixels."""
        left, upper = self.places[k]
        self.page.text(left, upper + 0.01, title)
        return self.page.picture(left, upper + LINE_IN, self.width, self.height, pixels)


def write_figure(figure: Any, path: Path, caption: str = "") -> None:
    """Write a figure as PDF, PNG or SVG by the suffix of ``path``, with its folder; ``ConfigError`` for others.

    ``caption`` is only in the metadata of the file: a figure has no title, as its caption belongs to the paper.
    """
    content = figure_bytes(figure, figure_format(path), caption)
    make_folder(path.parent)
    write_bytes(path, content)


def figure_format(path: Path) -> str:
    """The format of a figure by the suffix of ``path``; ``ConfigError`` if it is not one of ``METADATA``."""
    if (kind := path.suffix.lower().removeprefix(".")) not in METADATA:
        raise ConfigError(
            f"{printable(str(path), 200)}: unknown format of a figure; use a suffix of {', '.join(METADATA)}"
        )
    return kind


def figure_bytes(figure: Any, kind: str, caption: str = "") -> bytes:
    """Return the file of a figure: the same bytes for the same figure."""
    buffer = io.BytesIO()
    title = {"Title": printable(caption, 1000)} if caption else {}
    with figure_style():
        figure.savefig(buffer, format=kind, dpi="figure", metadata=METADATA[kind] | title)
    return buffer.getvalue()


def fitted(text: str, inches: float) -> str:
    """Return ``text`` in lines that fit this width."""
    return textwrap.fill(drawable(printable(text)), max(8, int(inches * LETTERS_PER_INCH)))


def drawable(text: str) -> str:
    """Replace characters that the font cannot draw by escapes."""
    from matplotlib.font_manager import findfont, get_font

    known = get_font(findfont("DejaVu Sans")).get_charmap()
    return "".join(c if ord(c) in known else c.encode("unicode_escape").decode("ascii") for c in text)


def paper(edge: str = "none", pad: float = 0.15, alpha: float = 0.85, **more: Any) -> dict[str, Any]:
    """Return the style of the white rounded box behind text in a picture."""
    return {"boxstyle": f"round,pad={pad}", "facecolor": "white", "edgecolor": edge, "alpha": alpha} | more


def hex_of(colour: tuple[int, ...]) -> str:
    """Return a colour in matplotlib's format.

    >>> hex_of((255, 0, 16))
    '#ff0010'
    """
    return "#{:02x}{:02x}{:02x}".format(*colour)


Colour = tuple[int, int, int]
Scale = Literal["paper", "cividis"]
SCALES: tuple[Scale, ...] = ("paper", "cividis")
STEPS = 256
NO_INSTANCE = (214, 214, 210)
# Room surfaces are pale, so that objects stand out.
ROOM_SURFACES = {"wall": (226, 222, 214), "floor": (208, 203, 196), "ceiling": (236, 236, 232)}
# The most similar instance dark red, the least similar dark blue, as in the paper's heat maps.
HEAT_STOPS = np.array(
    [[0, 0, 128], [0, 80, 255], [90, 215, 190], [250, 190, 40], [230, 50, 10], [128, 0, 0]], np.float64
)
N_OTHERS = 199  # colours for names in no class table; a prime, so that hashes spread
GRID = np.arange(24, 256, 11)  # candidate values per channel
LIGHTNESS, MIN_CHROMA = (0.42, 0.86), 0.16  # in Oklab: neither black nor white, and distinct from the pale surfaces
HUE_WEIGHT = 2.0  # relative to lightness, which shading changes
TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
TO_OKLAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
FIRST = (46, 112, 222)  # the first colour of the palette


def class_colours(names: Sequence[str]) -> dict[str, Colour]:
    """Return name -> colour, the same for a name in every picture; room surfaces are pale.

    Names of the class tables have the most distinct colours, all different. Other names have a colour by their hash, or
    the next one if another of these ``names`` has it.

    >>> class_colours(["book", "lamp"])["lamp"] == class_colours(["lamp"])["lamp"]
    True
    """
    known = _place_of_class()
    others = sorted({name for name in names if name not in known and name not in ROOM_SURFACES})
    palette = distinct_colours(len(known) + (N_OTHERS if others else 0))
    place_of, taken = dict(known), set[int]()
    for name in others:
        place = zlib.crc32(name.encode("utf-8", "surrogatepass")) % N_OTHERS
        while place in taken and len(taken) < N_OTHERS:
            place = (place + 1) % N_OTHERS
        taken.add(place)
        place_of[name] = len(known) + place
    return {name: ROOM_SURFACES.get(name) or palette[place_of[name]] for name in names}


def instance_colours(names: Sequence[str]) -> list[Colour]:
    """Return one colour per instance, the first ones most distinct; room surfaces are pale."""
    many = distinct_colours(len(names))
    return [ROOM_SURFACES.get(name) or many[k] for k, name in enumerate(names)]


@cache
def _place_of_class() -> dict[str, int]:
    """Return the palette index of each known class except room surfaces."""
    things = (name for name in class_names() if name not in ROOM_SURFACES)
    return {name: place for place, name in enumerate(things)}


def distinct_colours(n: int) -> tuple[Colour, ...]:
    """Return the first ``n`` colours of a palette of maximally distinct colours, repeated if ``n`` is large."""
    row = _palette(min(n, len(_place_of_class()) + N_OTHERS))
    return tuple(row[k % len(row)] for k in range(n))


@cache
def _palette(n: int) -> tuple[Colour, ...]:
    """Return ``n`` colours, each the farthest in Oklab from all before it and from the pale ones."""
    grid = np.stack(np.meshgrid(GRID, GRID, GRID, indexing="ij"), -1).reshape(-1, 3)
    places = _oklab(grid)
    is_strong = np.hypot(places[:, 1], places[:, 2]) > MIN_CHROMA
    is_strong &= (places[:, 0] > LIGHTNESS[0]) & (places[:, 0] < LIGHTNESS[1])
    grid, places = grid[is_strong], places[is_strong]
    pale = _oklab(np.array([*ROOM_SURFACES.values(), NO_INSTANCE]))
    away = ((places[:, None] - pale) ** 2).sum(axis=2).min(axis=1)
    chosen = [int(np.abs(grid - FIRST).sum(axis=1).argmin())]
    while len(chosen) < n:
        away = np.minimum(away, ((places - places[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(away.argmax()))
    return tuple((int(red), int(green), int(blue)) for red, green, blue in grid[chosen])


def _oklab(colours: Int64Array) -> Float64Array:
    """Convert sRGB (N, 3) in 0..255 to Oklab (Ottosson 2020) with weighted colour axes."""
    share = colours / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    places: Float64Array = np.cbrt(linear @ TO_CONES.T) @ TO_OKLAB.T * (1.0, HUE_WEIGHT, HUE_WEIGHT)
    return places


def heat_colours(similarity: Float64Array) -> list[Colour]:
    """Return colours from dark blue (minimum) to dark red (maximum); the middle if all values are equal."""
    if len(similarity) == 0:
        return []
    place = _places(similarity)
    stops = np.linspace(0.0, 1.0, len(HEAT_STOPS))
    channels = [np.rint(np.interp(place, stops, HEAT_STOPS[:, c])).astype(int) for c in range(3)]
    return [(int(r), int(g), int(b)) for r, g, b in zip(*channels, strict=True)]


def _places(similarity: Float64Array) -> Float64Array:
    """Scale the values from minimum to maximum to 0..1; 0.5 if all are equal."""
    low, high = float(similarity.min()), float(similarity.max())
    return np.full(len(similarity), 0.5) if high == low else (similarity - low) / (high - low)


def scale_stops(scale: Scale) -> UInt8Array:
    """Return the colours (256, 3) of a scale, from least to most similar."""
    if scale == "cividis":  # Nunez, Anderton, Renslow 2018
        from matplotlib import colormaps

        colours: UInt8Array = (colormaps["cividis"](np.arange(STEPS), bytes=True))[:, :3].astype(np.uint8)
        return colours
    return np.array(heat_colours(np.linspace(0.0, 1.0, STEPS)), np.uint8)


def similarity_colours(similarity: Float64Array, scale: Scale = "paper") -> UInt8Array:
    """Return one colour (K, 3) per value, scaled from minimum to maximum; the middle if all are equal.

    >>> similarity_colours(np.array([0.2, 0.1, 0.3]))[1:].tolist()
    [[0, 0, 128], [128, 0, 0]]
    """
    if len(similarity) == 0:
        return np.zeros((0, 3), np.uint8)
    colours: UInt8Array = scale_stops(scale)[np.rint(_places(similarity) * (STEPS - 1)).astype(np.int64)]
    return colours


@njit(cache=True)
def averaged_colours(point: Any, shade: Any, palette: Any, steps: int) -> Any:
    """Return the mean colours (h / steps, w / steps, 3) of pixel blocks, summed in numpy's order.

    ``palette`` (N + 1, 3) float32 ends with the background colour, used where ``point`` (h, w) is -1.
    """
    height, width = point.shape[0] // steps, point.shape[1] // steps
    background = palette.shape[0] - 1
    picture = np.empty((height, width, 3), np.uint8)
    total = np.empty(3, np.float32)
    for row in range(height):
        for column in range(width):
            total[:] = 0.0
            for y in range(row * steps, (row + 1) * steps):
                for x in range(column * steps, (column + 1) * steps):
                    place = point[y, x]
                    light = shade[y, x]
                    if place < 0:
                        place, light = background, np.float32(1.0)
                    for c in range(3):
                        total[c] += palette[place, c] * light
            for c in range(3):
                picture[row, column, c] = np.uint8(np.rint(total[c] / np.float32(steps * steps)))
    return picture


BACKGROUND = (252, 252, 250)
OVERSAMPLING = 2
CUT_BELOW_TOP_M = 0.3  # also removes lamps and other things at the ceiling
ROOM_HEIGHT_M = 1.8  # lower clouds have no ceiling to cut away
CUT_BEHIND_WALL_M = 0.25
ELEVATION = np.deg2rad(38.0)
AZIMUTHS = (np.deg2rad(-125.0), np.deg2rad(55.0))
FIELD_OF_VIEW = np.deg2rad(38.0)
DEPTH_BINS = 3  # near points are drawn larger than far ones, in this many size steps
MAX_SQUARE = 15
SHADE_STRENGTH = 60.0
SHADE_REACH = 2  # pixels of the oversampled image
MAX_STEP_BEHIND = 0.02  # of log2 of depth


@dataclass(frozen=True)
class Camera:
    """A view of a box of the world.

    ``rotation``: the camera's right, down and forward axes as rows; ``focal``: in pixels, or pixels per metre if not
    ``is_perspective``. Points outside ``box`` (2, 3) are cut away.
    """

    rotation: Float64Array
    eye: Float64Array
    focal: float
    is_perspective: bool
    box: Float64Array
    width: int
    height: int


@dataclass(frozen=True)
class View:
    """A rendering: ``point`` (h, w) int32 is the visible point, -1 for none; ``shade`` (h, w) float32 in 0..1."""

    point: Int32Array
    shade: Float32Array


def room_bounds(points: Float32Array) -> Float64Array:
    """Return the lowest and highest corner (2, 3) of a cloud, ignoring outliers."""
    return np.percentile(points.astype(np.float64), [0.5, 99.5], axis=0)


def view_cameras(bounds: Float64Array, width: int, height: int) -> tuple[Camera, Camera, Camera]:
    """Return a top view and views from two opposite corners of ``bounds``, without ceiling and near walls; z is up."""
    width, height = width * OVERSAMPLING, height * OVERSAMPLING
    low, high = bounds[0] - 0.1, bounds[1] + 0.1
    size = high - low
    top_z = bounds[1][2] - CUT_BELOW_TOP_M if size[2] >= ROOM_HEIGHT_M else high[2]
    open_top = np.array([low, [high[0], high[1], top_z]])
    pixels_per_m = 0.96 * min(width / size[0], height / size[1])
    above = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, open_top[1, 2] + 4.0])
    top = Camera(np.diag([1.0, -1.0, -1.0]), above, pixels_per_m, False, open_top, width, height)
    first, second = (_corner_camera(open_top, azimuth, width, height) for azimuth in AZIMUTHS)
    return top, first, second


def _corner_camera(open_top: Float64Array, azimuth: float, width: int, height: int) -> Camera:
    outward = np.array([np.cos(azimuth) * np.cos(ELEVATION), np.sin(azimuth) * np.cos(ELEVATION), np.sin(ELEVATION)])
    forward = -outward
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    box = open_top.copy()
    for axis in range(2):
        if outward[axis] > 0:
            box[1, axis] -= CUT_BEHIND_WALL_M + 0.1
        else:
            box[0, axis] += CUT_BEHIND_WALL_M + 0.1
    focal = 0.5 * height / np.tan(FIELD_OF_VIEW / 2)
    corners = np.array(list(itertools.product(*open_top.T)))
    relative = (corners - open_top.mean(axis=0)) @ rotation.T
    # The smallest distance at which all corners are inside the image.
    reach = np.abs(relative[:, :2]) * focal / (0.48 * np.array([width, height])) - relative[:, 2:]
    eye = open_top.mean(axis=0) + outward * float(reach.max())
    return Camera(rotation, eye, float(focal), True, box, width, height)


def render(points: Float32Array, spacing_m: float, camera: Camera) -> View:
    """Return the visible point of each pixel, with points drawn as squares of ``spacing_m`` width."""
    from scipy.ndimage import minimum_filter

    inside = np.flatnonzero(((points >= camera.box[0]) & (points <= camera.box[1])).all(axis=1))
    relative = (points[inside].astype(np.float64) - camera.eye) @ camera.rotation.T
    depth = relative[:, 2]
    scale = camera.focal / depth if camera.is_perspective else np.full(len(depth), camera.focal)
    column = np.floor(relative[:, 0] * scale + camera.width / 2).astype(np.int64)
    row = np.floor(relative[:, 1] * scale + camera.height / 2).astype(np.int64)
    seen = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    order = np.flatnonzero(seen)[np.argsort(-depth[seen], kind="stable")]  # far first: the last point of a pixel stays
    rank = np.arange(len(order), 0, -1, dtype=np.float64)  # 1 is the nearest; float64, as in the filter
    nearest = np.full((camera.height, camera.width), np.inf)
    for part in np.array_split(np.arange(len(order)), DEPTH_BINS):
        if len(part) == 0:
            continue
        layer = np.full((camera.height, camera.width), np.inf)
        layer[row[order[part]], column[order[part]]] = rank[part]
        size = int(np.clip(np.rint(spacing_m * scale[order[part]].mean()), 1, MAX_SQUARE))
        np.minimum(nearest, minimum_filter(layer, size, mode="constant", cval=np.inf), out=nearest)
    is_drawn = np.isfinite(nearest)
    chosen = order[len(order) - nearest[is_drawn].astype(np.int64)]
    point = np.full(nearest.shape, -1, np.int32)
    point[is_drawn] = inside[chosen]
    depth_image = np.full(nearest.shape, np.nan)
    depth_image[is_drawn] = depth[chosen]
    return View(point, _shade(depth_image))


def project(camera: Camera, points: Float64Array) -> Float64Array:
    """Project points to columns and rows (N, 2) of the picture of ``camera``; NaN for points behind it."""
    relative = (points - camera.eye) @ camera.rotation.T
    depth = np.where(relative[:, 2] > 0, relative[:, 2], np.nan)
    scale = camera.focal / depth if camera.is_perspective else np.full(len(points), camera.focal)
    middle = np.array([camera.width, camera.height]) / 2
    pixels: Float64Array = (relative[:, :2] * scale[:, None] + middle) / OVERSAMPLING
    return pixels


def _shade(depth: Float64Array) -> Float32Array:
    """Return the shading factor (eye-dome lighting): 1 on open surfaces, darker behind depth edges.

    ``depth`` is NaN where nothing is drawn.
    """
    padded = np.pad(np.log2(depth), SHADE_REACH, mode="wrap")
    behind: Float64Array = depth_steps(padded, SHADE_REACH, MAX_STEP_BEHIND)
    return np.exp(-SHADE_STRENGTH / 8.0 * behind).astype(np.float32)


@njit(cache=True)
def depth_steps(padded: Any, reach: int, max_step: float) -> Any:
    """Sum how far each pixel is behind its eight neighbours ``reach`` pixels away, each up to ``max_step``.

    ``padded`` has a border of ``reach`` pixels around the image; NaN adds nothing.
    """
    height, width = padded.shape[0] - 2 * reach, padded.shape[1] - 2 * reach
    behind = np.zeros((height, width))
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        above, left = reach - dy * reach, reach - dx * reach
        for row in range(height):
            for column in range(width):
                step = padded[row + reach, column + reach] - padded[row + above, column + left]
                behind[row, column] += min(step, max_step) if step > 0.0 else 0.0
    return behind


def colour(view: View, colours: UInt8Array) -> UInt8Array:
    """Return the picture (h / 2, w / 2, 3) of a view, point i in ``colours[i]``, downsampled by averaging."""

    palette = np.concatenate([colours, np.array([BACKGROUND], np.uint8)]).astype(np.float32)
    averaged: UInt8Array = averaged_colours(view.point, view.shade, palette, OVERSAMPLING)
    return averaged
