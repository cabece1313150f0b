"""A map without points and features: what reasoning is given."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from su3d_bench.core.english import last_word
from su3d_bench.core.errors import PredictionError, printable
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import BoolArray, Float64Array
from su3d_bench.metrics.questions.score import RefinedNames, labels_n
from su3d_bench.numerics.relations import (
    BUILT_IN,
    FIXTURES,
    RELATIONS,
    SURFACES,
    Relation,
    Relations,
    is_between,
    may_be_between,
)
from su3d_bench.questions.looks import Looks

MOST_NAME, MOST_CAPTION = 80, 400  # characters; a hostile map may hold texts of any length


@dataclass(frozen=True, eq=False)
class MapObject:
    """One instance; ``centroid`` (3,) and ``box`` (2, 3), lowest and highest corner, in metres, z up.

    Of a truth: ``is_asked``, whether people can see it well enough to be asked about it; ``is_whole``, whether its box
    is that of the thing itself and not of what a recording saw; ``is_cut``, whether it ends where the images ended;
    ``looks``, of a recording alone.
    """

    id: int
    name: str
    caption: str
    centroid: Float64Array
    box: Float64Array
    row: int = -1
    is_asked: bool = True
    is_whole: bool = True
    is_cut: bool = False
    looks: Looks | None = None

    @property
    def shown(self) -> str:
        """Name and id as answers write them."""
        return f"{self.name or 'object'} #{self.id}"

    @property
    def size(self) -> Float64Array:
        sides: Float64Array = self.box[1] - self.box[0]
        return sides


def is_room_surface(name: str) -> bool:
    """Whether what is called so is a part of the room itself."""
    return last_word(name) in SURFACES


@dataclass(frozen=True)
class SceneMap:
    """M' of the paper: the map minus points and feature vectors; ``row`` of an object leads back to the map."""

    objects: tuple[MapObject, ...]

    def __len__(self) -> int:
        return len(self.objects)

    @cached_property
    def _by_id(self) -> dict[int, MapObject]:
        return {thing.id: thing for thing in self.objects}

    def by_id(self, object_id: int) -> MapObject:
        return self._by_id[object_id]

    @cached_property
    def relations(self) -> Relations:
        """How the objects lie to one another, by their rows here."""
        boxes = np.array([thing.box for thing in self.objects], np.float64).reshape(-1, 2, 3)
        return Relations(boxes, [last_word(thing.name) for thing in self.objects])

    @cached_property
    def _row_of(self) -> dict[int, int]:
        return {thing.id: row for row, thing in enumerate(self.objects)}

    def holds(self, relation: Relation, subject: MapObject, other: MapObject) -> bool:
        """Whether one object of the map stands in ``relation`` to another."""
        return bool(self.relations.of(relation)[self._row_of[subject.id], self._row_of[other.id]])

    def is_doubtful(self, relation: Relation, subject: MapObject, other: MapObject) -> bool:
        """Whether a slightly other threshold, another reading or an object that is seen whole may decide otherwise."""
        return bool(self.doubtful(relation)[self._row_of[subject.id], self._row_of[other.id]])

    def doubtful(self, relation: Relation) -> BoolArray:
        """The doubtful pairs (K, K) by their rows here."""
        return self._doubtful[relation]

    @cached_property
    def _doubtful(self) -> dict[Relation, BoolArray]:
        is_cut = np.array([thing.is_cut for thing in self.objects], bool)
        beside_cut = (is_cut[:, None] | is_cut[None]) & self.relations.near
        return {relation: self.relations.doubtful(relation) | beside_cut for relation in RELATIONS}

    def is_between(self, thing: MapObject, first: MapObject, second: MapObject) -> bool:
        """Whether an object stands between two others; what one of them holds, or stands on, does not."""
        return is_between(thing.box, first.box, second.box) and not self._is_of(thing, first, second)

    def may_be_between(self, thing: MapObject, first: MapObject, second: MapObject) -> bool:
        """Whether some people would say that an object stands between two others."""
        return may_be_between(thing.box, first.box, second.box) and not self._is_of(thing, first, second)

    def _is_of(self, thing: MapObject, *ends: MapObject) -> bool:
        """Whether an object is one of ``ends``, or holds or is held by one."""
        pairs = [pair for end in ends for pair in ((thing, end), (end, thing))]
        return thing in ends or any(self.holds("on", *pair) or self.holds("in", *pair) for pair in pairs)

    @staticmethod
    def is_said(relation: Relation, subject: MapObject, other: MapObject) -> bool:
        """Whether people speak so of such things: windows, blinds and vents are above whatever is in the room."""
        if relation not in ("above", "under"):
            return True
        if relation == "under" and last_word(other.name) in BUILT_IN:
            return False
        return {last_word(subject.name), last_word(other.name)}.isdisjoint(FIXTURES)

    def are_in_one_place(self, *things: MapObject) -> bool:
        """Whether objects are on one support, all on the floor, or all hang."""
        rows = [self._row_of[thing.id] for thing in things]
        return all(self.relations.one_place[a, b] for a in rows for b in rows if a != b)

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(thing.id for thing in self.objects)

    @property
    def middle(self) -> Float64Array:
        """The middle of the box around all objects."""
        if not self.objects:
            return np.zeros(3)
        low = np.min([thing.box[0] for thing in self.objects], axis=0)
        high = np.max([thing.box[1] for thing in self.objects], axis=0)
        centre: Float64Array = (low + high) / 2
        return centre


def map_of(instances: Instances, refined: RefinedNames | None = None) -> SceneMap:
    """The map of ``instances``; names are n' where ``refined`` gives them, else the method's own label, else n.

    What the filter of labels n' leaves out is left out, and so is what has no finite box; without ids of their own
    instances are numbered from 0.
    """
    k = len(instances)
    names = labels_n(instances) if refined is None else refined.names
    ids = instances.ids if len(instances.ids) else np.arange(k)
    boxes, centroids = instances.boxes.astype(np.float64), instances.centroids.astype(np.float64)
    if boxes.shape != (k, 2, 3) or centroids.shape != (k, 3) or len(ids) != k:
        raise PredictionError(f"this map has boxes {boxes.shape} and centroids {centroids.shape} for {k} instances")
    if len(set(ids.tolist())) != k:
        raise PredictionError("this map has two instances of one id, so an answer could name neither")
    is_sound = np.isfinite(boxes).all(axis=(1, 2)) & np.isfinite(centroids).all(axis=1)
    is_sound &= True if refined is None else refined.is_kept
    return SceneMap(
        tuple(
            MapObject(
                int(ids[row]),
                printable(names[row], MOST_NAME),
                printable(instances.captions[row], MOST_CAPTION),
                centroids[row],
                boxes[row],
                int(row),
            )
            for row in np.flatnonzero(is_sound)
        )
    )
