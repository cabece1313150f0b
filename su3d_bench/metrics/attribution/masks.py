"""Where the points of an AP are lost: six kinds of error, each with the gain in AP when it alone is corrected.

In the spirit of TIDE (Bolya et al., ECCV 2020), for masks on points and the ScanNet AP. Nothing is estimated: a
mending turns the predictions into others, which are scored anew by the same evaluator. *Counted* instances are those
of scored classes with at least the minimum size; predictions of any class, and of none, may be the cause of an error.

A mask *lies in* an instance that has more than half of its points, and *holds* an instance of which it has more than
half. A mask *matches* an instance at IoU above 0.5, so at most one. The kinds:

- ``merged`` (over-merge): a mask that holds several instances, and whose label is that of one of them or of the one
  it lies in. Mended: it is cut. Each instance that it holds becomes a mask with the class of that instance and the
  same confidence, except the one that has most points of the mask: what is left goes with it, and takes its class if
  it then matches. Pieces of instances that a mask finds (matches with the right class) already are dropped.
- ``split`` (under-merge): an instance with at least two parts, which no merged mask finds. Its parts are taken from
  the masks that lie in it and are not merged: first the match with the right class and the highest IoU, then other
  matches, then by points in common; a further mask is a part where less than half of it is in the parts before, and
  it raises the IoU of their union. The union must match, and the class of the first part if that matches, else the
  class with most points among the parts, must be right. Mended: the parts become one mask of that class, with the
  highest confidence that a part of it has.
- ``duplicate``: a mask of at least the minimum size and of a scored class that lies in an instance and has at least
  half of itself in the parts before. Mended: it is dropped; the first part takes its confidence where that is higher
  and the class the same, as the evaluator itself does.
- ``mislabelled``: the first part of an instance matches it and has another class, and no mask finds the instance.
  Mended: it gets the right class.
- ``background``: a mask of at least the minimum size and of a scored class that lies in no counted instance, holds
  none, and of which too little is void for the evaluator to ignore it at all thresholds. Mended: it is dropped.
- ``missed``: no mask of at least the minimum size lies in the instance or holds it, and it is not split. Mended:
  its exact mask is added, with the right class and the highest confidence of the scene (1 where there is none).

Sum rules: ``AP + sum of gains + overlap + rest = 1``. ``rest`` is 1 less the AP with all six corrected, one after the
other in the order merged, split, duplicate, mislabelled, background, missed: masks that fit their one instance badly,
and those that are wrong in mask and label at once. ``overlap`` is what all mendings give together beyond the sum of
what each gives alone. A gain in AP is below 0 where a corrected mask is still too poor for the
higher thresholds.
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
    """A scene's counts as they are, after each mending alone and after ``all``; ``n`` errors, or points, of each kind.

    ``with_true_labels``: each mask named by the truth, nothing else changed; None without masks or where no label
    counts. ``n_scored`` points in all, None where errors are of masks.
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
    """The counts of one scene with its errors corrected; ``truth`` (N,) is label * 1000 + instance, 0 where void.

    ``overlaps`` of the predictions with it, where they were measured before.

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
    """The predictions, each with the class of the instance that it shares most points with, whatever the kind of error.

    A mask that shares no point with any keeps its class.
    """
    predicted = overlaps.predicted
    class_ids = predicted.class_ids.copy()
    if overlaps.n_instances:
        touching = np.flatnonzero(overlaps.shared.any(axis=1))
        class_ids[touching] = overlaps.class_of_instance[overlaps.shared[touching].argmax(axis=1)]
    return LabelledMasks(predicted.masks, class_ids, predicted.scores)


def count_masks(truth: Int64Array, predicted: LabelledMasks, rules: ScoringRules) -> InstanceCounts:
    """The additive counts of one scene, as the evaluator has them."""
    return scene_counts.per_scene(
        truth,
        predicted.masks.indptr,
        predicted.masks.indices,
        predicted.class_ids,
        predicted.scores,
        rules.class_ids,
        rules.min_region_size,
        rules.thresholds,
        forgives_void=rules.forgives_void,
    )


@dataclass(frozen=True)
class MaskError:
    """One error of a kind: the predicted ``masks`` that make it and the counted ``instances`` that suffer it.

    The mask, or part, and the instance that it is told by come first. A background mask has no instance, a missed
    instance no mask.
    """

    kind: str
    masks: tuple[int, ...]
    instances: tuple[int, ...]


class Repair:
    """The predictions of a scene while errors are corrected in them."""

    def __init__(self, predicted: LabelledMasks) -> None:
        self._predicted = predicted
        self.points: dict[int, Int32Array] = {}  # of the masks that have other points now
        self.class_ids, self.scores = predicted.class_ids.copy(), predicted.scores.copy()
        self.is_kept = np.ones(len(predicted.masks), bool)
        self.added: list[tuple[Int32Array, int, float]] = []  # points, class and confidence of masks behind the others

    def mask(self, k: int) -> Int32Array:
        """The points of mask ``k`` as they are now."""
        return self.points[k] if k in self.points else self._predicted.masks.mask(k)

    @property
    def is_changed(self) -> BoolArray:
        """Which of the masks (K,) count otherwise than before."""
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
    """All errors of a scene, kind after kind."""
    return [error for find, _ in _KINDS.values() for error in find(overlaps)]


@dataclass(frozen=True)
class Errors:
    """Whose errors they are: ``of_mask`` (K,) and ``of_instance`` (G,) name the kind, empty for none.

    An error is that of a mask, but ``split`` and ``missed`` are those of an instance: there are as many of each kind as
    ``Mended.n`` counts.
    """

    of_mask: tuple[str, ...]
    of_instance: tuple[str, ...]


def errors_of(overlaps: Overlaps) -> Errors:
    """The kind of error of each mask and of each counted instance, before anything is corrected."""
    of_mask, of_instance = [""] * len(overlaps.predicted.masks), [""] * overlaps.n_instances
    for error in find_errors(overlaps):
        if error.kind in ("split", "missed"):
            of_instance[error.instances[0]] = error.kind
        else:
            of_mask[error.masks[0]] = error.kind
    return Errors(tuple(of_mask), tuple(of_instance))


def repaired(overlaps: Overlaps, errors: Sequence[MaskError]) -> Repair:
    """The predictions with those errors corrected, which are of one kind and in the order in which they are found."""
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


# Of each kind what finds its errors, in the order in which they are corrected, and what mends some of them.
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
NEAR_M = 0.05  # the middle one of the radii at which coverage is reported
RIGHT, NOT_SCORED = -1, -2


@dataclass(frozen=True)
class LabelledPoints:
    """The evaluation points (N,) of a scene.

    ``true_class`` and ``predicted`` are class indices, -1 for none; ``is_scored`` marks the points that count;
    ``object_id`` is one number an object of the truth; ``mask`` the mask that gave the class, -1 where none did;
    ``map_distance_m`` and ``mask_distance_m`` are to the nearest point of the map and of any mask, infinity for none;
    of those to the map it only counts whether they are above ``NEAR_M``.
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

    Without masks, as with one feature a point, what is near and wrong is a wrong label.

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
    """The object that each mask belongs to, in the order of masks; -1 where no point took its class from it."""
    taken = np.flatnonzero(points.is_scored & (points.mask >= 0) & (points.mask_distance_m <= NEAR_M))
    return _most_frequent(points.mask[taken], points.object_id[taken], int(points.mask.max(initial=-1)) + 1)


