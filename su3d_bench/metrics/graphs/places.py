"""Protocols of kind ``places``: floors by their heights, rooms by what lies in them, seen from above.

Source: ``evaluate_floors`` and ``evaluate_rooms`` of hovsg/eval/hm3dsem_evaluator.py, hovsg/HOV-SG at commit 71a8069.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import UP, Float64Array, Floor, GroundTruth, Int64Array, Places, Room
from su3d_bench.metrics.graphs.objects import (
    THRESHOLDS,
    Cloud,
    best_pairs,
    covered_share,
    found_at,
    larger_share,
    rates,
    summed,
    voxel_ids,
    voxel_means,
)
from su3d_bench.metrics.metric import Arrays, Counts, Metric, Pooled, SceneScore

RADIUS_M = VOXEL_M = 0.05  # evaluate_rooms
BOUND_M = 0.5  # evaluate_floors: how far the height of a bound may be off
# evaluate_rooms prints what it calls IoU=0.5 from this place of the list, which is 0.6; recalls were sorted, so that
# theirs is the place as far from the end, 0.4
ROOM_THRESHOLD, RECALL_THRESHOLD = 6, len(THRESHOLDS) - 1 - 6
NEEDS_PLACES = "needs floors and rooms, the map has none; HOV-SG's folder graph/ holds them"
OTHER_FLOORS = "{} floors are predicted, {} are true: no bound counts as found (the original ends in an error)"


@dataclass(frozen=True)
class PlaceCounts(Counts):
    """What one scene, or several, adds; of two ``sides`` the first is the prediction's, the second the truth's.

    ``n_scenes`` (2,): those with the right number of floors, and all. ``n_bounds``, ``n_rooms`` (2,);
    ``n_bounds_found`` (1,); ``n_rooms_found`` (T,) at each threshold; ``room_shares`` (2,) float64: the sum over rooms
    of how much of each is covered by the room of the other side that covers it most.
    """

    stored_as = "places"
    arrays: ClassVar[Arrays] = {
        "n_scenes": ("i", ("sides",)),
        "n_bounds": ("i", ("sides",)),
        "n_bounds_found": ("i", ("numbers",)),
        "n_rooms": ("i", ("sides",)),
        "n_rooms_found": ("i", ("thresholds",)),
        "room_shares": ("f", ("sides",)),
    }

    n_scenes: Int64Array
    n_bounds: Int64Array
    n_bounds_found: Int64Array
    n_rooms: Int64Array
    n_rooms_found: Int64Array
    room_shares: Float64Array

    def contradiction(self) -> str | None:
        """More found than there is."""
        if len(self.n_scenes) != 2 or len(self.n_bounds_found) != 1:
            return "'n_scenes' or 'n_bounds_found' has another number of values"
        if self.n_scenes[0] > self.n_scenes[1] or (self.n_bounds_found > self.n_bounds.min()).any():
            return "more floors are right than there are"
        if (np.diff([self.n_rooms.min(), *self.n_rooms_found]) > 0).any():
            return "'n_rooms_found' has more rooms than there are, or more at a higher threshold"
        inside = (self.room_shares >= 0) & (self.room_shares <= self.n_rooms * (1 + 1e-9))
        return None if inside.all() else "'room_shares' is more than the number of rooms"


class PlaceMetric(Metric[PlaceCounts]):
    """HOV-SG's floors and rooms."""

    truth = GroundTruth
    counts = PlaceCounts

    def per_scene(self, truth: GroundTruth, prediction: Instances, encoder: Encoder | None) -> SceneScore:
        if truth.places is None:
            raise DataError(f"{self.rules.name}: the truth '{truth.variant}' knows no floors and no rooms")
        if prediction.places is None and len(prediction):
            raise PredictionError(f"{self.rules.name}: {NEEDS_PLACES}")
        predicted = prediction.places or Places((), ())
        n_predicted, n_true = len(predicted.floors), len(truth.places.floors)
        overlap, of_predicted, of_true = room_overlaps(predicted.rooms, truth.places)
        rows, columns = best_pairs(overlap)
        n_bounds, n_found = floor_bounds(predicted.floors, truth.places.floors)
        counts = PlaceCounts(
            np.array([n_predicted == n_true, 1], np.int64),
            n_bounds,
            np.array([n_found], np.int64),
            np.array(overlap.shape, np.int64),
            found_at(overlap[rows, columns]),
            np.array([of_predicted.max(axis=1, initial=0.0).sum(), of_true.max(axis=0, initial=0.0).sum()]),
        )
        differs = OTHER_FLOORS.format(n_predicted, n_true) if n_predicted != n_true else None
        return self.score(counts, prediction, np.zeros(0), [differs])

    @property
    def sizes(self) -> dict[str, int]:
        return {"thresholds": len(THRESHOLDS), "sides": 2, "numbers": 1}

    def pooled(self, counts: Sequence[PlaceCounts]) -> Pooled:
        values = self.resampled(counts, np.ones((1, len(counts)), np.int64))
        return Pooled({name: float(value[0]) for name, value in values.items()})

    def resampled(self, counts: Sequence[PlaceCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        n_scenes, n_bounds, n_bounds_found, n_rooms, n_rooms_found, shares = (
            summed([getattr(of_scene, name) for of_scene in counts], weights) for name in PlaceCounts.arrays
        )
        floors = rates(n_bounds_found, n_bounds[:, 0], n_bounds[:, 1])
        rooms = rates(n_rooms_found, n_rooms[:, 0], n_rooms[:, 1])
        covered = rates(shares, n_rooms[:, 0], n_rooms[:, 1])
        columns = [
            n_scenes[:, 0] / np.maximum(n_scenes[:, 1], 1),
            *(floors.accuracy[:, 0], floors.precision[:, 0], floors.recall[:, 0]),
            covered.precision[:, 0],
            covered.recall[:, 1],
            rooms.area,
            rooms.accuracy[:, ROOM_THRESHOLD],
            rooms.precision[:, ROOM_THRESHOLD],
            rooms.recall[:, RECALL_THRESHOLD],
        ]
        return dict(zip(self.rules.value_names, columns, strict=True))


def floor_bounds(predicted: Sequence[Floor], true: Sequence[Floor]) -> tuple[Int64Array, int]:
    """How many bounds between storeys there are on each side (2,), and how many of them lie within ``BOUND_M``.

    Bounds meet in their order; where there are more on one side, none is found.

    >>> floor_bounds([Floor(0.0, 2.4), Floor(2.8, 5.0)], [Floor(0.1, 2.5), Floor(2.9, 5.6)])
    (array([3, 3]), 2)
    """
    one, other = _bounds(predicted), _bounds(true)
    n_found = int((np.abs(one - other) < BOUND_M).sum()) if len(one) == len(other) else 0
    return np.array([len(one), len(other)], np.int64), n_found


def _bounds(floors: Sequence[Floor]) -> Float64Array:
    """The lowest and the highest height, and between them the middles of two that follow one another."""
    heights = np.sort([height for floor in floors for height in (floor.lowest_m, floor.highest_m)])
    if not len(heights):
        return np.zeros(0)
    return np.array([heights[0], *((heights[1:-1:2] + heights[2:-1:2]) / 2), heights[-1]])


def room_overlaps(predicted: Sequence[Room], truth: Places) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Of each pair of rooms (P, T): the overlap, how much of the predicted one is covered and how much of the true one.

    A pair counts where the true room lies on a floor and the middle of the predicted one is within its heights. The
    true room's points are reduced anew for each such pair, as the original does it, so that its cloud depends on how
    many pairs came before.
    """
    n_pairs = len(predicted), len(truth.rooms)
    overlap, of_predicted, of_true = np.zeros(n_pairs), np.zeros(n_pairs), np.zeros(n_pairs)
    flat = [_reduced(Cloud(_from_above(room))) for room in predicted]
    true = [Cloud(_from_above(room)) for room in truth.rooms]
    for row, column in _met(predicted, truth):
        true[column] = _reduced(true[column])
        overlap[row, column] = larger_share(flat[row], true[column], RADIUS_M)
    for row, column in _met(predicted, truth):
        true[column] = _reduced(true[column])
        of_predicted[row, column] = covered_share(flat[row], true[column], RADIUS_M)
        of_true[row, column] = covered_share(true[column], flat[row], RADIUS_M)
    return overlap, of_predicted, of_true


def _met(predicted: Sequence[Room], truth: Places) -> Iterator[tuple[int, int]]:
    """The pairs of rooms that count, once for each floor of the true one."""
    for floor in truth.floors:
        for column, true in enumerate(truth.rooms):
            if floor.lowest_m < true.middle_m < floor.highest_m:
                for row, room in enumerate(predicted):
                    if true.lowest_m < room.middle_m < true.highest_m:
                        yield row, column


def _from_above(room: Room) -> Float64Array:
    return np.delete(np.asarray(room.points, np.float64), UP, axis=1)


def _reduced(cloud: Cloud) -> Cloud:
    """The cloud with one point a voxel; itself where each voxel has one."""
    voxel = voxel_ids(cloud.points, VOXEL_M)
    is_reduced = voxel.max(initial=-1) + 1 == len(cloud.points)
    return cloud if is_reduced else Cloud(voxel_means(cloud.points, voxel))
