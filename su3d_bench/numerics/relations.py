"""Spatial relations between the objects of a scene: on, in, under, above, next to, near, between.

The same code is used for the ground truth of the built-in rooms, for questions generated from any ground truth and for
answers from a map. It uses axis-aligned boxes, z up, in metres; docs/questions/relations.md has a picture and the
reason for every rule. Boxes contain less information than surfaces: an object on an inner board of a shelf and one in a
basket look alike, so "on" and "in" depend on which objects are containers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from su3d_bench.core.types import BoolArray, Float64Array

Point = Float64Array | tuple[float, ...]
Relation = Literal["on", "under", "in", "above", "next to", "near"]
RELATIONS: tuple[Relation, ...] = ("on", "under", "in", "above", "next to", "near")

# The thresholds are chosen here, because the field has no agreed ones; for the reasons see docs/questions/relations.md.
CONTACT_M = 0.04  # objects in contact may be apart by the paper's voxel of 0.02 m on either side
SAME_TOP_M = 0.01  # an object is on several others if their tops differ by less; lower ones are under the first of them
ON_SHARE = 0.3  # of the smaller footprint: with less it would fall
WITHIN_SHARE = 0.7  # of the footprint of the inner object
INNER_FLOOR_M = 0.05  # minimum height of an inner board above the holder's foot
OVER_SHARE, OVER_PAD_M = 0.5, 0.1  # half of a footprint, or its centre; a picture hangs behind the sofa, not in it
ABOVE_M = 1.0  # a lamp over a table, not one under the ceiling of a hall
REACH_SHARE, MIN_REACH_M, MAX_REACH_M = 0.5, 0.1, 0.5  # neighbours: half the longer side of the smaller one
HAND_M = 0.25  # some people call even the smallest objects neighbours within a hand's width
NEAR_M = 1.0  # an arm's length
FLAT_M, SPREAD_M = 0.03, 0.5  # an object this low and this wide is a rug: part of the floor for its neighbours
BETWEEN_ENDS = 0.05  # fraction of the line, at either end, that is not between
BETWEEN_CORE = 0.5  # of each side of a footprint, about its centre: an object that the line only grazes is not between
MIN_BEARING_RAD = 0.05  # two objects closer to one line of sight are neither left nor right of each other
# Last words of names that decide the relations of other objects to them.
CONTAINERS = frozenset(
    {"basket", "bin", "box", "bag", "backpack", "bathtub", "sink", "bucket", "drawer", "pot", "bowl", "vase", "crate"}
)
# Objects that carry others below their top; it is doubtful whether people say "on" for the inside of other objects.
SHELVES = frozenset({"shelf", "bookshelf", "bookcase", "rack"})
SEATS = frozenset({"sofa", "couch", "loveseat", "chair", "armchair", "recliner", "bench", "stool", "bed", "futon"})
FIXTURES = frozenset({"window", "door", "vent", "switch", "plug", "outlet", "socket", "blinds", "blind", "radiator"})
# "Under the sink" is in its cabinet.
BUILT_IN = frozenset({"sink", "basin", "washbasin", "cooktop", "hob", "stove", "countertop", "worktop"})
FLOORS = frozenset({"floor", "ground"})
SURFACES = FLOORS | {"wall", "ceiling", "roof"}  # of the room itself
BAND = 1.25  # a relation is doubtful if a threshold lower or higher by this factor changes it


@dataclass(frozen=True)
class Link:
    """Row ``subject`` is in ``relation`` to row ``object``."""

    subject: int
    relation: Relation
    object: int


class Relations:
    """The relations of all pairs of ``boxes`` (K, 2, 3); ``names`` are the last words of the objects' names.

    Surfaces of the room have no relations. ``slack`` above 1 loosens every threshold by this factor, below 1 tightens
    it. Row and column of a matrix (K, K) are subject and object.
    """

    def __init__(self, boxes: Float64Array, names: Sequence[str], slack: float = 1.0) -> None:
        self._boxes = np.asarray(boxes, np.float64).reshape(-1, 2, 3)
        self._names = tuple(names)
        self._is_container = np.array([name in CONTAINERS for name in names], bool)
        self._carries_inside = np.array([name in SHELVES | SEATS for name in names], bool)
        self._is_fixture = np.array([name in FIXTURES for name in names], bool)
        self._is_thing = np.array([name not in SURFACES for name in names], bool)
        self._is_floor = np.array([name in FLOORS for name in names], bool)
        self._is_built_in = np.array([name in BUILT_IN for name in names], bool)
        self._slack = slack

    def __len__(self) -> int:
        return len(self._boxes)

    def of(self, relation: Relation) -> BoolArray:
        """Which pairs (K, K) are in ``relation``."""
        return np.asarray(getattr(self, {"in": "inside", "next to": "next_to"}.get(relation, relation)))

    def usual(self, relation: Relation) -> BoolArray:
        """The pairs (K, K) for which people say so: not a window above a bed, nor a sink on a countertop."""
        is_usual = np.ones((len(self), len(self)), bool)
        if relation in ("above", "under"):
            is_usual &= ~(self._is_fixture[:, None] | self._is_fixture[None])
        if relation == "above":  # a picture is above the cabinet, not above the candle on it
            is_usual &= ~(self.holders.any(axis=1) & ~self._is_built_in)[None]
        is_built_in = {"on": self._is_built_in[:, None], "under": self._is_built_in[None]}.get(relation, np.False_)
        return np.asarray(is_usual & ~is_built_in)

    @cached_property
    def faces(self) -> Float64Array:
        """Square metres (K,): the product of the two longest sides."""
        return np.asarray(np.prod(np.sort(self._boxes[:, 1] - self._boxes[:, 0], axis=1)[:, 1:], axis=1))

    def facts(self, relation: Relation) -> BoolArray:
        """The usual pairs (K, K) in ``relation`` that do not repeat another relation.

        "Under" is not the reverse of "on" or "above": the first is beneath the second and does not carry it.
        """
        holds = self.of(relation) & self.usual(relation)
        return np.asarray(holds & ~(self.on | self.above).T if relation == "under" else holds)

    def doubtful(self, relation: Relation) -> BoolArray:
        """The pairs (K, K) that a slightly different threshold, or another reading of the word, would change."""
        tight, loose = self._around
        answer: BoolArray = tight.of(relation) != loose.of(relation)
        if relation in ("on", "under"):
            is_within = self._stands_inside & ~self._rests_on_top & ~self._carries_inside[None]
            answer |= is_within if relation == "on" else is_within.T
        if relation == "above":
            sides = (self._boxes[:, 1] - self._boxes[:, 0])[:, None, :2]
            # only the depth of a thin object on a wall may be beside the other
            answer |= self.above & ~self._has_centre_over(np.where(2 * sides < sides[..., ::-1], OVER_PAD_M, 0.0))
        if relation == "next to":
            answer |= loose.may_be_next_to & ~self.next_to
        return answer

    @cached_property
    def _around(self) -> tuple[Relations, Relations]:
        return Relations(self._boxes, self._names, 1 / BAND), Relations(self._boxes, self._names, BAND)

    def links(self) -> Iterator[Link]:
        """Every relation except "near", by subject and object."""
        relations = {name: self.of(name) for name in RELATIONS if name != "near"}
        for a, b in np.argwhere(np.any(list(relations.values()), axis=0)).tolist():
            for name, matrix in relations.items():
                if matrix[a, b]:
                    yield Link(a, name, b)

    # ---- building blocks of the rules

    @cached_property
    def _is_pair(self) -> BoolArray:
        """Pairs of two objects, neither of which is a surface of the room."""
        is_pair = self._is_thing[:, None] & self._is_thing[None]
        return np.asarray(is_pair & ~np.eye(len(self), dtype=bool))

    @cached_property
    def _apart(self) -> Float64Array:
        """Metres (K, K, 3) between two boxes along each axis; 0 if they overlap."""
        low, high = self._boxes[:, 0], self._boxes[:, 1]
        return np.maximum(low[:, None] - high[None], low[None] - high[:, None]).clip(min=0.0)

    @cached_property
    def _area(self) -> Float64Array:
        """Square metres (K,) of the footprints, always above 0 for divisions."""
        return np.asarray(np.prod((self._boxes[:, 1] - self._boxes[:, 0])[:, :2], axis=1).clip(min=1e-9))

    def _shared(self, pad_m: float = 0.0) -> Float64Array:
        """Square metres (K, K) that a footprint shares with another one grown by ``pad_m``."""
        low, high = self._boxes[:, 0, :2], self._boxes[:, 1, :2]
        sides = np.minimum(high[:, None], high[None] + pad_m) - np.maximum(low[:, None], low[None] - pad_m)
        return np.asarray(np.prod(sides.clip(min=0.0), axis=2))

    @cached_property
    def _risen(self) -> Float64Array:
        """Metres (K, K) by which the bottom of one object is above the top of the other."""
        return self._boxes[:, None, 0, 2] - self._boxes[None, :, 1, 2]

    @cached_property
    def _rests_on_top(self) -> BoolArray:
        low, high = self._boxes[:, 0, 2], self._boxes[:, 1, 2]
        share = self._shared() / np.minimum(self._area[:, None], self._area[None])
        touches = (np.abs(self._risen) <= CONTACT_M * self._slack) & (high[:, None] > high[None])
        begins_higher = low[:, None] > low[None]
        is_fixed = self._is_fixture[:, None] | self._is_fixture[None]
        rests = ~is_fixed & touches & begins_higher & (share >= ON_SHARE / self._slack) & self._is_pair
        gap_m = np.where(rests, np.abs(self._risen), np.inf)
        return np.asarray(rests & (gap_m <= gap_m.min(axis=1, initial=np.inf)[:, None] + SAME_TOP_M))

    @cached_property
    def _rests_inside(self) -> BoolArray:
        """The first begins inside the box of the second, within its footprint."""
        low, high = self._boxes[:, 0, 2], self._boxes[:, 1, 2]
        is_within = self._shared() / self._area[:, None] >= min(1.0, WITHIN_SHARE / self._slack)
        is_smaller = self._area[:, None] < self._area[None]
        begins = (low[:, None] >= low[None] - CONTACT_M) & (low[:, None] < high[None] - CONTACT_M)
        return is_within & is_smaller & begins & self._is_pair

    @cached_property
    def _stands_inside(self) -> BoolArray:
        """As ``_rests_inside``, but above the holder's foot: on a seat or an inner board."""
        foot = self._boxes[:, 0, 2]
        return self._rests_inside & (foot[:, None] >= foot[None] + INNER_FLOOR_M / self._slack)

    @cached_property
    def _is_over(self) -> BoolArray:
        """Half of the first, or its centre, is over the footprint of the second."""
        pad_m = OVER_PAD_M * self._slack
        share = self._shared(pad_m) / self._area[:, None]
        has_centre = self._has_centre_over(pad_m)
        return np.asarray((share >= OVER_SHARE / self._slack) | (has_centre & (share >= 0.25 / self._slack)))

    def _has_centre_over(self, pad_m: Float64Array | float) -> BoolArray:
        """The centre of the first is over the footprint of the second grown by ``pad_m``, (K, 1, 2) or for all."""
        centre, low, high = self._boxes.mean(axis=1)[:, None, :2], self._boxes[:, 0, :2], self._boxes[:, 1, :2]
        return np.asarray(((centre >= low - pad_m) & (centre <= high + pad_m)).all(axis=2))

    @cached_property
    def _hangs_in_front(self) -> BoolArray:
        """Two objects that hang one in front of the other, such as blinds in front of a window."""
        sides = (self._boxes[:, 1] - self._boxes[:, 0])[:, :2]
        along = sides.argmax(axis=1)
        low, high = self._boxes[:, 0, :2], self._boxes[:, 1, :2]
        shared = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])
        row = np.arange(len(self))
        of_subject = shared[row[:, None], row[None], along[:, None]]
        least = np.minimum(sides[row, along][:, None], sides[row, along][None])
        return np.asarray((along[:, None] == along[None]) & (of_subject > ON_SHARE * least))

    @cached_property
    def _is_spread_out(self) -> BoolArray:
        sides = self._boxes[:, 1] - self._boxes[:, 0]
        return np.asarray((sides[:, 2] < FLAT_M) & (sides[:, :2].max(axis=1, initial=0.0) > SPREAD_M))

    @cached_property
    def holders(self) -> BoolArray:
        """The holders (K, K) of each object, on or in which it lies; rugs are part of the floor and hold nothing."""
        return (self.on | self.inside) & ~self._is_spread_out[None]

    @cached_property
    def is_on_floor(self) -> BoolArray:
        """Which objects (K,) are on the floor: at the top of the object named so, or as low as the lowest object."""
        foot, top = self._boxes[:, 0, 2], self._boxes[:, 1, 2]
        floor_m = top.min(initial=foot.min(initial=np.inf, where=self._is_thing), where=self._is_floor)
        return np.asarray(foot <= floor_m + CONTACT_M)

    @cached_property
    def hangs(self) -> BoolArray:
        """Which objects (K,) rest on nothing: they hang on a wall or from the ceiling."""
        return ~self.holders.any(axis=1) & ~self.is_on_floor

    @cached_property
    def one_place(self) -> BoolArray:
        """Pairs (K, K) on one support, both on the floor, or both hanging."""
        stands = self.is_on_floor & ~self.holders.any(axis=1)
        shares_holder = (self.holders[:, None] & self.holders[None]).any(axis=2)
        is_one = (stands[:, None] & stands[None]) | (self.hangs[:, None] & self.hangs[None])
        return (shares_holder | is_one) & self._is_pair

    # ---- the rules

    @cached_property
    def on(self) -> BoolArray:
        """The first rests on the top of the second, or on an inner board or seat of it."""
        return np.asarray(self._rests_on_top | (self._stands_inside & ~self._is_container[None]))

    @cached_property
    def inside(self) -> BoolArray:
        """The first lies in the second, a container, and may stick out of it."""
        return np.asarray(self._rests_inside & self._is_container[None])

    @cached_property
    def above(self) -> BoolArray:
        """The first hangs over the second: half of it or its centre, at most a metre above, with nothing in between."""
        candidates = self._is_over & self.hangs[:, None] & self._is_pair
        candidates &= (self._risen > CONTACT_M / self._slack) & (self._risen <= ABOVE_M * self._slack)
        top, foot = self._boxes[:, 1, 2], self._boxes[:, 0, 2]
        for a, b in np.argwhere(candidates).tolist():
            is_next = self._is_over[a] & (top > top[b] + CONTACT_M) & (top <= foot[a] + CONTACT_M)
            candidates[a, b] = not is_next.any()
        return candidates

    @cached_property
    def under(self) -> BoolArray:
        """The first carries the second or has it above, or stands on the ground covered by the second."""
        foot, top = self._boxes[:, 0, 2], self._boxes[:, 1, 2]
        is_low = (np.abs(foot[:, None] - foot[None]) <= INNER_FLOOR_M * self._slack) & (top[:, None] <= top[None])
        is_covered = self._shared() / self._area[:, None] >= min(1.0, WITHIN_SHARE / self._slack)
        stands_under = is_low & is_covered & (self._area[:, None] < self._area[None]) & ~self._is_container[None]
        is_covered_floor = stands_under & ~self._is_spread_out[:, None] & self._is_pair
        return np.asarray(self.on.T | self.above.T | is_covered_floor)

    @cached_property
    def next_to(self) -> BoolArray:
        """Side by side at the same height on one support, on the floor or on the wall, with nothing in between."""
        return self._without_between(self._is_beside(np.minimum, MIN_REACH_M) & self.one_place)

    @cached_property
    def may_be_next_to(self) -> BoolArray:
        """Pairs that some people call next to each other: within the reach of the larger one, also on other supports.

        An object on a table is never next to a chair in front of it.
        """
        stands = self.is_on_floor & ~self.holders.any(axis=1)
        lies = self.holders.any(axis=1) & ~self.is_on_floor
        is_apart = (stands[:, None] & lies[None]) | (lies[:, None] & stands[None])
        return self._without_between(self._is_beside(np.maximum, HAND_M) & ~is_apart)

    def _is_beside(self, longer_or_shorter: np.ufunc, least_m: float) -> BoolArray:
        """Pairs (K, K) side by side at the same height, within the reach of the larger or smaller of the two."""
        sides = (self._boxes[:, 1] - self._boxes[:, 0])[:, :2].max(axis=1, initial=0.0)
        side_m = longer_or_shorter(sides[:, None], sides[None])
        reach_m = np.clip(REACH_SHARE * side_m, least_m, MAX_REACH_M) * self._slack
        gap_m = np.linalg.norm(self._apart[..., :2], axis=2)
        low, high = self._boxes[:, 0, 2], self._boxes[:, 1, 2]
        shared_height = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])
        is_level = shared_height > 0.25 * np.minimum((high - low)[:, None], (high - low)[None]) / self._slack
        stacked = self._rests_on_top | self._rests_inside
        is_rug = self._is_spread_out[:, None] | self._is_spread_out[None]
        is_aside = self._shared() <= ON_SHARE * self._slack * np.minimum(self._area[:, None], self._area[None])
        is_aside &= ~(self.hangs[:, None] & self.hangs[None]) | ~self._hangs_in_front
        return np.asarray((gap_m <= reach_m) & is_aside & is_level & ~stacked & ~stacked.T & ~is_rug & self._is_pair)

    def _without_between(self, pairs: BoolArray) -> BoolArray:
        """The symmetric ``pairs`` (K, K) with nothing in between."""
        free = pairs.copy()
        for a, b in np.argwhere(np.triu(pairs)).tolist():
            free[a, b] = free[b, a] = not self._has_between(a, b)
        return free

    def _has_between(self, a: int, b: int) -> bool:
        """Whether another object at their height is in the gap between two objects."""
        low, high = self._boxes[:, 0], self._boxes[:, 1]
        first, last = np.minimum(high[a], high[b]), np.maximum(low[a], low[b])
        gap = np.array([np.minimum(first, last), np.maximum(first, last)])
        gap[:, 2] = max(low[a, 2], low[b, 2]), min(high[a, 2], high[b, 2])
        inside = (np.minimum(high, gap[1]) - np.maximum(low, gap[0])) > 0.01
        is_other = ~np.isin(np.arange(len(self)), (a, b)) & ~self._is_spread_out
        return bool((inside.all(axis=1) & is_other).any()) and bool(self._apart[a, b, :2].any())

    @cached_property
    def near(self) -> BoolArray:
        """At most one metre from box to box."""
        return np.asarray((np.linalg.norm(self._apart, axis=2) <= NEAR_M * self._slack) & self._is_pair)


