"""Panoptic quality from matched segments of things and stuff, equal to the originals in every bit.

Sources: ``panopticapi``: ``pq_compute`` of panopticapi/evaluation.py (cocodataset/panopticapi at 7bb4655), one image
per scene and one process per image. ``semantic-kitti``: ``EvalPanoptic`` of
mmdet3d/evaluation/functional/panoptic_seg_eval.py (open-mmlab/mmdetection3d at fe25f7a), which is the evaluator of
SemanticKITTI and the one of OneFormer3D on ScanNet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Masks, Partition
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array, IntArray
from su3d_bench.metrics.instance.score import masks_and_scores, named_classes, score_of_masks
from su3d_bench.metrics.matching import transfer
from su3d_bench.metrics.matching.labelling import class_index_of_ids, encoder_warning, places_among_scored
from su3d_bench.metrics.metric import Counts, Metric, Pooled, SceneScore, axes, first_row
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.numerics.statistics import ratio

Rule = Literal["panopticapi", "semantic-kitti"]
MATCHED = 0.5  # an IoU must be above it; then at most one of several disjoint segments can match
IGNORED = 0.5  # a segment with a larger share of void, or of a crowd of its class, is no false positive
QUALITIES = ("PQ", "SQ", "RQ")
_EPS = 1e-15  # the smallest denominator of the original


@dataclass(frozen=True)
class PanopticCounts(Counts):
    """The counts of one scene per class (C,): ``n_matched`` segments int64, ``n_false`` predicted ones, ``n_missed``
    true ones, and the sum of the IoUs of the matched ones, ``iou`` float64."""

    stored_as = "panoptic"

    n_matched: Int64Array = field(metadata=axes("classes"))
    n_false: Int64Array = field(metadata=axes("classes"))
    n_missed: Int64Array = field(metadata=axes("classes"))
    iou: Float64Array = field(metadata=axes("classes"))

    def contradiction(self) -> str | None:
        """A sum of IoUs that is impossible for the number of matches."""
        fits = (self.iou >= MATCHED * self.n_matched) & (self.iou <= self.n_matched * (1 + 1e-12))
        wrong = np.flatnonzero(~fits)
        if len(wrong):
            return f"'iou' of class {wrong[0]} is {self.iou[wrong[0]]:g} over {self.n_matched[wrong[0]]} matches"
        return None


@dataclass(frozen=True)
class Segments:
    """The segment of each of N points: ``class_index`` (N,) int64, -1 for none, and ``number`` (N,) int64 within the
    class."""

    class_index: Int64Array
    number: Int64Array


@dataclass(frozen=True)
class _Listed:
    """The segments of a scene, by class and number: the ``row`` (N,) of each point's segment, -1 for none, and the
    class, number and size in points of each segment."""

    row: Int64Array
    class_index: Int64Array
    number: Int64Array
    size: Int64Array

    @classmethod
    def of(cls, segments: Segments) -> _Listed:
        is_in_one = segments.class_index >= 0
        span = int(segments.number.max(initial=0)) + 1
        key = segments.class_index[is_in_one] * span + segments.number[is_in_one]
        distinct, place, size = np.unique(key, return_inverse=True, return_counts=True)
        row = np.full(len(is_in_one), -1, np.int64)
        row[is_in_one] = place
        return cls(row, distinct // span, distinct % span, size.astype(np.int64))


def per_scene(
    truth: Segments, predicted: Segments, is_thing: BoolArray, rule: Rule = "panopticapi", min_region_size: int = 1
) -> PanopticCounts:
    """The additive counts of one scene; ``is_thing`` (C,) marks things, the others are stuff.

    All points of a stuff class are one segment, whatever their numbers. With ``panopticapi`` points of a thing without
    a number (0) are a COCO crowd: its things are not separated, it is not missed, and predictions there are not wrong.
    With ``semantic-kitti`` they are a segment like any other, void points of the ground truth are ignored entirely, and
    segments below ``min_region_size`` are neither missed nor wrong, though they may match.

    >>> truth = Segments(np.array([0] * 6 + [1] * 4), np.array([1] * 3 + [2] * 3 + [0] * 4))
    >>> found = Segments(np.array([0] * 5 + [1] * 5), np.array([7] * 3 + [8] * 2 + [9] * 5))
    >>> counts = per_scene(truth, found, np.array([True, False]))
    >>> counts.n_matched.tolist(), np.round(counts.iou, 3).tolist()  # a whole thing, two thirds of one; stuff by 4/5
    ([2, 1], [1.667, 0.8])
    """
    is_api = rule == "panopticapi"
    if not is_api:
        exists = truth.class_index >= 0
        truth, predicted = (Segments(each.class_index[exists], each.number[exists]) for each in (truth, predicted))
    true, found = (_Listed.of(_with_one_of_stuff(each, is_thing)) for each in (truth, predicted))
    is_crowd = is_api & is_thing[true.class_index] & (true.number == 0)
    both = (true.row >= 0) & (found.row >= 0)
    pair, shared = np.unique(true.row[both] * max(1, len(found.size)) + found.row[both], return_counts=True)
    of_true, of_found = np.divmod(pair, max(1, len(found.size)))
    n_void = np.bincount(found.row[(true.row < 0) & (found.row >= 0)], minlength=len(found.size))
    is_candidate = (true.class_index[of_true] == found.class_index[of_found]) & ~is_crowd[of_true]
    union = found.size[of_found] + true.size[of_true] - shared - n_void[of_found]
    iou = np.divide(shared, union, out=np.zeros(len(shared)), where=is_candidate)
    is_match = iou > MATCHED
    is_met, is_used = np.zeros(len(true.size), bool), np.zeros(len(found.size), bool)
    is_met[of_true[is_match]] = True
    is_used[of_found[is_match]] = True
    n_ignored = n_void.astype(np.int64)
    in_crowd = is_crowd[of_true] & (true.class_index[of_true] == found.class_index[of_found])
    n_ignored[of_found[in_crowd]] += shared[in_crowd]
    is_wrong = ~is_used & (n_ignored / np.maximum(found.size, 1) <= IGNORED)
    is_missed = ~is_met & ~is_crowd
    if not is_api:
        is_wrong, is_missed = ~is_used & (found.size >= min_region_size), is_missed & (true.size >= min_region_size)
    n_classes = len(is_thing)
    return PanopticCounts(
        n_matched=np.bincount(true.class_index[of_true[is_match]], minlength=n_classes).astype(np.int64),
        n_false=np.bincount(found.class_index[is_wrong], minlength=n_classes).astype(np.int64),
        n_missed=np.bincount(true.class_index[is_missed], minlength=n_classes).astype(np.int64),
        iou=_sums(true.class_index[of_true[is_match]], iou[is_match], n_classes, one_by_one=is_api),
    )


def _with_one_of_stuff(segments: Segments, is_thing: BoolArray) -> Segments:
    is_stuff = np.append(~is_thing, False)[segments.class_index]
    return Segments(segments.class_index, np.where(is_stuff, 0, segments.number))


def _sums(class_index: Int64Array, iou: Float64Array, n_classes: int, *, one_by_one: bool) -> Float64Array:
    """The sum of the IoUs of each class, sequentially or, as numpy does, pairwise: they differ in the last bit."""
    if one_by_one:
        return np.bincount(class_index, weights=iou, minlength=n_classes).astype(np.float64)
    return np.array([np.sum(iou[class_index == index]) for index in range(n_classes)], np.float64)


def class_qualities(sums: Mapping[str, NDArray[Any]], rule: Rule) -> dict[str, Float64Array]:
    """PQ, SQ and RQ (R, C) of each class from sums of counts; NaN for a class neither true nor predicted.

    A class without a match has SQ 0 in both originals, and with ``semantic-kitti`` a class neither true nor predicted
    scores 0 as well.
    """
    matched, iou = sums["n_matched"].astype(np.float64), sums["iou"]
    halves = matched + 0.5 * sums["n_false"] + 0.5 * sums["n_missed"]
    if rule == "semantic-kitti":
        sq, rq = iou / np.maximum(matched, _EPS), matched / np.maximum(halves, _EPS)
        return {"PQ": sq * rq, "SQ": sq, "RQ": rq}
    sq = np.where(halves > 0, np.where(matched > 0, iou / np.maximum(matched, 1.0), 0.0), np.nan)
    return {"PQ": ratio(iou, halves), "SQ": sq, "RQ": ratio(matched, halves)}


def means(values: dict[str, Float64Array], is_thing: BoolArray, rule: Rule) -> dict[str, Float64Array]:
    """The means (R,) over all classes, over things and over stuff of values (R, C), ignoring NaN.

    >>> table = {"PQ": np.array([[0.5, np.nan, 1.0]])}
    >>> {name: mean.tolist() for name, mean in means(table, np.arange(3) < 2, "panopticapi").items()}
    {'PQ': [0.75], 'PQ things': [0.5], 'PQ stuff': [1.0]}
    """
    answer = {}
    for suffix, kept in (("", np.ones(len(is_thing), bool)), (" things", is_thing), (" stuff", ~is_thing)):
        for name, table in values.items():
            answer[name + suffix] = _mean_of_rows(np.ascontiguousarray(table[:, kept]), rule)
    return answer


def _mean_of_rows(table: Float64Array, rule: Rule) -> Float64Array:
    """The sum over classes, sequentially or as numpy sums: they differ in the last bit."""
    is_number = ~np.isnan(table)
    filled = np.where(is_number, table, 0.0)
    total = filled.sum(axis=1) if rule == "semantic-kitti" else np.cumsum(filled, axis=1)[:, -1:].sum(axis=1)
    return ratio(total, is_number.sum(axis=1))


class PanopticMetric(Metric[PanopticCounts]):
    """Recognition and segmentation quality of single things and of whole stuff classes."""

    truth = GroundTruth
    counts = PanopticCounts

    def per_scene(self, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        if truth.evaluation_points is not None:
            raise DataError(f"{rules.name}: ground truth '{truth.variant}' has no instances on its evaluation points")
        ids = named_classes(rules, truth.semantic, prediction, encoder)
        masks, scores = masks_and_scores(prediction)
        cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
        moved = transfer.transfer_masks(prediction.points, masks, truth.points, cap_m, voxel_m)
        counts = count_segments(rules, truth.semantic, truth.instance, moved, scores, ids)
        wanted = _scored_index(rules, truth.semantic) >= 0
        warnings = [encoder_warning(rules, prediction, encoder), _shared_warning(moved, scores, len(truth.points))]
        return score_of_masks(self, counts, prediction, truth.points, wanted, warnings)

    @property
    def sizes(self) -> dict[str, int]:
        return {"classes": len(self.rules.scored)}

    def pooled(self, counts: Sequence[PanopticCounts]) -> Pooled:
        table = self._once(counts)
        columns = self.class_columns(table, np.ones(len(self.rules.scored), bool))
        classes = {name: first_row(values) for name, values in columns.items()}
        n_classes = int((~np.isnan(table["PQ"])).sum())
        values = first_row(means(table, things_of(self.rules), rule_of(self.rules))) | {"n_classes": n_classes}
        return Pooled(values, classes, self.group_means(classes, {name: name for name in QUALITIES}))

    def _once(self, counts: Sequence[PanopticCounts]) -> dict[str, Float64Array]:
        """The qualities (1, C) over all scenes, whose IoUs are summed in order, which affects the last bit."""
        sums = vars(PanopticCounts.joined(counts))
        return class_qualities({name: values[None] for name, values in sums.items()}, rule_of(self.rules))

    def resampled(self, counts: Sequence[PanopticCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        rule = rule_of(self.rules)
        return means(class_qualities(PanopticCounts.drawn(counts, weights), rule), things_of(self.rules), rule)

    def resampled_classes(
        self, counts: Sequence[PanopticCounts], weights: Int64Array
    ) -> dict[str, dict[str, Float64Array]]:
        table = class_qualities(PanopticCounts.drawn(counts, weights), rule_of(self.rules))
        has_truth = np.sum([of_scene.n_matched + of_scene.n_missed for of_scene in counts], axis=0) > 0
        return self.class_columns(table, has_truth)


def things_of(rules: ProtocolRules) -> BoolArray:
    """Which scored classes are things (C,); the others are stuff."""
    return np.array([entry.name not in rules.stuff for entry in rules.scored], bool)


def rule_of(rules: ProtocolRules) -> Rule:
    return "panopticapi" if rules.metric == "panopticapi" else "semantic-kitti"


def visible_truth(rules: ProtocolRules, truth: GroundTruth) -> GroundTruth:
    """The ground truth that oracle methods get for a protocol: unchanged, except for protocols with stuff.

    For those every labelled point belongs to a segment, and points annotated with a class but no instance, such as
    walls in ScanNet++, become one instance per class.

    >>> from su3d_bench.core.types import LabelSet, IntArray
    >>> from su3d_bench.metrics.protocols.loading import load_protocol
    >>> names = LabelSet("replica", (93, 20), ("wall", "chair"))
    >>> ids = np.array([93, 20, 0, 93], np.int32), np.array([0, 5, 0, 0], np.int32)
    >>> truth = GroundTruth(np.zeros((4, 3), np.float32), *ids, names, "mesh-vertices", "by hand")
    >>> visible_truth(load_protocol("rooms-panoptic"), truth).instance.tolist()
    [6, 5, 0, 6]
    """
    is_open = (truth.semantic > 0) & (truth.instance <= 0)
    if not rules.stuff or not is_open.any():
        return truth
    number = np.unique(truth.semantic[is_open], return_inverse=True)[1]
    instance = truth.instance.copy()
    instance[is_open] = truth.instance.max(initial=0) + 1 + number
    return replace(truth, instance=instance)


def count_segments(
    rules: ProtocolRules,
    semantic: IntArray,
    instance: IntArray,
    masks: Masks,
    scores: Float64Array,
    class_ids: Int64Array,
) -> PanopticCounts:
    """The counts of K masks on N ground-truth points with class ids (N,) and instance numbers (N,), 0 for none.

    A point in several masks belongs to that of the greatest score, the first on ties; masks whose class id (K,) is not
    scored are ignored. Points of class -1 are excluded from ground truth and masks.
    """
    called = _scored_index(rules, class_ids)
    order = np.argsort(-scores, kind="stable")
    order = order[called[order] >= 0]
    first = transfer.first_owner(transfer.select(masks, order), len(semantic))
    owner = np.where(first >= 0, order[first], -1) if len(order) else first
    predicted = Segments(np.where(np.asarray(semantic) < 0, -1, np.append(called, -1)[owner]), owner)
    truth = Segments(_scored_index(rules, semantic), np.asarray(instance, np.int64))
    size = rules.min_region_size or 1
    return per_scene(truth, predicted, things_of(rules), rule_of(rules), size)


def _scored_index(rules: ProtocolRules, ids: IntArray) -> Int64Array:
    """The index of each class id among the scored classes, -1 if it is not one of them."""
    return places_among_scored(rules)[class_index_of_ids(rules, ids)]


def _shared_warning(masks: Masks, scores: Float64Array, n_points: int) -> str | None:
    n_covering = np.bincount(masks.indices, minlength=n_points)
    n_shared, n_covered = int((n_covering > 1).sum()), int((n_covering > 0).sum())
    if not n_shared:
        return None
    by = "the highest confidence" if len(np.unique(scores)) > 1 else "the first of equal confidence"
    share = f"{100 * n_shared / n_covered:.1f} %"
    return f"{share} of the points that masks cover are in several; each counts for the mask with {by}"