def _most_frequent(key: Int64Array, value: Int64Array, n_keys: int) -> Int64Array:
    """For each key from 0 the value that stands beside it most often, the lowest of equals; -1 where none does.

    >>> _most_frequent(np.array([0, 0, 0, 2]), np.array([5, 4, 4, 9]), 3).tolist()
    [4, -1, 9]
    """
    answer = np.full(n_keys, -1, np.int64)
    values = np.unique(value)
    pairs, n = np.unique(key * len(values) + np.searchsorted(values, value), return_counts=True)
    keys, places = np.divmod(pairs, max(1, len(values)))
    order = np.lexsort((-places, n))  # the most frequent last, of equals the lowest value last
    answer[keys[order]] = values[places[order]]
    return answer


def correct_points(
    points: LabelledPoints, is_counted: BoolArray, *, has_masks: bool = True
) -> CorrectedCounts[SemanticCounts]:
    """The counts of one scene with its errors corrected; ``is_counted`` (C,) marks the classes of the confusion matrix."""
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
    """The class of each point when its mask is called by the class that most of the scored points there have."""
    taken = np.flatnonzero(points.is_scored & (points.mask >= 0) & (points.mask_distance_m <= NEAR_M))
    n_masks = int(points.mask.max(initial=-1)) + 1
    class_of_mask = _most_frequent(points.mask[taken], points.true_class[taken], n_masks)
    has_class = points.mask >= 0
    has_class[has_class] = class_of_mask[points.mask[has_class]] >= 0
    predicted = points.predicted.copy()
    predicted[has_class] = class_of_mask[points.mask[has_class]]
    return predicted
