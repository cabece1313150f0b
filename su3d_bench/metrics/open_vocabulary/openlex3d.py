"""OpenLex3D's two measures of labels: category frequencies and the ranking of the right labels.

Source: openlex3d at commit 3dbad2b. Its per-point loops compare every point with all others; here points are counted
per pair of object and predicted unit (an instance, or a point of a dense map), and the rest is computed per pair.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, GroundTruth, Int64Array, LabelSet
from su3d_bench.metrics.metric import ROWS, Counts, axes
from su3d_bench.metrics.protocols.kinds import CATEGORIES
from su3d_bench.numerics.statistics import ratio

SPACE = "openlex3d"
_SYNONYMS, _DEPICTIONS, _VIS_SIM, _CLUTTER, _MISSING, _INCORRECT = range(len(CATEGORIES))
_EPS = 1e-8  # for the left side of the box, as in the original


ROUNDING = 1e-6  # tolerance for sums of shares


@dataclass(frozen=True)
class ObjectCounts(Counts):
    """The counts of one scene or several: one row per object with scored points.

    ``n_points`` (O,) int64; ``totals`` (O, V) float64, V values summed over the points, NaN if the object has none.
    """

    stored_as = "objects"

    n_points: Int64Array = field(metadata=axes(ROWS))
    totals: Float64Array = field(metadata=axes(ROWS, "values"))

    def contradiction(self) -> str | None:
        """An object without points, or a total of shares above its number of points."""
        if not (self.n_points > 0).all():
            return "'n_points' has an object without points"
        most = self.n_points[:, None] * (1 + ROUNDING)
        beyond = np.argwhere(~np.isnan(self.totals) & ~((self.totals >= -ROUNDING) & (self.totals <= most)))
        if not len(beyond):
            return None
        row, column = beyond[0]
        return f"'totals' has {self.totals[row, column]:g} over {self.n_points[row]} points"


def combine(counts: Sequence[ObjectCounts]) -> Float64Array:
    """The mean (V,) over objects of the mean over their points, without NaN rows.

    >>> combine([ObjectCounts(np.array([4, 1]), np.array([[2.0, np.nan], [1.0, 0.25]]))]).tolist()
    [0.75, 0.25]
    """
    return ratio(*_sums(ObjectCounts.joined(counts)))


def _sums(counts: ObjectCounts) -> tuple[Float64Array, Int64Array]:
    """The sum (V,) of the objects' means and the number (V,) of objects with one."""
    of_object = counts.totals / counts.n_points[:, None]
    has_value = ~np.isnan(of_object)
    return np.where(has_value, of_object, 0.0).sum(axis=0), has_value.sum(axis=0)


def resampled(counts: Sequence[ObjectCounts], weights: Int64Array) -> Float64Array:
    """The means (R, V) over the objects of the scenes drawn ``weights`` (R, S) times.

    >>> a, b = ObjectCounts(np.array([2]), np.array([[2.0]])), ObjectCounts(np.array([2]), np.array([[1.0]]))
    >>> resampled([a, b], np.array([[2, 0], [1, 1]])).tolist()
    [[1.0], [0.75]]
    """
    per_scene = [_sums(of_scene) for of_scene in counts]
    sums: Float64Array = weights.astype(np.float64) @ np.stack([total for total, _ in per_scene])
    return ratio(sums, weights @ np.stack([n for _, n in per_scene]))


@dataclass(frozen=True)
class ObjectLabels:
    """The labels of one object, nearest in meaning first; ``clutter`` has the ids of objects close to it."""

    synonyms: tuple[str, ...]
    depictions: tuple[str, ...] = ()
    vis_sim: tuple[str, ...] = ()
    clutter: tuple[int, ...] = ()


@dataclass(frozen=True)
class OpenLexTruth:
    """Labelled objects of a scene: ``points`` (N, 3) float32 m, ``object_of_point`` (N,) int64, -1 for none.

    ``objects`` maps an object's id to its labels, ``prompts`` are all labels that a method can choose from.
    """

    points: Float32Array
    object_of_point: Int64Array
    objects: Mapping[int, ObjectLabels]
    prompts: tuple[str, ...]
    variant: str
    source: str
    space: str = SPACE

    def __post_init__(self) -> None:
        n = len(self.points)
        if self.points.shape != (n, 3) or self.object_of_point.shape != (n,):
            raise DataError(
                f"ground truth '{self.variant}': points {self.points.shape} and objects {self.object_of_point.shape} "
                "do not agree"
            )
        if not self.prompts:
            raise DataError(f"ground truth '{self.variant}': has no prompts; give the list of all labels")

    def by_first_synonym(self) -> GroundTruth:
        """The objects with a synonym, each an instance of the class of its first synonym."""
        first = {object_id: labels.synonyms[0] for object_id, labels in self.objects.items() if labels.synonyms}
        names = tuple(dict.fromkeys(first.values()))
        ids, row = np.unique(self.object_of_point, return_inverse=True)
        class_of = [names.index(first[object_id]) + 1 if object_id in first else 0 for object_id in ids.tolist()]
        semantic = np.array(class_of, np.int32)[row]
        return GroundTruth(
            self.points,
            semantic,
            np.where(semantic > 0, self.object_of_point + 1, 0).astype(np.int32),
            LabelSet(self.space, tuple(range(1, len(names) + 1)), names),
            self.variant,
            self.source,
        )


