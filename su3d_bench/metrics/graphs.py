"""Protocols of kind ``objects``: predicted objects matched one to one with the true ones, and the rank of the true
category of each match among all categories.

Source: ``evaluate_objects`` of hovsg/eval/hm3dsem_evaluator.py, hovsg/HOV-SG at commit 71a8069.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import UP, Float64Array, Floor, GroundTruth, Int64Array, Places, Room
from su3d_bench.metrics.instance.boxes import box_around
from su3d_bench.metrics.instance.score import score_of_masks
from su3d_bench.metrics.matching import transfer
from su3d_bench.metrics.matching.labelling import class_index_of_ids, encoder_warning, has_every_label, similarities
from su3d_bench.metrics.matching.nearest import without_crowds
from su3d_bench.metrics.matching.rows import row_ids
from su3d_bench.metrics.metric import Counts, Metric, SceneScore, axes
from su3d_bench.metrics.protocols.kinds import OBJECT_RANKS
from su3d_bench.metrics.protocols.model import ProtocolRules

THRESHOLDS = np.linspace(0.0, 1.0, 11)  # a pair is found if its overlap is above
Pairs = tuple[Int64Array, Int64Array]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (N, D) in m with a neighbour search."""

    points: Float64Array

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points[without_crowds(self.points)])

    @cached_property
    def corners(self) -> Float64Array:
        """The lowest and the highest corner (2, D); needs at least one point."""
        return box_around(self.points)

    def n_near(self, other: Cloud, radius_m: float) -> int:
        """The number of its points with one of ``other`` nearer than ``radius_m``."""
        if not len(self.points) or not len(other.points):
            return 0
        low, high = other.corners
        around = self.points[((self.points >= low - radius_m) & (self.points <= high + radius_m)).all(axis=1)]
        if not len(around):
            return 0
        distance_m, _ = other._tree.query(around, distance_upper_bound=radius_m)
        return int(np.isfinite(distance_m).sum())


def larger_share(first: Cloud, second: Cloud, radius_m: float) -> float:
    """The share of a cloud's points nearer than ``radius_m`` to the other cloud; the larger of the two directions.

    >>> line = Cloud(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]))
    >>> larger_share(line, Cloud(line.points[:1] + 0.01), 0.02), larger_share(line, Cloud(np.zeros((0, 3))), 0.02)
    (1.0, 0.0)
    """
    if not len(first.points) or not len(second.points):
        return 0.0
    shares = (one.n_near(other, radius_m) / len(one.points) for one, other in ((first, second), (second, first)))
    return max(shares)


def covered_share(of: Cloud, by: Cloud, radius_m: float) -> float:
    """The number of points of ``by`` nearer than ``radius_m`` to ``of``, divided by the size of ``of``, at most 1.

    The original counts the points of one cloud and divides by those of the other.

    >>> covered_share(Cloud(np.zeros((4, 2))), Cloud(np.zeros((1, 2))), 0.05)
    0.25
    """
    return min(by.n_near(of, radius_m) / len(of.points), 1.0) if len(of.points) else 0.0


def voxel_ids(points: Float64Array, voxel_m: float) -> Int64Array:
    """The voxel number, from 0, of each point (N, D), in a grid that starts at their lowest corner, as in Open3D."""
    corner = points.min(axis=0, initial=np.inf) - voxel_m * 0.5
    return row_ids(np.floor((points - corner) / voxel_m).astype(np.int64))


def voxel_means(values: Float64Array, voxel: Int64Array) -> Float64Array:
    """The mean (V, C) of ``values`` (N, C) over the points of each voxel (N,).

    >>> points = np.array([[0.0, 0], [0.02, 0], [0.03, 0], [0.05, 0]])
    >>> voxel_means(points, voxel_ids(points, 0.05))[:, 0].tolist()
    [0.01, 0.04]
    """
    n = np.bincount(voxel)
    return np.stack([np.bincount(voxel, weights=column) / n for column in values.T], axis=1)


def best_pairs(overlap: Float64Array) -> Pairs:
    """Rows and columns of the one-to-one assignment of greatest total ``overlap`` (P, T); min(P, T) pairs.

    Pairs without any overlap are included: as many pairs as possible.
    """
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(overlap, maximize=True)
    return rows.astype(np.int64), columns.astype(np.int64)


