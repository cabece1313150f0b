"""Error attribution: planted errors are found, and nothing else is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import Int32Array, Int64Array
from su3d_bench.metrics.attribution.arrays import Pool, single_mask_errors, single_point_errors
from su3d_bench.metrics.attribution.masks import (
    KINDS,
    LabelledPoints,
    causes_of,
    correct_points,
    correct_scene,
    count_masks,
    find_errors,
    repaired,
    with_true_labels,
)
from su3d_bench.metrics.attribution.overlaps import (
    LabelledMasks,
    Overlaps,
    ScoringRules,
    measure_overlaps,
    true_instances,
)
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules, VoidRule
from su3d_bench.metrics.scoring import metric_of
from su3d_bench.metrics.semantic import confusion as semantic

SIZE = 200  # points per instance
CLASSES = (3, 3, 3, 4, 4, 5)
RULES = ScoringRules((3, 4, 5))
N_VOID = 300


def truth() -> Int64Array:
    """Six instances of three classes, one after another, and void points at the end."""
    values = np.array([c * 1000 + k + 1 for k, c in enumerate(CLASSES)])
    return np.concatenate([np.repeat(values, SIZE), np.zeros(N_VOID, np.int64)])


def points(instance: int, share: float = 1.0, start: float = 0.0) -> Int32Array:
    first = SIZE * instance
    return np.arange(first + int(start * SIZE), first + int((start + share) * SIZE), dtype=np.int32)


def perfect() -> tuple[list[Int32Array], list[int], list[float]]:
    return [points(k) for k in range(len(CLASSES))], list(CLASSES), [0.9] * len(CLASSES)


def overlaps_of(truth: Int64Array, predicted: LabelledMasks, rules: ScoringRules) -> Overlaps:
    return measure_overlaps(true_instances(truth, rules), predicted, rules)


def labelled(masks: list[Int32Array], classes: list[int], scores: list[float]) -> LabelledMasks:
    return LabelledMasks(Masks.of_sets([np.unique(mask) for mask in masks]), np.array(classes), np.array(scores))


def gains(masks: list[Int32Array], classes: list[int], scores: list[float]) -> tuple[dict[str, float], dict[str, int]]:
    """The gain in AP50 of each kind, after checks that always hold."""
    corrected = correct_scene(truth(), labelled(masks, classes, scores), RULES)
    base = instance_ap.combine([corrected.as_is])
    found = {kind: instance_ap.combine([counts]) for kind, counts in corrected.alone.items()}
    assert list(found) == list(KINDS)
    for kind, ap in found.items():
        assert (ap.ap != base.ap) <= (corrected.n[kind] > 0)
    return {kind: ap.ap50 - base.ap50 for kind, ap in found.items()}, dict(corrected.n)


def test_mask_on_void_is_background_unless_void_is_ignored() -> None:
    masks, classes, scores = perfect()
    on_void = labelled([*masks, np.arange(SIZE * 6, SIZE * 6 + 150, dtype=np.int32)], [*classes, 3], [*scores, 0.95])
    of_rule: dict[VoidRule | None, int] = {None: 0, "false-positives": 1}
    for void, n in of_rule.items():
        rules = ScoringRules((3, 4, 5), void=void)
        corrected = correct_scene(truth(), on_void, rules)
        assert corrected.n["background"] == n
        assert (instance_ap.combine([corrected.as_is]).ap50 < 1) == (n == 1)
        assert instance_ap.combine([corrected.all]).ap50 == 1


def test_perfect_prediction_has_no_errors() -> None:
    gain, n = gains(*perfect())
    assert set(gain.values()) == {0.0}
    assert set(n.values()) == {0}


def with_error(kind: str) -> tuple[list[Int32Array], list[int], list[float]]:
    masks, classes, scores = perfect()
    if kind == "merged":
        masks[0:2], classes[0:2], scores[0:2] = [np.concatenate([masks[0], masks[1]])], [3], [0.9]
    elif kind == "split":
        masks[0:1], classes[0:1], scores[0:1] = [points(0, 0.5), points(0, 0.5, 0.5)], [3, 3], [0.9, 0.9]
    elif kind == "duplicate":
        masks, classes, scores = [*masks, masks[0]], [*classes, 3], [*scores, 0.9]
    elif kind == "mislabelled":
        classes[0] = 4
    elif kind == "background":
        # 30 % of two instances each and the rest void: matches nothing, but is not ignored
        blob = np.concatenate([points(0, 0.3), points(3, 0.3), np.arange(1200, 1300, dtype=np.int32)])
        masks, classes, scores = [*masks, blob], [*classes, 3], [*scores, 0.95]
    else:
        del masks[0], classes[0], scores[0]
    return masks, classes, scores


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_planted_error_is_found_and_correcting_it_gives_a_perfect_score(kind: str) -> None:
    gain, n = gains(*with_error(kind))
    assert n == {name: int(name == kind) for name in KINDS}
    assert gain.pop(kind) > 0
    assert set(gain.values()) == {0.0}
    corrected = correct_scene(truth(), labelled(*with_error(kind)), RULES)
    assert instance_ap.combine([corrected.alone[kind]]).ap == instance_ap.combine([corrected.all]).ap == 1


def test_mask_is_a_part_if_it_raises_the_iou_and_a_duplicate_if_half_of_it_is_covered() -> None:
    void = np.arange(1200, 1300, dtype=np.int32)
    first = points(0, 0.6)  # 120 of 200 points, IoU 0.6
    with_new = np.concatenate([points(0, 0.3, 0.375), void[:40]])  # 45 of its 100 points covered, 15 new: 135 / 240
    half_known = np.concatenate([points(0, 0.4, 0.4)])  # 40 of its 80 points covered
    better = points(0, 0.2, 0.6)  # 40 new points: 160 / 200
    overlaps = overlaps_of(truth(), labelled([first, with_new, half_known, better], [3] * 4, [0.9] * 4), RULES)
    assert overlaps.parts[0].parts == (0, 3)
    assert overlaps.parts[0].duplicates == (2,)


SPLITS = {
    "two halves": ([(0.5, 0.0, 3), (0.5, 0.5, 3)], True),
    "one mask": ([(0.6, 0.0, 3)], False),
    "two halves of another class": ([(0.5, 0.0, 4), (0.5, 0.5, 4)], False),
    "exactly half together": ([(0.25, 0.0, 3), (0.25, 0.25, 3)], False),
    # 110 points of the match, 130 of the others
    "a match of the right class and others": ([(0.55, 0.0, 3), (0.35, 0.4, 4), (0.3, 0.7, 4)], True),
    "a match of the wrong class and others": ([(0.55, 0.0, 4), (0.35, 0.4, 3), (0.3, 0.7, 3)], False),
    # no match: 100 points of one class, 110 of the other
    "most points of the right class": ([(0.5, 0.0, 4), (0.3, 0.45, 3), (0.25, 0.75, 3)], True),
    "most points of the wrong class": ([(0.5, 0.0, 3), (0.3, 0.45, 4), (0.25, 0.75, 4)], False),
}


@pytest.mark.parametrize("name", SPLITS)
def test_instance_is_split_if_its_parts_together_match_it_with_its_class(name: str) -> None:
    parts, is_split = SPLITS[name]
    masks = [points(0, share, start) for share, start, _ in parts]
    predicted = labelled(masks, [class_id for *_, class_id in parts], [0.9] * len(parts))
    assert (0 in overlaps_of(truth(), predicted, RULES).split) == is_split


def test_true_labels_are_from_the_instance_that_shares_most_points() -> None:
    void = np.arange(1200, 1300, dtype=np.int32)
    masks = [np.concatenate([points(0, 0.3), points(3, 0.4)]), points(5, 0.1), void]
    predicted = labelled(masks, [3, 3, 3], [0.9, 0.8, 0.7])
    named = with_true_labels(overlaps_of(truth(), predicted, RULES))
    assert named.class_ids.tolist() == [4, 5, 3]
    assert named.scores.tolist() == [0.9, 0.8, 0.7]
    of_none = with_true_labels(overlaps_of(np.zeros_like(truth()), predicted, RULES))
    assert of_none.class_ids.tolist() == [3, 3, 3]


def test_best_fitting_duplicate_is_kept_with_the_highest_confidence() -> None:
    masks, classes, scores = perfect()
    masks, classes, scores = [*masks, points(0, 0.7)], [*classes, 3], [*scores, 0.99]
    corrected = correct_scene(truth(), labelled(masks, classes, scores), RULES)
    assert corrected.n["duplicate"] == 1
    after = corrected.alone["duplicate"]
    at_half = (after.class_index == 0) & (after.threshold_index == 0)
    assert sorted(after.score[at_half]) == [0.9, 0.9, 0.99]
    assert instance_ap.combine([after]).ap == 1


MASK_RULES = load_protocol("rooms-instance")
POINT_RULES = load_protocol("rooms-semantic")


def scoring(rules: ProtocolRules) -> ScoringRules:
    return ScoringRules(tuple(entry.id for entry in rules.scored), 20, rules.thresholds)


def made_scene(seed: int) -> tuple[Int64Array, LabelledMasks]:
    """A scene with errors of every kind: split, merged, duplicated, mislabelled, missed, and masks on no object."""
    rng = np.random.default_rng(seed)
    ids = [entry.id for entry in MASK_RULES.scored][:4]
    n_objects = int(rng.integers(3, 9))
    sizes = rng.integers(10, 90, n_objects)  # some below the minimum size
    classes = rng.choice(ids, n_objects)
    truth = np.concatenate([np.repeat(classes * 1000 + np.arange(1, n_objects + 1), sizes), np.zeros(120, np.int64)])
    starts = np.append(0, np.cumsum(sizes))
    sets, labels = [], []
    for _ in range(int(rng.integers(1, 14))):
        g = int(rng.integers(0, n_objects))
        start, end = starts[g], starts[g + 1]
        kind = rng.integers(0, 6)
        if kind == 0:
            end = starts[min(n_objects, g + 2)]
        elif kind == 1:
            end = start + (end - start) * 6 // 10
        elif kind == 2:
            start = start + (end - start) * 4 // 10
        elif kind == 3:
            start, end = len(truth) - 120, len(truth) - 120 + int(rng.integers(20, 110))
        points = np.arange(start, end)
        extra = rng.integers(0, len(truth), int(rng.integers(0, 20)))
        sets.append(np.unique(np.append(points, extra)).astype(np.int32))
        labels.append(int(classes[g]) if rng.random() < 0.7 else int(rng.choice([*ids, 0])))
    scores = np.round(rng.random(len(sets)), 1)  # some are equal
    return truth, LabelledMasks(Masks.of_sets(sets), np.array(labels), scores)


@pytest.mark.parametrize("seed", range(40))
def test_single_corrections_never_lower_ap50_and_change_nothing_without_errors(seed: int) -> None:
    truth, predicted = made_scene(seed)
    corrected = correct_scene(truth, predicted, scoring(MASK_RULES))
    base = instance_ap.combine([corrected.as_is])
    for kind in KINDS:
        after = instance_ap.combine([corrected.alone[kind]])
        assert corrected.n[kind] or after.ap == base.ap
        assert after.ap50 >= base.ap50 - 1e-12, kind


def reported(rules: ProtocolRules, counts: Sequence[instance_ap.InstanceCounts]) -> dict[str, float]:
    values = metric_of(rules).reported(counts)
    return {name: values[name] for name in rules.headline}


@pytest.mark.parametrize("aggregate", ["pooled", "scene-mean"])
@pytest.mark.parametrize("void", [None, "false-positives", "groups"])
def test_gain_of_a_corrected_mask_equals_that_of_a_full_evaluation(aggregate: str, void: VoidRule | None) -> None:
    rules = MASK_RULES.model_copy(update={"aggregate": aggregate})
    scored = replace(scoring(rules), void=void)
    kinds = dict.fromkeys(KINDS, 0)
    for seed in range(10):
        scenes = [made_scene(1000 * seed + k) for k in range(3)]
        counts = [count_masks(truth, predicted, scored) for truth, predicted in scenes]
        before = reported(rules, counts)
        truth, predicted = scenes[0]
        overlaps = measure_overlaps(true_instances(truth, scored), predicted, scored)
        pool = Pool(metric_of(rules), counts[0], counts[1:])
        found = single_mask_errors(truth, overlaps, scored, pool)
        errors = find_errors(overlaps)
        assert len(found) == len(errors)
        for single, error in zip(found, errors, strict=True):
            kinds[error.kind] += 1
            corrected = count_masks(truth, repaired(overlaps, [error]).labelled(), scored)
            after = reported(rules, [corrected, *counts[1:]])
            assert single.gains == pytest.approx({name: after[name] - before[name] for name in before}, abs=1e-12)
    assert all(n >= 2 for n in kinds.values()), kinds


def test_single_error_has_its_masks_objects_and_gain() -> None:
    scored = scoring(MASK_RULES)
    first, second = scored.class_ids[:2]
    truth = np.concatenate([np.repeat([first * 1000 + 1, second * 1000 + 2], 100), np.zeros(50, np.int64)])
    masks = LabelledMasks(Masks.of_sets([np.arange(90)]), np.array([second]), np.array([0.8]))
    overlaps = measure_overlaps(true_instances(truth, scored), masks, scored)
    pool = Pool(metric_of(MASK_RULES), count_masks(truth, masks, scored), [])
    named, missed = single_mask_errors(truth, overlaps, scored, pool)
    assert (named.kind, named.true, named.called, named.masks) == ("mislabelled", (first,), (second,), (0,))
    assert (named.score, named.iou) == (0.8, 0.9)
    assert named.predicted[0].tolist() == list(range(90))
    assert named.truth[0].tolist() == list(range(100))
    assert (missed.kind, missed.true, missed.called, missed.masks) == ("missed", (second,), (), ())
    assert (missed.score, missed.iou, len(missed.predicted)) == (None, 0.0, 0)
    assert missed.gains["AP"] == pytest.approx(0.375)  # its class: recall 1, (1 + precision 1/2) / 2


def synthetic_points(seed: int) -> LabelledPoints:
    rng = np.random.default_rng(seed)
    objects = rng.integers(1, 8, 400)
    true = objects % 5 - (objects == 7) * 3
    near = np.where(rng.random(400) < 0.1, 0.2, 0.0)
    called = np.where(rng.random(400) < 0.6, true, rng.integers(-1, 5, 400))
    mask = np.where(rng.random(400) < 0.1, -1, objects + (rng.random(400) < 0.2))
    return LabelledPoints(true, called, true >= 0, objects, mask, np.where(rng.random(400) < 0.05, 1.0, 0.0), near)


@pytest.mark.parametrize("aggregate", ["pooled", "scene-mean"])
def test_gain_of_corrected_points_equals_that_of_a_full_evaluation(aggregate: str) -> None:
    rules = POINT_RULES.model_copy(update={"aggregate": aggregate})
    metric, n_classes = metric_of(rules), len(rules.classes)
    is_counted = np.arange(n_classes) < 5
    for seed in range(4):
        scenes = [synthetic_points(3 * seed + k) for k in range(3)]
        counts = [correct_points(points, is_counted).as_is for points in scenes]
        pool = Pool(metric, counts[0], counts[1:])
        n, found = single_point_errors(scenes[0], is_counted, pool, has_masks=True, most=10_000)
        assert n == len(found) > 20
        before = metric.reported(counts)
        cause = causes_of(scenes[0])
        n_told = 0
        for error in found:
            (wrong,), (thing,) = error.predicted, error.truth
            n_told += len(wrong)
            assert len({*cause[wrong]}) == 1
            assert set(scenes[0].object_id[wrong]) == set(scenes[0].object_id[thing])
            called = scenes[0].predicted.copy()
            called[wrong] = error.true[0]
            corrected = semantic.per_scene(scenes[0].true_class, called, is_counted)
            after = metric.reported([corrected, *counts[1:]])
            gain = {name: after[name] - before[name] for name in rules.headline}
            assert error.gains == pytest.approx(gain, abs=1e-12)
        assert n_told == (cause >= 0).sum()
        fewer = single_point_errors(scenes[0], is_counted, pool, has_masks=True, most=3)
        assert fewer[0] == n
        assert [error.gains for error in fewer[1]] == [error.gains for error in found[:3]]
        costs = [error.gains[rules.headline[0]] for error in found]
        assert costs == sorted(costs, reverse=True)
