"""The exact intersection of two boxes of any rotation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int32Array, Int64Array, OrientedBox
from su3d_bench.metrics.instance.score import CONSTANT_CONFIDENCE, masks_and_scores
from su3d_bench.metrics.matching import labelling
from su3d_bench.metrics.matching.nearest import Points
from su3d_bench.metrics.metric import ROWS, Counts, Metric, Pooled, SceneScore, Values, axes, first_row, present
from su3d_bench.metrics.protocols.model import BOX_AXES
from su3d_bench.numerics.statistics import ratio, row_means

# A cube of half sides 1 in six tetrahedra (6, 4, 3): one for each order of the axes on the way from corner to corner.
_TETRAHEDRA: Float64Array = np.array(
    [[[1.0 if axis in order[:n] else -1.0 for axis in range(3)] for n in range(4)] for order in permutations(range(3))]
)


def smallest_box(points: Float64Array, rotation: Float64Array) -> OrientedBox:
    """The smallest box around ``points`` (N, 3), N at least 1, whose axes are the columns of ``rotation`` (3, 3).

    >>> smallest_box(np.array([[0.0, 0, 0], [2, 1, 0]]), np.eye(3)).sizes.tolist()
    [2.0, 1.0, 0.0]
    """
    along_axes = rotation.T @ points.T  # (3, N): each axis is contiguous, which is much faster than (N, 3)
    low, high = along_axes.min(axis=1), along_axes.max(axis=1)
    return OrientedBox(rotation @ ((low + high) / 2), high - low, rotation)


def box_around(points: Points) -> Float64Array:
    """The lowest and the highest corner (2, 3) of the smallest box around points (N, 3) along the axes of the world."""
    known = np.asarray(points, np.float64)
    return np.stack([known.min(axis=0), known.max(axis=0)])


def box_iou(first: OrientedBox, second: OrientedBox) -> float:
    """The intersection over union of two boxes, 0 if neither has a volume.

    >>> unit = OrientedBox(np.zeros(3), np.ones(3), np.eye(3))
    >>> round(box_iou(unit, OrientedBox(np.array([0.5, 0.0, 0.0]), np.ones(3), np.eye(3))), 12)
    0.333333333333
    """
    shared = shared_volume(first, second)
    either = float(np.prod(first.sizes) + np.prod(second.sizes)) - shared
    return shared / either if either > 0 else 0.0


def shared_volume(first: OrientedBox, second: OrientedBox) -> float:
    """The volume in m3 of the intersection of two boxes."""
    if not first.sizes.all() or not second.sizes.all():
        return 0.0
    middle, half = second.rotation.T @ (first.centre - second.centre), second.sizes / 2
    if np.array_equal(first.rotation, second.rotation):
        high, low = np.minimum(half, middle + first.sizes / 2), np.maximum(-half, middle - first.sizes / 2)
        return float(np.prod(np.maximum(high - low, 0.0)))
    # the first box, in the axes of the second, as tetrahedra that are cut at the second's six sides
    parts = (_TETRAHEDRA * (first.sizes / 2)) @ (second.rotation.T @ first.rotation).T + middle
    for axis in range(3):
        for sign in (-1.0, 1.0):
            parts = _cut(parts, half[axis] - sign * parts[:, :, axis])
    edges = parts[:, 1:] - parts[:, :1]
    return float(np.abs(np.linalg.det(edges)).sum() / 6)


def _cut(parts: Float64Array, inside: Float64Array) -> Float64Array:
    """The parts of tetrahedra (T, 4, 3) in which ``inside`` (T, 4), linear over space, is above 0, as tetrahedra."""
    order = np.argsort(-inside, axis=1, kind="stable")
    inside = np.take_along_axis(inside, order, axis=1)
    parts = np.take_along_axis(parts, order[:, :, None], axis=1)
    n_inside = (inside > 0).sum(axis=1)
    left = [parts[n_inside == 4]]

    def crossing(rows: np.ndarray, near: int, far: int) -> Float64Array:
        """The points at which the edges from the corners ``near`` to the corners ``far`` leave."""
        share = inside[rows, near] / (inside[rows, near] - inside[rows, far])
        return np.asarray(parts[rows, near] + share[:, None] * (parts[rows, far] - parts[rows, near]))

    one, two, three = (np.flatnonzero(n_inside == n) for n in (1, 2, 3))
    left.append(np.stack([parts[one, 0], *(crossing(one, 0, far) for far in (1, 2, 3))], axis=1))
    left += _wedge(
        [parts[two, 0], crossing(two, 0, 2), crossing(two, 0, 3)],
        [parts[two, 1], crossing(two, 1, 2), crossing(two, 1, 3)],
    )
    left += _wedge([parts[three, k] for k in range(3)], [crossing(three, k, 3) for k in range(3)])
    return np.concatenate(left)


def _wedge(first: list[Float64Array], second: list[Float64Array]) -> list[Float64Array]:
    """Wedges between triangles of three corners (T, 3) each, as three arrays of tetrahedra (T, 4, 3)."""
    a, b, c = first
    x, y, z = second
    return [np.stack(corners, axis=1) for corners in ((a, b, c, z), (a, b, y, z), (a, x, y, z))]


THRESHOLDS = (0.25, 0.5)
PLACES = tuple(f"{100 * threshold:.0f}" for threshold in THRESHOLDS)  # suffixes of value names
_MAX_CELLS = 4_000_000  # of a (resamples, rows) block: 32 MB of float64


@dataclass(frozen=True)
class BoxCounts(Counts):
    """The counts of one scene or several: one row per instance of a scored class.

    ``class_index`` (E,) int32 and ``score`` (E,) float64 are its class and confidence, ``is_true`` (E, T) whether it is
    the one that finds a true box at each threshold. Numbers of true boxes per class, (C,) int64: ``n_truth`` of all,
    ``n_centred`` of those that contain the centroid of an instance of their class, ``n_located`` of those found at the
    first threshold by an instance of any class, ``n_named`` of these with an instance of their own class.
    """

    stored_as = "boxes"

    class_index: Int32Array = field(metadata=axes(ROWS))
    score: Float64Array = field(metadata=axes(ROWS))
    is_true: BoolArray = field(metadata=axes(ROWS, "thresholds"))
    n_truth: Int64Array = field(metadata=axes("classes"))
    n_centred: Int64Array = field(metadata=axes("classes"))
    n_located: Int64Array = field(metadata=axes("classes"))
    n_named: Int64Array = field(metadata=axes("classes"))

    def contradiction(self) -> str | None:
        """Rows beyond the classes, non-finite scores, or more boxes found or named than possible."""
        n_classes = len(self.n_truth)
        if self.class_index.max(initial=-1) >= n_classes:
            return f"'class_index' counts beyond the {n_classes} classes"
        if not np.isfinite(self.score).all():
            return "'score' has values that are NaN or infinite"
        if self.is_true.shape[1] != len(THRESHOLDS):
            return f"'is_true' has {self.is_true.shape[1]} thresholds of {len(THRESHOLDS)}"
        n_rows = np.bincount(self.class_index, minlength=n_classes)
        loose, strict = (self._n_hits(t) for t in range(len(THRESHOLDS)))
        reachable = np.where(n_rows > 0, self.n_truth, 0)
        for name, few, many in (
            ("is_true", loose, self.n_truth),
            ("is_true", strict, loose),
            ("n_centred", self.n_centred, reachable),
            ("n_located", self.n_located, self.n_truth),
            ("n_named", self.n_named, self.n_located),
            ("n_named", self.n_named, n_rows),
        ):
            wrong = np.flatnonzero(few > many)
            if len(wrong):
                row = wrong[0]
                return f"'{name}' of class {row} counts {few[row]} boxes, but at most {many[row]} are possible"
        return None

    def _n_hits(self, threshold: int) -> Int64Array:
        return np.bincount(self.class_index[self.is_true[:, threshold]], minlength=len(self.n_truth))


def count_boxes(
    iou: Float64Array,
    holds_centroid: BoolArray,
    true_class: Int64Array,
    called: Int64Array,
    scores: Float64Array,
    n_classes: int,
) -> BoxCounts:
    """The counts of a scene of K instances and G true boxes from their ``iou`` (K, G).

    ``holds_centroid`` (K, G): whether each box contains the centroid of each instance; ``true_class`` (G,) and
    ``called`` (K,) are class indices, -1 for an instance of none of them, which can only locate a box.

    >>> iou = np.array([[0.6, 0.0], [0.4, 0.0], [0.0, 0.3]])
    >>> counts = count_boxes(iou, iou > 0.2, np.array([0, 1]), np.array([0, 0, 0]), np.array([0.5, 0.9, 0.7]), 2)
    >>> counts.score.tolist(), counts.is_true.tolist()
    ([0.9, 0.7, 0.5], [[True, False], [False, False], [False, True]])
    >>> counts.n_centred.tolist(), counts.n_located.tolist(), counts.n_named.tolist()
    ([1, 0], [1, 1], [1, 0])
    """
    order = np.lexsort((-scores, called))
    order = order[called[order] >= 0]
    is_true = np.zeros((len(order), len(THRESHOLDS)), bool)
    for c in np.intersect1d(called, true_class):
        rows, columns = np.flatnonzero(called[order] == c), np.flatnonzero(true_class == c)
        of_class = iou[np.ix_(order[rows], columns)]
        best, best_iou = of_class.argmax(axis=1), of_class.max(axis=1)
        for t, threshold in enumerate(THRESHOLDS):
            over = np.flatnonzero(best_iou > threshold)
            is_true[rows[over[np.unique(best[over], return_index=True)[1]]], t] = True
    is_same = called[:, None] == true_class
    located, named = _located(iou, scores, is_same)
    centred = (holds_centroid & is_same).any(axis=0)
    n_truth, *found = (
        np.bincount(true_class[which], minlength=n_classes).astype(np.int64)
        for which in (np.ones(len(true_class), bool), centred, located, named)
    )
    return BoxCounts(called[order].astype(np.int32), np.asarray(scores, np.float64)[order], is_true, n_truth, *found)


def _located(iou: Float64Array, scores: Float64Array, is_same: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Which boxes (G,) are found by instances of any class, and for which the best of these has the right class.

    The best by confidence, then by IoU, then one of the right class, so that the order of instances does not matter.
    """
    located, named = np.zeros(iou.shape[1], bool), np.zeros(iou.shape[1], bool)
    if not iou.size:
        return located, named
    best, best_iou = iou.argmax(axis=1), iou.max(axis=1)
    found = np.flatnonzero(best_iou > THRESHOLDS[0])
    is_right = is_same[found, best[found]]
    order = found[np.lexsort((is_right, best_iou[found], scores[found]))]
    located[best[order]] = True
    for row in order:  # the last one of each box remains
        named[best[row]] = is_same[row, best[row]]
    return located, named


