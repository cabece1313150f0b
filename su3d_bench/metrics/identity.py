"""Identity over time of instances: HOTA, OWTA, IDF1 and label flips.

A method's map is requested at several time steps; an instance keeps its identity if it has the same id in all of them.
Sources: HOTA and OWTA (HOTA with the recall of detections in place of their accuracy): ``metrics/hota.py``, and IDF1:
``metrics/identity.py`` of trackeval 1.3.0.

These are counted by time: each step of an object counts. The association is also counted by object: AssA by object is
the mean over the objects g that are matched at least once of the mean association of their matches,
(1 / |G|) sum_g [sum_p m(g, p) A(g, p) / sum_p m(g, p)] with the number of steps m(g, p) in which g is matched with the
predicted id p and A(g, p) = m(g, p) / (n(g) + n(p) - m(g, p)). DetRe by object is the mean over all objects of the
share of their steps in which they are matched, and OWTA by object is the square root of the product of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array, IntArray
from su3d_bench.metrics.metric import Counts, Values, axes
from su3d_bench.numerics.statistics import ratio

ALPHAS = np.arange(0.05, 0.99, 0.05)  # smallest similarities of a match; HOTA is the mean over them
MATCHED_IDENTITY = 0.5  # the smallest similarity that counts for IDF1
_EPS = float(np.finfo(np.float64).eps)
_LEAST = 1e-10  # the smallest denominator of LocA, which is therefore 1 without a match
_NO_IDS = np.zeros(0, np.int64)


@dataclass(frozen=True)
class Step:
    """One time step: the objects ``true_ids`` (G,), the instances ``ids`` (P,), and their ``similarity`` (G, P), 0..1.

    Raises ``DataError`` for another shape or range, and for an id that is there twice.
    """

    true_ids: Int64Array
    ids: Int64Array
    similarity: Float64Array

    def __post_init__(self) -> None:
        for name, kind in (("true_ids", np.int64), ("ids", np.int64), ("similarity", np.float64)):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), kind))
        shape = (len(self.true_ids), len(self.ids))
        if self.similarity.shape != shape:
            raise DataError(f"step: similarity is {self.similarity.shape}; expected {shape}")
        if not ((self.similarity >= 0) & (self.similarity <= 1)).all():  # written so that NaN fails too
            raise DataError("step: similarity is not between 0 and 1")
        for ids in (self.true_ids, self.ids):
            distinct, n = np.unique(ids, return_counts=True)
            if (n > 1).any():
                raise DataError(f"step: id {distinct[n > 1][0]} occurs {n.max()} times; each id names one instance")


def step_of(instance: IntArray, masks: Masks, ids: IntArray, counted: BoolArray | None = None) -> Step:
    """The step of ground-truth instances (N,), 0 or less for none, and K masks over the same points with ``ids`` (K,).

    Masks may overlap. The similarity is the IoU of the sets of points among those ``counted`` (N,), by default all;
    objects and masks without any such point are not in the step.

    >>> step = step_of(np.array([7, 7, 7, 0, 9]), Masks.of_sets([np.array([1, 2, 3]), np.array([4])]), np.array([3, 5]))
    >>> step.true_ids.tolist(), step.ids.tolist(), step.similarity.tolist()
    ([7, 9], [3, 5], [[0.5, 0.0], [0.0, 1.0]])
    """
    is_counted = np.ones(len(instance), bool) if counted is None else counted
    true_ids, row, n_true = np.unique(instance[is_counted & (instance > 0)], return_inverse=True, return_counts=True)
    row_of_point = np.full(len(instance), -1, np.int64)
    row_of_point[is_counted & (instance > 0)] = row
    is_in = is_counted[masks.indices]
    owner, shared_row, k = masks.owners[is_in], row_of_point[masks.indices[is_in]], len(masks)
    sizes = np.bincount(owner, minlength=k)
    key = shared_row[shared_row >= 0] * k + owner[shared_row >= 0]
    shared = np.bincount(key, minlength=len(true_ids) * k).reshape(len(true_ids), k)[:, sizes > 0]
    union = n_true[:, None] + sizes[sizes > 0] - shared
    return Step(true_ids.astype(np.int64), ids[sizes > 0].astype(np.int64), shared / union)


@dataclass(frozen=True)
class TrackCounts(Counts):
    """The counts of a sequence for each of ``ALPHAS`` (A,); those of several are joined by ``joined``.

    ``n_matched``, ``n_missed``, ``n_false``: pairs, objects and instances, summed over steps; ``similarity`` and
    ``association``: sums over matches; ``n_met``: objects matched at least once; ``object_association`` and
    ``object_recall``: sums over objects of the means over their matches and steps; ``n_objects`` (1,);
    ``n_identified`` (1,): steps in which an object has the id assigned to it for the whole sequence.
    """

    stored_as = "tracks"

    n_matched: Int64Array = field(metadata=axes("alphas"))
    n_missed: Int64Array = field(metadata=axes("alphas"))
    n_false: Int64Array = field(metadata=axes("alphas"))
    similarity: Float64Array = field(metadata=axes("alphas"))
    association: Float64Array = field(metadata=axes("alphas"))
    n_met: Int64Array = field(metadata=axes("alphas"))
    object_association: Float64Array = field(metadata=axes("alphas"))
    object_recall: Float64Array = field(metadata=axes("alphas"))
    n_objects: Int64Array = field(metadata=axes("one"))
    n_identified: Int64Array = field(metadata=axes("one"))


def count_tracks(steps: Sequence[Step]) -> TrackCounts:
    """The counts of one sequence.

    Assignments are those of scipy's ``linear_sum_assignment``, as in the original: among equally good ones the result
    depends on the order of the ids.
    """
    from scipy.optimize import linear_sum_assignment

    true_ids = np.unique(np.concatenate([_NO_IDS, *(step.true_ids for step in steps)]))
    ids = np.unique(np.concatenate([_NO_IDS, *(step.ids for step in steps)]))
    shape = len(true_ids), len(ids)
    places = [(np.searchsorted(true_ids, step.true_ids), np.searchsorted(ids, step.ids)) for step in steps]
    n_true, n_found = np.zeros((shape[0], 1)), np.zeros(shape[1])
    potential, same = np.zeros(shape), np.zeros(shape)
    for step, (rows, columns) in zip(steps, places, strict=True):
        similarity, at = step.similarity, np.ix_(rows, columns)
        either = similarity.sum(axis=0)[None] + similarity.sum(axis=1)[:, None] - similarity
        potential[at] += np.divide(similarity, either, out=np.zeros_like(similarity), where=either > _EPS)
        same[at] += similarity >= MATCHED_IDENTITY
        n_true[rows] += 1
        n_found[columns] += 1
    alignment = potential / (n_true + n_found - potential)
    summed, pairs, levels = np.zeros(len(ALPHAS)), [_NO_IDS], [_NO_IDS]
    for step, (rows, columns) in zip(steps, places, strict=True):
        row, column = linear_sum_assignment(-(alignment[np.ix_(rows, columns)] * step.similarity))
        of_match = step.similarity[row, column]
        is_match = of_match >= ALPHAS[:, None] - _EPS
        # one after another, as the original sums
        summed += np.cumsum(np.where(is_match, of_match, 0.0), axis=1)[:, -1:].sum(axis=1)
        pairs.append(rows[row] * shape[1] + columns[column])
        levels.append(is_match.sum(axis=0))
    pair, level = np.concatenate(pairs), np.concatenate(levels)
    by_alpha = [_associations(pair[level > a], n_true, n_found) for a in range(len(ALPHAS))]
    association, n_met, object_association, object_recall = (np.array(each) for each in zip(*by_alpha, strict=True))
    n_matched = (level > np.arange(len(ALPHAS))[:, None]).sum(axis=1)
    identified = same[linear_sum_assignment(same, maximize=True)].sum()
    return TrackCounts(
        n_matched=n_matched,
        n_missed=int(n_true.sum()) - n_matched,
        n_false=int(n_found.sum()) - n_matched,
        similarity=summed,
        association=association,
        n_met=n_met,
        object_association=object_association,
        object_recall=object_recall,
        n_objects=np.array([shape[0]]),
        n_identified=np.array([int(identified)]),
    )


def _associations(pair: Int64Array, n_true: Float64Array, n_found: Float64Array) -> tuple[float, int, float, float]:
    """Of the matched pairs (M,), rows times ids plus columns: the sum of associations over matches, the number of
    objects, and the sums over objects of the mean over their matches and of the share of their steps."""
    shape = len(n_true), len(n_found)
    matches = np.bincount(pair, minlength=shape[0] * shape[1]).reshape(shape)
    weighted = matches * (matches / np.maximum(1, n_true + n_found - matches))
    n = matches.sum(axis=1)
    of_objects = weighted.sum(axis=1) / np.maximum(n, 1)
    return float(np.sum(weighted)), int(np.count_nonzero(n)), float(of_objects.sum()), float((n / n_true[:, 0]).sum())


def track_curves(counts: TrackCounts) -> dict[str, Float64Array]:
    """Each metric (A,) at each of ``ALPHAS``; by object NaN if there is none.

    As in the original, values without any object or instance are 0, and LocA without a match is 1.
    """
    n = counts.n_matched.astype(np.float64)
    recall, precision = n / np.maximum(1, n + counts.n_missed), n / np.maximum(1, n + counts.n_false)
    detection = n / np.maximum(1, n + counts.n_missed + counts.n_false)
    association = counts.association / np.maximum(1, n)
    objects_met = np.maximum(1, counts.n_met)
    by_object = np.where(counts.n_objects > 0, counts.object_association / objects_met, np.nan)
    recall_by_object = ratio(counts.object_recall, np.broadcast_to(counts.n_objects, n.shape))
    return {
        "HOTA": np.sqrt(detection * association),
        "OWTA": np.sqrt(recall * association),
        "DetA": detection,
        "DetRe": recall,
        "DetPr": precision,
        "AssA": association,
        "LocA": np.maximum(_LEAST, counts.similarity) / np.maximum(_LEAST, n),
        "OWTA by object": np.sqrt(recall_by_object * by_object),
        "DetRe by object": recall_by_object,
        "AssA by object": by_object,
    }


def track_values(counts: TrackCounts) -> Values:
    """The means of ``track_curves`` over ``ALPHAS``, and IDF1, its precision IDP and its recall IDR.

    >>> one, other = (Step(np.array([1]), np.array([k]), np.array([[0.8]])) for k in (5, 6))
    >>> values = track_values(count_tracks([one, one, one, other]))
    >>> {name: round(values[name], 3) for name in ("DetA", "AssA", "IDF1")}  # found in 4 of 4 steps, the same id in 3
    {'DetA': 0.842, 'AssA': 0.526, 'IDF1': 0.75}
    """
    n = int(counts.n_identified[0])
    n_missed = int(counts.n_matched[0] + counts.n_missed[0]) - n
    n_false = int(counts.n_matched[0] + counts.n_false[0]) - n
    return {name: float(np.mean(curve)) for name, curve in track_curves(counts).items()} | {
        "IDF1": n / max(1.0, n + 0.5 * n_false + 0.5 * n_missed),
        "IDP": n / max(1.0, n + n_false),
        "IDR": n / max(1.0, n + n_missed),
    }


@dataclass(frozen=True)
class LabelFlips:
    """Per step and object (T, G) of ``true_ids`` (G,): whether its best id ``is_compared`` with an earlier one, and
    whether it ``is_flip``, another one."""

    true_ids: Int64Array
    is_compared: BoolArray
    is_flip: BoolArray

    @property
    def rate(self) -> float:
        """The share of comparisons that are flips; NaN without any."""
        return float(ratio(self.is_flip.sum(keepdims=True), self.is_compared.sum(keepdims=True))[0, 0])


def label_flips(steps: Sequence[Step]) -> LabelFlips:
    """How often the most similar id of an object changes from the last step in which it had one.

    An id has a similarity above 0; among equally similar ones the previous one, otherwise the first.

    >>> one, other = (Step(np.array([1]), np.array([5, 6]), np.array([row])) for row in ([0.8, 0.1], [0.8, 0.8]))
    >>> flips = label_flips([one, other, Step(np.array([1]), np.array([6]), np.array([[0.2]]))])
    >>> flips.is_flip.T.tolist(), flips.rate
    ([[False, False, True]], 0.5)
    """
    true_ids = np.unique(np.concatenate([_NO_IDS, *(step.true_ids for step in steps)]))
    is_known, previous = np.zeros(len(true_ids), bool), np.zeros(len(true_ids), np.int64)
    is_compared, is_flip = (np.zeros((len(steps), len(true_ids)), bool) for _ in range(2))
    for t, step in enumerate(steps):
        best = step.similarity.max(axis=1, initial=0.0)
        rows = np.searchsorted(true_ids, step.true_ids)[best > 0]
        is_best = (step.similarity == best[:, None])[best > 0]
        is_kept = (is_best & (step.ids == previous[rows, None])).any(axis=1) & is_known[rows]
        is_compared[t, rows] = is_known[rows]
        is_flip[t, rows] = is_known[rows] & ~is_kept
        if len(rows):
            previous[rows] = np.where(is_kept, previous[rows], step.ids[is_best.argmax(axis=1)])
        is_known[rows] = True
    return LabelFlips(true_ids, is_compared, is_flip)
