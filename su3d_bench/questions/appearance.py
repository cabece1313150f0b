"""What images show of an object, and what its vertices imply about its looks: colour, sides, words for its shape.

Only visible objects are asked about: an object that no frame shows large enough is not. Looks are for ground truth from
scans, which has no annotated appearance. A word for an object is certain, possible or ruled out; if it is merely
possible, no question uses it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from su3d_bench.core.english import last_word
from su3d_bench.core.types import BoolArray, Float64Array, Frame, GroundTruth, Int64Array
from su3d_bench.numerics.relations import FIXTURES, FLAT_M

N_FRAMES = 40  # ours: spread evenly, enough to see nearly everything in a room
MAX_VERTICES = 3000  # per object: at 0.5 m a scan with 0.02 m spacing still hits most cells of its image
SAME_SURFACE_M = 0.05  # a vertex is seen if the depth image agrees with it within this
CELLS_PER_SIDE = 80  # of the grid over an image in which seen vertices are counted
MIN_PART_SHARE = 0.002  # ours: of an image; about 25 x 25 pixels of 640 x 480, enough to recognise an object
MIN_PIXELS = 60  # ours: fewer are too few to name a colour
OTHER_LIGHT = 1.25  # ours: an unannotated colour is named if this much more or less light does not change its word
END_M = 0.05  # within this of each side of an object's box, some vertex must be seen away from the image's border
BORDER_SHARE = 0.05  # of the image's longer side
# Objects whose colour is that of what they show or of their frame, which is not used to name them.
WITHOUT_COLOUR = frozenset(("picture", "painting", "poster", "photo", "mirror", "window", "screen", "tv", "monitor"))
MIN_SHARE = 0.6  # ours: of the pixels of an object that must have the same word
MAYBE_SHARE = 0.2  # ours: from this share of pixels on, the word is possible for the object
# CIELAB, all ours: below this chroma a colour is black, grey or white, by its lightness.
GREY_CHROMA, BLACK_L, WHITE_L = 12.0, 25.0, 75.0
HUES_DEGREES = (
    (40.0, "red"), (75.0, "orange"), (105.0, "yellow"), (200.0, "green"), (310.0, "blue"), (345.0, "purple"),
)  # fmt: skip
COLOURS = frozenset(("black", "grey", "white", "brown", "beige", "pink", *(name for _, name in HUES_DEGREES)))
BROWN_L, BROWN_CHROMA, BEIGE_CHROMA = 60.0, 45.0, 30.0  # a dull dark orange is brown, a pale orange or yellow beige
PINK_L = 60.0  # a light red is pink
DARK_L, LIGHT_L = 35.0, 70.0  # for any hue
TONES = frozenset(("dark", "light-coloured"))


@dataclass(frozen=True)
class Sight:
    """``share``: the largest share of an image that an object fills; ``colour``: a word, empty if none fits.

    ``is_certain_colour``: whether it stays the same in slightly different light; ``possible_colours``: words for many
    of its pixels in such light; ``tones`` and ``possible_tones``: dark or light, likewise. ``is_cut``: whether a side
    of its box was seen only at the border of the images.
    """

    share: float
    colour: str
    is_certain_colour: bool = False
    is_cut: bool = False
    possible_colours: frozenset[str] = frozenset()
    tones: frozenset[str] = frozenset()
    possible_tones: frozenset[str] = frozenset()

    @property
    def is_plain(self) -> bool:
        """Whether it is visible enough to ask about."""
        return self.share >= MIN_PART_SHARE


def sights(dataset: Any, scene: str, truth: GroundTruth, min_vertices: int) -> Mapping[int, Sight]:
    """Instance id -> what the frames show of it, for the ground-truth instances seen in any frame."""
    rows = _sampled_vertices(truth, min_vertices)
    points, owner = truth.points[rows].astype(np.float64), truth.instance[rows].astype(np.int64)
    pixels: dict[int, list[Float64Array]] = {}
    shares: dict[int, float] = {}
    is_inside = np.zeros(len(points), bool)
    for frame in evaluated(dataset, scene):
        seen, line, column = _seen(frame, points)
        height, width = frame.depth_m.shape
        from_border = np.minimum.reduce([line, height - 1 - line, column, width - 1 - column])
        is_inside[seen] |= from_border >= BORDER_SHARE * max(height, width)
        side = max(frame.depth_m.shape) / CELLS_PER_SIDE
        n_lines, n_columns = np.ceil(np.array(frame.depth_m.shape) / side).astype(np.int64)
        cell = (line / side).astype(np.int64) * n_columns + (column / side).astype(np.int64)
        taken = np.unique(owner[seen] * (n_lines * n_columns) + cell) // (n_lines * n_columns)
        for instance, n in zip(*np.unique(taken, return_counts=True), strict=True):
            share = float(n / (n_lines * n_columns))
            shares[int(instance)] = max(shares.get(int(instance), 0.0), share)
        rgb = frame.rgb[line, column].astype(np.float64)
        for instance in np.unique(owner[seen]).tolist():
            pixels.setdefault(instance, []).append(rgb[owner[seen] == instance][:: max(1, MAX_VERTICES // 300)])
    found = {}
    for instance in sorted(shares):
        rgb, own = np.concatenate(pixels[instance]), owner == instance
        word = colour_word(rgb)
        lights = [(rgb * light).clip(max=255.0) for light in (1 / OTHER_LIGHT, OTHER_LIGHT)]
        is_sure = all(colour_word(lit) == word for lit in lights)
        tones = tones_of([rgb, *lights])
        is_cut = _is_cut(points[own], is_inside[own])
        found[instance] = Sight(shares[instance], word, is_sure, is_cut, possible_colours([rgb, *lights]), *tones)
    return found


def _is_cut(points: Float64Array, is_inside: BoolArray) -> bool:
    """Whether along one of the six sides of their box no point (N, 3) was seen inside an image."""
    low, high = points.min(axis=0), points.max(axis=0)
    ends = np.concatenate([points - low <= END_M, high - points <= END_M], axis=1)
    return not (ends & is_inside[:, None]).any(axis=0).all()


def evaluated(dataset: Any, scene: str) -> Iterator[Frame]:
    """The frames of a scene, one at a time, that decide which objects are visible enough for questions."""
    frames = dataset.frames(scene, max(1, int(dataset.info(scene, 1).n_frames) // N_FRAMES))
    return (frames[k] for k in range(min(len(frames), N_FRAMES)))


def instance_rows(truth: GroundTruth, min_vertices: int) -> Iterator[tuple[int, Int64Array]]:
    """Id and rows, both ascending, of each ground-truth instance with at least ``min_vertices`` vertices."""
    order = np.argsort(truth.instance, kind="stable")
    ids, starts = np.unique(truth.instance[order], return_index=True)
    for instance, rows in zip(ids.tolist(), np.split(order, starts[1:]), strict=True):
        if instance > 0 and len(rows) >= min_vertices:
            yield instance, rows


def _sampled_vertices(truth: GroundTruth, min_vertices: int) -> Int64Array:
    """Ground-truth rows: up to 3000 of each instance that is large enough, spread evenly in its order."""
    parts = [
        rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_VERTICES)).astype(np.int64)]
        for _, rows in instance_rows(truth, min_vertices)
    ]
    return np.concatenate([np.zeros(0, np.int64), *parts])


def _seen(frame: Frame, points: Float64Array) -> tuple[Int64Array, Int64Array, Int64Array]:
    """The rows of the points seen in the frame, with the image row and column of the pixel of each."""
    rotation, centre = frame.camera_to_world[:3, :3], frame.camera_to_world[:3, 3]
    camera = (points - centre) @ rotation
    rows = np.flatnonzero(camera[:, 2] > 0)
    projected = camera[rows] @ frame.intrinsics.T
    column, line = np.rint(projected[:, :2] / projected[:, 2:]).T
    height, width = frame.depth_m.shape
    inside = (column >= 0) & (column < width) & (line >= 0) & (line < height)
    rows, column, line = rows[inside], column[inside].astype(np.int64), line[inside].astype(np.int64)
    agrees = np.abs(frame.depth_m[line, column] - camera[rows, 2]) < SAME_SURFACE_M
    return rows[agrees], line[agrees], column[agrees]


def colour_word(rgb: Float64Array) -> str:
    """The colour word for pixels (N, 3), 0..255, empty if they are too few or of too many colours.

    >>> colour_word(np.tile([200.0, 40.0, 40.0], (100, 1))), colour_word(np.tile([200.0, 40.0, 40.0], (3, 1)))
    ('red', '')
    """
    if len(rgb) < MIN_PIXELS:
        return ""
    words, counts = np.unique(_words_of(rgb), return_counts=True)
    best = int(counts.argmax())
    return str(words[best]) if counts[best] >= MIN_SHARE * len(rgb) else ""


def possible_colours(lights: Sequence[Float64Array]) -> frozenset[str]:
    """The words for many of the same pixels (N, 3) in one of several lights; all words if there are too few pixels."""
    if len(lights[0]) < MIN_PIXELS:
        return COLOURS
    found = set()
    for rgb in lights:
        words, counts = np.unique(_words_of(rgb), return_counts=True)
        found |= set(words[counts >= MAYBE_SHARE * len(rgb)].tolist())
    return frozenset(found)


def tones_of(lights: Sequence[Float64Array]) -> tuple[frozenset[str], frozenset[str]]:
    """The tones of most of the same pixels (N, 3) in all of several lights, and of many of them in at least one."""
    if len(lights[0]) < MIN_PIXELS:
        return frozenset(), TONES
    lightness = np.stack([_lab(rgb)[:, 0] for rgb in lights])
    shares = {"dark": (lightness < DARK_L).mean(axis=1), "light-coloured": (lightness > LIGHT_L).mean(axis=1)}
    sure = frozenset(tone for tone, share in shares.items() if share.min() >= MIN_SHARE)
    return sure, frozenset(tone for tone, share in shares.items() if share.max() >= MAYBE_SHARE)


def _lab(rgb: Float64Array) -> Float64Array:
    import cv2

    lab: Float64Array = cv2.cvtColor((rgb / 255.0).astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0].astype(np.float64)
    return lab


def _words_of(rgb: Float64Array) -> np.ndarray:
    """The word for each pixel, by lightness, chroma and hue in CIELAB."""
    lab = _lab(rgb)
    lightness, chroma = lab[:, 0], np.hypot(lab[:, 1], lab[:, 2])
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) % 360
    ends = np.array([end for end, _ in HUES_DEGREES])
    names = np.array([*(name for _, name in HUES_DEGREES), "red"])
    words = names[np.searchsorted(ends, hue, side="right")]
    is_warm = (words == "orange") | (words == "yellow")
    words = np.where(is_warm & (lightness >= BROWN_L) & (chroma < BEIGE_CHROMA), "beige", words)
    words = np.where((words == "orange") & (lightness < BROWN_L) & (chroma < BROWN_CHROMA), "brown", words)
    words = np.where((words == "red") & (lightness >= PINK_L), "pink", words)
    greys = np.where(lightness < BLACK_L, "black", np.where(lightness >= WHITE_L, "white", "grey"))
    return np.where(chroma < GREY_CHROMA, greys, words)


# Objects commonly named by shape, by the last word: seen from above, or from the front if they hang flat.
WITH_TOP = frozenset(("table", "desk", "nightstand", "stool", "ottoman", "bench"))
WITH_SHAPE = WITH_TOP | frozenset((
    "rug", "mat", "carpet", "tray", "bin", "basket", "box",
    "mirror", "clock", "picture", "painting", "poster", "window",
))  # fmt: skip
SHAPES = frozenset(("round", "square", "rectangular"))
# Objects without a fixed height or shape: the face of a leaning object is not its footprint.
SOFT = frozenset(("blanket", "towel", "cloth", "clothes", "comforter", "cushion", "pillow", "bag", "backpack", "shoe"))
MIN_SIDE_M = 0.2  # ours: for a smaller face, the noise of a scan hides the shape
TOP_M = 0.05  # ours: the depth of a top, beyond which legs may stick out
FLAT_SHARE = 0.2  # ours: a face is upright if the object is this much thinner than it is long and high
# All ours. Area over that of the circle with the longest diameter: an octagon has 0.90, a square 0.64.
ROUND, MAYBE_ROUND = 0.92, 0.80
# Area over that of the smallest enclosing rectangle: a circle has 0.79, an octagon 0.83.
STRAIGHT, MAYBE_STRAIGHT = 0.93, 0.86
# Height over length; length over width, and twice that over the height.
BUILDS = frozenset(("tall", "long"))
TALL, MAYBE_TALL, LONG, MAYBE_LONG = 1.8, 1.3, 2.5, 1.8
MIN_LONG_M = 1.0  # minimum to be long or tall in general; a smaller object may be so for its kind
# Longer over shorter side of that rectangle.
SQUARE, MAYBE_SQUARE = 1.1, 1.25


def is_flat(sides: Float64Array) -> bool:
    """Whether an object with these sides (3,) is so flat that its volume is not a meaningful size."""
    least, middle, _ = sorted(sides.tolist())
    return bool(least < FLAT_SHARE * middle)


@dataclass(frozen=True, eq=False)
class Appearance:
    """``sides`` (3,): length, width and height in metres along the object's own axes, with length >= width.

    ``words`` are certain; ``maybe`` are possible, including the certain ones.
    """

    sides: Float64Array
    words: frozenset[str]
    maybe: frozenset[str]


def appearance_of(name: str, points: Float64Array, sight: Sight | None, *, is_cut: bool) -> Appearance:
    """The looks of a named object by its points (N, 3), z up, without outliers; if it is cut, any shape is possible."""
    sides, words, maybe = _shape(points, has_top=last_word(name) in WITH_TOP)
    if is_cut or min(sides[0], max(sides[1:])) < MIN_SIDE_M:
        words, maybe = frozenset(), SHAPES
    elif sides[2] < FLAT_M:  # objects on the floor may continue under the furniture
        words, maybe = words - {"square", "rectangular"}, maybe | {"square", "rectangular"}
    elif last_word(name) == "box" and sides[2] > SQUARE * sides[0]:  # its side is as much its face as its top
        words, maybe = words - {"square"}, maybe | {"rectangular"}
    if last_word(name) not in WITH_SHAPE:
        words, maybe = frozenset(), SHAPES
    sure_build, maybe_build = (frozenset[str](), BUILDS) if is_cut else _build(name, sides)
    words, maybe = words | sure_build, maybe | maybe_build
    has_colour = sight is not None and last_word(name) not in WITHOUT_COLOUR
    if sight is None or not has_colour:
        return Appearance(sides, words, maybe | COLOURS | TONES)
    sure = sight.tones | ({sight.colour} if sight.colour and sight.is_certain_colour else set())
    return Appearance(sides, words | sure, maybe | sight.possible_colours | sight.possible_tones | sure)


def _build(name: str, sides: Float64Array) -> tuple[frozenset[str], frozenset[str]]:
    """Words for a long or tall object, certain and possible; none for soft or built-in objects."""
    length, width, height = map(float, sides)
    if last_word(name) in SOFT | FIXTURES:
        return frozenset(), frozenset()
    rise, stretch = height / max(length, 1e-6), min(length / max(width, 1e-6), 2 * length / max(height, 1e-6))
    is_tall, is_long = height >= MIN_LONG_M and rise >= TALL, length >= MIN_LONG_M and stretch >= LONG
    return _words(tall=is_tall, long=is_long), _words(tall=rise >= MAYBE_TALL, long=stretch >= MAYBE_LONG)


def _words(**holds: bool) -> frozenset[str]:
    return frozenset(word for word, is_so in holds.items() if is_so)


def _shape(points: Float64Array, *, has_top: bool) -> tuple[Float64Array, frozenset[str], frozenset[str]]:
    """The sides of an object, the certain words for the shape of its face, and the possible ones."""
    import cv2

    height = float(np.ptp(points[:, 2]))
    footprint = (points[:, :2] - points[:, :2].mean(axis=0)).astype(np.float32)
    _, (a, b), degrees = cv2.minAreaRect(footprint)
    length, width = max(a, b), min(a, b)
    sides = np.array([length, width, height], np.float64)
    face = footprint[points[:, 2] >= points[:, 2].max() - TOP_M] if has_top else footprint
    if width < FLAT_SHARE * min(length, height):
        angle = np.deg2rad(degrees if a >= b else degrees + 90.0)
        along = footprint @ np.array([np.cos(angle), np.sin(angle)], np.float32)
        face = np.stack([along, points[:, 2].astype(np.float32)], axis=1)
    _, (a, b), _ = cv2.minAreaRect(face)
    area, rectangle = float(cv2.contourArea(cv2.convexHull(face))), float(a * b)
    corners = cv2.convexHull(face)[:, 0]
    across = float(np.linalg.norm(corners[:, None] - corners[None], axis=2).max())
    if not rectangle or not min(a, b):
        return sides, frozenset(), SHAPES
    roundness, straightness, ratio = 4 * area / (np.pi * across**2), area / rectangle, max(a, b) / min(a, b)
    is_straight, may_be_straight = straightness >= STRAIGHT, straightness >= MAYBE_STRAIGHT
    words = _words(
        round=roundness >= ROUND,
        square=is_straight and ratio <= SQUARE,
        rectangular=is_straight and ratio >= MAYBE_SQUARE,
    )
    maybe = _words(
        round=roundness >= MAYBE_ROUND,
        square=may_be_straight and ratio <= MAYBE_SQUARE,
        rectangular=may_be_straight and ratio >= SQUARE,
    )
    return sides, words, maybe


# A word for more of a measure, one for less if there is an unambiguous one, and the factor by which the extreme object
# of a name must differ from every other; ours.
SIZES: tuple[tuple[str, str, float], ...] = (
    ("large", "small", 2.0),
    ("long", "", 1.5),
    ("wide", "narrow", 1.5),
    ("tall", "", 1.5),
)
LEAD = 1.25  # ours: lead in the longest side from which a size difference is visible from any viewpoint


def measure_of(name: str, looks: Appearance, word: str) -> float | None:
    """How large, long, wide or tall a named object appears; None if the word does not apply.

    Large is the volume, for flat or soft objects the area of the face, because how thick a cushion is depends on how it
    leans; upright objects are wide and not long, flat-lying ones are not tall, and soft ones none of the three.
    """
    length, width, height = map(float, looks.sides)
    least, middle, longest = sorted((length, width, height))
    if word == "large":
        return middle * longest if is_flat(looks.sides) or last_word(name) in SOFT else least * middle * longest
    if last_word(name) in SOFT:
        return None
    if word in ("long", "wide"):
        return length if (length >= height) == (word == "long") else None
    return None if height < FLAT_M or (is_flat(looks.sides) and height == least) else height