def class_values(counts: Sequence[BoxCounts], weights: Int64Array) -> dict[str, Float64Array]:
    """AP and recall at each threshold (R, C) of the scenes drawn ``weights`` (R, S) times; NaN without a true box.

    Instances of equal confidence enter the curve together; for distinct confidences the area is VoteNet's.

    >>> found = BoxCounts(np.zeros(1, np.int32), np.ones(1), np.array([[True, False]]), *np.array([[2], [1], [1], [1]]))
    >>> {name: value.tolist() for name, value in class_values([found], np.array([[1]])).items()}
    {'AP25': [[0.5]], 'recall25': [[0.5]], 'AP50': [[0.0]], 'recall50': [[0.0]]}
    """
    n_truth = weights @ np.stack([of_scene.n_truth for of_scene in counts])
    scene = np.concatenate([np.full(len(of_scene.score), s) for s, of_scene in enumerate(counts)])
    score = np.concatenate([of_scene.score for of_scene in counts])
    class_index = np.concatenate([of_scene.class_index for of_scene in counts])
    is_true = np.concatenate([of_scene.is_true for of_scene in counts])
    order = np.lexsort((-score, class_index))
    bounds = np.searchsorted(class_index[order], np.arange(n_truth.shape[1] + 1))
    values = {f"{name}{place}": np.full(n_truth.shape, np.nan) for place in PLACES for name in ("AP", "recall")}
    for c in np.flatnonzero(n_truth.any(axis=0)):
        own = order[bounds[c] : bounds[c + 1]]
        for t, place in enumerate(PLACES):
            area, recall = _curves(score[own], is_true[own, t], scene[own], n_truth[:, c], weights)
            values[f"AP{place}"][:, c], values[f"recall{place}"][:, c] = area, recall
    return values


