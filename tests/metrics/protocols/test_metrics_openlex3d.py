"""OpenLex3D's measures of labels: equal to the original, hand-computed values, and invariants."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from open_scene import (
    ENCODER,
    OBJECTS,
    PROMPTS,
    WordEncoder,
    instances_with,
    labels_of,
    lex_truth,
    nothing_at,
    perfect,
)
from places import CASES

from su3d_bench.core.errors import DataError, PredictionError
from su3d_bench.core.maps import DenseFeatures, Partition, Prediction
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.matching import transfer
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.open_vocabulary import openlex3d, score
from su3d_bench.metrics.open_vocabulary.openlex3d import (
    ObjectCounts,
    ObjectLabels,
    OpenLexTruth,
    category_table,
    combine,
    count_categories,
    count_ranks,
    point_categories,
    rank_scores,
    ranked_labels,
    scored_objects,
)
from su3d_bench.metrics.open_vocabulary.score import voxel_means
from su3d_bench.metrics.protocols.kinds import CATEGORIES
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine as combine_scenes
from su3d_bench.metrics.scoring import score_scene

GOLDEN = json.loads((CASES / "conceptgraphs_golden.json").read_text())
TOPN, RANKING = load_protocol("openlex3d-topn"), load_protocol("openlex3d-ranking")


def values_of(rules: Any, truth: OpenLexTruth, prediction: Prediction) -> dict[str, float]:
    return dict(combine_scenes(rules, {"scene": score_scene(rules, truth, prediction, ENCODER)}).metrics)


# ---- equal to the original


def golden_labels() -> dict[int, ObjectLabels]:
    return {
        int(one): ObjectLabels(
            tuple(labels["synonyms"]),
            tuple(labels["depictions"]),
            tuple(labels["vis_sim"]),
            tuple(labels.get("clutter", ())),
        )
        for one, labels in GOLDEN["ol_topn"]["labels"].items()
    }


def golden_categories() -> tuple[list[int], np.ndarray, np.ndarray]:
    case = GOLDEN["ol_topn"]
    objects, words = golden_labels(), sorted({word for row in case["pred_labels"] for word in row})
    ids = scored_objects(objects, case["excluded"])
    row = np.array([ids.index(one) if one in ids else -1 for one in case["gt_ids"]])
    _, unit = nearest(np.array(case["pred_points"], float), np.array(case["gt_points"], float), 0.05)
    top = np.array([[words.index(word) for word in labels] for labels in case["pred_labels"]])
    return ids, row, point_categories(row, unit, top, category_table(objects, ids, words))


def test_golden_point_categories_equal_the_original() -> None:
    _, _, category = golden_categories()
    assert [CATEGORIES[one] if one >= 0 else "none" for one in category] == GOLDEN["ol_topn"]["cats"]


def test_golden_category_frequencies_are_reproduced() -> None:
    ids, row, category = golden_categories()
    means = combine([count_categories(row, category, len(ids))])
    assert dict(zip(CATEGORIES, means.tolist(), strict=True)) == GOLDEN["ol_topn"]["freq"]


@pytest.mark.parametrize("case", ["ol_rank_syn", "ol_rank_sec"])
def test_golden_rank_scores_are_reproduced(case: str) -> None:
    ranks, first, last, highest = GOLDEN[case]["args"]
    ours = rank_scores(np.array(ranks), first, last, highest)
    np.testing.assert_allclose([part.tolist() for part in ours], GOLDEN[case]["scores"], rtol=0, atol=1e-15)


# ---- by hand


def test_labels_are_compared_without_spaces_but_with_case() -> None:
    table = category_table({1: ObjectLabels(("tv stand",))}, [1], ["tvstand", "t v stand", "TV stand"])
    assert table.tolist() == [[0, 0, 5]]


def test_clutter_counts_any_label_of_a_nearby_object() -> None:
    objects = {1: ObjectLabels(("a",), clutter=(2, 77)), 2: ObjectLabels(("b",), ("c",), ("d",), clutter=(3,))}
    words = ["b", "c", "d", "e"]
    assert [CATEGORIES[one] for one in category_table(objects, [1], words)[0]] == ["clutter"] * 3 + ["incorrect"]


def test_an_object_without_synonyms_or_with_an_excluded_one_is_not_scored() -> None:
    objects = {4: ObjectLabels(("wall", "a")), 2: ObjectLabels((), ("b",)), 9: ObjectLabels(("door frame",)), 1: A}
    assert scored_objects(objects, ["wall", "doorframe"]) == [1]


A = ObjectLabels(("a",))


def test_ranks_are_counted_for_points_of_objects_with_labels() -> None:
    scores = np.array([[1.0, 0.5, np.nan], [0.0, 0.25, np.nan], [0.5, np.nan, 1.0]])
    counts = count_ranks(np.array([0, 0, 0, -1, 2]), np.array([0, 4, 0, 4, 0]), scores, 3)
    assert counts.n_points.tolist() == [3, 1]
    np.testing.assert_array_equal(counts.totals, [[2.0, 1.25, np.nan], [0.5, np.nan, 1.0]])


def test_objects_have_equal_weight_for_any_number_of_points() -> None:
    counts = count_categories(np.array([0] * 99 + [1]), np.array([0] * 99 + [5]), 2)
    assert combine([counts]).tolist() == [0.5, 0, 0, 0, 0, 0.5]


def test_best_label_of_a_point_for_its_own_object_counts() -> None:
    table = np.array([[0, 5, 3], [5, 1, 5], [2, 5, 5]])  # three objects, three words
    top = np.array([[0, 2], [1, 2], [2, 2]])  # three units
    rows, units = np.repeat([-1, 0, 1, 2], 4), np.tile([-1, 0, 1, 2], 4)
    expected = [-1, -1, -1, -1, 4, 0, 3, 3, 4, 5, 1, 5, 4, 2, 5, 5]
    assert point_categories(rows, units, top, table).tolist() == expected


def test_a_point_without_an_object_or_a_category_is_not_counted() -> None:
    counts = count_categories(np.array([0, -1, 1, 1]), np.array([0, 2, -1, 3]), 2)
    assert counts.totals.tolist() == [[1, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0]]


def test_a_box_that_ends_at_the_last_rank_has_nothing_to_its_right() -> None:
    score, _, _ = rank_scores(np.array([0, 1, 2]), 0, 2, 2)
    assert score.tolist() == [1.0, 1.0, 1.0]


def test_object_whose_synonyms_are_not_prompts_has_only_a_secondary_score() -> None:
    labels = ranked_labels(ObjectLabels(("unheard",), ("flower",)), ["x", "flower"])
    scores = labels.scores(np.array([[1, 0], [0, 1]]))
    assert np.isnan(scores[:, 1]).all()
    assert scores[:, 2].tolist() == scores[:, 0].tolist() == [1.0, 0.0]


def test_overall_score_weighs_labels_equally() -> None:
    labels = ranked_labels(ObjectLabels(("a", "b"), ("c",)), ["a", "b", "c", "d"])
    scores = labels.scores(np.array([[0, 1, 3, 2]]))[0]
    assert scores.tolist() == pytest.approx([2 / 3, 1.0, 0.0])


def test_ranks_outside_their_box_count_by_distance() -> None:
    labels = ranked_labels(ObjectLabels(("a", "b"), ("c",)), ["a", "b", "c", "d", "e"])
    scores = labels.scores(np.array([[0, 2, 1, 3, 4], [4, 0, 3, 1, 2]]))
    # the boxes are 0..1 and 2..2 of 0..4: 1 and 1 - 1 / 3, 1 - 1 / 2; then 1 - 3 / 3 and 1, 1 - 1 / 2
    expected = [[(1 + 2 / 3 + 1 / 2) / 3, 5 / 6, 1 / 2], [(0 + 1 + 1 / 2) / 3, 1 / 2, 1 / 2]]
    np.testing.assert_allclose(scores, expected, atol=1e-8)


# ---- a whole scene


def test_empty_prediction_is_all_missing_and_ranks_zero() -> None:
    truth = lex_truth()
    assert values_of(TOPN, truth, nothing_at(truth)) == {name: float(name == "missing") for name in CATEGORIES}
    assert values_of(RANKING, truth, nothing_at(truth)) == {"overall": 0.0, "synonyms": 0.0, "secondary": 0.0}
    ranked, nothing = (score_scene(RANKING, truth, one, ENCODER).counts for one in (perfect(truth), nothing_at(truth)))
    assert isinstance(ranked, ObjectCounts) and isinstance(nothing, ObjectCounts)
    assert nothing.n_points.tolist() == ranked.n_points.tolist()  # every object counts, including the first
    assert np.isnan(nothing.totals).tolist() == np.isnan(ranked.totals).tolist()
    unseen = replace(truth, objects={**truth.objects, 99: ObjectLabels(("pot",))})  # an object without points
    without = score_scene(RANKING, unseen, nothing_at(truth), ENCODER).counts
    assert isinstance(without, ObjectCounts)
    assert without.n_points.tolist() == ranked.n_points.tolist()


@pytest.mark.parametrize("rules", [TOPN, RANKING], ids=lambda rules: rules.name)
def test_units_compared_in_blocks_score_as_in_one(rules: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    truth, prediction = lex_truth(), noisy(0)
    in_one = values_of(rules, truth, prediction)
    monkeypatch.setattr(score, "_BLOCK_UNITS", 2)  # of five units
    assert values_of(rules, truth, prediction) == pytest.approx(in_one, abs=1e-12)


def test_point_is_missing_beyond_five_centimetres_but_ranked_at_any_distance() -> None:
    truth = lex_truth()
    whole = perfect(truth)
    far = instances_with(truth.points + np.array([0, 0, 30], np.float32), masks_of(whole), whole.features)
    assert values_of(TOPN, truth, far)["missing"] == 1.0
    assert values_of(RANKING, truth, far)["synonyms"] > 0.5


def masks_of(prediction: Any) -> list[np.ndarray]:
    return [prediction.mask(k) for k in range(len(prediction))]


def test_the_ranking_scores_walls_and_the_categories_do_not() -> None:
    truth = lex_truth()
    n_walls = int((truth.object_of_point == 40).sum())
    named, ranked = (score_scene(rules, truth, perfect(truth), ENCODER) for rules in (TOPN, RANKING))
    assert ranked.n_scored - named.n_scored == n_walls > 0


def test_one_of_five_labels_is_enough_for_a_category() -> None:
    truth = lex_truth()
    rules = TOPN.model_copy(update={"top_k": 1})
    mixed = perfect(truth, first="pot", second=0.9)
    assert values_of(rules, truth, mixed)["synonyms"] < values_of(TOPN, truth, mixed)["synonyms"] == 1.0


def test_labels_of_the_method_are_its_only_ones() -> None:
    truth = lex_truth()
    whole = perfect(truth)
    named = instances_with(truth.points, masks_of(whole), None, labels=labels_of(truth))
    assert values_of(TOPN, truth, named)["synonyms"] == 1.0
    wrong = instances_with(truth.points, masks_of(whole), None, labels=["pot"] * len(whole))
    assert values_of(TOPN, truth, wrong)["incorrect"] > 0.5


@pytest.mark.parametrize("rules", [TOPN, RANKING], ids=lambda rules: rules.name)
def test_a_partition_and_dense_features_score_as_the_same_instances(rules: Any) -> None:
    truth = lex_truth()
    whole = perfect(truth, first="pot", second=0.9)
    assert whole.features is not None
    owner = transfer.first_owner(transfer.masks_of(whole), len(truth.points))
    partition = Partition(truth.points, owner.astype(np.int32), whole.features)
    features = np.where(owner[:, None] >= 0, whole.features[owner], 0).astype(np.float16)
    expected = values_of(rules, truth, whole)
    assert values_of(rules, truth, partition) == expected
    assert values_of(rules, truth, DenseFeatures(truth.points, features)) == pytest.approx(expected, abs=1e-3)


def noisy(seed: int) -> Any:
    """Disjoint parts of the objects, each with a feature between its own words and others'."""
    rng = np.random.default_rng(seed)
    truth = lex_truth(seed)
    whole = perfect(truth)
    masks = [whole.mask(k)[rng.random(len(whole.mask(k))) < 0.7] for k in range(len(whole))]
    assert whole.features is not None
    return instances_with(truth.points, masks, whole.features + rng.random(whole.features.shape).astype(np.float32))


