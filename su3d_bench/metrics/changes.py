"""Scenes that change: ghosts, times until found and removed, wrong merges, Khronos' measures, and t-AP.

A place is an object at one position; an object that is moved has two, before and after the change. Points of a place
count as soon as a frame has shown them, and as empty as soon as a later frame looks through them.

Names and slices are those of Khronos (Schmid et al., RSS 2024; ``khronos_eval`` of github.com/MIT-SPARK/Khronos at
63faadd): robot time is that of the map, query time the time asked about. Objects are counted ``online``, where both are
equal; for ``4D`` each map is also asked about all earlier ones, and taken to hold at any time. The association is that
by surface: most shared points. Three slips of ``object_evaluator.cpp`` are not repeated:

- the default association, by centroids, does not list what finds no partner, so that it counts neither as
  hallucinated nor as missed;
- a true negative of *disappeared* is counted where an associated object has neither disappeared nor *appeared*,
  whatever became of its partner;
- the association by boxes takes ``max_matching_distance``, metres, as the least IoU, and what stays below it gets
  the partner 0 instead of none.

Counts are summed over maps before ratios are formed (Khronos averages the ratios of maps), and an object counts from
the update by which it was seen. Khronos' maps state when an object appeared and disappeared; ours are compared with the
last map before the change: a place that was seen and not covered, and is now, has *appeared*; one that was covered and
no longer is has *disappeared*. Changes without a partner count, as in its columns ``...Incl``.

t-AP is that of ReScene4D (Steiner et al., CVPR 2026, arXiv 2601.11508) as its abstract and the readme of its package
stmetrics describe it: the average precision of instances that match in every stage with one identity. Its formula was
not at hand: here the IoU of an object and an id is the least over the stages, and in a stage without the object the id
must be gone. Classes are disregarded, and identical objects are not interchangeable.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.identity import MATCHED_IDENTITY
from su3d_bench.metrics.instance.average_precision import InstanceCounts
from su3d_bench.metrics.instance.scene_counts import count_class
from su3d_bench.metrics.metric import Values
from su3d_bench.numerics.statistics import ratio

NEVER = int(np.iinfo(np.int64).max)
MOST = 0.5  # share of an instance's points that makes it a ghost, and of a place's points that an instance covers
Pairs = Mapping[str, Int64Array]  # by name: part and whole (2,), which are summed over scenes before they are divided


@dataclass(frozen=True)
class Places:
    """R places: ``object_ids`` (R,), there only before frame ``change`` if ``is_left`` (R,), only later if ``is_new``.

    For N points: the ``place`` (N,) of each, -1 for background, and after how many updates it is ``shown`` (N,) there,
    and ``empty`` (N,) afterwards. ``frames``: the index of the frame of each update. An object is seen as soon as
    ``min_points`` are; its place is seen empty as soon as half of the points that were shown are.
    """

    object_ids: Int64Array
    is_new: BoolArray
    is_left: BoolArray
    change: int
    place: Int64Array
    shown: Int64Array
    empty: Int64Array
    frames: list[int]
    min_points: int = 1

    @cached_property
    def after(self) -> Int64Array:
        """Updates (2, R) until each object is seen at its place, and until that is seen empty; or ``NEVER``."""
        after = np.full((2, len(self.object_ids)), NEVER)
        for r in range(len(self.object_ids)):
            seen = np.flatnonzero((self.place == r) & (self.shown < NEVER))
            if len(seen) >= self.min_points:
                after[0, r] = np.sort(self.shown[seen])[self.min_points - 1]
                after[1, r] = np.sort(self.empty[seen])[(len(seen) - 1) // 2]
        return after

    def is_present(self, frame: int) -> BoolArray:
        """Which objects are there in a frame."""
        return ~(self.is_new if frame < self.change else self.is_left)

    def known(self, n_updates: int) -> tuple[BoolArray, BoolArray]:
        """Which places have an object that was seen after some updates; and which were seen to be left."""
        is_there = self.is_present(self.frames[n_updates - 1])
        return is_there & (self.after[0] <= n_updates), self.after[1] <= n_updates

    def map_at(self, n_updates: int, masks: Masks, ids: Int64Array, scores: Float64Array) -> MapAt:
        """The map after ``n_updates``, with ``masks`` on the points.

        >>> one, never = np.array([1, 1, 1, 1]), np.full(4, NEVER)
        >>> places = Places(np.array([7, 8]), *np.zeros((2, 2), bool), NEVER, np.array([0, 0, 1, -1]), one, never, [5])
        >>> found = places.map_at(1, Masks.of_sets([np.array([0, 1, 2]), np.array([3])]), np.array([5, 6]), np.ones(2))
        >>> found.seen.tolist(), found.n_points.tolist(), found.n_background.tolist()
        ([[2, 0], [1, 0]], [3, 1], [0, 1])
        """
        shape, key = (len(self.object_ids) + 1, len(masks)), (self.place[masks.indices] + 1) * len(masks) + masks.owners
        counted = self.shown <= n_updates, (self.shown <= n_updates) & (self.empty <= n_updates)
        n_seen, n_empty = (np.bincount(self.place[use] + 1, minlength=shape[0])[1:] for use in counted)
        tables = (np.bincount(key[use[masks.indices]], minlength=shape[0] * shape[1]) for use in counted)
        seen, empty = (table.reshape(shape) for table in tables)
        now = self.frames[n_updates - 1], n_updates
        return MapAt(*now, ids, scores, seen.sum(axis=0), seen[0], n_seen, seen[1:], n_empty, empty[1:])

    def perfect(self, n_updates: int) -> MapAt:
        """The map of what is there and has been seen; ids are those of the objects."""
        rows, is_shown = np.flatnonzero(self.known(n_updates)[0]), self.shown <= n_updates
        masks = Masks.of_sets([np.flatnonzero((self.place == r) & is_shown) for r in rows])
        return self.map_at(n_updates, masks, self.object_ids[rows], np.ones(len(rows)))


@dataclass(frozen=True)
class MapAt:
    """A map of K instances after ``n_updates``, the last of them frame ``frame``.

    ``n_points`` (K,) seen points of each instance, ``n_background`` (K,) of them of no object; ``n_seen`` (R,) seen
    points of each place, ``seen`` (R, K) those in each instance; ``n_empty``, ``empty``: those of them seen empty.
    """

    frame: int
    n_updates: int
    ids: Int64Array
    scores: Float64Array
    n_points: Int64Array
    n_background: Int64Array
    n_seen: Int64Array
    seen: Int64Array
    n_empty: Int64Array
    empty: Int64Array


def count_changes(places: Places, maps: Sequence[MapAt]) -> Pairs:
    """The counts of one scene from its maps over time, at least one."""
    before, last = last_before_change(places, maps), maps[-1]
    later = [one for one in maps if one.frame >= places.change]
    changes = [_changes(places, before, one) for one in later] if before else []
    outcomes = {"Appeared": _sum(pair[0] for pair in changes), "Disappeared": _sum(pair[1] for pair in changes)}
    outcomes["Change"] = outcomes["Appeared"] + outcomes["Disappeared"]
    outcomes["Object"] = _sum(objects(places, one, one.frame) for one in maps)
    queries = ((one, query.frame) for k, one in enumerate(maps) for query in maps[: k + 1])
    outcomes["4D Object"] = _sum(objects(places, one, frame) for one, frame in queries)
    parts: dict[str, Iterable[int]] = {"wrong merges": wrong_merges(places, last)}
    for name, four in (("", ghosts(last)), (" online", _sum((ghosts(one) for one in later), 4))):
        parts[f"ghosts{name}"], parts[f"ghost points{name}"] = four[:2], four[2:]
    matched = [(one.n_updates, np.asarray((iou(one) >= MATCHED_IDENTITY).any(axis=1))) for one in maps]
    cleared = [(one.n_updates, ~_is_covered(one.n_empty, one.empty)) for one in maps]
    times = _times(places.after[0], places.is_new, matched), _times(places.after[1], places.is_left, cleared)
    for name, (n, n_asked, n_updates) in zip(("found", "removed"), times, strict=True):
        parts[name], parts[f"updates until {name}"] = (n, n_asked), (n_updates, n)
    for name, (hits, false, missed) in outcomes.items():
        parts[f"{name}Precision"], parts[f"{name}Recall"] = (hits, hits + false), (hits, hits + missed)
        parts[f"{name}F1"] = 2 * hits, 2 * hits + false + missed
    return {name: np.array(part, np.int64) for name, part in parts.items()}


def change_values(scenes: Sequence[Pairs]) -> Values:
    """The ratios over scenes; NaN without anything to count. Times are means over what was found or removed.

    >>> change_values([{"ghosts": np.array([1, 4])}, {"ghosts": np.array([0, 1])}])
    {'ghosts': 0.2}
    """
    sums = {name: np.sum([scene[name] for scene in scenes], axis=0) for name in scenes[0]}
    return {name: float(ratio(part[:1], part[1:])[0]) for name, part in sums.items()}


def _sum(counts: Iterable[Int64Array], n: int = 3) -> Int64Array:
    return sum(counts, np.zeros(n, np.int64))


def last_before_change(places: Places, maps: Sequence[MapAt]) -> MapAt | None:
    """The last map before the change of a scene, None if there is none."""
    return next((one for one in reversed(maps) if one.frame < places.change), None)


def _is_covered(n: Int64Array, shared: Int64Array) -> BoolArray:
    """Which places (R,) with so many points instances cover."""
    return np.asarray((n > 0) & (shared.sum(axis=1) >= MOST * n), np.bool_)


def ghosts(found: MapAt) -> Int64Array:
    """Ghost instances, whose points lie mostly where nothing is any more, and instances; the same for points (4,)."""
    n_ghost = found.empty.sum(axis=0)
    n, is_ghost = found.n_points, n_ghost > MOST * found.n_points
    return np.array([is_ghost.sum(), np.count_nonzero(n), n_ghost.sum(), n.sum()], np.int64)


def wrong_merges(places: Places, found: MapAt) -> Int64Array:
    """Instances that cover two places, two objects or one where it was and where it is; and all instances (2,)."""
    is_there, is_left = (known[:, None] for known in places.known(found.n_updates))
    covers = is_there & (found.seen >= MOST * found.n_seen[:, None])
    covers |= is_left & (found.empty >= MOST * found.n_empty[:, None])
    return np.array([(covers.sum(axis=0) > 1).sum(), np.count_nonzero(found.n_points)], np.int64)


def answers(found: MapAt, asked: Int64Array, first: Int64Array) -> Int64Array:
    """Right answers to "where is it?", and questions (2,).

    The answer to a question about place ``asked`` (Q,) is the instance ``first`` (Q,), -1 for none; it is right if
    the instance has more points there than at any other place or on background.
    """
    main = np.append(np.concatenate([found.n_background[None], found.seen]).argmax(axis=0) - 1, -2)
    return np.array([np.count_nonzero(main[first] == asked), len(asked)], np.int64)


def iou(found: MapAt) -> Float64Array:
    """The IoU (R, K) of each place and instance on the points seen."""
    return np.asarray(found.seen / np.maximum(found.n_seen[:, None] + found.n_points - found.seen, 1), np.float64)


def _times(since: Int64Array, is_asked: BoolArray, states: Sequence[tuple[int, BoolArray]]) -> Int64Array:
    """Places whose state holds in a map after ``since`` (R,) updates or later, those asked for, and the sum of updates
    from there to the first such map."""
    asked = np.flatnonzero(is_asked & (since < NEVER))
    waits = [min((n - since[r] for n, holds in states if n >= since[r] and holds[r]), default=-1) for r in asked]
    return np.array([sum(w >= 0 for w in waits), len(asked), sum(w for w in waits if w >= 0)], np.int64)


def objects(places: Places, found: MapAt, query: int) -> Int64Array:
    """Khronos' objects detected, hallucinated and missed (3,) in frame ``query``.

    Instances mostly on background do not count.
    """
    is_there, shared = places.is_present(query), found.seen
    counts = found.n_background <= MOST * found.n_points
    n_detected = int((counts & is_there[shared.argmax(axis=0)] & shared.any(axis=0)).sum()) if len(shared) else 0
    is_missed = is_there & (places.after[0] <= found.n_updates) & ~shared.any(axis=1)
    return np.array([n_detected, counts.sum() - n_detected, is_missed.sum()], np.int64)


def _changes(places: Places, before: MapAt, now: MapAt) -> tuple[Int64Array, Int64Array]:
    """True positives, false positives and false negatives (3,) of *appeared* and of *disappeared*."""
    is_seen, is_left = places.known(now.n_updates)
    is_new, was_covered = places.is_new, _is_covered(before.n_seen, before.seen)
    is_covered = np.where(is_left, _is_covered(now.n_empty, now.empty), _is_covered(now.n_seen, now.seen))
    appears = is_seen & (is_new | (places.after[0] <= before.n_updates)) & ~was_covered & is_covered
    disappears = (is_left | is_seen) & was_covered & ~is_covered
    return _outcomes(is_seen & is_new, appears), _outcomes(is_left, disappears)


def _outcomes(truth: BoolArray, claim: BoolArray) -> Int64Array:
    return np.array([(truth & claim).sum(), (claim & ~truth).sum(), (truth & ~claim).sum()], np.int64)


def count_stages(places: Places, stages: Sequence[MapAt], thresholds: Sequence[float]) -> InstanceCounts:
    """The counts for t-AP of one scene from the last map of each stage."""
    there = [places.known(one.n_updates)[0] for one in stages]
    true_ids = np.unique(np.concatenate([places.object_ids[is_there] for is_there in there]))
    ids = np.unique(np.concatenate([one.ids[one.n_points > 0] for one in stages]))
    least, scores, background = np.ones((len(ids), len(true_ids))), np.zeros(len(ids)), np.zeros(len(ids))
    for one, is_there in zip(stages, there, strict=True):
        has = one.n_points > 0
        row, column = np.searchsorted(ids, one.ids[has]), np.searchsorted(true_ids, places.object_ids[is_there])
        of_stage = np.ones_like(least)
        of_stage[row], of_stage[:, column] = 0, 0
        of_stage[np.ix_(row, column)] = iou(one)[np.ix_(is_there, has)].T
        least = np.minimum(least, of_stage)
        scores[row], background[row] = one.scores[has], (one.n_background / np.maximum(one.n_points, 1))[has]
    return count_class(0, least, np.ones(len(true_ids), bool), scores, background, thresholds)