def found_at(overlap: Float64Array) -> Int64Array:
    """The number (T,) of the best pairs' overlaps above each of ``THRESHOLDS``."""
    return np.array([(overlap > threshold).sum() for threshold in THRESHOLDS], np.int64)


@dataclass(frozen=True)
class Rates:
    """Precision, recall and accuracy (R, T) at each threshold; accuracy is found / (found + false + missed)."""

    precision: Float64Array
    recall: Float64Array
    accuracy: Float64Array

    @property
    def area(self) -> Float64Array:
        """The area (R,) under precision over recall, as in the original: recalls are sorted, precisions are not.

        Precisions are ordered by threshold and recalls by value, so that the highest precision is paired with the
        lowest recall.
        """
        return trapezoid(self.precision, np.sort(self.recall, axis=1))


def rates(n_found: Float64Array, n_predicted: Float64Array, n_true: Float64Array) -> Rates:
    """The rates of numbers (R, T), (R,) and (R,); 0 without predictions, NaN without ground truth.

    >>> table = rates(np.array([[2.0, 1.0]]), np.array([4.0]), np.array([2.0]))
    >>> table.precision.tolist(), table.recall.tolist(), table.accuracy.tolist()
    ([[0.5, 0.25]], [[1.0, 0.5]], [[0.5, 0.2]])
    """
    predicted, true = n_predicted[:, None], n_true[:, None]
    wholes = (predicted, true, predicted + true - n_found)
    return Rates(*(np.where(true > 0, n_found / np.maximum(whole, 1), np.nan) for whole in wholes))


def trapezoid(values: Float64Array, places: Float64Array) -> Float64Array:
    """The area (R,) under ``values`` (R, K) at ``places`` (R, K)."""
    return np.asarray(np.trapezoid(values, places, axis=1))


RADIUS_M = 0.02  # evaluate_objects: points of two objects nearer than this overlap
RANK_STEP = 10  # evaluate_objects: the curve has a point at every tenth k from 0
HALF = int(np.flatnonzero(THRESHOLDS == 0.5)[0])
FEW_LABELS = "labels name only the first categories of an object: the true one counts as unranked if it is missing"


@dataclass(frozen=True)
class MatchedObjects(Counts):
    """The counts of one scene or several.

    ``n_objects`` (2,): predicted and true ones. ``n_found`` (T,): pairs whose overlap is above each threshold.
    ``n_ranked`` (C + 1,): pairs by the rank of the true category, from 1; the last entry counts pairs without a rank.
    """

    stored_as = "matched-objects"

    n_objects: Int64Array = field(metadata=axes("sides"))
    n_found: Int64Array = field(metadata=axes("thresholds"))
    n_ranked: Int64Array = field(metadata=axes("ranks"))

    def contradiction(self) -> str | None:
        """More pairs than objects, or pairs found at a threshold but not at a lower one."""
        if len(self.n_objects) != 2:
            return f"'n_objects' has {len(self.n_objects)} numbers"
        n_pairs, most = int(self.n_ranked.sum()), int(self.n_objects.min())
        if n_pairs > most or (np.diff([most, *self.n_found]) > 0).any():
            return f"'n_found' or 'n_ranked' has more than the {most} possible pairs, or more at a higher threshold"
        return None


