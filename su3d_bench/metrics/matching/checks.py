"""Checks of a prediction before scoring; each message states where and how much is wrong or doubtful."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import PredictionError, counted, nearest, printable
from su3d_bench.core.maps import DenseFeatures, Instances, Masks, Prediction
from su3d_bench.core.types import Float32Array, Float64Array, GroundTruth, Int32Array, Int64Array, IntArray
from su3d_bench.metrics.instance.scene_counts import intersections
from su3d_bench.metrics.matching import transfer
from su3d_bench.metrics.matching.nearest import are_same_points
from su3d_bench.metrics.matching.nearest import nearest as nearest_points
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules


def duplicate_pairs(masks: Masks, n_points: int, iou: float) -> list[tuple[int, int]]:
    """Pairs of masks, the lower first, whose IoU is above ``iou``.

    >>> masks = Masks.of_sets([np.arange(20), np.arange(10), np.arange(1, 20)])
    >>> duplicate_pairs(masks, 20, 0.9)
    [(0, 2)]
    """
    size, pairs = masks.sizes, []
    is_in = np.zeros(n_points, np.bool_)
    marked = -1
    for k, m in zip(*_candidates(masks, n_points, iou), strict=True):
        if k != marked:
            is_in[:] = False
            is_in[masks.mask(k)] = True
            marked = k
        shared = np.count_nonzero(is_in[masks.mask(m)])
        if shared > iou * (size[k] + size[m] - shared):
            pairs.append((k, m))
    return pairs


def _candidates(masks: Masks, n_points: int, iou: float) -> tuple[list[int], list[int]]:
    """The candidate pairs, in order, for such an IoU: masks that share some of their first points.

    Two masks with an IoU above t share more than t of each. So at most a share (1 - t) of the points of one is not in
    the other, and the first 2 (1 - t) + 1 points of each, by index, must contain as many common ones as remain after
    removing the possibly foreign ones. All other pairs are skipped without reading their points.
    """
    size = masks.sizes
    n_foreign = np.minimum(size, ((1.0 - iou) * size).astype(np.int64) + 1)  # at most; 1 more because of rounding
    n_first = np.minimum(size, 2 * n_foreign + 1)
    n_common = np.maximum(n_first - n_foreign, 1)
    owner = np.repeat(np.arange(len(size)), n_first)
    point = masks.indices[np.arange(len(owner)) + np.repeat(masks.indptr[:-1] - np.cumsum(n_first) + n_first, n_first)]
    is_shared = np.bincount(point, minlength=n_points)[point] > 1
    point, owner = point[is_shared], owner[is_shared]
    order = np.argsort(point, kind="stable")
    point, owner = point[order], owner[order]
    keys: list[Int64Array] = [np.zeros(0, np.int64)]
    at, step = np.arange(len(point)), 0
    while len(at):
        step += 1
        at = at[: np.searchsorted(at, len(point) - step)]
        at = at[point[at + step] == point[at]]
        first, second = owner[at], owner[at + step]
        is_alike = np.minimum(size[first], size[second]) > iou * np.maximum(size[first], size[second])
        keys.append(first[is_alike] * len(size) + second[is_alike])
    key, n_shared = np.unique(np.concatenate(keys), return_counts=True)
    first, second = np.divmod(key, max(len(size), 1))
    is_candidate = n_shared >= np.minimum(n_common[first], n_common[second])
    return first[is_candidate].tolist(), second[is_candidate].tolist()


NEAR_IOU = 0.9  # pairs above it are duplicates of one object
MAX_SHARED = 300_000_000  # products in the search for pairs; 600 masks of a large scene need about ten million
UNITS = {1000.0: "millimetres", 100.0: "centimetres", 0.001: "kilometres"}
LARGEST_RATIO = 20.0  # of the extents of two clouds of one scene
FEW_PERCENT = (1, 99)  # the extent without stray points
NEAR_M = 0.1  # margin around the scene's box in which a point still counts as inside
MIN_INSIDE = 0.5  # of the points; less means another frame of reference or another scene
MIN_COVERED = 0.5  # of the scored points, within the largest radius; less means the same, or a very incomplete map
MIN_NEAR = 0.9  # of a map's points within 10 cm of the ground truth: it is where it should be
N_SAMPLED = 10_000  # points of the map for that
LEAST_IOU = 0.25  # the lowest threshold of the originals: at least one mask of a scene is above it
ROUNDING = 1e-6  # of confidences in single precision
NOTHING = "the prediction is empty, without any mask or point: nothing in the scene is found"
LOW_COVERAGE = "less than half of the scored points have a predicted point within 10 cm"
NO_CLASSES = "labels are not classes of the protocol"


@dataclass(frozen=True)
class MaskFacts:
    """Facts about the masks of a scene that warnings are based on.

    ``near`` and ``identical`` are pairs of masks whose IoU is above 0.9 or is 1, ``near`` None if there are too many
    overlaps to search; of ``n_covered`` points in masks, ``n_contested`` are in several.
    """

    n_masks: int
    near: tuple[tuple[int, int], ...] | None
    identical: tuple[tuple[int, int], ...]
    lowest_score: float | None
    highest_score: float | None
    n_covered: int
    n_contested: int


def mask_facts(masks: Masks, scores: Float64Array, n_points: int) -> MaskFacts:
    """Facts of K masks over ``n_points`` points."""
    n_owners = np.bincount(masks.indices, minlength=n_points)
    near = None
    if float((n_owners.astype(np.float64) ** 2).sum()) <= MAX_SHARED:
        near = tuple(duplicate_pairs(masks, n_points, NEAR_IOU))
    return MaskFacts(
        n_masks=len(masks),
        near=near,
        identical=tuple((k, m) for k, m in near or () if np.array_equal(masks.mask(k), masks.mask(m))),
        lowest_score=float(scores.min()) if len(scores) else None,
        highest_score=float(scores.max()) if len(scores) else None,
        n_covered=int((n_owners > 0).sum()),
        n_contested=int((n_owners > 1).sum()),
    )


def map_warnings(
    rules: ProtocolRules, truth: GroundTruth | Float32Array, prediction: Prediction, score: SceneScore
) -> list[str]:
    """What makes the ``score`` of a map doubtful: the map is empty, elsewhere, or has strange labels or confidences.

    ``truth`` is the ground truth, or only its points (N, 3) if masks are not compared with objects. Labels of its
    classes that a protocol leaves out are no mistake.
    """
    points = truth.points if isinstance(truth, GroundTruth) else truth
    lines: list[str] = []
    if isinstance(prediction, Instances):
        names = truth.labels.names if isinstance(truth, GroundTruth) else ()
        lines += mask_warnings(rules, prediction, prediction.scores, prediction.names)
        lines += _label_warnings(rules, prediction.labels, names)
    if not score.n_predictions or not len(prediction.points):
        return lines or [NOTHING]
    is_whole = rules.names_points or rules.needs_instances or rules.kind == "categories"
    share = 1 - int(score.n_farther[-1]) / score.n_scored if score.n_scored else 1.0
    if is_whole and share < MIN_COVERED and not are_same_points(prediction.points, points):
        sample = prediction.points[:: 1 + len(prediction.points) // N_SAMPLED]
        is_near = np.isfinite(nearest_points(points, sample, NEAR_M)[0]).mean() >= MIN_NEAR
        why = "the map is incomplete" if is_near else "is it of another scene, rotated, scaled or shifted?"
        return [*lines, f"{LOW_COVERAGE}: {why}"]
    if rules.needs_instances and not score.counts.has_match and isinstance(truth, GroundTruth):
        assert not isinstance(prediction, DenseFeatures)
        masks, cap_m, voxel_m = transfer.masks_of(prediction), rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
        moved = transfer.transfer_masks(prediction.points, masks, points, cap_m, voxel_m)
        lines += overlap_warnings(moved, truth.instance)
    return lines


def mask_warnings(rules: ProtocolRules, masks: Masks, scores: Float64Array, keys: Sequence[str]) -> list[str]:
    """Warnings on a scene without masks, on empty masks, and on confidences (K,) that are none, if they count."""
    if not len(masks):
        return [NOTHING]
    lines, empty = [], np.flatnonzero(masks.sizes == 0)
    if len(empty):
        lines.append(f"{counted(len(empty), 'empty mask')}, the first is mask {empty[0]}{_key(keys, int(empty[0]))}")
    n_outside = int(((scores < -ROUNDING) | (scores > 1 + ROUNDING)).sum())
    if n_outside and (rules.confidence == "prediction" or rules.kind == "panoptic"):
        lines.append(
            f"{n_outside} of {len(scores)} confidences are negative or above 1 ({scores.min():g} to "
            f"{scores.max():g}): are they logits or percentages?"
        )
    return lines


def overlap_warnings(masks: Masks, objects: IntArray) -> list[str]:
    """A warning if no mask reaches IoU 0.25 with any of ``objects``, the object of each point (N,), 0 for none."""
    ids, column, sizes = np.unique(np.maximum(objects, 0), return_inverse=True, return_counts=True)
    shared = intersections(column, len(ids), masks.indptr, masks.indices, np.arange(len(masks)))
    iou = (shared / (sizes + masks.sizes[:, None] - shared))[:, ids > 0]
    if not iou.size or iou.max() >= LEAST_IOU or not len(masks.indices):
        return []
    return [
        "no mask reaches IoU 0.25 with any object: are the points in the order and frame of reference of the ground "
        "truth?"
    ]


def _label_warnings(rules: ProtocolRules, labels: Sequence[str] | None, names: Collection[str]) -> list[str]:
    """A warning on labels that are neither classes of the protocol nor among ``names``; '' is no label."""
    if rules.n_labels is None or not rules.classes:
        return []
    known = dict.fromkeys([*(entry.name for entry in rules.classes), *names])
    given = [label for label in labels or () if label]
    strange = [label for label in given if label not in known]
    if not strange:
        return []
    meant = nearest(strange[0].strip().lower(), known)
    return [f"{len(strange)} of {len(given)} {NO_CLASSES}, such as {strange[0][:60]!r}{meant}"]


def duplicate_warnings(scene: str, facts: MaskFacts, keys: Sequence[str]) -> list[str]:
    """Warnings on duplicate masks, with the number of pairs and the first of them."""
    lines = []
    identical = set(facts.identical)
    only_near = tuple(pair for pair in facts.near or () if pair not in identical)
    for pairs, what in ((facts.identical, "identical masks"), (only_near, "near-duplicates")):
        if pairs:
            first, other = pairs[0]
            names = f"{first}{_key(keys, first)} and {other}{_key(keys, other)}"
            lines.append(f"{scene}: {counted(len(pairs), 'pair')} of {what}, the first is {names}; they can move AP")
    if facts.near is None:
        lines.append(f"{scene}: the masks overlap too much to search for duplicates")
    return lines


def _key(keys: Sequence[str], k: int) -> str:
    plain = k < len(keys) and keys[k] not in {"", f"mask {k}"}
    return f" ({printable(keys[k], 80)})" if plain else ""


def class_warnings(scene: str, rules: ProtocolRules, numbers: Int32Array | None, ids: Int64Array) -> list[str]:
    """A warning on masks whose class the protocol does not score; ``ids`` (K,) are class ids, 0 for none.

    ``numbers`` (K,) are the classes as in the file.
    """
    if numbers is None or rules.class_agnostic is not None:
        return []
    scored = {entry.id for entry in rules.scored}
    name_of = {entry.id: entry.name for entry in rules.classes}
    is_dropped = np.array([int(class_id) not in scored for class_id in ids], bool)
    if not is_dropped.any():
        return []
    values, counts = np.unique(np.asarray(numbers)[is_dropped], return_counts=True)
    most = np.argsort(-counts, kind="stable")[:3]
    names = {row: f" ({name_of[int(values[row])]})" if int(values[row]) in name_of else "" for row in most}
    texts = [f"{counts[row]} of class {values[row]}{names[row]}" for row in most]
    more = f" and {counted(len(values) - 3, 'class')} more" if len(values) > 3 else ""
    first = int(np.argmax(is_dropped))
    verb = "has" if is_dropped.sum() == 1 else "have"
    return [
        f"{scene}: {int(is_dropped.sum())} of {len(ids)} masks {verb} a class that is not scored and "
        f"{'counts' if verb == 'has' else 'count'} for nothing: {', '.join(texts)}{more}; the first is mask {first}"
    ]


def label_warnings(scene: str, rules: ProtocolRules, class_ids: Int64Array) -> list[str]:
    """A warning on points whose predicted class is not in the protocol."""
    is_unknown = ~np.isin(class_ids, [entry.id for entry in rules.classes])
    if not is_unknown.any():
        return []
    values, counts = np.unique(class_ids[is_unknown], return_counts=True)
    worst = int(values[np.argmax(counts)])
    return [
        f"{scene}: {int(is_unknown.sum())} of {len(class_ids)} points are predicted as none of the "
        f"{len(rules.classes)} classes (most often {worst}, first at point {int(np.argmax(is_unknown))}), which is "
        "wrong wherever they are scored"
    ]


def check_cloud(points: Float32Array, truth: Float32Array) -> list[str]:
    """Warnings on the alignment of a predicted cloud with ground truth; ``PredictionError`` if it is impossible."""
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise PredictionError(f"point {bad} is at {points[bad].tolist()}; coordinates must be finite")
    if not len(points) or not len(truth):
        return []
    # column by column: numpy is slow along short rows
    low, high = ([float(bound(column)) for column in truth.T] for bound in (np.min, np.max))
    span = max(float(np.ptp(column)) for column in points.T)
    true_span = max(b - a for a, b in zip(low, high, strict=True))
    ratio = span / true_span if true_span > 0 else 1.0
    if ratio > LARGEST_RATIO:  # few points may be far away
        ratio = float(np.ptp(np.percentile(points, FEW_PERCENT, axis=0), axis=0).max()) / true_span
    unit = next((name for factor, name in UNITS.items() if factor / 4 < ratio < factor * 4), None)
    if ratio > LARGEST_RATIO or (unit is not None and ratio < 1):
        guess = f": {unit}?" if unit else "; wrong scene?"
        raise PredictionError(
            f"the cloud spans {span:.4g}, the scene {true_span:.4g} m{guess} coordinates must be metres in the frame "
            "of the ground truth"
        )
    is_inside = np.ones(len(points), bool)
    for column, a, b in zip(points.T, low, high, strict=True):
        is_inside &= (column >= a - NEAR_M) & (column <= b + NEAR_M)
    share = float(is_inside.mean())
    if share == 0:
        raise PredictionError(
            "no point of the cloud is in the box of the scene; is it from another scene or in another frame of "
            "reference?"
        )
    if share < MIN_INSIDE:
        return [
            f"only {100 * share:.0f} % of the cloud is in the box of the scene (the first outside is point "
            f"{int(np.argmin(is_inside))}); is the frame of reference right?"
        ]
    return []