def bare(label: str) -> str:
    """A label without spaces and in lower case, for comparisons.

    >>> bare("tv stand")
    'tvstand'
    """
    return label.replace(" ", "")


def _bare_set(labels: Sequence[str]) -> set[str]:
    return {bare(label) for label in labels}


def scored_objects(objects: Mapping[int, ObjectLabels], excluded: Sequence[str]) -> list[int]:
    """Ascending ids of the objects whose points have a category: those with synonyms, none of them ``excluded``."""
    without = _bare_set(excluded)
    return sorted(
        object_id
        for object_id, labels in objects.items()
        if labels.synonyms and not _bare_set(labels.synonyms) & without
    )


def category_table(
    objects: Mapping[int, ObjectLabels], object_ids: Sequence[int], vocabulary: Sequence[str]
) -> Int64Array:
    """The category (O, P) that each word of ``vocabulary`` reaches for each object, as an index of ``CATEGORIES``.

    >>> objects = {1: ObjectLabels(("chair",), ("flower",), clutter=(2,)), 2: ObjectLabels(("side table",))}
    >>> [CATEGORIES[index] for index in category_table(objects, [1], ["flower", "sidetable", "wall"])[0]]
    ['depictions', 'clutter', 'incorrect']
    """
    words = [bare(word) for word in vocabulary]
    table = np.full((len(object_ids), len(words)), _INCORRECT, np.int64)
    for row, object_id in enumerate(object_ids):
        labels = objects[object_id]
        near = [objects[other] for other in labels.clutter if other in objects]
        # the closest category last, so that it overwrites the others
        for category, known in (
            (_CLUTTER, [word for other in near for word in (*other.synonyms, *other.depictions, *other.vis_sim)]),
            (_VIS_SIM, labels.vis_sim),
            (_DEPICTIONS, labels.depictions),
            (_SYNONYMS, labels.synonyms),
        ):
            bare_words = _bare_set(known)
            table[row, [index for index, word in enumerate(words) if word in bare_words]] = category
    return table


def point_categories(object_row: Int64Array, unit: Int64Array, top: Int64Array, table: Int64Array) -> Int64Array:
    """The category of each point as an index of ``CATEGORIES``, -1 if its object has none.

    ``object_row`` (N,) is a row of ``table``, -1 for none; ``unit`` (N,) a row of ``top``, -1 without a prediction;
    ``top`` (U, n) has the n labels of each unit as columns of ``table``. The best of a point's labels counts.

    >>> table = np.array([[0, 5]])
    >>> point_categories(np.array([0, 0, 0, -1]), np.array([0, 1, -1, 0]), np.array([[1, 0], [1, 1]]), table).tolist()
    [0, 5, 4, -1]
    """
    n_units = len(top)
    pairs, of_point = np.unique(object_row * (n_units + 1) + unit + 1, return_inverse=True)
    row, column = pairs // (n_units + 1), pairs % (n_units + 1) - 1
    category = np.full(len(pairs), _MISSING, np.int64)
    met = (row >= 0) & (column >= 0)
    category[met] = table[row[met][:, None], top[column[met]]].min(axis=1)
    category[row < 0] = -1
    return category[of_point]


def count_categories(object_row: Int64Array, category: Int64Array, n_objects: int) -> ObjectCounts:
    """The number of points of each object in each category, without objects that have no points.

    >>> counts = count_categories(np.array([0, 0, 2]), np.array([0, 4, 5]), 3)
    >>> counts.n_points.tolist(), counts.totals.tolist()
    ([2, 1], [[1.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    """
    scored = (object_row >= 0) & (category >= 0)
    key = object_row[scored] * len(CATEGORIES) + category[scored]
    table = np.bincount(key, minlength=n_objects * len(CATEGORIES)).reshape(n_objects, len(CATEGORIES))
    table = table[table.sum(axis=1) > 0]
    return ObjectCounts(table.sum(axis=1).astype(np.int64), table.astype(np.float64))


