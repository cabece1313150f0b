"""Spatial relations between axis-aligned boxes (2, 3) in metres, z up: on, under, in, above, next to, near, between.

The thresholds of "above" and "next to" are those by which the built-in rooms are labelled, in ``numerics.boxes``; the
others are ours and stand below. Boxes say less than surfaces: what lies on an inner board of a shelf and what lies in a
basket look alike, so "on" and "in" take whether the holder is a container.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.numerics.boxes import (
    ABOVE_M,
    NEXT_TO_M,
    NEXT_TO_SMALL_M,
    UNDER_SHARE,
    are_side_by_side,
    gap_m,
    ground_area,
    is_over,
    shared_area,
    shared_ground,
)
from su3d_bench.perception.embedded.text import words

PairRelation = Literal["on", "under", "in", "above", "next to", "near"]
PAIR_RELATIONS: tuple[PairRelation, ...] = ("on", "under", "in", "above", "next to", "near")

SMALL_M = 0.45  # longest side of what is small: things that share a support
FLAT_M, SPREAD_M = 0.03, 0.5  # so low and so wide is a rug, which lies under its neighbours, not beside them
NEAR_M = 1.0  # ours: an arm's length
CONTACT_M = 0.08  # ours: twice the paper's voxel of 0.02 m on either side
ON_SHARE = 0.3  # of the smaller footprint
WITHIN_SHARE = 0.7  # of the footprint of what is inside
INNER_FLOOR_M = 0.05  # an inner board lies above the holder's foot by this
BETWEEN_ENDS = 0.05  # ours: share of the way, at either end, that is not between
BETWEEN_SLOPE, BETWEEN_ASIDE_M = 0.5, 0.3  # ours: 27 degrees off the way from either end, or aside by this much

CONTAINERS = frozenset(
    {"basket", "bin", "box", "bag", "backpack", "bathtub", "sink", "bucket", "drawer", "pot", "bowl", "vase", "crate"}
)
ROOM_SURFACES = frozenset({"wall", "floor", "ceiling", "ground", "roof"})


@dataclass(frozen=True)
class RelationFound:
    """Row ``subject`` stands in ``relation`` to row ``object``."""

    subject: int
    relation: PairRelation
    object: int


def is_container(name: str) -> bool:
    """Whether things lie *in* what is called so."""
    return bool(set(words(name)[-1:]) & CONTAINERS)


def is_room_surface(name: str) -> bool:
    """Whether what is called so is a part of the room itself."""
    return bool(set(words(name)[-1:]) & ROOM_SURFACES)


def _rests_on_top(a: Float64Array, b: Float64Array) -> bool:
    has_risen = a[1][2] > b[1][2]
    return has_risen and abs(float(a[0][2] - b[1][2])) <= CONTACT_M and shared_ground(a, b) >= ON_SHARE


def _rests_inside(a: Float64Array, b: Float64Array) -> bool:
    """``a`` begins inside the box of ``b``, within its footprint."""
    is_within = shared_area(a, b) / ground_area(a) >= WITHIN_SHARE and ground_area(a) < ground_area(b)
    return is_within and b[0][2] - CONTACT_M <= a[0][2] < b[1][2] - CONTACT_M


def is_on(a: Float64Array, b: Float64Array, *, b_is_container: bool = False) -> bool:
    """``a`` rests on the top of ``b``, or on an inner board or seat of it."""
    if _rests_on_top(a, b):
        return True
    return not b_is_container and _rests_inside(a, b) and a[0][2] >= b[0][2] + INNER_FLOOR_M


def is_in(a: Float64Array, b: Float64Array, *, b_is_container: bool = False) -> bool:
    """``a`` lies in ``b``: a container that it may stick out of, or anything that holds all of it."""
    if b_is_container:
        return _rests_inside(a, b)
    is_held = bool((a[0] >= b[0] - CONTACT_M).all() and (a[1] <= b[1] + CONTACT_M).all())
    return is_held and _rests_inside(a, b)


def is_above(a: Float64Array, b: Float64Array) -> bool:
    """``a`` hangs or stands higher than ``b`` over its footprint, and does not touch it."""
    return is_over(a, b, CONTACT_M, ABOVE_M)


def is_under(a: Float64Array, b: Float64Array, *, b_is_container: bool = False) -> bool:
    """``b`` stands on ``a`` or hangs above it, or ``a`` stands on the ground that ``b`` covers."""
    if is_above(b, a) or (_rests_on_top(b, a) and shared_ground(a, b) > UNDER_SHARE):
        return True
    is_low = abs(float(a[0][2] - b[0][2])) <= INNER_FLOOR_M and a[1][2] <= b[1][2]
    is_covered = shared_area(a, b) / ground_area(a) >= WITHIN_SHARE and ground_area(a) < ground_area(b)
    return not b_is_container and is_low and is_covered


def _is_spread_out(a: Float64Array) -> bool:
    return bool(a[1][2] - a[0][2] < FLAT_M and (a[1] - a[0])[:2].max() > SPREAD_M)


def is_next_to(a: Float64Array, b: Float64Array) -> bool:
    """Side by side at about one height: no more than 0.3 m apart on the ground, 0.12 m where both are small."""
    if _is_spread_out(a) or _is_spread_out(b):
        return False
    both_small = max(float((a[1] - a[0]).max()), float((b[1] - b[0]).max())) <= SMALL_M
    if not are_side_by_side(a, b, NEXT_TO_SMALL_M if both_small else NEXT_TO_M):
        return False
    stacked = _rests_on_top(a, b) or _rests_on_top(b, a) or _rests_inside(a, b) or _rests_inside(b, a)
    return not stacked


def is_near(a: Float64Array, b: Float64Array) -> bool:
    """No more than a metre from box to box."""
    return gap_m(a, b) <= NEAR_M


def holds(relation: PairRelation, a: Float64Array, b: Float64Array, *, b_is_container: bool = False) -> bool:
    """Whether ``a`` stands in ``relation`` to ``b``."""
    if relation == "on":
        return is_on(a, b, b_is_container=b_is_container)
    if relation == "in":
        return is_in(a, b, b_is_container=b_is_container)
    if relation == "under":
        return is_under(a, b, b_is_container=b_is_container)
    if relation == "above":
        return is_above(a, b)
    return is_next_to(a, b) if relation == "next to" else is_near(a, b)


def is_between(a: Float64Array, b: Float64Array, c: Float64Array) -> bool:
    """Whether the centroid ``a`` (3,) lies on the way from ``b`` to ``c``, seen from above, or little aside of it."""
    way = (c - b)[:2]
    length = float(np.linalg.norm(way))
    if length < 1e-6:
        return False
    along = float((a - b)[:2] @ way) / length
    aside = abs(float(way[0] * (a - b)[1] - way[1] * (a - b)[0])) / length
    is_on_the_way = BETWEEN_ENDS * length < along < (1 - BETWEEN_ENDS) * length
    return is_on_the_way and aside <= max(BETWEEN_SLOPE * min(along, length - along), BETWEEN_ASIDE_M)


def relations_of(boxes: Float64Array, names: Sequence[str]) -> Iterator[RelationFound]:
    """Every relation between two of the ``boxes`` (K, 2, 3) but "near"; surfaces of the room by name are left out."""
    things = [row for row, name in enumerate(names) if not is_room_surface(name)]
    holders = [is_container(name) for name in names]
    for a in things:
        for b in things:
            if a == b:
                continue
            for relation in PAIR_RELATIONS:
                if relation != "near" and holds(relation, boxes[a], boxes[b], b_is_container=holders[b]):
                    yield RelationFound(a, relation, b)
