"""How the things of a scene lie to one another: on, in, under, above, next to, near, between.

One code for the truth of the built-in rooms, for questions made from any ground truth and for what is answered of a
map. It sees axis-aligned boxes, z up, in metres; docs/questions/relations.md has a picture and the reason of every
rule. Boxes say less than surfaces: what lies on an inner board of a shelf and what lies in a basket look alike, so that
"on" and "in" take which things are containers.
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

# Every threshold is ours, for the field has no agreed ones; the reasons stand in docs/questions/relations.md.
CONTACT_M = 0.04  # what touches may miss by the paper's voxel of 0.02 m on either side
SAME_TOP_M = 0.01  # one thing lies on several whose tops are so level; what is deeper is under the first of them
ON_SHARE = 0.3  # of the smaller footprint: less, and it would fall
WITHIN_SHARE = 0.7  # of the footprint of what lies inside
INNER_FLOOR_M = 0.05  # an inner board lies above the holder's foot by this
OVER_SHARE, OVER_PAD_M = 0.5, 0.1  # half of a footprint, or its centre; a picture hangs behind the sofa, not in it
ABOVE_M = 1.0  # a lamp over a table, not one under the ceiling of a hall
REACH_SHARE, MIN_REACH_M, MAX_REACH_M = 0.5, 0.1, 0.5  # neighbours: half the longer side of the smaller one
HAND_M = 0.25  # within an open hand of one another some people call the smallest things neighbours
NEAR_M = 1.0  # an arm's length
FLAT_M, SPREAD_M = 0.03, 0.5  # so low and so wide is a rug: part of the floor for what stands beside it
BETWEEN_ENDS = 0.05  # share of the way, at either end, that is not between
BETWEEN_CORE = 0.5  # of either side of a footprint, about its middle: what the line grazes is not between
MIN_BEARING_RAD = 0.05  # two things nearer to one line of sight are neither left nor right of each other
# What things are called whose last word decides how others lie to them.
CONTAINERS = frozenset(
    {"basket", "bin", "box", "bag", "backpack", "bathtub", "sink", "bucket", "drawer", "pot", "bowl", "vase", "crate"}
)
# What carries things below its top; whether people call what stands in any other thing "on" it, nobody knows.
SHELVES = frozenset({"shelf", "bookshelf", "bookcase", "rack"})
SEATS = frozenset({"sofa", "couch", "loveseat", "chair", "armchair", "recliner", "bench", "stool", "bed", "futon"})
FIXTURES = frozenset({"window", "door", "vent", "switch", "plug", "outlet", "socket", "blinds", "blind", "radiator"})
BUILT_IN = frozenset({"sink", "basin", "washbasin", "cooktop", "hob", "stove"})  # "under the sink" is in its cabinet
FLOORS = frozenset({"floor", "ground"})
SURFACES = FLOORS | {"wall", "ceiling", "roof"}  # of the room itself
BAND = 1.25  # what a threshold so much lower or higher would decide otherwise is doubtful


@dataclass(frozen=True)
class Link:
    """Row ``subject`` stands in ``relation`` to row ``object``."""

    subject: int
    relation: Relation
    object: int


class Relations:
    """The relations of all pairs of ``boxes`` (K, 2, 3) of things with such last words of their ``names``.

    Surfaces of the room stand in none. ``slack`` above 1 loosens every threshold by this factor, below 1 it tightens
    them. Row and column of a matrix (K, K) are subject and object.
    """

    def __init__(self, boxes: Float64Array, names: Sequence[str], slack: float = 1.0) -> None:
        self._boxes = np.asarray(boxes, np.float64).reshape(-1, 2, 3)
        self._names = tuple(names)
        self._is_container = np.array([name in CONTAINERS for name in names], bool)
        self._carries_inside = np.array([name in SHELVES | SEATS for name in names], bool)
        self._is_fixture = np.array([name in FIXTURES for name in names], bool)
        self._is_thing = np.array([name not in SURFACES for name in names], bool)
        self._is_floor = np.array([name in FLOORS for name in names], bool)
        self._slack = slack

    def __len__(self) -> int:
        return len(self._boxes)

    def of(self, relation: Relation) -> BoolArray:
        """Which pairs (K, K) stand in ``relation``."""
        return np.asarray(getattr(self, {"in": "inside", "next to": "next_to"}.get(relation, relation)))

    def doubtful(self, relation: Relation) -> BoolArray:
        """The pairs (K, K) of which a slightly other threshold, or another reading of the word, says otherwise."""
        tight, loose = self._around
        answer: BoolArray = tight.of(relation) != loose.of(relation)
        if relation in ("on", "under"):
            is_within = self._stands_inside & ~self._rests_on_top & ~self._carries_inside[None]
            answer |= is_within if relation == "on" else is_within.T
        if relation == "next to":
            answer |= loose.may_be_next_to & ~self.next_to
        return answer

    @cached_property
    def _around(self) -> tuple[Relations, Relations]:
        return Relations(self._boxes, self._names, 1 / BAND), Relations(self._boxes, self._names, BAND)

    def links(self) -> Iterator[Link]:
        """Every relation but "near", by subject and object."""
        held = {name: self.of(name) for name in RELATIONS if name != "near"}
        for a, b in np.argwhere(np.any(list(held.values()), axis=0)).tolist():
            for name, matrix in held.items():
                if matrix[a, b]:
                    yield Link(a, name, b)

    # ---- what the rules are made of

    @cached_property
    def _is_pair(self) -> BoolArray:
        """Pairs of two things of which neither is a surface of the room."""
        is_pair = self._is_thing[:, None] & self._is_thing[None]
        return np.asarray(is_pair & ~np.eye(len(self), dtype=bool))

    @cached_property
    def _apart(self) -> Float64Array:
        """Metres (K, K, 3) between two boxes along each axis; 0 where they overlap."""
        low, high = self._boxes[:, 0], self._boxes[:, 1]
        return np.maximum(low[:, None] - high[None], low[None] - high[:, None]).clip(min=0.0)

    @cached_property
    def _area(self) -> Float64Array:
        """Square metres (K,) of the footprints, above 0 so that one can divide by them."""
        return np.asarray(np.prod((self._boxes[:, 1] - self._boxes[:, 0])[:, :2], axis=1).clip(min=1e-9))

    def _shared(self, pad_m: float = 0.0) -> Float64Array:
        """Square metres (K, K) that a footprint shares with another that is grown by ``pad_m``."""
        low, high = self._boxes[:, 0, :2], self._boxes[:, 1, :2]
        sides = np.minimum(high[:, None], high[None] + pad_m) - np.maximum(low[:, None], low[None] - pad_m)
        return np.asarray(np.prod(sides.clip(min=0.0), axis=2))

    @cached_property
    def _risen(self) -> Float64Array:
        """Metres (K, K) by which the bottom of one thing is above the top of the other."""
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
        """As ``_rests_inside``, above the holder's foot: on a seat or an inner board."""
        foot = self._boxes[:, 0, 2]
        return self._rests_inside & (foot[:, None] >= foot[None] + INNER_FLOOR_M / self._slack)

    @cached_property
    def _is_over(self) -> BoolArray:
        """Half of the first, or its centre, is over the footprint of the second."""
        share = self._shared(OVER_PAD_M) / self._area[:, None]
        centre = self._boxes.mean(axis=1)[:, None, :2]
        low, high = self._boxes[:, 0, :2] - OVER_PAD_M, self._boxes[:, 1, :2] + OVER_PAD_M
        has_centre = ((centre >= low[None]) & (centre <= high[None])).all(axis=2)
        return np.asarray((share >= OVER_SHARE / self._slack) | (has_centre & (share >= 0.25 / self._slack)))

    @cached_property
    def _hangs_in_front(self) -> BoolArray:
        """Two things that hang one in front of the other, as blinds before their window."""
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
        """What (K, K) each thing rests on or lies in; rugs, which are part of the floor, hold nothing."""
        return (self.on | self.inside) & ~self._is_spread_out[None]

    @cached_property
    def is_on_floor(self) -> BoolArray:
        """Which things (K,) stand on the floor: at the top of what is called so, or as low as the lowest one."""
        foot, top = self._boxes[:, 0, 2], self._boxes[:, 1, 2]
        floor_m = top.min(initial=foot.min(initial=np.inf, where=self._is_thing), where=self._is_floor)
        return np.asarray(foot <= floor_m + CONTACT_M)

    @cached_property
    def hangs(self) -> BoolArray:
        """Which things (K,) rest on nothing: on a wall, or from the ceiling."""
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
        """The first lies in the second: a container that it may stick out of."""
        return np.asarray(self._rests_inside & self._is_container[None])

    @cached_property
    def above(self) -> BoolArray:
        """The first hangs over the second: half of it or its centre, a metre at most, with nothing in between."""
        candidates = self._is_over & self.hangs[:, None] & self._is_pair
        candidates &= (self._risen > CONTACT_M / self._slack) & (self._risen <= ABOVE_M * self._slack)
        top, foot = self._boxes[:, 1, 2], self._boxes[:, 0, 2]
        for a, b in np.argwhere(candidates).tolist():
            is_next = self._is_over[a] & (top > top[b] + CONTACT_M) & (top <= foot[a] + CONTACT_M)
            candidates[a, b] = not is_next.any()
        return candidates

    @cached_property
    def under(self) -> BoolArray:
        """The first bears the second or has it above, or stands on the ground that the second covers."""
        foot, top = self._boxes[:, 0, 2], self._boxes[:, 1, 2]
        is_low = (np.abs(foot[:, None] - foot[None]) <= INNER_FLOOR_M * self._slack) & (top[:, None] <= top[None])
        is_covered = self._shared() / self._area[:, None] >= min(1.0, WITHIN_SHARE / self._slack)
        stands_under = is_low & is_covered & (self._area[:, None] < self._area[None]) & ~self._is_container[None]
        is_covered_floor = stands_under & ~self._is_spread_out[:, None] & self._is_pair
        return np.asarray(self.on.T | self.above.T | is_covered_floor)

    @cached_property
    def next_to(self) -> BoolArray:
        """Side by side at one height on one support, on the floor or on the wall, with nothing in between."""
        return self._without_between(self._is_beside(np.minimum, MIN_REACH_M) & self.one_place)

    @cached_property
    def may_be_next_to(self) -> BoolArray:
        """What some people call so: by the reach of the larger thing, and for a switch beside the door that stands.

        What lies on a table is not next to the chair before it, whatever one means by the words.
        """
        stands = self.is_on_floor & ~self.holders.any(axis=1)
        lies = self.holders.any(axis=1) & ~self.is_on_floor
        is_apart = (stands[:, None] & lies[None]) | (lies[:, None] & stands[None])
        return self._without_between(self._is_beside(np.maximum, HAND_M) & ~is_apart)

    def _is_beside(self, longer_or_shorter: np.ufunc, least_m: float) -> BoolArray:
        """Pairs (K, K) at one height, aside of one another, within the reach of the larger or smaller of the two."""
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
        """The symmetrical ``pairs`` (K, K) between which nothing stands."""
        free = pairs.copy()
        for a, b in np.argwhere(np.triu(pairs)).tolist():
            free[a, b] = free[b, a] = not self._has_between(a, b)
        return free

    def _has_between(self, a: int, b: int) -> bool:
        """Whether something at their height stands in the gap between two things."""
        low, high = self._boxes[:, 0], self._boxes[:, 1]
        first, last = np.minimum(high[a], high[b]), np.maximum(low[a], low[b])
        gap = np.array([np.minimum(first, last), np.maximum(first, last)])
        gap[:, 2] = max(low[a, 2], low[b, 2]), min(high[a, 2], high[b, 2])
        inside = (np.minimum(high, gap[1]) - np.maximum(low, gap[0])) > 0.01
        is_other = ~np.isin(np.arange(len(self)), (a, b)) & ~self._is_spread_out
        return bool((inside.all(axis=1) & is_other).any()) and bool(self._apart[a, b, :2].any())

    @cached_property
    def near(self) -> BoolArray:
        """No more than a metre from box to box."""
        return np.asarray((np.linalg.norm(self._apart, axis=2) <= NEAR_M * self._slack) & self._is_pair)