def rank_scores(
    ranks: Int64Array, first: int, last: int, n_others: int
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """The score of each rank, from 0, for the box ``first``..``last`` of ranks, 1 inside; and its left and right part.

    ``n_others`` is the highest rank. Equations of compute_set_ranking_score; if the box ends at the highest rank,
    nothing can be to its right, and the original divides by zero.

    >>> [part.round(3).tolist() for part in rank_scores(np.array([0, 4, 8]), 3, 5, 11)]
    [[0.0, 1.0, 0.5], [0.0, 1.0, 1.0], [1.0, 1.0, 0.5]]
    """
    left = 1.0 + np.minimum(0.0, (ranks - first) / (first + _EPS))
    right = 1.0 - np.maximum(0.0, (ranks - last) / max(n_others - last, 1))
    return np.minimum(left, right), left, right


@dataclass(frozen=True)
class RankedLabels:
    """The labels of one object as positions in the prompt list: synonyms, then depictions and similar things."""

    synonyms: Int64Array
    secondary: Int64Array

    def scores(self, rank_of_prompt: Int64Array) -> Float64Array:
        """Overall, synonyms, secondary (U, 3) of units with these ranks of the prompts (U, P); NaN without a label."""
        n_synonyms, n = len(self.synonyms), len(self.synonyms) + len(self.secondary)
        highest = rank_of_prompt.shape[1] - 1
        of_synonyms, _, _ = rank_scores(rank_of_prompt[:, self.synonyms], 0, n_synonyms - 1, highest)
        of_secondary, _, _ = rank_scores(rank_of_prompt[:, self.secondary], n_synonyms, n - 1, highest)
        both = np.concatenate([of_synonyms, of_secondary], axis=1)
        return np.stack([_row_mean(both), _row_mean(of_synonyms), _row_mean(of_secondary)], axis=1)


def _row_mean(values: Float64Array) -> Float64Array:
    return values.mean(axis=1) if values.shape[1] else np.full(len(values), np.nan)


def ranked_labels(labels: ObjectLabels, prompts: Sequence[str]) -> RankedLabels:
    """The indices of the object's labels in the prompt list, of the first occurrence if a prompt is repeated.

    >>> found = ranked_labels(ObjectLabels(("chair", "seat"), ("flower",), ("stool",)), ["stool", "x", "chair"])
    >>> found.synonyms.tolist(), found.secondary.tolist()
    ([2], [0])
    """
    position: dict[str, int] = {}
    for index, prompt in enumerate(prompts):
        position.setdefault(bare(prompt), index)

    def places(words: Sequence[str]) -> Int64Array:
        return np.array([position[bare(word)] for word in words if bare(word) in position], np.int64)

    return RankedLabels(places(labels.synonyms), places((*labels.depictions, *labels.vis_sim)))


def top_labels(similarity: Float64Array, n: int) -> Int64Array:
    """The ``n`` most similar labels of each row (U, P), best first, on ties the first in the list.

    >>> top_labels(np.array([[0.1, 0.9, 0.1]]), 2).tolist()
    [[1, 0]]
    """
    left, top = similarity.copy(), np.empty((len(similarity), n), np.int64)
    for place in range(n):  # a full sort of thousands of labels would take ten times as long
        top[:, place] = left.argmax(axis=1)
        left[np.arange(len(left)), top[:, place]] = -np.inf
    return top


def rank_of_labels(similarity: Float64Array) -> Int64Array:
    """The rank (U, P) of each label, from 0 for the most similar one, on ties the first in the list.

    >>> rank_of_labels(np.array([[0.1, 0.9, 0.1]])).tolist()
    [[1, 0, 2]]
    """
    order = np.argsort(-similarity, axis=1, kind="stable")
    ranks = np.empty_like(order)
    np.put_along_axis(ranks, order, np.broadcast_to(np.arange(order.shape[1]), order.shape), axis=1)
    return ranks


def count_ranks(object_row: Int64Array, unit: Int64Array, scores: Float64Array, n_objects: int) -> ObjectCounts:
    """The scores of each object, summed over its points.

    ``scores`` (R, 3) belong to the R distinct pairs of ``object_row`` and ``unit`` in ascending order, as
    ``distinct_pairs`` lists them.
    """
    rows, _, n_points_of_pair = distinct_pairs(object_row, unit)
    n_points = np.bincount(rows, weights=n_points_of_pair, minlength=n_objects).astype(np.int64)
    weighted = scores * n_points_of_pair[:, None]
    totals = np.zeros((n_objects, scores.shape[1]))
    np.add.at(totals, rows, weighted)
    return ObjectCounts(n_points[n_points > 0], totals[n_points > 0])


def distinct_pairs(object_row: Int64Array, unit: Int64Array) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Object row, unit and number of points of each existing pair, ascending, ignoring points without either.

    >>> [part.tolist() for part in distinct_pairs(np.array([1, 0, 1, -1]), np.array([5, 5, 5, 5]))]
    [[0, 1], [5, 5], [1, 2]]
    """
    has_both: BoolArray = (object_row >= 0) & (unit >= 0)
    n_units = int(unit.max(initial=0)) + 1
    pairs, n_points = np.unique(object_row[has_both] * n_units + unit[has_both], return_counts=True)
    return pairs // n_units, pairs % n_units, n_points.astype(np.int64)