def test_cloud_is_downsampled_as_in_open3d() -> None:
    import open3d

    points = (np.random.default_rng(0).random((2000, 3)) - 0.37).astype(np.float32)
    theirs = open3d.t.geometry.PointCloud(points).voxel_down_sample(0.05).point.positions.numpy()
    assert len(theirs) < 1900
    assert sorted(voxel_means(points, 0.05).tolist()) == sorted(theirs.tolist())


def test_without_voxels_every_point_counts_separately() -> None:
    """A chair and a table one centimetre apart, and a map of both; in voxels of 5 cm they are merged."""
    points = np.array([[0.01, 0, 0], [0.02, 0, 0]], np.float32)
    truth = OpenLexTruth(points, np.array([7, 12]), OBJECTS, PROMPTS, "openlex3d-visible", "made for a test")
    features = np.stack([WordEncoder().feature({word: 1.0}) for word in ("chair", "table")])
    both = instances_with(points, [np.array([0]), np.array([1])], features)
    one_label = TOPN.model_copy(update={"top_k": 1})
    without = one_label.model_copy(update={"transfer": TOPN.transfer.model_copy(update={"evaluation_voxel_m": 0.0})})
    assert [values_of(rules, truth, both)["synonyms"] for rules in (one_label, without)] == [0.5, 1.0]
    assert values_of(without, truth, nothing_at(truth))["missing"] == 1.0