def _curves(
    score: Float64Array, is_true: BoolArray, scene: Int64Array, n_truth: Int64Array, weights: Int64Array
) -> tuple[Float64Array, Float64Array]:
    """Area (R,) and recall (R,) of one class, whose rows have descending scores; NaN if a draw has no true box."""
    area, recall = np.zeros(len(weights)), np.zeros(len(weights))
    if len(score):
        is_last = np.append(np.diff(score) != 0, True)
        n_at_once = max(1, _MAX_CELLS // len(score))
        for start in range(0, len(weights), n_at_once):
            block = slice(start, start + n_at_once)
            drawn = weights[block][:, scene]
            n_true = np.cumsum(drawn * is_true, axis=1)[:, is_last]
            precision = n_true / np.maximum(np.cumsum(drawn, axis=1)[:, is_last], 1)
            found = n_true / np.maximum(n_truth[block, None], 1)
            envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
            area[block] = (np.diff(found, axis=1, prepend=0.0) * envelope).sum(axis=1)
            recall[block] = found[:, -1]
    return np.where(n_truth > 0, area, np.nan), np.where(n_truth > 0, recall, np.nan)


def share_values(counts: Sequence[BoxCounts], weights: Int64Array) -> dict[str, tuple[Float64Array, Float64Array]]:
    """The numerator and denominator (R, C) of the shares ``centroid``, ``class`` and precision at each threshold."""
    drawn = BoxCounts.drawn(counts, weights, "n_truth", "n_centred", "n_located", "n_named")
    n_classes = drawn["n_truth"].shape[1]

    def rows(classes: Sequence[Int32Array]) -> Float64Array:
        each = [np.bincount(of_scene, minlength=n_classes) for of_scene in classes]
        return weights.astype(np.float64) @ np.stack(each).astype(np.float64)

    n_rows = rows([c.class_index for c in counts])
    shares = {"centroid": (drawn["n_centred"], drawn["n_truth"]), "class": (drawn["n_named"], drawn["n_located"])}
    for t, place in enumerate(PLACES):
        shares[f"precision{place}"] = rows([c.class_index[c.is_true[:, t]] for c in counts]), n_rows
    return shares


_REACH = 3**0.5  # a box, of any rotation, around points within r of a position is within this many r of it


class BoxMetric(Metric[BoxCounts]):
    """Whether objects are found as boxes with the right class."""

    truth = GroundTruth
    counts = BoxCounts

    @property
    def sizes(self) -> dict[str, int]:
        return {"classes": len(self.rules.scored), "thresholds": len(self.rules.thresholds)}

    def per_scene(self, truth: GroundTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules
        assert rules.min_region_size is not None
        if truth.boxes is None:
            raise DataError(f"{rules.name}: ground truth '{truth.variant}' has no boxes")
        boxes = list(truth.boxes.boxes.values())
        ids = np.array([truth.boxes.class_of_instance[instance] for instance in truth.boxes.boxes], np.int64)
        known = labelling.class_index_of_ids(rules, ids)
        place = labelling.places_among_scored(rules)
        is_present = present(known, len(rules.classes))
        called = place[labelling.classes_of_prediction(rules, prediction, encoder, is_present)]
        masks, scores = masks_and_scores(prediction)
        scores = np.ones(len(scores)) if rules.confidence == "ones" else scores
        kept = np.flatnonzero(masks.sizes >= rules.min_region_size)
        shapes = [_Shape.of(prediction.points[masks.mask(k)].astype(np.float64)) for k in kept.tolist()]
        wanted = np.flatnonzero(place[known] >= 0)
        iou, holds_centroid = _meet(shapes, [boxes[g] for g in wanted], rules.box_axes)
        counts = count_boxes(iou, holds_centroid, place[known[wanted]], called[kept], scores[kept], len(rules.scored))
        warnings = [labelling.encoder_warning(rules, prediction, encoder), _constant_warning(scores[kept])]
        # the sides of a box are not a surface that a map should contain: there is no coverage
        return self.score(counts, prediction, np.zeros(0), warnings)

    def pooled(self, counts: Sequence[BoxCounts]) -> Pooled:
        tables = self._of_classes(counts, np.ones((1, len(counts)), np.int64))
        columns = self.class_columns(tables, np.ones(len(self.rules.scored), bool))
        return Pooled(self.combine(counts), {name: first_row(values) for name, values in columns.items()})

    def combine(self, counts: Sequence[BoxCounts]) -> Values:
        return self.values_once(counts)

    def resampled(self, counts: Sequence[BoxCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        values = {name: row_means(table) for name, table in class_values(counts, weights).items()}
        for name, (part, whole) in share_values(counts, weights).items():
            values[name] = ratio(part.sum(axis=1), whole.sum(axis=1))
        return {name: values[name] for name in self.rules.value_names}

    def resampled_classes(self, counts: Sequence[BoxCounts], weights: Int64Array) -> dict[str, dict[str, Float64Array]]:
        tables = self._of_classes(counts, weights)
        has_truth = np.any([of_scene.n_truth > 0 for of_scene in counts], axis=0)
        return self.class_columns({name: tables[name] for name in self.rules.headline}, has_truth)

    def _of_classes(self, counts: Sequence[BoxCounts], weights: Int64Array) -> dict[str, Float64Array]:
        """Each value (R, C) per class; NaN if a draw has no true box of it."""
        shares = share_values(counts, weights)
        has_truth = shares["centroid"][1] > 0
        tables = class_values(counts, weights)
        tables |= {name: np.where(has_truth, ratio(*parts), np.nan) for name, parts in shares.items()}
        return {name: tables[name] for name in self.rules.value_names}


def _constant_warning(scores: Float64Array) -> str | None:
    if len(scores) < 2 or scores.min() != scores.max():
        return None
    return f"{CONSTANT_CONFIDENCE} {scores[0]:g}: AP per class is recall x precision"


@dataclass(frozen=True)
class _Shape:
    """The points (N, 3) of an instance, their mean, and a sphere around all of them."""

    points: Float64Array
    centroid: Float64Array
    middle: Float64Array
    radius_m: float

    @classmethod
    def of(cls, points: Float64Array) -> _Shape:
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        return cls(points, points.mean(axis=0), middle, float(np.linalg.norm(points - middle, axis=1).max()))


def _meet(
    shapes: Sequence[_Shape], boxes: Sequence[OrientedBox], axes: BOX_AXES | None
) -> tuple[Float64Array, BoolArray]:
    """The IoU (K, G) of the box of each shape with each true box, and whether each contains its centroid (K, G)."""
    iou = np.zeros((len(shapes), len(boxes)))
    centroids = np.array([shape.centroid for shape in shapes]).reshape(-1, 3)
    middles = np.array([shape.middle for shape in shapes]).reshape(-1, 3)
    radii = np.array([shape.radius_m for shape in shapes])
    holds_centroid = np.zeros(iou.shape, bool)
    straight = [smallest_box(shape.points, np.eye(3)) if axes == "world" else None for shape in shapes]
    for g, box in enumerate(boxes):
        holds_centroid[:, g] = box.distance_outside(centroids) <= 0
        is_near = np.linalg.norm(middles - box.centre, axis=1) <= _REACH * radii + np.linalg.norm(box.sizes) / 2
        for k in np.flatnonzero(is_near).tolist():
            iou[k, g] = box_iou(straight[k] or smallest_box(shapes[k].points, box.rotation), box)
    return iou, holds_centroid