class ObjectMetric(Metric[MatchedObjects]):
    """HOV-SG's objects: every predicted one is matched, and its feature ranks all categories."""

    truth = GroundTruth
    counts = MatchedObjects

    def per_scene(self, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        masks = transfer.masks_of(prediction)
        predicted = [Cloud(np.asarray(prediction.points[members], np.float64)) for members in masks.sets()]
        ids, objects = objects_of(truth)
        overlap = object_overlaps(predicted, objects, boxes_of(truth, ids, objects))
        rows, columns = best_pairs(overlap)
        n_places = len(self.rules.classes)
        rank = self._ranks(truth, ids, prediction, encoder, rows, columns)
        counts = MatchedObjects(
            np.array(overlap.shape, np.int64),
            found_at(overlap[rows, columns]),
            np.bincount(np.where(rank > 0, rank, n_places + 1) - 1, minlength=n_places + 1),
        )
        warnings = [encoder_warning(self.rules, prediction, encoder)]
        if has_every_label(prediction) and len(masks):
            warnings.append(FEW_LABELS)
        return score_of_masks(self, counts, prediction, truth.points, truth.instance > 0, warnings)

    def _ranks(
        self,
        truth: GroundTruth,
        ids: Int64Array,
        prediction: Instances | Partition,
        encoder: Encoder | None,
        rows: Int64Array,
        columns: Int64Array,
    ) -> Int64Array:
        """The rank (n,) of the true category of each pair, 0 for none."""
        first_point = np.unique(truth.instance, return_index=True)[1][-len(ids) :] if len(ids) else ids
        category = class_index_of_ids(self.rules, truth.semantic[first_point])[columns]
        if not len(rows):
            return np.zeros(0, np.int64)
        if isinstance(prediction, Instances) and has_every_label(prediction):
            return _ranks_of_labels(self.rules, prediction, rows, category)
        names = [entry.name for entry in self.rules.classes]
        rank = ranks_among(similarities(self.rules, names, prediction, encoder, rows), category)
        assert prediction.features is not None
        return np.where(prediction.features[rows].any(axis=1), rank, 0)

    @property
    def sizes(self) -> dict[str, int]:
        return {"thresholds": len(THRESHOLDS), "ranks": len(self.rules.classes) + 1, "sides": 2}

    def resampled(self, counts: Sequence[MatchedObjects], weights: Int64Array) -> Mapping[str, Float64Array]:
        n_objects, n_found, n_ranked = MatchedObjects.drawn(counts, weights).values()
        n_predicted, n_true = n_objects[:, 0], n_objects[:, 1]
        at = rates(n_found, n_predicted, n_true)
        n_places = len(self.rules.classes)
        n_pairs = n_ranked.sum(axis=1, keepdims=True)
        within = np.concatenate([np.zeros((len(weights), 1)), np.cumsum(n_ranked[:, :-1], axis=1)], axis=1)
        # the original divides by the number of pairs
        share = np.where(n_true[:, None] > 0, within / np.maximum(n_pairs, 1), np.nan)
        ks = np.arange(0, n_places, RANK_STEP)
        area = trapezoid(share[:, ks], np.broadcast_to(ks / n_places, (len(share), len(ks))))
        columns = [area, *(share[:, min(k, n_places)] for k in OBJECT_RANKS)]
        columns += [at.area, at.accuracy[:, HALF], at.precision[:, HALF], at.recall[:, HALF]]
        return dict(zip(self.rules.value_names, columns, strict=True))


def objects_of(truth: GroundTruth) -> tuple[Int64Array, list[Cloud]]:
    """The ids (T,) of the true objects, ascending, and the cloud of each."""
    order = np.argsort(truth.instance, kind="stable")
    ids, starts = np.unique(truth.instance[order], return_index=True)
    parts = np.split(order, starts[1:])
    kept = [(int(key), part) for key, part in zip(ids, parts, strict=True) if key > 0]
    clouds = [Cloud(np.asarray(truth.points[part], np.float64)) for _, part in kept]
    return np.array([key for key, _ in kept], np.int64), clouds


def boxes_of(truth: GroundTruth, ids: Int64Array, objects: Sequence[Cloud]) -> Float64Array:
    """The lowest and highest corners (T, 2, 3) of the boxes used to preselect pairs of objects.

    Their given centre and sides along the axes of the world, whatever the rotation of the box, as in the original.
    """
    given = {} if truth.places is None else truth.places.object_boxes
    corners = np.zeros((len(ids), 2, 3))
    for row, (key, cloud) in enumerate(zip(ids.tolist(), objects, strict=True)):
        if key in given:
            centre, sides = given[key]
            corners[row] = centre - sides / 2, centre + sides / 2
        else:
            corners[row] = cloud.corners
    return corners


def object_overlaps(predicted: Sequence[Cloud], objects: Sequence[Cloud], boxes: Float64Array) -> Float64Array:
    """The overlap (P, T) of the clouds of each pair whose boxes share a volume; 0 for other pairs."""
    overlap = np.zeros((len(predicted), len(objects)))
    for row, cloud in enumerate(predicted):
        if not len(cloud.points):
            continue
        sides = np.minimum(cloud.corners[1], boxes[:, 1]) - np.maximum(cloud.corners[0], boxes[:, 0])
        for column in np.flatnonzero((sides > 0).all(axis=1)).tolist():
            overlap[row, column] = larger_share(cloud, objects[column], RADIUS_M)
    return overlap


def ranks_among(similarity: Float64Array, category: Int64Array) -> Int64Array:
    """The rank (n,), from 1, of each row's ``category`` among all classes (n, C), 0 if that is -1.

    On ties the last in the list comes first, as in a reversed ascending order; the original's sort does not define the
    order of ties.

    >>> ranks_among(np.array([[0.1, 0.9, 0.3]] * 3), np.array([1, 0, -1])).tolist()
    [1, 3, 0]
    """
    own = similarity[np.arange(len(category)), category][:, None]
    is_later = np.arange(similarity.shape[1]) > category[:, None]
    before = (similarity > own) | ((similarity == own) & is_later)
    rank: Int64Array = 1 + before.sum(axis=1)
    return np.where(category >= 0, rank, 0)


def _ranks_of_labels(rules: ProtocolRules, prediction: Instances, rows: Int64Array, category: Int64Array) -> Int64Array:
    """The rank of the true category among the labels of each instance, 0 if it is not among them."""
    assert prediction.labels is not None
    further = prediction.further_labels or ((),) * len(prediction)
    rank = np.zeros(len(rows), np.int64)
    for place, (row, index) in enumerate(zip(rows.tolist(), category.tolist(), strict=True)):
        labels = (prediction.labels[row], *further[row])
        name = rules.classes[index].name if index >= 0 else None
        rank[place] = labels.index(name) + 1 if name in labels else 0
    return np.minimum(rank, len(rules.classes))


ROOM_RADIUS_M = VOXEL_M = 0.05  # evaluate_rooms
BOUND_M = 0.5  # evaluate_floors: tolerance of the height of a bound
# evaluate_rooms prints what it calls IoU=0.5 from this index of the list, which is 0.6; recalls were sorted, so
# theirs is the index as far from the end, 0.4
ROOM_THRESHOLD, RECALL_THRESHOLD = 6, len(THRESHOLDS) - 1 - 6
NEEDS_PLACES = "needs floors and rooms, the map has none; HOV-SG's folder graph/ has them"
OTHER_FLOORS = "{} floors are predicted, {} are true: no bound counts as found (the original raises an error)"


@dataclass(frozen=True)
class PlaceCounts(Counts):
    """The counts of one scene or several; of two ``sides`` the first is the prediction, the second the ground truth.

    ``n_scenes`` (2,): those with the right number of floors, and all. ``n_bounds``, ``n_rooms`` (2,);
    ``n_bounds_found`` (1,); ``n_rooms_found`` (T,) at each threshold; ``room_shares`` (2,) float64: the sum over rooms
    of the largest share of each that one room of the other side covers.
    """

    stored_as = "places"

    n_scenes: Int64Array = field(metadata=axes("sides"))
    n_bounds: Int64Array = field(metadata=axes("sides"))
    n_bounds_found: Int64Array = field(metadata=axes("numbers"))
    n_rooms: Int64Array = field(metadata=axes("sides"))
    n_rooms_found: Int64Array = field(metadata=axes("thresholds"))
    room_shares: Float64Array = field(metadata=axes("sides"))

    def contradiction(self) -> str | None:
        """More found than exist."""
        if len(self.n_scenes) != 2 or len(self.n_bounds_found) != 1:
            return "'n_scenes' or 'n_bounds_found' has another number of values"
        if self.n_scenes[0] > self.n_scenes[1] or (self.n_bounds_found > self.n_bounds.min()).any():
            return "more right numbers of floors than scenes, or more bounds found than exist"
        if (np.diff([self.n_rooms.min(), *self.n_rooms_found]) > 0).any():
            return "'n_rooms_found' has more rooms than exist, or more at a higher threshold"
        inside = (self.room_shares >= 0) & (self.room_shares <= self.n_rooms * (1 + 1e-9))
        return None if inside.all() else "'room_shares' is more than the number of rooms"


class PlaceMetric(Metric[PlaceCounts]):
    """HOV-SG's floors and rooms."""

    truth = GroundTruth
    counts = PlaceCounts

    def per_scene(self, truth: GroundTruth, prediction: Instances, encoder: Encoder | None) -> SceneScore:
        if truth.places is None:
            raise DataError(f"{self.rules.name}: ground truth '{truth.variant}' has no floors and rooms")
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

    def resampled(self, counts: Sequence[PlaceCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        drawn = PlaceCounts.drawn(counts, weights)
        n_scenes, n_bounds, n_bounds_found, n_rooms, n_rooms_found, shares = drawn.values()
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
    """The number of bounds between storeys on each side (2,), and how many of them match within ``BOUND_M``.

    Bounds are compared in order; if one side has more, none is found.

    >>> floor_bounds([Floor(0.0, 2.4), Floor(2.8, 5.0)], [Floor(0.1, 2.5), Floor(2.9, 5.6)])
    (array([3, 3]), 2)
    """
    one, other = _bounds(predicted), _bounds(true)
    n_found = int((np.abs(one - other) < BOUND_M).sum()) if len(one) == len(other) else 0
    return np.array([len(one), len(other)], np.int64), n_found


def _bounds(floors: Sequence[Floor]) -> Float64Array:
    """The lowest and the highest height, and between them the midpoints of consecutive ones."""
    heights = np.sort([height for floor in floors for height in (floor.lowest_m, floor.highest_m)])
    if not len(heights):
        return np.zeros(0)
    return np.array([heights[0], *((heights[1:-1:2] + heights[2:-1:2]) / 2), heights[-1]])


def room_overlaps(predicted: Sequence[Room], truth: Places) -> tuple[Float64Array, Float64Array, Float64Array]:
    """For each pair of rooms (P, T): the overlap, and the covered shares of the predicted and of the true room.

    A pair counts if the true room is on a floor and the middle of the predicted one is within that floor's heights.
    The true room's points are downsampled again for each such pair, as in the original, so that its cloud depends on
    the number of previous pairs.
    """
    n_pairs = len(predicted), len(truth.rooms)
    overlap, of_predicted, of_true = np.zeros(n_pairs), np.zeros(n_pairs), np.zeros(n_pairs)
    flat = [_reduced(Cloud(_from_above(room))) for room in predicted]
    true = [Cloud(_from_above(room)) for room in truth.rooms]
    for row, column in _met(predicted, truth):
        true[column] = _reduced(true[column])
        overlap[row, column] = larger_share(flat[row], true[column], ROOM_RADIUS_M)
    for row, column in _met(predicted, truth):
        true[column] = _reduced(true[column])
        of_predicted[row, column] = covered_share(flat[row], true[column], ROOM_RADIUS_M)
        of_true[row, column] = covered_share(true[column], flat[row], ROOM_RADIUS_M)
    return overlap, of_predicted, of_true


def _met(predicted: Sequence[Room], truth: Places) -> Iterator[tuple[int, int]]:
    """The pairs of rooms that count, one per floor of the true one."""
    for floor in truth.floors:
        for column, true in enumerate(truth.rooms):
            if floor.lowest_m < true.middle_m < floor.highest_m:
                for row, room in enumerate(predicted):
                    if true.lowest_m < room.middle_m < true.highest_m:
                        yield row, column


def _from_above(room: Room) -> Float64Array:
    return np.delete(np.asarray(room.points, np.float64), UP, axis=1)


def _reduced(cloud: Cloud) -> Cloud:
    """The cloud with one point per voxel; unchanged if each voxel already has one."""
    voxel = voxel_ids(cloud.points, VOXEL_M)
    is_reduced = voxel.max(initial=-1) + 1 == len(cloud.points)
    return cloud if is_reduced else Cloud(voxel_means(cloud.points, voxel))
