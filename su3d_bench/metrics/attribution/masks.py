"""Where the points of an AP are lost: six kinds of error, each with the gain in AP when it alone is mended.

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

Sum rules: ``AP + sum of gains + overlap + rest = 1``. ``rest`` is 1 less the AP with all six mended, one after the
other in the order merged, split, duplicate, mislabelled, background, missed: masks that fit their one instance badly,
and those that are wrong in mask and label at once. ``overlap`` is what all mendings give together beyond the sum of
what each gives alone. A gain in AP is below 0 where a mended mask is still too poor for the
higher thresholds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

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
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance.average_precision import InstanceCounts

__all__ = ["KINDS", "LabelledMasks", "Mended", "ScoringRules", "count_masks", "mend_scene", "with_true_labels"]

KINDS = ("merged", "split", "duplicate", "mislabelled", "background", "missed")
Mending = tuple[LabelledMasks, int]


@dataclass(frozen=True)
class Mended:
    """A scene's counts as they are, after each mending alone and after ``all``; ``n`` errors of each kind.

    ``with_true_labels``: each mask named by the truth, where labels count. Points are not counted here.
    """

    as_is: InstanceCounts
    alone: Mapping[str, InstanceCounts]
    all: InstanceCounts
    n: Mapping[str, int]
    with_true_labels: InstanceCounts | None = None
    n_scored: int | None = None


def mend_scene(truth: Int64Array, predicted: LabelledMasks, rules: ScoringRules) -> Mended:
    """The counts of one scene with its errors mended; ``truth`` (N,) is label * 1000 + instance, 0 where void.

    >>> truth = np.repeat([3001, 3002], 200)
    >>> both = LabelledMasks(Masks.of_sets([np.arange(400)]), np.array([3]), np.ones(1))
    >>> mended = mend_scene(truth, both, ScoringRules((3,)))
    >>> [instance_ap.combine([counts]).ap50 for counts in (mended.as_is, mended.alone["merged"], mended.all)]
    [0.0, 1.0, 1.0]
    >>> mended.n["merged"], mended.n["missed"]
    (1, 0)
    """
    instances = true_instances(truth, rules)
    overlaps = measure_overlaps(instances, predicted, rules)
    as_is = count_masks(truth, predicted, rules)
    alone, n = {}, {}
    for kind, mend in _MENDINGS.items():
        mended, n[kind] = mend(overlaps)
        alone[kind] = count_masks(truth, mended, rules) if n[kind] else as_is
    everything = predicted
    for mend in _MENDINGS.values():
        everything, _ = mend(measure_overlaps(instances, everything, rules))
    return Mended(as_is, alone, count_masks(truth, everything, rules), n)


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
    return instance_ap.per_scene(
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


def _mend_merged(overlaps: Overlaps) -> Mending:
    predicted = overlaps.predicted
    merged = np.flatnonzero(overlaps.is_merged)
    is_found = [overlaps.is_found(g) for g in range(overlaps.n_instances)]
    masks, class_ids, scores = predicted.masks.sets(), predicted.class_ids.tolist(), predicted.scores.tolist()
    is_kept = np.ones(len(masks), bool)
    for k in merged[np.argsort(-predicted.scores[merged], kind="stable")].tolist():
        home = int(overlaps.shared[k].argmax())
        others = [g for g in np.flatnonzero(overlaps.cover[k] > HALF).tolist() if g != home]
        for g in others:
            masks[k] = np.setdiff1d(masks[k], overlaps.members[g], assume_unique=True)
            if not is_found[g]:
                is_found[g] = True
                masks.append(np.intersect1d(predicted.masks.mask(k), overlaps.members[g], assume_unique=True))
                class_ids.append(int(overlaps.class_of_instance[g]))
                scores.append(scores[k])
        if overlaps.finds(k, home):
            continue
        is_kept[k] = not is_found[home]
        n_outside = len(masks[k]) - int(overlaps.shared[k, home])
        if overlaps.shared[k, home] > HALF * (len(overlaps.members[home]) + n_outside):
            class_ids[k] = int(overlaps.class_of_instance[home])
            is_found[home] = True
    is_kept = np.concatenate([is_kept, np.ones(len(masks) - len(is_kept), bool)])
    return _kept(masks, np.array(class_ids, np.int64), np.array(scores, np.float64), is_kept), len(merged)


def _mend_split(overlaps: Overlaps) -> Mending:
    predicted = overlaps.predicted
    masks, scores, is_kept = predicted.masks.sets(), predicted.scores.copy(), np.ones(len(predicted.masks), bool)
    class_ids = predicted.class_ids.copy()
    split = [g for g in range(overlaps.n_instances) if overlaps.is_split(g)]
    for g in split:
        members = np.array(overlaps.parts[g].parts)
        has_class = predicted.class_ids[members] == overlaps.class_of_instance[g]
        first = int(members[0])
        masks[first] = np.unique(np.concatenate([predicted.masks.mask(k) for k in members]))
        scores[first] = predicted.scores[members[has_class]].max()
        class_ids[first] = overlaps.class_of_instance[g]
        is_kept[members[1:]] = False
    return _kept(masks, class_ids, scores, is_kept), len(split)


def _mend_duplicate(overlaps: Overlaps) -> Mending:
    predicted = overlaps.predicted
    scores, is_kept = predicted.scores.copy(), np.ones(len(predicted.masks), bool)
    for parts in overlaps.parts:
        for k in parts.duplicates:
            if not overlaps.is_counted[k]:
                continue
            is_kept[k] = False
            first = parts.parts[0]
            if predicted.class_ids[k] == predicted.class_ids[first]:
                scores[first] = max(scores[first], predicted.scores[k])
    return _kept(predicted.masks.sets(), predicted.class_ids, scores, is_kept), int((~is_kept).sum())


def _mend_mislabelled(overlaps: Overlaps) -> Mending:
    predicted = overlaps.predicted
    class_ids = predicted.class_ids.copy()
    for g, parts in enumerate(overlaps.parts):
        if parts.parts and overlaps.iou[parts.parts[0], g] > HALF and not overlaps.is_found(g):
            class_ids[parts.parts[0]] = overlaps.class_of_instance[g]
    return LabelledMasks(predicted.masks, class_ids, predicted.scores), int((class_ids != predicted.class_ids).sum())


def _mend_background(overlaps: Overlaps) -> Mending:
    predicted = overlaps.predicted
    belongs = (overlaps.inside > HALF).any(axis=1) | (overlaps.cover > HALF).any(axis=1)
    is_wrong = overlaps.is_counted & ~overlaps.is_ignored & ~belongs
    return _kept(predicted.masks.sets(), predicted.class_ids, predicted.scores, ~is_wrong), int(is_wrong.sum())


def _mend_missed(overlaps: Overlaps) -> Mending:
    predicted = overlaps.predicted
    touches = ((overlaps.inside > HALF) | (overlaps.cover > HALF)) & overlaps.is_large[:, None]
    is_split = np.array([overlaps.is_split(g) for g in range(overlaps.n_instances)], bool)
    missed = np.flatnonzero(~touches.any(axis=0) & ~is_split)
    best = float(predicted.scores.max()) if len(predicted.scores) else 1.0
    return (
        LabelledMasks(
            Masks.of_sets([*predicted.masks.sets(), *(overlaps.members[g] for g in missed)]),
            np.concatenate([predicted.class_ids, overlaps.class_of_instance[missed]]),
            np.concatenate([predicted.scores, np.full(len(missed), best)]),
        ),
        len(missed),
    )


_MENDINGS: dict[str, Callable[[Overlaps], Mending]] = {
    "merged": _mend_merged,
    "split": _mend_split,
    "duplicate": _mend_duplicate,
    "mislabelled": _mend_mislabelled,
    "background": _mend_background,
    "missed": _mend_missed,
}


def _kept(masks: list[Int32Array], class_ids: Int64Array, scores: Float64Array, is_kept: BoolArray) -> LabelledMasks:
    kept = np.flatnonzero(is_kept)
    return LabelledMasks(Masks.of_sets([masks[k] for k in kept]), class_ids[kept], scores[kept])
