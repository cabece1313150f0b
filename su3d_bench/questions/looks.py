"""What a truth's vertices and its frames say of how a thing looks: its own sides, and words for its shape and colour.

For truths that come from scans, of which nobody noted what their things were made like. A word is sure, or some people
might say it, or nobody would; between sure and nobody nothing is asked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from su3d_bench.core.english import last_word
from su3d_bench.core.types import Float64Array
from su3d_bench.numerics.relations import FIXTURES, FLAT_M
from su3d_bench.questions.sight import COLOURS, TONES, WITHOUT_COLOUR, Sight

# Things whose shape people name, by the last word: seen from above, or from the front where they hang flat.
WITH_TOP = frozenset(("table", "desk", "nightstand", "stool", "ottoman", "bench"))
WITH_SHAPE = WITH_TOP | frozenset((
    "rug", "mat", "carpet", "tray", "bin", "basket", "box",
    "mirror", "clock", "picture", "painting", "poster", "window",
))  # fmt: skip
SHAPES = frozenset(("round", "square", "rectangular"))
# Things that have no height of their own, however they lie, and no shape: the face of what leans is not its footprint.
SOFT = frozenset(("blanket", "towel", "cloth", "clothes", "comforter", "cushion", "pillow", "bag", "backpack", "shoe"))
LEAST_SIDE_M = 0.2  # ours: of a smaller face the noise of a scan hides the shape
TOP_M = 0.05  # ours: so deep are the tops, of which the legs may stand out
FLAT_SHARE = 0.2  # ours: a face stands upright where the thing is so much thinner than it is long and high
# All ours. Area over that of the circle about the longest way across: an octagon has 0.90, a square 0.64.
ROUND, MAYBE_ROUND = 0.92, 0.80
# Area over that of the smallest rectangle about it: a circle has 0.79, an octagon 0.83.
STRAIGHT, MAYBE_STRAIGHT = 0.93, 0.86
# Height over length; length over width, and twice that over the height.
BUILDS = frozenset(("tall", "long"))
TALL, MAYBE_TALL, LONG, MAYBE_LONG = 1.8, 1.3, 2.5, 1.8
LEAST_BUILD_M = 1.0  # so much at least is long or tall by itself; a smaller thing may be so for its kind
# Longer over shorter side of that rectangle.
SQUARE, MAYBE_SQUARE = 1.1, 1.25


@dataclass(frozen=True, eq=False)
class Looks:
    """``sides`` (3,): length, width and height in metres by the thing's own directions, the longer of the two first.

    ``words`` are sure; ``maybe`` are those that some people might say, the sure ones among them.
    """

    sides: Float64Array
    words: frozenset[str]
    maybe: frozenset[str]

    @property
    def is_flat(self) -> bool:
        """Whether nobody speaks of its volume."""
        least, middle, _ = sorted(self.sides.tolist())
        return bool(least < FLAT_SHARE * middle)


def looks_of(name: str, points: Float64Array, sight: Sight | None, *, is_cut: bool) -> Looks:
    """How a thing of that name looks, by its points (N, 3), z up, without strays; of a shape that is cut all may be."""
    sides, words, maybe = _shape(points, has_top=last_word(name) in WITH_TOP)
    if is_cut or min(sides[0], max(sides[1:])) < LEAST_SIDE_M:
        words, maybe = frozenset(), SHAPES
    elif sides[2] < FLAT_M:  # what lies on the floor may go on under the furniture
        words, maybe = words - {"square", "rectangular"}, maybe | {"square", "rectangular"}
    elif last_word(name) == "box" and sides[2] > SQUARE * sides[0]:  # its side is as much its face as its lid
        words, maybe = words - {"square"}, maybe | {"rectangular"}
    if last_word(name) not in WITH_SHAPE:
        words, maybe = frozenset(), SHAPES
    sure_build, maybe_build = (frozenset[str](), BUILDS) if is_cut else _build(name, sides)
    words, maybe = words | sure_build, maybe | maybe_build
    has_colour = sight is not None and last_word(name) not in WITHOUT_COLOUR
    if sight is None or not has_colour:
        return Looks(sides, words, maybe | COLOURS | TONES)
    sure = sight.tones | ({sight.colour} if sight.colour and sight.is_sure_colour else set())
    return Looks(sides, words | sure, maybe | sight.maybe_colours | sight.maybe_tones | sure)


def _build(name: str, sides: Float64Array) -> tuple[frozenset[str], frozenset[str]]:
    """Whether a thing is long or tall by itself, for sure and perhaps; of what is soft or built in nobody says so."""
    length, width, height = map(float, sides)
    if last_word(name) in SOFT | FIXTURES:
        return frozenset(), frozenset()
    rise, stretch = height / max(length, 1e-6), min(length / max(width, 1e-6), 2 * length / max(height, 1e-6))
    sure = [
        *(["tall"] if rise >= TALL and height >= LEAST_BUILD_M else []),
        *(["long"] if stretch >= LONG and length >= LEAST_BUILD_M else []),
    ]
    maybe = [*(["tall"] if rise >= MAYBE_TALL else []), *(["long"] if stretch >= MAYBE_LONG else [])]
    return frozenset(sure), frozenset(maybe)


def _shape(points: Float64Array, *, has_top: bool) -> tuple[Float64Array, frozenset[str], frozenset[str]]:
    """The sides of a thing, the words that are sure for the shape of its face, and those that may be."""
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
    across = _longest_way(cv2.convexHull(face)[:, 0])
    if not rectangle or not min(a, b):
        return sides, frozenset(), SHAPES
    roundness, straightness, ratio = 4 * area / (np.pi * across**2), area / rectangle, max(a, b) / min(a, b)
    words = [
        *(["round"] if roundness >= ROUND else []),
        *(["square"] if straightness >= STRAIGHT and ratio <= SQUARE else []),
        *(["rectangular"] if straightness >= STRAIGHT and ratio >= MAYBE_SQUARE else []),
    ]
    maybe = [
        *(["round"] if roundness >= MAYBE_ROUND else []),
        *(["square"] if straightness >= MAYBE_STRAIGHT and ratio <= MAYBE_SQUARE else []),
        *(["rectangular"] if straightness >= MAYBE_STRAIGHT and ratio >= SQUARE else []),
    ]
    return sides, frozenset(words), frozenset(maybe)


def _longest_way(corners: np.ndarray) -> float:
    """The greatest distance between two of the corners (C, 2) of a hull, of which there are few."""
    return float(np.linalg.norm(corners[:, None] - corners[None], axis=2).max())


# A word for more of a measure, one for less where people have one that says nothing else, and how much more the
# extreme one of a name must have than every other; ours.
SIZES: tuple[tuple[str, str, float], ...] = (
    ("large", "small", 2.0),
    ("long", "", 1.5),
    ("wide", "narrow", 1.5),
    ("tall", "", 1.5),
)
LEAD = 1.25  # ours: of the longest side, by which one sees a size from where one stands


def measure_of(name: str, looks: Looks, word: str) -> float | None:
    """How large, long, wide or tall a thing of that name is, as people see it; None where they would not say so of it.

    Large is the volume, of what is flat or soft the area of its face, for how thick a cushion is depends on how it
    leans; what stands is wide and not long, what lies flat is not tall, and what is soft is none of these three.
    """
    length, width, height = map(float, looks.sides)
    least, middle, longest = sorted((length, width, height))
    if word == "large":
        return middle * longest if looks.is_flat or last_word(name) in SOFT else least * middle * longest
    if last_word(name) in SOFT:
        return None
    if word in ("long", "wide"):
        return length if (length >= height) == (word == "long") else None
    return None if height < FLAT_M or (looks.is_flat and height == least) else height
