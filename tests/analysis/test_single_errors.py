"""What a single error costs is what mending it alone gains: held against the whole evaluation, done again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from su3d_bench.core.maps import Masks
from su3d_bench.core.types import Int64Array
from su3d_bench.metrics.attribution.masks import (
    KINDS,
    LabelledPoints,
    causes_of,
    count_masks,
    find_errors,
    mend_points,
    mend_scene,
    repaired,
)
from su3d_bench.metrics.attribution.overlaps import LabelledMasks, ScoringRules, measure_overlaps, true_instances
from su3d_bench.metrics.attribution.singles import Pool, single_mask_errors, single_point_errors
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import metric_of
from su3d_bench.metrics.semantic import confusion as semantic

MASK_RULES = load_protocol("rooms-instance")
POINT_RULES = load_protocol("rooms-semantic")


def scoring(rules: ProtocolRules) -> ScoringRules:
    return ScoringRules(tuple(entry.id for entry in rules.scored), 20, rules.thresholds)


def made_scene(seed: int) -> tuple[Int64Array, LabelledMasks]:
    """A scene with errors of every kind: cut, joined, repeated, renamed, lost, and masks on what is no object."""
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


def reported(rules: ProtocolRules, counts: Sequence[instance_ap.InstanceCounts]) -> dict[str, float]:
    values = metric_of(rules).reported(counts)
    return {name: values[name] for name in rules.headline}


@pytest.mark.parametrize("aggregate", ["pooled", "scene-mean"])
@pytest.mark.parametrize("forgives_void", [True, False])
def test_the_gain_of_a_mended_mask_is_that_of_the_whole_evaluation(aggregate: str, forgives_void: bool) -> None:
    rules = MASK_RULES.model_copy(update={"aggregate": aggregate})
    scored = replace(scoring(rules), forgives_void=forgives_void)
    kinds = dict.fromkeys(KINDS, 0)
    for seed in range(10):
        scenes = [made_scene(1000 * seed + k) for k in range(3)]
        counts = [count_masks(truth, predicted, scored) for truth, predicted in scenes]
        before = reported(rules, counts)
        truth, predicted = scenes[0]
        overlaps = measure_overlaps(true_instances(truth, scored), predicted, scored)
        pool = Pool(metric_of(rules), counts[0], counts[1:], instance_ap.concatenate)
        found = single_mask_errors(truth, overlaps, scored, pool)
        errors = find_errors(overlaps)
        assert len(found) == len(errors)
        for single, error in zip(found, errors, strict=True):
            kinds[error.kind] += 1
            mended = count_masks(truth, repaired(overlaps, [error]).labelled(), scored)
            after = reported(rules, [mended, *counts[1:]])
            assert single.gains == pytest.approx({name: after[name] - before[name] for name in before}, abs=1e-12)
    assert all(n >= 2 for n in kinds.values()), kinds


@given(st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_the_errors_of_a_kind_mended_together_are_the_mending_of_the_kind(seed: int) -> None:
    truth, predicted = made_scene(seed)
    scored = scoring(MASK_RULES)
    overlaps = measure_overlaps(true_instances(truth, scored), predicted, scored)
    errors, mended = find_errors(overlaps), mend_scene(truth, predicted, scored)
    for kind in KINDS:
        own = [error for error in errors if error.kind == kind]
        assert mended.n[kind] == len(own)
        if len(own) == 1:
            assert np.array_equal(
                count_masks(truth, repaired(overlaps, own).labelled(), scored).score, mended.alone[kind].score
            )


def test_an_error_is_told_by_its_masks_and_objects() -> None:
    scored = scoring(MASK_RULES)
    first, second = scored.class_ids[:2]
    truth = np.concatenate([np.repeat([first * 1000 + 1, second * 1000 + 2], 100), np.zeros(50, np.int64)])
    masks = LabelledMasks(Masks.of_sets([np.arange(90)]), np.array([second]), np.array([0.8]))
    overlaps = measure_overlaps(true_instances(truth, scored), masks, scored)
    pool = Pool(metric_of(MASK_RULES), count_masks(truth, masks, scored), [], instance_ap.concatenate)
    named, missed = single_mask_errors(truth, overlaps, scored, pool)
    assert (named.kind, named.true, named.called, named.masks) == ("mislabelled", (first,), (second,), (0,))
    assert (named.score, named.iou) == (0.8, 0.9)
    assert named.predicted[0].tolist() == list(range(90))
    assert named.truth[0].tolist() == list(range(100))
    assert (missed.kind, missed.true, missed.called, missed.masks) == ("missed", (second,), (), ())
    assert (missed.score, missed.iou, len(missed.predicted)) == (None, 0.0, 0)
    assert missed.gains["AP"] == pytest.approx(0.375)  # its class: recall 1, (1 + precision 1/2) / 2


def made_points(seed: int) -> LabelledPoints:
    rng = np.random.default_rng(seed)
    objects = rng.integers(1, 8, 400)
    true = objects % 5 - (objects == 7) * 3
    near = np.where(rng.random(400) < 0.1, 0.2, 0.0)
    called = np.where(rng.random(400) < 0.6, true, rng.integers(-1, 5, 400))
    mask = np.where(rng.random(400) < 0.1, -1, objects + (rng.random(400) < 0.2))
    return LabelledPoints(true, called, true >= 0, objects, mask, np.where(rng.random(400) < 0.05, 1.0, 0.0), near)


@pytest.mark.parametrize("aggregate", ["pooled", "scene-mean"])
def test_the_gain_of_mended_points_is_that_of_the_whole_evaluation(aggregate: str) -> None:
    rules = POINT_RULES.model_copy(update={"aggregate": aggregate})
    metric, n_classes = metric_of(rules), len(rules.classes)
    is_counted = np.arange(n_classes) < 5
    for seed in range(4):
        scenes = [made_points(3 * seed + k) for k in range(3)]
        counts = [mend_points(points, is_counted).as_is for points in scenes]
        pool = Pool(metric, counts[0], counts[1:], semantic.concatenate)
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
            mended = semantic.per_scene(scenes[0].true_class, called, is_counted)
            after = metric.reported([mended, *counts[1:]])
            gain = {name: after[name] - before[name] for name in rules.headline}
            assert error.gains == pytest.approx(gain, abs=1e-12)
        assert n_told == (cause >= 0).sum()
        fewer = single_point_errors(scenes[0], is_counted, pool, has_masks=True, most=3)
        assert fewer[0] == n
        assert [error.gains for error in fewer[1]] == [error.gains for error in found[:3]]
        costs = [error.gains[rules.headline[0]] for error in found]
        assert costs == sorted(costs, reverse=True)
