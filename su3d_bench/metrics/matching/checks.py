"""What is wrong or doubtful in a prediction, found before it is scored; each line says where and how much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import PredictionError, counted, printable
from su3d_bench.core.maps import Masks
from su3d_bench.core.types import Float32Array, Float64Array, Int32Array, Int64Array
from su3d_bench.metrics.matching.nearest import remembered
from su3d_bench.metrics.protocols.model import ProtocolRules


@remembered
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
    """The pairs, in order, that may have such an IoU: of masks whose first points are shared already.

    Two masks with an IoU above t share more than t of each. So of the points of one, by their number, all but (1 - t)
    are the other's; and among the first 2 (1 - t) + 1 of each must be as many common ones as are left when those that
    may be foreign are taken away. All other pairs are passed over, and their points are never looked at.
    """
    size = masks.sizes
    n_foreign = np.minimum(size, ((1.0 - iou) * size).astype(np.int64) + 1)  # at most; 1 more, for that is rounded
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


NEAR_IOU = 0.9  # pairs above it are the same object twice
MAX_SHARED = 300_000_000  # products while pairs are sought; 600 masks of a large scene take some ten million
UNITS = {1000.0: "millimetres", 100.0: "centimetres", 0.001: "kilometres"}
LARGEST_RATIO = 20.0  # of what two clouds of one scene span
NEAR_M = 0.1  # outside of the scene's box that a point still counts as inside
MIN_INSIDE = 0.5  # of the points; less means another frame of reference or another scene


@dataclass(frozen=True)
class MaskFacts:
    """What a reader must know of the masks of a scene.

    ``near`` and ``identical`` are pairs of masks whose IoU is above 0.9 or 1, ``near`` None where there are too many
    overlaps to look; of ``n_covered`` points in masks, ``n_contested`` are in several.
    """

    n_masks: int
    n_empty: int
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
        n_empty=int((masks.sizes == 0).sum()),
        near=near,
        identical=tuple((k, m) for k, m in near or () if np.array_equal(masks.mask(k), masks.mask(m))),
        lowest_score=float(scores.min()) if len(scores) else None,
        highest_score=float(scores.max()) if len(scores) else None,
        n_covered=int((n_owners > 0).sum()),
        n_contested=int((n_owners > 1).sum()),
    )


def empty_warnings(scene: str, facts: MaskFacts, masks: Masks, keys: Sequence[str]) -> list[str]:
    """A sentence on empty masks, with their number and the first of them."""
    if not facts.n_empty:
        return []
    first = int(np.flatnonzero(masks.sizes == 0)[0])
    return [f"{scene}: {counted(facts.n_empty, 'empty mask')}, the first is mask {first}{_key(keys, first)}"]


def duplicate_warnings(scene: str, facts: MaskFacts, keys: Sequence[str]) -> list[str]:
    """Sentences on masks that are there twice, with the number of pairs and the first of them."""
    lines = []
    identical = set(facts.identical)
    only_near = tuple(pair for pair in facts.near or () if pair not in identical)
    for pairs, what in ((facts.identical, "identical masks"), (only_near, "near-duplicates")):
        if pairs:
            first, other = pairs[0]
            names = f"{first}{_key(keys, first)} and {other}{_key(keys, other)}"
            lines.append(f"{scene}: {counted(len(pairs), 'pair')} of {what}, the first is {names}; they can move AP")
    if facts.near is None:
        lines.append(f"{scene}: the masks overlap so much that duplicates were not looked for")
    return lines


def _key(keys: Sequence[str], k: int) -> str:
    plain = k < len(keys) and keys[k] not in {"", f"mask {k}"}
    return f" ({printable(keys[k], 80)})" if plain else ""


def class_warnings(scene: str, rules: ProtocolRules, numbers: Int32Array | None, ids: Int64Array) -> list[str]:
    """A sentence on masks whose class the protocol does not score; ``ids`` (K,) are class ids, 0 for none.

    ``numbers`` (K,) are the classes as the file has them.
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
    """A sentence on points whose predicted class is none of the protocol's."""
    is_unknown = ~np.isin(class_ids, [entry.id for entry in rules.classes])
    if not is_unknown.any():
        return []
    values, counts = np.unique(class_ids[is_unknown], return_counts=True)
    worst = int(values[np.argmax(counts)])
    return [
        f"{scene}: {int(is_unknown.sum())} of {len(class_ids)} points are predicted as none of the "
        f"{len(rules.classes)} classes (most often {worst}, first at point {int(np.argmax(is_unknown))}), which is "
        "wrong wherever they count"
    ]


def check_cloud(scene: str, points: Float32Array, truth: Float32Array) -> list[str]:
    """Sentences on how a prediction's cloud lies over the truth's; ``PredictionError`` where that makes no sense."""
    if not len(points) or not len(truth):
        return []
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise PredictionError(f"{scene}: point {bad} is at {points[bad].tolist()}; coordinates are finite metres")
    low, high = truth.min(axis=0).astype(np.float64), truth.max(axis=0).astype(np.float64)
    span, true_span = float((points.max(axis=0) - points.min(axis=0)).max()), float((high - low).max())
    ratio = span / true_span if true_span > 0 else 1.0
    if ratio > LARGEST_RATIO or 0 < ratio < 1 / LARGEST_RATIO:
        unit = next((name for factor, name in UNITS.items() if factor / 4 < ratio < factor * 4), None)
        guess = f": {unit}?" if unit else "; is it of this scene?"
        raise PredictionError(
            f"{scene}: the cloud spans {span:.4g}, the scene {true_span:.4g} m{guess} coordinates must be metres in "
            "the frame of the ground truth"
        )
    is_inside = ((points >= low - NEAR_M) & (points <= high + NEAR_M)).all(axis=1)
    share = float(is_inside.mean())
    if share == 0:
        raise PredictionError(
            f"{scene}: no point of the cloud lies in the box of the scene; is it of another scene or in another frame "
            "of reference?"
        )
    if share < MIN_INSIDE:
        return [
            f"{scene}: only {100 * share:.0f} % of the cloud lies in the box of the scene (the first outside is point "
            f"{int(np.argmin(is_inside))}); is the frame of reference right?"
        ]
    return []