def is_between(a: Float64Array, b: Float64Array, c: Float64Array) -> bool:
    """Whether the line from the centre of box ``b`` to that of box ``c`` crosses the inner half of box ``a``.

    Boxes (2, 3), ``a`` at the height of both; False if any of the three is flat.
    """
    way = _Way.of(a, b, c)
    return way is not None and BETWEEN_ENDS < way.along(a) < 1 - BETWEEN_ENDS and way.meets(a, BETWEEN_CORE, 0.0)


def may_be_between(a: Float64Array, b: Float64Array, c: Float64Array) -> bool:
    """Whether some people would call box ``a`` so: it is anywhere in the lane that is as wide as its two ends."""
    way = _Way.of(a, b, c)
    return way is not None and 0.0 < way.along(a) < 1.0 and way.meets(a, 1.0, 1.0)


@dataclass(frozen=True)
class _Way:
    """In top view, the line from the centre of one box to that of another, with half their sides, each (2,)."""

    start: Float64Array
    way: Float64Array
    half_start: Float64Array
    half_end: Float64Array

    @classmethod
    def of(cls, a: Float64Array, b: Float64Array, c: Float64Array) -> _Way | None:
        """The line from ``b`` to ``c``; None if ``a`` is not at their height, a box is flat or the centres coincide."""
        if any(min(a[1, 2], end[1, 2]) <= max(a[0, 2], end[0, 2]) for end in (b, c)):
            return None
        if any(end[1, 2] - end[0, 2] < FLAT_M for end in (a, b, c)):
            return None
        way = cls(b.mean(axis=0)[:2], (c - b).mean(axis=0)[:2], (b[1] - b[0])[:2] / 2, (c[1] - c[0])[:2] / 2)
        return way if float(np.linalg.norm(way.way)) >= 1e-6 else None

    def along(self, a: Float64Array) -> float:
        """The position of a box's centre along the line, as a fraction of it."""
        return float((a.mean(axis=0)[:2] - self.start) @ self.way) / float(self.way @ self.way)

    def meets(self, a: Float64Array, share: float, width: float) -> bool:
        """Whether a rectangle moved along the line meets the inner ``share`` of a box's sides.

        The rectangle has ``width`` times the size of the ends, interpolated linearly from one to the other.
        """
        aside, half = self.start - a.mean(axis=0)[:2], share * (a[1] - a[0])[:2] / 2
        enters, leaves = 0.0, 1.0
        for sign in (1.0, -1.0):
            # sign * (aside + t * way) <= half + width * (half_start + t * (half_end - half_start))
            slope = sign * self.way - width * (self.half_end - self.half_start)
            room = half + width * self.half_start - sign * aside
            for rise, most in zip(slope.tolist(), room.tolist(), strict=True):
                if rise > 0:
                    leaves = min(leaves, most / rise)
                elif rise < 0:
                    enters = max(enters, most / rise)
                elif most < 0:
                    return False
        return enters < leaves


def bearing_rad(eye: Point, a: Point, b: Point) -> float:
    """The angle, in top view, by which point ``a`` is left of ``b`` as seen from ``eye``."""
    angle_a = math.atan2(float(a[1] - eye[1]), float(a[0] - eye[0]))
    angle_b = math.atan2(float(b[1] - eye[1]), float(b[0] - eye[0]))
    return math.remainder(angle_a - angle_b, math.tau)


def is_left_of(a: Point, b: Point, eye: Point) -> bool:
    """Whether point ``a`` is left of ``b`` as seen from ``eye``."""
    return bearing_rad(eye, a, b) > MIN_BEARING_RAD


def gap_m(a: Float64Array, b: Float64Array) -> float:
    """The distance between two boxes (2, 3); 0 if they touch."""
    return float(np.linalg.norm(np.clip(np.maximum(a[0] - b[1], b[0] - a[1]), 0.0, None)))
