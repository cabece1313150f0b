"""Protocols of kind ``categories`` and ``queries``: features against texts, without a label set."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import release_pages
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Partition, Prediction
from su3d_bench.core.types import Float32Array, Float64Array, Int64Array
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance import scene_counts
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.instance.score import CurveMetric, score_of_masks
from su3d_bench.metrics.matching import labelling, transfer
from su3d_bench.metrics.matching.nearest import ball_tree, chosen_tree, nearest_as_found
from su3d_bench.metrics.matching.rows import first_rows, row_ids, rows_of
from su3d_bench.metrics.matching.votes import transfer_each_mask
from su3d_bench.metrics.metric import Metric, Pooled, SceneScore
from su3d_bench.metrics.open_vocabulary import openlex3d
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectCounts, OpenLexTruth
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic.score import has_feature

SPACE = "queries"
_SMALLEST_RANGE = 1e-8  # openlex3d's lower bound of the range that similarities are rescaled by


@dataclass(frozen=True)
class TextQuery:
    """A text and the ids of the objects that it refers to.

    ``groups``: those in which it is also scored separately, such as ``unique``; ``name``: the object's name in the
    file, '' if it has none.
    """

    text: str
    object_ids: tuple[int, ...]
    groups: tuple[str, ...] = ()
    name: str = ""

    def __post_init__(self) -> None:
        if len(set(self.object_ids)) != len(self.object_ids):
            raise DataError(f"query '{self.text[:60]}': an object is listed twice; list each once")


@dataclass(frozen=True)
class QueryTruth:
    """Objects of a scene and the texts that ask for them.

    ``points`` (N, 3) float32 m, ``object_of_point`` (N,) int64, -1 for none. ``alignment`` (4, 4): the rigid transform
    to the frame aligned with the walls, if the dataset has one that is not applied to its points.
    """

    points: Float32Array
    object_of_point: Int64Array
    queries: tuple[TextQuery, ...]
    variant: str
    source: str
    space: str = SPACE
    alignment: Float64Array | None = None


def confidences(similarity: Float64Array, rule: Literal["similarity", "similarity-min-max"]) -> Float64Array:
    """The confidence (K, Q) of each mask for each query: its cosine, or the cosine rescaled to 0..1 over the masks.

    With ``similarity-min-max`` the best mask of every query has confidence 1, however low its similarity.

    >>> confidences(np.array([[0.5, 0.1], [0.0, 0.1], [-0.5, 0.1]]), "similarity-min-max").tolist()
    [[1.0, 0.0], [0.5, 0.0], [0.0, 0.0]]
    """
    if rule == "similarity" or not len(similarity):
        return similarity
    halved = (similarity + 1.0) / 2.0
    low, high = halved.min(axis=0), halved.max(axis=0)
    return np.asarray((halved - low) / np.maximum(high - low, _SMALLEST_RANGE))


def per_scene(
    object_of_point: Int64Array,
    queries: Sequence[TextQuery],
    masks: Masks,
    confidence: Float64Array,
    *,
    top_k: int | None = None,
    min_region_size: int = 1,
    thresholds: Sequence[float] = instance_ap.THRESHOLDS,
    matches_by_confidence: bool = True,
) -> InstanceCounts:
    """The additive counts of one scene: ``masks`` over its points with ``confidence`` (K, Q) for each query.

    The ``top_k`` masks of each query count, the first on ties, and of these those of at least the minimum size. Smaller
    objects are not instances; a query without any instance still has its false positives. An object is matched with the
    masks by descending confidence or, as in ScanNet's script and its derivatives, in their own order.

    >>> masks = Masks(np.array([0, 2, 4]), np.array([0, 1, 2, 3]))
    >>> found = TextQuery("seat", (7,)), TextQuery("lamp", (8,))
    >>> objects = np.array([7, 7, 8, 8])
    >>> counts = per_scene(objects, found, masks, np.array([[0.9, 0.2], [0.1, 0.8]]))
    >>> instance_ap.combine([counts]).ap
    1.0
    """
    ids, segment_of_point, size_of_object = np.unique(object_of_point, return_inverse=True, return_counts=True)
    n_masks = len(masks)
    size = masks.sizes
    shared = scene_counts.intersections(segment_of_point, len(ids), masks.indptr, masks.indices, np.arange(n_masks))
    iou = shared / (size_of_object[None, :] + size[:, None] - shared)
    column_of = {int(object_id): column for column, object_id in enumerate(ids) if object_id >= 0}
    order = np.argsort(-confidence, axis=0, kind="stable")[:top_k]
    if not matches_by_confidence:
        order = np.sort(order, axis=0)
    none = np.zeros(0)
    parts = [scene_counts.count_class(0, np.zeros((0, 0)), none.astype(bool), none, none, thresholds)]
    for q, query in enumerate(queries):
        columns = [column_of[object_id] for object_id in query.object_ids if object_id in column_of]
        takes_part = size_of_object[columns] >= min_region_size
        rows = order[size[order[:, q]] >= min_region_size, q]
        of_query = scene_counts.count_class(
            0,
            iou=iou[np.ix_(rows, np.array(columns, np.int64)[takes_part])],
            takes_part=np.ones(int(takes_part.sum()), bool),
            scores=confidence[rows, q],
            ignored_share=np.zeros(len(rows)),
            thresholds=thresholds,
        )
        parts.append(of_query)
    return InstanceCounts.joined(parts)


_NOT_KNOWN = "the ground-truth ceiling is unknown"
NO_CEILING = (
    f"{_NOT_KNOWN}: masks grow by the threshold, also over their neighbours, and each query's best mask has "
    "confidence 1, so perfect masks with perfect features may score below 1"
)
NO_QUERY_CEILING = f"{_NOT_KNOWN}: the ranking of perfect masks depends on the encoder"
NEEDS_FEATURES = "needs features to compare with texts, the prediction has none"
_BLOCK_UNITS = 2048  # 2048 units x 3407 prompts of float64 are 56 MB


class CategoriesMetric(Metric[ObjectCounts]):
    """OpenLex3D's category frequencies or its ranking of labels."""

    truth = OpenLexTruth
    counts = ObjectCounts

    def per_scene(self, truth: OpenLexTruth, prediction: Prediction, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        points, units = _units(prediction, rules.transfer.evaluation_voxel_m)
        is_ranking = rules.metric == "openlex3d-ranking"
        ids = sorted(truth.objects) if is_ranking else openlex3d.scored_objects(truth.objects, rules.ignore)
        object_row = rows_of(np.array(ids, np.int64), truth.object_of_point)
        scored = object_row >= 0
        cap_m = rules.transfer.cap_m
        reach_m = np.inf if cap_m is None else max(cap_m, *transfer.COVERAGE_RADII_M)
        unit, distance, n_tied = np.full(len(scored), -1, np.int64), np.full(len(scored), np.inf), 0
        if len(points):
            distance[scored], nearest, n_tied = nearest_as_found(
                ball_tree, points, units, truth.points[scored], reach_m
            )
            unit[scored] = np.append(units, -1)[nearest]
        if cap_m is not None:
            unit[distance > cap_m] = -1
        # the units with points, ascending, and each point's index among them, -1 for none
        used = np.unique(unit[unit >= 0])
        count = _count_ranks if is_ranking else _count_categories
        of_point = rows_of(used, unit)
        counts, n_equal = count(rules, truth, prediction, encoder, ids, object_row, used, of_point)
        ties = {"points as near to one object as to another": n_tied, "objects with labels of equal cosine": n_equal}
        warnings = (
            labelling.encoder_warning(rules, prediction, encoder),
            _shared_points_warning(prediction),
            *(f"{what}: {n}; the original may choose otherwise" for what, n in ties.items() if n),
        )
        return self.score(counts, prediction, distance[scored], warnings)

    @property
    def sizes(self) -> dict[str, int]:
        return {"values": len(self.rules.value_names)}

    def pooled(self, counts: Sequence[ObjectCounts]) -> Pooled:
        return Pooled(dict(zip(self.rules.value_names, openlex3d.combine(counts).tolist(), strict=True)))

    def resampled(self, counts: Sequence[ObjectCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        values = openlex3d.resampled(counts, weights)
        return dict(zip(self.rules.value_names, values.T, strict=True))


def _units(prediction: Prediction, voxel_m: float) -> tuple[Float32Array, Int64Array]:
    """The points (M, 3) that belong to a unit (an instance or a point of a dense map), and the unit (M,) of each.

    Downsampled to the mean of the points in each voxel, with the unit of the point nearest to it.
    """
    if isinstance(prediction, DenseFeatures):
        unit = np.where(has_feature(prediction), np.arange(len(prediction.points)), -1)
    elif isinstance(prediction, Partition):
        unit = prediction.instance.astype(np.int64)
    else:
        unit = transfer.first_owner(prediction, len(prediction.points))
    points, unit = np.asarray(prediction.points[unit >= 0], np.float32), unit[unit >= 0]
    if not len(points) or voxel_m <= 0:
        return points, unit
    means = voxel_means(points, voxel_m)
    _, nearest, _ = nearest_as_found(chosen_tree, points, unit, means)
    return means, unit[nearest]


def voxel_means(points: Float32Array, voxel_m: float) -> Float32Array:
    """The mean of the points in each voxel of a grid at the world's origin, as in Open3D's tensor point clouds.

    Cells, sums and means are float32, equal to those of Open3D 0.19 in every bit: with two points in a voxel, only
    this rounding decides which one the mean is nearer to. The means are in the order of the voxels' first points, as
    there with one thread; with several their order is another each time.

    >>> voxel_means(np.array([[0.01, 0, 0], [0.03, 0, 0], [0.06, 0, 0]], np.float32), 0.05)[:, 0].tolist()
    [0.019999999552965164, 0.05999999865889549]
    """
    voxel = row_ids(np.floor(points / np.float32(voxel_m)).astype(np.int64))
    voxel = np.argsort(np.argsort(first_rows(voxel[:, None])))[voxel]
    sums = np.zeros((int(voxel.max()) + 1, 3), np.float32)
    np.add.at(sums, voxel, points)
    return sums / np.bincount(voxel).astype(np.float32)[:, None]


def _count_categories(
    rules: ProtocolRules,
    truth: OpenLexTruth,
    prediction: Prediction,
    encoder: Encoder | None,
    ids: list[int],
    object_row: Int64Array,
    used: Int64Array,
    of_point: Int64Array,
) -> tuple[ObjectCounts, int]:
    """The counts, and the number of units whose last label counts only because it is listed before an equal one."""
    assert rules.top_k is not None
    labels, n_equal = getattr(prediction, "labels", None), 0
    if not len(used):
        vocabulary, top = list[str](), np.zeros((0, 1), np.int64)
    elif labels is not None and labelling.has_every_label(prediction):
        vocabulary = sorted(set(labels))
        top = np.array([[vocabulary.index(labels[row])] for row in used], np.int64).reshape(-1, 1)
    else:
        vocabulary = list(truth.prompts)
        n_top, tops = min(rules.top_k, len(vocabulary)), []
        for block in _similarity_blocks(rules, truth, prediction, encoder, used):
            tops.append(openlex3d.top_labels(block, n_top))
            is_as_near = block >= np.take_along_axis(block, tops[-1][:, -1:], axis=1)
            n_equal += int((is_as_near.sum(axis=1) > n_top).sum())
        top = np.concatenate(tops)
    table = openlex3d.category_table(truth.objects, ids, vocabulary)
    category = openlex3d.point_categories(object_row, of_point, top, table)
    return openlex3d.count_categories(object_row, category, len(ids)), n_equal


def _count_ranks(
    rules: ProtocolRules,
    truth: OpenLexTruth,
    prediction: Prediction,
    encoder: Encoder | None,
    ids: list[int],
    object_row: Int64Array,
    used: Int64Array,
    of_point: Int64Array,
) -> tuple[ObjectCounts, int]:
    """The counts, and the number of units with equal cosines, whose ranks follow the list."""
    labels = [openlex3d.ranked_labels(truth.objects[object_id], truth.prompts) for object_id in ids]
    rows, units, _ = openlex3d.distinct_pairs(object_row, of_point)
    if len(units) == 0 and (object_row >= 0).any():  # no prediction: no label has a rank, each counts 0
        n_points = np.bincount(object_row[object_row >= 0], minlength=len(labels))
        has = np.array([(len(ranked.synonyms) > 0, len(ranked.secondary) > 0) for ranked in labels])
        totals = np.where(np.column_stack([has.any(axis=1), has]), 0.0, np.nan)
        return ObjectCounts(n_points[n_points > 0].astype(np.int64), totals[n_points > 0]), 0
    scores = np.full((len(rows), 3), np.nan)
    start, n_equal = 0, 0
    for similarity in _similarity_blocks(rules, truth, prediction, encoder, used) if len(used) else ():
        ranks = openlex3d.rank_of_labels(similarity)
        n_equal += int((np.diff(np.sort(similarity, axis=1), axis=1) == 0).any(axis=1).sum())
        here = (units >= start) & (units < start + len(ranks))
        for row in np.unique(rows[here]):
            mine = np.flatnonzero(here & (rows == row))
            scores[mine] = labels[row].scores(ranks[units[mine] - start])
        start += len(ranks)
    return openlex3d.count_ranks(object_row, of_point, scores, len(ids)), n_equal


def _similarity_blocks(
    rules: ProtocolRules, truth: OpenLexTruth, prediction: Prediction, encoder: Encoder | None, used: Int64Array
) -> Iterator[Float64Array]:
    """The cosines (B, P) of the units ``used`` with the prompts, in blocks of units."""
    features, known = labelling.needed_features(rules, prediction, encoder)
    text = labelling.text_features(rules, truth.prompts, features, known)
    for start in range(0, len(used), _BLOCK_UNITS):
        yield labelling.cosines(features[used[start : start + _BLOCK_UNITS]], text, labelling.device_of(known))
        release_pages(features)


def _shared_points_warning(prediction: Prediction) -> str | None:
    if not isinstance(prediction, Instances):
        return None
    n_shared = int((np.bincount(prediction.indices, minlength=1) > 1).sum())
    return f"points in several instances, counted for the first of them: {n_shared}" if n_shared else None


class QueryMetric(CurveMetric):
    """Masks ranked by their similarity to each text."""

    truth = QueryTruth

    @property
    def ceiling_remark(self) -> str:
        return NO_CEILING if self.rules.transfer.candidates == "each-mask" else NO_QUERY_CEILING

    def per_scene(self, truth: QueryTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        assert rules.min_region_size is not None
        assert rules.confidence in ("similarity", "similarity-min-max")
        masks = transfer.masks_of(prediction)
        similarity = np.empty((len(masks), len(truth.queries)))
        if len(masks) and truth.queries:
            similarity = labelling.similarities(rules, [query.text for query in truth.queries], prediction, encoder)
        cap_m, voxel_m = rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
        if rules.transfer.candidates == "each-mask":
            assert cap_m is not None
            moved = transfer_each_mask(prediction.points, masks, truth.points, cap_m)
        else:
            moved = transfer.transfer_masks(prediction.points, masks, truth.points, cap_m, voxel_m)
        counts = per_scene(
            truth.object_of_point,
            truth.queries,
            moved,
            confidences(similarity, rules.confidence),
            top_k=rules.top_k,
            min_region_size=rules.min_region_size,
            thresholds=rules.thresholds,
            matches_by_confidence=rules.metric != "opensun3d",
        )
        asked_for = np.unique(np.array([each for query in truth.queries for each in query.object_ids], np.int64))
        wanted = np.isin(truth.object_of_point, asked_for[asked_for >= 0])
        warnings = [labelling.encoder_warning(rules, prediction, encoder)]
        return score_of_masks(self, counts, prediction, truth.points, wanted, warnings)
