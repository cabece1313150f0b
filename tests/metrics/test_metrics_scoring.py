"""A scene through score_scene: ceilings, floors, what changes nothing and what counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scored_room import (
    ID,
    INSTANCE,
    NAMES,
    ROOM,
    SEMANTIC,
    OneHotEncoder,
    headline,
    instances,
    room,
    truth_as_prediction,
)

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import DenseFeatures, Partition
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene


@pytest.mark.parametrize("name", [*SEMANTIC, *INSTANCE])
def test_the_truth_scores_one_where_faces_share_places(name: str) -> None:
    truth = room()
    twice = replace(
        truth,
        points=np.concatenate([truth.points, truth.points]),
        semantic=np.concatenate([truth.semantic, np.roll(truth.semantic, 150)]),
        instance=np.concatenate([truth.instance, np.roll(truth.instance, 150)]),
    )
    masks = [np.flatnonzero(twice.instance == i + 1) for i in range(len(NAMES))]
    names = [twice.labels.name_of(int(np.bincount(twice.semantic[m]).argmax())) for m in masks]
    assert set(headline(name, twice, instances(twice.points, masks, names))) == {1.0}


def test_a_map_on_other_points_reaches_the_truth_through_its_nearest_points() -> None:
    truth = room()
    moved = truth_as_prediction(truth, with_labels=True)
    shifted = replace(moved, points=truth.points + np.float32(0.001))
    for name in (*SEMANTIC, "rooms-instance"):
        assert min(headline(name, truth, shifted)) > 0.97


def test_a_mask_farther_than_the_cap_is_no_instance_but_still_names_points_for_conceptgraphs() -> None:
    truth = room()
    far = replace(truth_as_prediction(truth, with_labels=True), points=truth.points + np.array([0, 0, 50], np.float32))
    assert headline("rooms-instance", truth, far) == [0.0, 0.0, 0.0]
    assert headline("rooms-semantic", truth, far)[0] > 0.5


def test_background_points_of_the_map_keep_masks_from_growing_over_them() -> None:
    truth = room()
    background = truth.points[truth.semantic == ID["wall"]]
    chairs = np.flatnonzero(truth.instance == 2)
    points = (np.concatenate([truth.points[chairs], background]) + np.float32(0.001)).astype(np.float32)
    rules = load_protocol("rooms-instance")
    score = score_scene(rules, truth, instances(points, [np.arange(150)], ["chair"]), None)
    assert combine(rules, {"room": score}).per_class["chair"]["AP"] == 0.5


def test_a_partition_scores_as_the_same_instances() -> None:
    truth = room()
    whole = truth_as_prediction(truth, with_labels=False)
    assert whole.features is not None
    partition = Partition(truth.points, (truth.instance - 1).astype(np.int32), whole.features)
    for name in (*SEMANTIC, *INSTANCE):
        assert headline(name, truth, partition) == [1.0] * len(load_protocol(name).headline)


def test_a_partition_into_nothing_scores_zero_and_one_beyond_its_features_is_refused() -> None:
    truth = room()
    nowhere = np.full(len(truth.points), -1, np.int32)
    empty = Partition(truth.points, nowhere, np.zeros((0, OneHotEncoder().dim), np.float32))
    for name in (*SEMANTIC, *INSTANCE):
        assert headline(name, truth, empty) == [0.0] * len(load_protocol(name).headline)
    one = replace(empty, features=np.ones((1, OneHotEncoder().dim), np.float32))
    assert headline("rooms-instance", truth, one) == [0.0, 0.0, 0.0]
    with pytest.raises(PredictionError, match="needs one row of its 1 features a point, -1 for none"):
        headline("rooms-instance", truth, replace(one, instance=np.where(np.arange(len(nowhere)) == 5, 1, nowhere)))


def test_each_object_keeps_its_first_point_a_voxel_where_a_semantic_protocol_says_so() -> None:
    truth = room()
    chair, table = (truth.semantic[np.flatnonzero(truth.instance == k)[0]] for k in (2, 4))
    points = np.array([[0.0, 0, 0], [0.024, 0, 0], [0.03, 0, 0]], np.float32)  # the first two share a voxel of 0.025
    target, own = points[1:2] - np.float32(0.001), np.array([1], np.int32)
    scene = replace(truth, points=target, semantic=np.array([chair], np.int32), instance=own)
    features = np.stack([OneHotEncoder().feature(name) for name in ("chair", "table")])
    both = Partition(points, np.array([0, 0, 1], np.int32), features)
    assert chair != table
    rules = load_protocol("replica-openmask3d-semantic")
    whole = rules.model_copy(update={"transfer": rules.transfer.model_copy(update={"evaluation_voxel_m": 0.0})})
    recalls = [
        combine(one, {"room": score_scene(one, scene, both, OneHotEncoder())}).per_class["chair"]["recall"]
        for one in (whole, rules)
    ]
    assert recalls == [1.0, 0.0]  # the chair's second point is gone, and the table's is nearest


def test_dense_features_score_as_the_same_instances_under_a_semantic_protocol() -> None:
    truth = room()
    encoder = OneHotEncoder()
    dense = np.zeros((len(truth.points), encoder.dim), np.float16)
    for i, name in enumerate(NAMES):
        dense[truth.instance == i + 1] = encoder.feature(name)
    prediction = DenseFeatures(truth.points, dense)
    for name in SEMANTIC:
        assert headline(name, truth, prediction) == [1.0, 1.0]
    rules = load_protocol("rooms-instance")
    assert (
        kind_incompatibility(rules, prediction)
        == "rooms-instance: needs instances, and the method gives one feature a point"
    )
    with pytest.raises(PredictionError, match="needs instances"):
        score_scene(rules, truth, prediction, encoder)


def test_a_point_without_a_feature_takes_the_class_of_its_nearest_neighbour_with_one() -> None:
    truth = room()
    encoder = OneHotEncoder()
    dense = np.zeros((len(truth.points), encoder.dim), np.float16)
    chairs = np.flatnonzero(truth.instance == 2)
    dense[chairs[:10]] = encoder.feature("chair")
    rules = load_protocol("rooms-semantic")
    result = combine(rules, {"room": score_scene(rules, truth, DenseFeatures(truth.points, dense), encoder)})
    assert result.per_class["chair"]["recall"] == 1.0
    assert result.per_class["table"]["recall"] == 0.0


def test_the_scene_vocabulary_offers_only_classes_of_the_scene_and_the_full_one_all() -> None:
    truth = room()
    prediction = truth_as_prediction(truth, with_labels=False)
    sofa, table = OneHotEncoder().feature("sofa"), OneHotEncoder().feature("table")
    assert prediction.features is not None
    features = prediction.features.copy()
    features[3] = sofa + 0.1 * table  # a table that looks more like a sofa, and no sofa is there
    prediction = replace(prediction, features=features)
    assert headline("replica-mesh-ex6", truth, prediction) == [1.0, 1.0]
    assert headline("rooms-semantic", truth, prediction)[0] == pytest.approx(5 / 6)


def test_classes_outside_the_protocol_are_void_in_the_truth_and_dropped_in_the_prediction() -> None:
    truth = room()
    prediction = truth_as_prediction(truth, with_labels=True)
    rules = load_protocol("replica-openmask3d")
    result = combine(rules, {"room": score_scene(rules, truth, prediction, None)})
    assert "backpack" not in result.per_class
    assert result.metrics["AP"] == 1.0


def test_points_of_another_cloud_may_take_their_class_from_the_first_point_of_the_truth() -> None:
    rules = load_protocol("replica-conceptgraphs-ex6")
    chairs = np.flatnonzero(room().semantic == ID["chair"])
    first = replace(
        room(),
        points=room().points[chairs],
        semantic=room().semantic[chairs],
        instance=room().instance[chairs],
        variant="conceptgraphs",
        evaluation_points=room().points[chairs[:1]] + np.float32(0.001),
    )
    score = score_scene(rules, first, instances(first.points, [np.arange(5)], ["chair"]), None)
    assert combine(rules, {"room": score}).per_class["chair"]["recall"] == 1.0


def test_a_class_that_no_truth_has_takes_points_away_from_the_true_one() -> None:
    truth = room()
    table = np.flatnonzero(truth.semantic == ID["table"])
    prediction = instances(truth.points, [table[:75], table[75:]], ["table", "sofa"])
    score = score_scene(ROOM, truth, prediction, None)
    assert combine(ROOM, {"room": score}).per_class["table"]["recall"] == 0.5


def test_confidences_count_where_the_protocol_says_so_and_are_all_one_elsewhere() -> None:
    truth = room()
    lamp, book = np.flatnonzero(truth.instance == 5), np.flatnonzero(truth.instance == 7)

    def ap_of_lamp(name: str, *scores: float) -> float:
        rules = load_protocol(name)
        prediction = instances(truth.points, [lamp, book], ["lamp", "lamp"], scores=scores)
        return combine(rules, {"room": score_scene(rules, truth, prediction, None)}).per_class["lamp"]["AP"]

    assert ap_of_lamp("rooms-instance", 0.9, 0.1) == 1.0
    assert ap_of_lamp("rooms-instance", 0.1, 0.9) == 0.25
    assert ap_of_lamp("replica-openmask3d", 0.9, 0.1) == ap_of_lamp("replica-openmask3d", 0.1, 0.9) == 0.75


def test_a_semantic_protocol_with_a_cap_takes_farther_points_for_missing() -> None:
    rules = load_protocol("scannet-semantic")
    labels = LabelSet("scannet", tuple(c.id for c in rules.classes), tuple(c.name for c in rules.classes))
    points = np.random.default_rng(0).random((200, 3)).astype(np.float32)
    semantic = np.repeat([5, 7], 100).astype(np.int32)
    truth = GroundTruth(points, semantic, semantic, labels, "nyu40-vertices", "made for a test")
    for offset, value in ((0.04, 1.0), (0.06, 0.0)):
        moved = points[:1] + np.array([offset, 0, 0], np.float32)
        alone = replace(truth, points=points[:1], semantic=semantic[:1], instance=semantic[:1])
        score = score_scene(rules, alone, instances(moved, [np.arange(1)], ["chair"]), None)
        per_class = combine(rules, {"a": score}).per_class
        assert per_class["chair"]["recall"] == value
        assert all(np.isnan(row["IoU"]) for name, row in per_class.items() if name != "chair")  # nothing is called so
    assert headline("scannet-semantic", truth, truth_as_prediction(truth, with_labels=True)) == [1.0, 1.0, 1.0]


def test_where_two_objects_have_a_point_in_one_place_the_first_names_it() -> None:
    truth = room()
    chairs = np.flatnonzero(truth.semantic == ID["chair"])
    place = np.repeat(truth.points[chairs[:1]], 40, axis=0) + np.float32(0.01)
    masks = [np.arange(20, 40), np.arange(20)]  # the first object holds the later points of the map
    for names, recall in ((("chair", "table"), 1.0), (("table", "chair"), 0.0)):
        score = score_scene(ROOM, truth, instances(place, masks, names), None)
        assert combine(ROOM, {"room": score}).per_class["chair"]["recall"] == recall


# ---- labels for some


def test_a_background_object_with_a_label_counts_only_where_its_class_is_scored() -> None:
    """ConceptGraphs' evaluation: with 1 excluded class background has its own name, with 6 it is not loaded."""
    truth = replace(room(), variant="conceptgraphs")
    masks = [np.flatnonzero(truth.instance == 2).astype(np.int32), np.flatnonzero(truth.instance == 1).astype(np.int32)]
    features = np.stack([OneHotEncoder().feature("chair"), OneHotEncoder().feature("lamp")])
    prediction = instances(truth.points, masks, ["", "wall"], features)
    encoder = OneHotEncoder()
    scored = {n: score_scene(load_protocol(f"replica-conceptgraphs-ex{n}"), truth, prediction, encoder) for n in (1, 6)}
    with_wall, without = (combine(load_protocol(f"replica-conceptgraphs-ex{n}"), {"a": scored[n]}) for n in (1, 6))
    assert with_wall.per_class["wall"]["recall"] == 1.0 and with_wall.per_class["chair"]["recall"] > 0
    assert "wall" not in {name for name, row in without.per_class.items() if row["recall"] > 0}
    only_chair = instances(truth.points, masks[:1], None, features[:1])
    alone = score_scene(load_protocol("replica-conceptgraphs-ex6"), truth, only_chair, encoder)
    np.testing.assert_array_equal(scored[6].counts.confusion, alone.counts.confusion)  # type: ignore[attr-defined]