def is_between(a: Float64Array, b: Float64Array, c: Float64Array) -> bool:
    """Whether the line from the middle of box ``b`` to that of box ``c`` leads over the inner half of box ``a``.

    Boxes (2, 3), ``a`` at the height of both; nothing is between what lies flat on the floor and something else.
    """
    way = _Way.of(a, b, c)
    return way is not None and BETWEEN_ENDS < way.along(a) < 1 - BETWEEN_ENDS and way.meets(a, BETWEEN_CORE, 0.0)


def may_be_between(a: Float64Array, b: Float64Array, c: Float64Array) -> bool:
    """Whether some people would call box ``a`` so: it stands anywhere in the lane that is as wide as its two ends."""
    way = _Way.of(a, b, c)
    return way is not None and 0.0 < way.along(a) < 1.0 and way.meets(a, 1.0, 1.0)


@dataclass(frozen=True)
class _Way:
    """Seen from above: from the middle of one box to that of another, with half their sides, each (2,)."""

    start: Float64Array
    way: Float64Array
    half_start: Float64Array
    half_end: Float64Array

    @classmethod
    def of(cls, a: Float64Array, b: Float64Array, c: Float64Array) -> _Way | None:
        """From ``b`` to ``c``, where something may be between them and ``a`` is at their height."""
        if any(min(a[1, 2], end[1, 2]) <= max(a[0, 2], end[0, 2]) for end in (b, c)):
            return None
        if any(end[1, 2] - end[0, 2] < FLAT_M for end in (a, b, c)):
            return None
        way = cls(b.mean(axis=0)[:2], (c - b).mean(axis=0)[:2], (b[1] - b[0])[:2] / 2, (c[1] - c[0])[:2] / 2)
        return way if float(np.linalg.norm(way.way)) >= 1e-6 else None

    def along(self, a: Float64Array) -> float:
        """How far along the way the middle of a box stands, as a share of it."""
        return float((a.mean(axis=0)[:2] - self.start) @ self.way) / float(self.way @ self.way)

    def meets(self, a: Float64Array, share: float, width: float) -> bool:
        """Whether what moves along the way comes to ``share`` of a box's sides.

        It is as wide as ``width`` of the ends, shrinking or growing evenly from one to the other.
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
    """The angle, seen from above, by which point ``a`` stands left of ``b`` for who looks at them from ``eye``."""
    angle_a = math.atan2(float(a[1] - eye[1]), float(a[0] - eye[0]))
    angle_b = math.atan2(float(b[1] - eye[1]), float(b[0] - eye[0]))
    return math.remainder(angle_a - angle_b, math.tau)


def is_left_of(a: Point, b: Point, eye: Point) -> bool:
    """Whether point ``a`` stands left of ``b`` for who looks at both from ``eye``."""
    return bearing_rad(eye, a, b) > MIN_BEARING_RAD


def gap_m(a: Float64Array, b: Float64Array) -> float:
    """The shortest way between two boxes (2, 3); 0 where they touch."""
    return float(np.linalg.norm(np.clip(np.maximum(a[0] - b[1], b[0] - a[1]), 0.0, None)))