@pytest.mark.parametrize(("far_m", "is_missing"), [(0.0625, False), (0.063, True)])
def test_point_at_the_cap_has_the_label_of_its_nearest(far_m: float, is_missing: bool) -> None:
    at_cap = TOPN.model_copy(update={"transfer": TOPN.transfer.model_copy(update={"cap_m": 0.0625})})
    truth = OpenLexTruth(
        np.zeros((1, 3), np.float32), np.array([7]), OBJECTS, PROMPTS, "openlex3d-visible", "made for a test"
    )
    feature = WordEncoder().feature({"chair": 1.0})[None]
    found = instances_with(np.array([[far_m, 0, 0]], np.float32), [np.array([0])], feature)
    assert values_of(at_cap, truth, found)["missing"] == float(is_missing)


# ---- scenes together


# ---- warnings and errors


def test_points_in_several_instances_are_reported() -> None:
    truth = lex_truth()
    whole = perfect(truth)
    assert whole.features is not None
    features = np.vstack([whole.features, whole.features[:1]])
    twice = instances_with(truth.points, [*masks_of(whole), whole.mask(0)], features)
    result = score_scene(TOPN, truth, twice, ENCODER).warnings
    assert f"points in several instances, counted for the first of them: {len(whole.mask(0))}" in result


