"""Average precision of text queries: equal to the original, ceilings, and invariants."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from open_scene import ENCODER, OBJECTS, WordEncoder, instances_with, query_truth
from places import CASES

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.maps import DenseFeatures, Instances, Masks
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.open_vocabulary.score import QueryTruth, TextQuery, confidences, per_scene
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, metric_of, score_scene

GOLDEN = json.loads((CASES / "conceptgraphs_golden.json").read_text())
OPENLEX, PLAIN = load_protocol("openlex3d-queries"), load_protocol("query-ap")
PROTOCOLS = {"openlex3d-queries": OPENLEX, "query-ap": PLAIN}


# ---- equal to the original


def golden_counts(case: dict[str, Any], top_k: int) -> instance_ap.InstanceCounts:
    """A golden case as masks with a confidence for each query; masks that a query does not list come last."""
    sets = sorted({tuple(rows) for _, rows, *_ in [*case["gt"], *case["pred"]]})
    texts = sorted({text for text, *_ in case["gt"]})
    objects = np.full(30, -1)
    for one, rows in enumerate(sets):
        objects[list(rows)] = one
    queries = [
        TextQuery(text, tuple(sets.index(tuple(rows)) for other, rows in case["gt"] if other == text)) for text in texts
    ]
    masks = Masks(np.concatenate([[0], np.cumsum([len(rows) for rows in sets])]), np.concatenate(sets).astype(np.int32))
    confidence = np.full((len(sets), len(texts)), -1.0)
    for text, rows, score in case["pred"]:
        confidence[sets.index(tuple(rows)), texts.index(text)] = score
    return per_scene(objects, queries, masks, confidence, top_k=top_k)


@pytest.mark.parametrize(
    ("name", "top_k"), [("ol_ap_perfect", 1), ("ol_ap_perfect_geometry_top3", 3), ("ol_ap_multi_gt_top3", 3)]
)
def test_golden_average_precisions_are_reproduced(name: str, top_k: int) -> None:
    case = GOLDEN[name]
    ours = instance_ap.combine([golden_counts(case, top_k)])
    np.testing.assert_allclose(ours.table[0], case["ap_per_threshold"], rtol=0, atol=1e-15)
    averages = (case["avg"]["all_ap"], case["avg"]["all_ap_50%"], case["avg"]["all_ap_25%"])
    np.testing.assert_allclose((ours.ap, ours.ap50, ours.ap25), np.array(averages) / 100, rtol=0, atol=1e-15)


# ---- confidences


def test_rescaled_confidences_are_one_for_the_best_mask_and_zero_for_the_worst() -> None:
    rng = np.random.default_rng(0)
    stretched = confidences(rng.uniform(-1, 1, (9, 5)), "similarity-min-max")
    assert (stretched.max(axis=0) == 1).all() and (stretched.min(axis=0) == 0).all()
    assert confidences(np.full((4, 1), 0.3), "similarity-min-max").tolist() == [[0.0]] * 4


def test_nearly_equal_confidences_are_not_rescaled_to_the_full_range() -> None:
    stretched = confidences(np.array([[0.0], [1e-8], [4e-9]]), "similarity-min-max")  # (s + 1) / 2 over at least 1e-8
    assert stretched[:, 0].tolist() == pytest.approx([0.0, 0.5, 0.2], abs=1e-6)


def test_single_point_mask_counts_and_points_without_object_match_nothing() -> None:
    objects, masks = np.array([-1, 7]), Masks(np.array([0, 1, 2]), np.arange(2, dtype=np.int32))
    found = per_scene(objects, [TextQuery("seat", (7,))], masks, np.array([[0.1], [0.9]]))
    assert instance_ap.combine([found]).ap == 1.0
    assert found.n_predictions.tolist() == [2]
    nothing = per_scene(objects, [TextQuery("air", (-1,))], masks, np.array([[0.9], [0.1]]))
    assert nothing.n_truth.tolist() == [0]


def test_top_masks_of_each_query_count_and_the_first_on_ties() -> None:
    objects = np.repeat([1, 2, 3], 4)
    masks = Masks(np.array([0, 4, 8, 12]), np.arange(12, dtype=np.int32))
    counts = per_scene(objects, [TextQuery("x", (2,))], masks, np.array([[0.5], [0.5], [0.5]]), top_k=1)
    assert instance_ap.combine([counts]).ap == 0.0
    assert counts.n_predictions.tolist() == [1]


# ---- a whole scene


def metrics(rules: ProtocolRules, truth: QueryTruth, prediction: Instances) -> list[float]:
    result = combine(rules, {"scene": score_scene(rules, truth, prediction, ENCODER)})
    return [result.metrics[name] for name in rules.headline]


def with_words(truth: QueryTruth, words: dict[int, dict[str, float]]) -> Instances:
    masks = [np.flatnonzero(truth.object_of_point == one) for one in OBJECTS]
    return instances_with(truth.points, masks, np.stack([WordEncoder().feature(words[one]) for one in OBJECTS]))


def asking(truth: QueryTruth, *queries: tuple[str, tuple[int, ...]]) -> QueryTruth:
    return replace(truth, queries=tuple(TextQuery(text, ids) for text, ids in queries))


ONE_QUERY_AN_OBJECT = (("seat", (7,)), ("desk", (12,)), ("light", (30,)), ("vase", (31,)), ("wall", (40,)))
OWN_WORD = {one: {text: 1.0} for text, (one,) in ONE_QUERY_AN_OBJECT}


def ruled(rules: ProtocolRules, truth: QueryTruth) -> QueryTruth:
    return replace(truth, variant=rules.ground_truth)


@pytest.mark.parametrize("rules", PROTOCOLS.values(), ids=PROTOCOLS)
def test_perfect_masks_with_a_query_for_each_score_exactly_one(rules: ProtocolRules) -> None:
    truth = ruled(rules, asking(query_truth(), *ONE_QUERY_AN_OBJECT))
    assert metrics(rules, truth, with_words(truth, OWN_WORD)) == [1.0, 1.0, 1.0]


def test_ground_truth_scores_below_one_for_two_object_queries_only_in_openlex3d() -> None:
    """Rescaling ranks the wrong second mask of a query above the right second mask of another."""
    words = {
        7: {"seat": 1.0},
        12: {"seat": 0.7, "lamp": 0.7},
        30: {"light": 0.6, "lamp": 0.8},
        31: {"light": 0.5, "lamp": 0.9},
        40: {"wall": 1.0},
    }
    truth = asking(query_truth(), ("seat", (7, 12)), ("light", (30,)))
    assert all(0.5 < value < 1 for value in metrics(OPENLEX, truth, with_words(truth, words)))
    assert metrics(PLAIN, ruled(PLAIN, truth), with_words(truth, words)) == pytest.approx([1.0, 1.0, 1.0])


def test_queries_state_why_there_is_no_ceiling() -> None:
    printed = {name: metric_of(rules).ceiling_remark for name, rules in PROTOCOLS.items()}
    assert "masks grow by the threshold" in str(printed["openlex3d-queries"])
    assert "the ranking of perfect masks depends on the encoder" in str(printed["query-ap"])


def test_mask_matches_only_objects_of_its_own_query() -> None:
    truth = asking(query_truth(), ("seat", (30,)), ("light", (7,)))
    assert metrics(OPENLEX, truth, with_words(truth, OWN_WORD))[0] < 0.5


def test_a_query_without_an_object_in_the_scene_still_has_false_positives() -> None:
    truth = asking(query_truth(), *ONE_QUERY_AN_OBJECT)
    whole = with_words(truth, OWN_WORD)
    more = replace(truth, queries=(*truth.queries, TextQuery("pot", (999,))))
    assert metrics(OPENLEX, more, whole)[0] <= metrics(OPENLEX, truth, whole)[0]
    counts = score_scene(OPENLEX, more, whole, ENCODER).counts
    assert isinstance(counts, instance_ap.InstanceCounts)
    assert counts.n_truth.tolist() == [5]
    assert counts.n_predictions.tolist() == [30]


def touching() -> tuple[QueryTruth, Instances]:
    """Two objects side by side, and the same two as masks."""
    points = np.random.default_rng(0).random((800, 3)).astype(np.float32)
    objects = np.where(points[:, 0] < 0.5, 7, 30)
    queries = (TextQuery("seat", (7,)), TextQuery("light", (30,)))
    truth = QueryTruth(points, objects, queries, OPENLEX.ground_truth, "made for a test")
    features = np.stack([WordEncoder().feature({word: 1.0}) for word in ("seat", "light")])
    return truth, instances_with(points, [np.flatnonzero(objects == one) for one in (7, 30)], features)


def test_touching_masks_grow_in_openlex3d_and_keep_their_shape_in_ours() -> None:
    truth, perfect_masks = touching()
    wide = OPENLEX.model_copy(update={"transfer": OPENLEX.transfer.model_copy(update={"cap_m": 0.3})})
    assert 0 < metrics(wide, truth, perfect_masks)[0] < 1
    assert metrics(PLAIN, ruled(PLAIN, truth), perfect_masks) == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(("offset_m", "is_reached"), [(0.0316, True), (0.0317, False)])
def test_a_mask_reaches_a_point_nearer_than_the_root_of_a_thousandth(offset_m: float, is_reached: bool) -> None:
    objects = np.array([7])
    truth = QueryTruth(np.zeros((1, 3), np.float32), objects, (TextQuery("seat", (7,)),), OPENLEX.ground_truth, "test")
    features = WordEncoder().feature({"seat": 1.0})[None]
    mask = instances_with(np.array([[0, offset_m, 0]], np.float32), [np.arange(1)], features)
    assert metrics(OPENLEX, truth, mask) == [float(is_reached)] * 3


def test_object_zero_can_be_queried_and_points_without_object_cannot() -> None:
    queries = (TextQuery("seat", (0,)), TextQuery("air", (-1,)))
    truth = QueryTruth(np.zeros((5, 3), np.float32), np.array([0, 0, 1, -1, -1]), queries, OPENLEX.ground_truth, "test")
    mask = instances_with(truth.points, [np.arange(5)], WordEncoder().feature({"seat": 1.0})[None])
    assert score_scene(OPENLEX, truth, mask, ENCODER).n_scored == 2


def test_overlapping_masks_are_all_ranked() -> None:
    truth = asking(query_truth(), ("seat", (7,)))
    seats = np.flatnonzero(truth.object_of_point == 7)
    features = np.stack([WordEncoder().feature({"seat": 1.0, "pot": other}) for other in (0.9, 0.0)])
    both = instances_with(truth.points, [seats[:50], seats], features)
    assert metrics(OPENLEX, truth, both)[:2] == [1.0, 1.0]


# ---- errors


def test_dense_features_and_masks_without_features_cannot_be_ranked() -> None:
    truth = query_truth()
    dense = DenseFeatures(truth.points, np.zeros((len(truth.points), 4), np.float16))
    assert kind_incompatibility(OPENLEX, dense) == (
        "openlex3d-queries: needs instances, and the method gives one feature per point"
    )
    with pytest.raises(PredictionError, match="openlex3d-queries: needs features to compare with texts"):
        score_scene(OPENLEX, truth, instances_with(truth.points, [np.arange(3)], None, ["chair"]), ENCODER)


def test_a_query_names_an_object_once() -> None:
    with pytest.raises(DataError, match="query 'seat': an object is listed twice"):
        TextQuery("seat", (7, 7))
