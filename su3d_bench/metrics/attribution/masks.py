"""Error attribution for AP: six kinds of error, each with the gain in AP when only that kind is corrected.

In the spirit of TIDE (Bolya et al., ECCV 2020), for masks on points and the ScanNet AP. Nothing is estimated: a
correction changes the predictions, and the same evaluator scores them again. *Counted* instances are those of scored
classes with at least the minimum size; predictions of any class, or without a class, may cause an error.

A mask *lies in* an instance that has more than half of the mask's points, and *holds* an instance if it has more than
half of the instance's points. A mask *matches* an instance at IoU above 0.5, so at most one. The kinds:

- ``merged`` (over-merge): a mask that holds several instances, and whose label is that of one of them or of the one
  it lies in. Correction: the mask is cut. Each instance that it holds becomes a mask with the class of that instance
  and the same confidence, except the one with most points of the mask: it gets the remaining points too, and its class
  if it then matches. Pieces of instances that a mask already finds (matches with the right class) are dropped.
- ``split`` (under-merge): an instance with at least two parts, which no merged mask finds. Its parts are taken from
  the masks that lie in it and are not merged: first the match with the right class and the highest IoU, then other
  matches, then by points in common; a further mask is a part if less than half of it is in the previous parts and it
  raises the IoU of their union. The union must match, and the class (of the first part if that matches, otherwise the
  one with most points among the parts) must be right. Correction: the parts become one mask of that class, with the
  highest confidence of any part.
- ``duplicate``: a mask of at least the minimum size and of a scored class that lies in an instance and has at least
  half of itself in the previous parts. Correction: it is dropped; the first part takes its confidence if that is higher
  and the class is the same, as in the evaluator itself.
- ``mislabelled``: the first part of an instance matches it and has another class, and no mask finds the instance.
  Correction: it gets the right class.
- ``background``: a mask of at least the minimum size and of a scored class that lies in no counted instance, holds
  none, and has too few void points for the evaluator to ignore it at all thresholds. Correction: it is dropped.
- ``missed``: no mask of at least the minimum size lies in the instance or holds it, and it is not split. Correction:
  its exact mask is added, with the right class and the highest confidence of the scene (1 if there are no masks).

Sum rules: ``AP + sum of gains + overlap + rest = 1``. ``rest`` is 1 minus the AP with all six kinds corrected, in the
order merged, split, duplicate, mislabelled, background, missed: masks that fit their one instance badly, and masks
that are wrong in both shape and label. ``overlap`` is the gain of all corrections together minus the sum of their
separate gains. A gain in AP is below 0 if a corrected mask is still too poor for the higher thresholds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int32Array, Int64Array
from su3d_bench.metrics.attribution.overlaps import (
    HALF,
    LabelledMasks,
    Overlaps,
    ScoringRules,
    measure_overlaps,
    true_instances,
)
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.metric import C
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.metrics.semantic.confusion import SemanticCounts

KINDS = ("merged", "split", "duplicate", "mislabelled", "background", "missed")


@dataclass(frozen=True)
class CorrectedCounts(Generic[C]):
    """A scene's counts unchanged, after each correction alone and after ``all``; ``n`` errors, or points, of each kind.

    ``with_true_labels``: each mask labelled by ground truth, nothing else changed; None without masks or if labels are
    not scored. ``n_scored`` is the total number of scored points, None if the errors are of masks.
    """

    as_is: C
    alone: Mapping[str, C]
    all: C
    n: Mapping[str, int]
    with_true_labels: C | None = None
    n_scored: int | None = None


def correct_scene(
    truth: Int64Array, predicted: LabelledMasks, rules: ScoringRules, overlaps: Overlaps | None = None
) -> CorrectedCounts[InstanceCounts]:
    """The counts of one scene with its errors corrected; ``truth`` (N,) is label * 1000 + instance, 0 if void.

    ``overlaps``: those of the predictions with ground truth, if already measured.

    >>> from su3d_bench.metrics.instance.average_precision import combine
    >>> truth = np.repeat([3001, 3002], 200)
    >>> both = LabelledMasks(Masks.of_sets([np.arange(400)]), np.array([3]), np.ones(1))
    >>> corrected = correct_scene(truth, both, ScoringRules((3,)))
    >>> [combine([counts]).ap50 for counts in (corrected.as_is, corrected.alone["merged"], corrected.all)]
    [0.0, 1.0, 1.0]
    >>> corrected.n["merged"], corrected.n["missed"]
    (1, 0)
    """
    instances = true_instances(truth, rules)
    overlaps = overlaps or measure_overlaps(instances, predicted, rules)
    as_is = count_masks(truth, predicted, rules)
    alone, n = {}, {}
    for kind, (find, _) in _KINDS.items():
        errors = find(overlaps)
        n[kind] = len(errors)
        alone[kind] = count_masks(truth, repaired(overlaps, errors).labelled(), rules) if errors else as_is
    everything = predicted
    for find, _ in _KINDS.values():
        left = overlaps if everything is predicted else measure_overlaps(instances, everything, rules)
        everything = repaired(left, find(left)).labelled()
    return CorrectedCounts(as_is, alone, count_masks(truth, everything, rules), n)


def with_true_labels(overlaps: Overlaps) -> LabelledMasks:
    """The predictions, each with the class of the instance it shares most points with, regardless of the kind of error.

    A mask that shares no point with any keeps its class.
    """
    predicted = overlaps.predicted
    class_ids = predicted.class_ids.copy()
    if overlaps.n_instances:
        touching = np.flatnonzero(overlaps.shared.any(axis=1))
        class_ids[touching] = overlaps.class_of_instance[overlaps.shared[touching].argmax(axis=1)]
    return LabelledMasks(predicted.masks, class_ids, predicted.scores)


def count_masks(truth: Int64Array, predicted: LabelledMasks, rules: ScoringRules) -> InstanceCounts:
    """The additive counts of one scene, as in the evaluator."""
    return scene_counts.per_scene(
        truth,
        predicted.masks.indptr,
        predicted.masks.indices,
        predicted.class_ids,
        predicted.scores,
        rules.class_ids,
        rules.min_region_size,
        rules.thresholds,
        void=rules.void,
    )


@dataclass(frozen=True)
class MaskError:
    """One error: the predicted ``masks`` that cause it and the counted ``instances`` that it affects.

    The mask (or part) and the instance that identify it come first. A background mask has no instance, a missed
    instance no mask.
    """

    kind: str
    masks: tuple[int, ...]
    instances: tuple[int, ...]


class Repair:
    """The predictions of a scene while their errors are corrected."""

    def __init__(self, predicted: LabelledMasks) -> None:
        self._predicted = predicted
        self.points: dict[int, Int32Array] = {}  # of the masks whose points have changed
        self.class_ids, self.scores = predicted.class_ids.copy(), predicted.scores.copy()
        self.is_kept = np.ones(len(predicted.masks), bool)
        self.added: list[tuple[Int32Array, int, float]] = []  # points, class and confidence of additional masks

    def mask(self, k: int) -> Int32Array:
        """The current points of mask ``k``."""
        return self.points[k] if k in self.points else self._predicted.masks.mask(k)

    @property
    def is_changed(self) -> BoolArray:
        """Which of the masks (K,) have changed."""
        touched: BoolArray = ~self.is_kept | (self.class_ids != self._predicted.class_ids)
        touched |= self.scores != self._predicted.scores
        touched[list(self.points)] = True
        return touched

    def labelled(self) -> LabelledMasks:
        """The corrected predictions."""
        sets = self._predicted.masks.sets()
        for k, points in self.points.items():
            sets[k] = points
        kept = np.flatnonzero(self.is_kept)
        return LabelledMasks(
            Masks.of_sets([*(sets[k] for k in kept), *(points for points, _, _ in self.added)]),
            np.append(self.class_ids[kept], np.array([one for _, one, _ in self.added], np.int64)),
            np.append(self.scores[kept], np.array([one for _, _, one in self.added], np.float64)),
        )


def find_errors(overlaps: Overlaps) -> list[MaskError]:
    """All errors of a scene, ordered by kind."""
    return [error for find, _ in _KINDS.values() for error in find(overlaps)]


@dataclass(frozen=True)
class Errors:
    """The kind of error per mask, ``of_mask`` (K,), and per instance, ``of_instance`` (G,); empty for none.

    An error belongs to a mask, but ``split`` and ``missed`` belong to an instance, as in the counts ``n`` of errors.
    """

    of_mask: tuple[str, ...]
    of_instance: tuple[str, ...]


def errors_of(overlaps: Overlaps) -> Errors:
    """The kind of error of each mask and of each counted instance, before any correction."""
    of_mask, of_instance = [""] * len(overlaps.predicted.masks), [""] * overlaps.n_instances
    for error in find_errors(overlaps):
        if error.kind in ("split", "missed"):
            of_instance[error.instances[0]] = error.kind
        else:
            of_mask[error.masks[0]] = error.kind
    return Errors(tuple(of_mask), tuple(of_instance))


def repaired(overlaps: Overlaps, errors: Sequence[MaskError]) -> Repair:
    """The predictions with ``errors`` corrected; all are of one kind, in the order in which they were found."""
    repair = Repair(overlaps.predicted)
    for kind in dict.fromkeys(error.kind for error in errors):
        _KINDS[kind][1](overlaps, errors, repair)
    return repair


def _find_merged(overlaps: Overlaps) -> list[MaskError]:
    merged = np.flatnonzero(overlaps.is_merged)
    found = []
    for k in merged[np.argsort(-overlaps.predicted.scores[merged], kind="stable")].tolist():
        home = int(overlaps.shared[k].argmax())
        others = [g for g in np.flatnonzero(overlaps.cover[k] > HALF).tolist() if g != home]
        found.append(MaskError("merged", (k,), (home, *others)))
    return found


def _correct_merged(overlaps: Overlaps, errors: Sequence[MaskError], repair: Repair) -> None:
    predicted = overlaps.predicted
    is_found = [overlaps.is_found(g) for g in range(overlaps.n_instances)]
    for error in errors:
        (k,), (home, *others) = error.masks, error.instances
        for g in others:
            repair.points[k] = np.setdiff1d(repair.mask(k), overlaps.members[g], assume_unique=True)
            if not is_found[g]:
                is_found[g] = True
                piece = np.intersect1d(predicted.masks.mask(k), overlaps.members[g], assume_unique=True)
                repair.added.append((piece, int(overlaps.class_of_instance[g]), float(predicted.scores[k])))
        if overlaps.finds(k, home):
            continue
        repair.is_kept[k] = not is_found[home]
        n_outside = len(repair.mask(k)) - int(overlaps.shared[k, home])
        if overlaps.shared[k, home] > HALF * (len(overlaps.members[home]) + n_outside):
            repair.class_ids[k] = int(overlaps.class_of_instance[home])
            is_found[home] = True


def _find_split(overlaps: Overlaps) -> list[MaskError]:
    return [MaskError("split", overlaps.parts[g].parts, (g,)) for g in overlaps.split.tolist()]


def _correct_split(overlaps: Overlaps, errors: Sequence[MaskError], repair: Repair) -> None:
    predicted = overlaps.predicted
    for error in errors:
        members, (g,) = np.array(error.masks), error.instances
        has_class = predicted.class_ids[members] == overlaps.class_of_instance[g]
        first = int(members[0])
        repair.points[first] = np.unique(np.concatenate([predicted.masks.mask(k) for k in members]))
        repair.scores[first] = predicted.scores[members[has_class]].max()
        repair.class_ids[first] = overlaps.class_of_instance[g]
        repair.is_kept[members[1:]] = False


def _find_duplicate(overlaps: Overlaps) -> list[MaskError]:
    return [
        MaskError("duplicate", (k, parts.parts[0]), (g,))
        for g, parts in enumerate(overlaps.parts)
        for k in parts.duplicates
        if overlaps.is_counted[k]
    ]


def _correct_duplicate(overlaps: Overlaps, errors: Sequence[MaskError], repair: Repair) -> None:
    predicted = overlaps.predicted
    for k, first in (error.masks for error in errors):
        repair.is_kept[k] = False
        if predicted.class_ids[k] == predicted.class_ids[first]:
            repair.scores[first] = max(repair.scores[first], predicted.scores[k])


def _find_mislabelled(overlaps: Overlaps) -> list[MaskError]:
    return [
        MaskError("mislabelled", parts.parts[:1], (g,))
        for g, parts in enumerate(overlaps.parts)
        if parts.parts and overlaps.iou[parts.parts[0], g] > HALF and not overlaps.is_found(g)
    ]


def _correct_mislabelled(overlaps: Overlaps, errors: Sequence[MaskError], repair: Repair) -> None:
    for error in errors:
        repair.class_ids[error.masks[0]] = overlaps.class_of_instance[error.instances[0]]


def _find_background(overlaps: Overlaps) -> list[MaskError]:
    belongs = (overlaps.inside > HALF).any(axis=1) | (overlaps.cover > HALF).any(axis=1)
    is_wrong = overlaps.is_counted & ~overlaps.is_ignored & ~belongs
    return [MaskError("background", (k,), ()) for k in np.flatnonzero(is_wrong).tolist()]


def _correct_background(overlaps: Overlaps, errors: Sequence[MaskError], repair: Repair) -> None:
    for error in errors:
        repair.is_kept[error.masks[0]] = False


def _find_missed(overlaps: Overlaps) -> list[MaskError]:
    return [MaskError("missed", (), (g,)) for g in overlaps.missed.tolist()]


def _correct_missed(overlaps: Overlaps, errors: Sequence[MaskError], repair: Repair) -> None:
    scores = overlaps.predicted.scores
    best = float(scores.max()) if len(scores) else 1.0
    for error in errors:
        (g,) = error.instances
        repair.added.append((overlaps.members[g], int(overlaps.class_of_instance[g]), best))


# For each kind, in the order of correction: the functions that find its errors and correct some of them.
_KINDS: dict[
    str,
    tuple[Callable[[Overlaps], list[MaskError]], Callable[[Overlaps, Sequence[MaskError], Repair], None]],
] = {
    "merged": (_find_merged, _correct_merged),
    "split": (_find_split, _correct_split),
    "duplicate": (_find_duplicate, _correct_duplicate),
    "mislabelled": (_find_mislabelled, _correct_mislabelled),
    "background": (_find_background, _correct_background),
    "missed": (_find_missed, _correct_missed),
}


CAUSES = ("geometry", "background", "association", "label")
NEAR_M = 0.05  # the middle radius at which coverage is reported
RIGHT, NOT_SCORED = -1, -2


@dataclass(frozen=True)
class LabelledPoints:
    """The evaluation points (N,) of a scene.

    ``true_class`` and ``predicted`` are class indices, -1 for none; ``is_scored`` marks the points that count;
    ``object_id`` is one number per ground-truth object; ``mask`` the mask that gave the class, -1 for none;
    ``map_distance_m`` and ``mask_distance_m`` are to the nearest point of the map and of any mask, infinity for none;
    for the map it only matters whether they are above ``NEAR_M``.
    """

    true_class: Int64Array
    predicted: Int64Array
    is_scored: BoolArray
    object_id: Int64Array
    mask: Int64Array
    map_distance_m: Float64Array
    mask_distance_m: Float64Array


def causes_of(points: LabelledPoints, *, has_masks: bool = True) -> Int64Array:
    """Index into ``CAUSES`` (N,) of each wrong point, ``RIGHT`` or ``NOT_SCORED`` elsewhere.

    Without masks, for example with one feature per point, a wrong point near the map is a label error.

    >>> truth, called, objects = np.array([0, 1, 1]), np.array([0, 0, 1]), np.array([7, 8, 8])
    >>> mask, near = np.zeros(3, int), np.zeros(3)
    >>> three = LabelledPoints(truth, called, np.ones(3, bool), objects, mask, near, near)
    >>> causes_of(three).tolist()  # the mask belongs to 8, which has two of its points
    [-1, 3, -1]
    """
    is_wrong = points.is_scored & (points.predicted != points.true_class)
    cause = np.where(points.is_scored, RIGHT, NOT_SCORED).astype(np.int64)
    cause[is_wrong] = CAUSES.index("label")
    if has_masks:
        owner = object_of_mask(points)
        of_other = is_wrong & (points.mask >= 0)
        of_other[of_other] = owner[points.mask[of_other]] != points.object_id[of_other]
        cause[of_other] = CAUSES.index("association")
        cause[is_wrong & ((points.mask_distance_m > NEAR_M) | (points.mask < 0))] = CAUSES.index("background")
    cause[is_wrong & (points.map_distance_m > NEAR_M)] = CAUSES.index("geometry")
    return cause


def object_of_mask(points: LabelledPoints) -> Int64Array:
    """The object that each mask belongs to, in the order of masks; -1 if no point took its class from the mask."""
    taken = np.flatnonzero(points.is_scored & (points.mask >= 0) & (points.mask_distance_m <= NEAR_M))
    return _most_frequent(points.mask[taken], points.object_id[taken], int(points.mask.max(initial=-1)) + 1)


def _most_frequent(key: Int64Array, value: Int64Array, n_keys: int) -> Int64Array:
    """For each key from 0 its most frequent value, the lowest on ties; -1 for a key without values.

    >>> _most_frequent(np.array([0, 0, 0, 2]), np.array([5, 4, 4, 9]), 3).tolist()
    [4, -1, 9]
    """
    answer = np.full(n_keys, -1, np.int64)
    values = np.unique(value)
    pairs, n = np.unique(key * len(values) + np.searchsorted(values, value), return_counts=True)
    keys, places = np.divmod(pairs, max(1, len(values)))
    order = np.lexsort((-places, n))  # the most frequent last, on ties the lowest value last
    answer[keys[order]] = values[places[order]]
    return answer


def correct_points(
    points: LabelledPoints, is_counted: BoolArray, *, has_masks: bool = True
) -> CorrectedCounts[SemanticCounts]:
    """The counts of one scene with its errors corrected; ``is_counted`` (C,): the classes of the confusion matrix."""
    cause = causes_of(points, has_masks=has_masks)

    def count(predicted: Int64Array) -> SemanticCounts:
        return semantic.per_scene(points.true_class, predicted, is_counted)

    return CorrectedCounts(
        as_is=count(points.predicted),
        alone={name: count(np.where(cause == k, points.true_class, points.predicted)) for k, name in enumerate(CAUSES)},
        all=count(np.where(cause >= 0, points.true_class, points.predicted)),
        with_true_labels=count(_true_labels(points)) if has_masks else None,
        n={name: int((cause == k).sum()) for k, name in enumerate(CAUSES)},
        n_scored=int(points.is_scored.sum()),
    )


def _true_labels(points: LabelledPoints) -> Int64Array:
    """The class of each point if its mask gets the most frequent class of the scored points there."""
    taken = np.flatnonzero(points.is_scored & (points.mask >= 0) & (points.mask_distance_m <= NEAR_M))
    n_masks = int(points.mask.max(initial=-1)) + 1
    class_of_mask = _most_frequent(points.mask[taken], points.true_class[taken], n_masks)
    has_class = points.mask >= 0
    has_class[has_class] = class_of_mask[points.mask[has_class]] >= 0
    predicted = points.predicted.copy()
    predicted[has_class] = class_of_mask[points.mask[has_class]]
    return predicted