@pytest.mark.parametrize("rules", [TOPN, RANKING], ids=lambda rules: str(rules.name))
def test_ties_that_the_original_may_break_otherwise_are_counted(rules: Any) -> None:
    points = np.array([[-0.03125, 0, 0], [0.03125, 0, 0]], np.float32)
    middle = replace(lex_truth(), points=np.zeros((3, 3), np.float32), object_of_point=np.array([7, 7, -1]))
    differing = WordEncoder().feature({word: 1 - 0.01 * k for k, word in enumerate(PROMPTS)})
    for feature, owner, ties in (
        (differing, [0, 1], ["points as near to one object as to another: 2"]),
        (differing, [0, 0], []),
        (np.zeros_like(differing), [0, 0], ["objects with labels of equal cosine: 1"]),
    ):
        found = Partition(points, np.array(owner, np.int32), np.stack([feature, feature]))
        _, *warnings = score_scene(rules, middle, found, ENCODER).warnings  # the first is on the encoder
        assert warnings == [f"{tie}; the original may choose otherwise" for tie in ties]


def test_a_prediction_without_features_cannot_be_ranked() -> None:
    truth = lex_truth()
    named = instances_with(truth.points, masks_of(perfect(truth)), None, labels=labels_of(truth))
    assert kind_incompatibility(TOPN, named) is None
    reason = kind_incompatibility(RANKING, named)
    assert reason == "openlex3d-ranking: needs features to compare with texts, the prediction has none"
    with pytest.raises(PredictionError, match="needs features"):
        score_scene(RANKING, truth, named, ENCODER)
    with pytest.raises(PredictionError, match="needs features and an encoder"):
        score_scene(RANKING, truth, perfect(truth), None)


def test_inconsistent_openlex3d_ground_truth_is_refused() -> None:
    points = np.zeros((3, 3), np.float32)
    with pytest.raises(DataError, match="do not agree"):
        OpenLexTruth(points, np.zeros(2, np.int64), {}, PROMPTS, "v", "s")
    with pytest.raises(DataError, match="has no prompts"):
        OpenLexTruth(points, np.zeros(3, np.int64), {}, (), "v", "s")


def test_point_of_an_unknown_object_is_not_scored() -> None:
    assert openlex3d.distinct_pairs(np.array([-1, 0]), np.array([0, -1]))[2].tolist() == []
