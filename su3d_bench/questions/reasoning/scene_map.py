"""A map without points and features: what reasoning is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from su3d_bench.core.errors import PredictionError, printable
from su3d_bench.core.types import Float64Array, Instances

MOST_NAME, MOST_CAPTION = 80, 400  # characters; a hostile map may hold texts of any length


@dataclass(frozen=True, eq=False)
class MapObject:
    """One instance; ``centroid`` (3,) and ``box`` (2, 3), lowest and highest corner, in metres, z up."""

    id: int
    name: str
    caption: str
    centroid: Float64Array
    box: Float64Array
    row: int = -1

    @property
    def shown(self) -> str:
        """Name and id as answers write them."""
        return f"{self.name or 'object'} #{self.id}"

    @property
    def size(self) -> Float64Array:
        sides: Float64Array = self.box[1] - self.box[0]
        return sides


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


def map_of(instances: Instances, refined: Sequence[str] | None = None) -> SceneMap:
    """The map of ``instances``; names are n' where ``refined`` gives them, else the method's own label, else n.

    Instances without a finite box are left out; without ids of their own they are numbered from 0.
    """
    k = len(instances)
    names = _names(instances, refined)
    ids = instances.ids if len(instances.ids) else np.arange(k)
    boxes, centroids = instances.boxes.astype(np.float64), instances.centroids.astype(np.float64)
    if boxes.shape != (k, 2, 3) or centroids.shape != (k, 3) or len(ids) != k:
        raise PredictionError(f"this map has boxes {boxes.shape} and centroids {centroids.shape} for {k} instances")
    if len(set(ids.tolist())) != k:
        raise PredictionError("this map has two instances of one id, so an answer could name neither")
    is_sound = np.isfinite(boxes).all(axis=(1, 2)) & np.isfinite(centroids).all(axis=1)
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


def _names(instances: Instances, refined: Sequence[str] | None) -> tuple[str, ...]:
    if refined is not None:
        return tuple(refined)
    labels = instances.labels or ("",) * len(instances)
    return tuple(label or name for label, name in zip(labels, instances.names, strict=True))
