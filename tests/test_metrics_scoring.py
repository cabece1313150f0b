"""A scene through score_scene and combine: ceilings, floors, what changes nothing, and what a reader is told."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from su3d_bench.errors import DataError, PredictionError
from su3d_bench.protocols import ProtocolRules, load_protocol
from su3d_bench.scoring import SceneScore, combine, pack_scores, score_scene, unpack_scores, why_not_scorable
from su3d_bench.types import (
    DenseFeatures,
    Encoder,
    Float32Array,
    GroundTruth,
    Instances,
    LabelSet,
    Partition,
    Prediction,
    UInt8Array,
)

SEMANTIC = ("rooms-semantic", "replica-mesh-ex6")
INSTANCE = ("rooms-instance", "replica-openmask3d")
ROOM = load_protocol("rooms-semantic")
LABELS = LabelSet("replica", tuple(c.id for c in ROOM.classes), tuple(c.name for c in ROOM.classes))
ID = {entry.name: entry.id for entry in ROOM.classes}


@dataclass
class OneHotEncoder:
    """Each known class name has an axis of its own: a prompt points along the axis of the longest name in it."""

    name: str = "one-hot"
    digest: str = "one-hot"
    dim: int = len(LABELS.names) + 1

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("scoring looks at no image")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.stack([self.feature(text) for text in texts])

    def feature(self, text: str) -> Float32Array:
        inside = [name for name in LABELS.names if name in text]
        axis = LABELS.names.index(max(inside, key=len)) if inside else self.dim - 1
        direction = np.zeros(self.dim, np.float32)
        direction[axis] = 1
        return direction


ENCODER: Encoder = OneHotEncoder()
NAMES = ("wall", "chair", "chair", "table", "lamp", "cushion", "book", "backpack")


def room(seed: int = 0, n_each: int = 150) -> GroundTruth:
    """Eight objects in a row, each a cloud of points of its own, and some points that nobody annotated."""
    rng = np.random.default_rng(seed)
    points = np.concatenate(
        [rng.random((n_each, 3)) * [0.8, 0.8, 0.8] + [i, 0, 0] for i in range(len(NAMES))] + [rng.random((20, 3)) - 2]
    ).astype(np.float32)
    semantic = np.concatenate([np.full(n_each, ID[name]) for name in NAMES] + [np.zeros(20)]).astype(np.int32)
    instance = np.concatenate([np.full(n_each, i + 1) for i in range(len(NAMES))] + [np.zeros(20)]).astype(np.int32)
    return GroundTruth(points, semantic, instance, LABELS, "mesh-vertices", "made for a test")


def instances(
    points: Float32Array,
    masks: Sequence[np.ndarray],
    labels: Sequence[str] | None,
    features: Float32Array | None = None,
    scores: Sequence[float] | None = None,
) -> Instances:
    k = len(masks)
    return Instances(
        points=points,
        indptr=np.concatenate([[0], np.cumsum([len(m) for m in masks])]).astype(np.int64),
        indices=np.concatenate([np.zeros(0, np.int32), *masks]).astype(np.int32),
        scores=np.linspace(0.9, 0.5, k) if scores is None else np.array(scores, np.float64),
        features=features,
        labels=None if labels is None else tuple(labels),
        names=("",) * k,
        captions=("",) * k,
        boxes=np.zeros((k, 2, 3), np.float32),
        centroids=np.zeros((k, 3), np.float32),
        view_indptr=np.zeros(k + 1, np.int64),
        views=np.zeros((0, 2), np.int32),
    )


def truth_as_prediction(truth: GroundTruth, *, with_labels: bool) -> Instances:
    ids = [int(i) for i in np.unique(truth.instance) if i]
    names = [truth.labels.name_of(int(truth.semantic[truth.instance == i][0])) for i in ids]
    features = None if with_labels else np.stack([OneHotEncoder().feature(name) for name in names])
    masks = [np.flatnonzero(truth.instance == i) for i in ids]
    return instances(truth.points, masks, names if with_labels else None, features)


def nothing(truth: GroundTruth) -> Instances:
    return instances(truth.points, [], None)


def headline(name: str, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None = ENCODER) -> list[float]:
    rules = load_protocol(name)
    result = combine(rules, {"room": score_scene(rules, truth, prediction, encoder)})
    return [result.metrics[key] for key in rules.headline]


@pytest.mark.parametrize("with_labels", [True, False])
@pytest.mark.parametrize("name", [*SEMANTIC, *INSTANCE])
def test_the_truth_on_its_own_points_scores_exactly_one(name: str, with_labels: bool) -> None:
    truth = room()
    assert set(headline(name, truth, truth_as_prediction(truth, with_labels=with_labels))) == {1.0}


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


@pytest.mark.parametrize("name", [*SEMANTIC, *INSTANCE])
def test_an_empty_prediction_scores_exactly_zero(name: str) -> None:
    assert set(headline(name, room(), nothing(room()))) == {0.0}


@pytest.mark.parametrize("name", [*SEMANTIC, *INSTANCE])
def test_shuffled_instance_ids_and_instance_order_change_nothing(name: str) -> None:
    truth = room()
    prediction = truth_as_prediction(truth, with_labels=True)
    rng = np.random.default_rng(4)
    masks = [prediction.mask(k)[rng.random(150) < 0.8] for k in range(len(prediction))]
    labels = ["table" if k == 4 else label for k, label in enumerate(prediction.labels or ())]
    scores = rng.random(len(masks))
    before = headline(name, truth, instances(truth.points, masks, labels, scores=list(scores)))
    order = rng.permutation(len(masks))
    shuffled = instances(
        truth.points, [masks[k] for k in order], [labels[k] for k in order], scores=[scores[k] for k in order]
    )
    renamed = replace(truth, instance=np.where(truth.instance > 0, (truth.instance * 7) % 10 + 100, 0).astype(np.int32))
    assert 0 < before[0] < 1
    assert headline(name, renamed, shuffled) == before


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
        why_not_scorable(rules, prediction)
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


def test_points_of_another_cloud_are_labelled_by_their_nearest_truth_point() -> None:
    rules = load_protocol("replica-conceptgraphs-ex6")
    truth = replace(room(), variant="conceptgraphs", evaluation_points=room().points + np.float32(0.001))
    score = score_scene(rules, truth, truth_as_prediction(room(), with_labels=True), None)
    assert combine(rules, {"room": score}).metrics == {**combine(rules, {"room": score}).metrics, "mAcc": 1.0}


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
        assert combine(rules, {"a": score}).per_class["chair"]["recall"] == value
    assert headline("scannet-semantic", truth, truth_as_prediction(truth, with_labels=True)) == [1.0, 1.0, 1.0]


def test_where_two_objects_have_a_point_in_one_place_the_first_names_it() -> None:
    truth = room()
    chairs = np.flatnonzero(truth.semantic == ID["chair"])
    place = np.repeat(truth.points[chairs[:1]], 40, axis=0) + np.float32(0.01)
    masks = [np.arange(20, 40), np.arange(20)]  # the first object holds the later points of the map
    for names, recall in ((("chair", "table"), 1.0), (("table", "chair"), 0.0)):
        score = score_scene(ROOM, truth, instances(place, masks, names), None)
        assert combine(ROOM, {"room": score}).per_class["chair"]["recall"] == recall


# ---- several scenes


def noisy(seed: int) -> tuple[GroundTruth, Instances]:
    rng = np.random.default_rng(seed)
    truth = room(seed, n_each=150 + 25 * (seed % 3))
    whole = truth_as_prediction(truth, with_labels=True)
    masks = [whole.mask(k)[rng.random(len(whole.mask(k))) < rng.uniform(0.4, 1)] for k in range(len(whole))]
    labels = [str(rng.choice(NAMES)) if rng.random() < 0.3 else name for name in NAMES]
    return truth, instances(truth.points, masks, labels, scores=list(rng.integers(1, 5, len(masks)) / 5))


def noisy_scores(name: str, n_scenes: int) -> dict[str, SceneScore]:
    rules = load_protocol(name)
    return {f"rooms/{seed}": score_scene(rules, *noisy(seed), None) for seed in range(n_scenes)}


@settings(max_examples=20, deadline=None)
@given(order=st.permutations(range(5)), name=st.sampled_from([*SEMANTIC, *INSTANCE]))
def test_the_order_of_scenes_changes_no_bit(order: list[int], name: str) -> None:
    scores = noisy_scores(name, 5)
    rules = load_protocol(name)
    shuffled = {f"rooms/{seed}": scores[f"rooms/{seed}"] for seed in order}
    assert json.dumps(combine(rules, shuffled).to_json()) == json.dumps(combine(rules, scores).to_json())


@settings(max_examples=20, deadline=None)
@given(seeds=st.sets(st.integers(0, 7), min_size=1), name=st.sampled_from([*SEMANTIC, *INSTANCE]))
def test_a_subset_of_scenes_is_scored_from_counts_alone(seeds: set[int], name: str) -> None:
    rules = load_protocol(name)
    packed = {scene: pack_scores({name: score}) for scene, score in noisy_scores(name, 8).items()}
    chosen = {f"rooms/{seed}": unpack_scores(packed[f"rooms/{seed}"])[name] for seed in seeds}
    fresh = {f"rooms/{seed}": score_scene(rules, *noisy(seed), None) for seed in seeds}
    assert combine(rules, chosen).to_json() == combine(rules, fresh).to_json()


@pytest.mark.parametrize("name", [*SEMANTIC, *INSTANCE])
def test_pooled_values_differ_from_the_mean_of_the_scenes(name: str) -> None:
    result = combine(load_protocol(name), noisy_scores(name, 5))
    key = result.headline[0]
    assert result.pooled[key] != result.scene_mean[key]
    assert result.scene_mean[key] == pytest.approx(np.mean([row[key] for row in result.per_scene.values()]))
    assert result.metrics == result.pooled


@pytest.mark.parametrize("name", [*SEMANTIC, *INSTANCE])
def test_the_interval_surrounds_the_value_and_is_the_same_every_time(name: str) -> None:
    rules = load_protocol(name)
    first, second = combine(rules, noisy_scores(name, 5)), combine(rules, noisy_scores(name, 5))
    assert first.intervals == second.intervals
    for key in rules.headline:
        interval = first.intervals[key]
        assert interval is not None
        assert interval[0] <= first.metrics[key] <= interval[1]
        assert interval[0] < interval[1]


def test_a_single_scene_has_no_interval() -> None:
    assert combine(ROOM, noisy_scores("rooms-semantic", 1)).intervals == {"mAcc": None, "F-mIoU": None}


def test_a_protocol_may_report_the_mean_of_the_scenes() -> None:
    rules = ROOM.model_copy(update={"aggregate": "scene-mean"})
    result = combine(rules, noisy_scores("rooms-semantic", 5))
    interval = result.intervals["mAcc"]
    assert result.metrics == result.scene_mean
    assert interval is not None
    assert interval[0] < result.metrics["mAcc"] < interval[1]


def test_groups_are_averaged_over_the_classes_that_have_ground_truth() -> None:
    classes = [entry.model_copy(update={"group": "head"}) if entry.name == "chair" else entry for entry in ROOM.classes]
    rules = load_protocol("rooms-instance").model_copy(update={"classes": tuple(classes)})
    result = combine(rules, noisy_scores("rooms-instance", 3))
    assert result.groups == {"head": result.per_class["chair"]}


# ---- what a reader is told


def warnings_of(name: str, prediction: Prediction, encoder: Encoder | None = None) -> str:
    rules = load_protocol(name)
    return "\n".join(combine(rules, {"rooms/a": score_scene(rules, room(), prediction, encoder)}).warnings)


def test_a_perfect_prediction_warns_of_nothing() -> None:
    for name in (*SEMANTIC, "rooms-instance"):
        assert warnings_of(name, truth_as_prediction(room(), with_labels=True)) == ""


def test_constant_confidences_are_told() -> None:
    prediction = replace(truth_as_prediction(room(), with_labels=True), scores=np.full(8, 0.5))
    told = warnings_of("rooms-instance", prediction)
    assert told == "rooms/a: all 8 confidences are 0.5: AP of a class is then recall (1 + precision) / 2"


def test_duplicates_are_told() -> None:
    truth = room()
    chairs = np.flatnonzero(truth.instance == 2)
    told = warnings_of("rooms-instance", instances(truth.points, [chairs, chairs[5:]], ["chair", "table"]))
    assert told == (
        "rooms/a: 1 pair of predictions overlaps with IoU above 0.9 (first 0 and 1); duplicates can raise or lower AP"
    )


def test_another_encoder_than_the_protocols_is_told() -> None:
    told = warnings_of("replica-mesh-ex6", truth_as_prediction(room(), with_labels=False), ENCODER)
    assert told == ("rooms/a: labels come from the encoder 'one-hot', the protocol's is 'ViT-H-14/laion2b_s32b_b79k'")
    assert warnings_of("rooms-semantic", truth_as_prediction(room(), with_labels=False), ENCODER) == ""


def test_what_every_scene_warns_of_is_told_once() -> None:
    rules = load_protocol("replica-mesh-ex6")
    score = score_scene(rules, room(), truth_as_prediction(room(), with_labels=False), ENCODER)
    assert len(combine(rules, {"a": score, "b": score, "c": score}).warnings) == 1


def test_a_class_of_the_truth_without_scored_points_is_told_and_counts_zero_in_its_scene_alone() -> None:
    rules = load_protocol("replica-conceptgraphs-ex6")
    points = room().points[room().semantic != ID["lamp"]]
    truth = replace(room(), variant="conceptgraphs", evaluation_points=points)
    score = score_scene(rules, truth, truth_as_prediction(room(), with_labels=True), None)
    result = combine(rules, {"a": score})
    assert result.warnings == (
        "a: the ground truth has 'lamp', but no scored point does; such a class counts 0 in this scene",
    )
    assert result.per_scene["a"]["mAcc"] == 4 / 5
    assert result.pooled["mAcc"] == 1.0


def test_a_class_with_small_instances_only_is_told() -> None:
    truth = room(n_each=99)
    rules = load_protocol("rooms-instance")
    result = combine(rules, {"a": score_scene(rules, truth, truth_as_prediction(truth, with_labels=True), None)})
    assert np.isnan(result.metrics["AP"])
    assert result.warnings == (
        "not scored, because no scene has an instance of 100 points: "
        "'backpack', 'book', 'chair', 'cushion', 'lamp', 'table'",
    )


@pytest.mark.parametrize("name", [*SEMANTIC, "rooms-instance"])
def test_coverage_is_the_share_of_scored_points_without_a_predicted_point_that_near(name: str) -> None:
    truth = room()
    rules = load_protocol(name)
    half = [k for k in range(8) if k != 4]  # the lamp is missing; the nearest object is 20 cm or more away
    whole = truth_as_prediction(truth, with_labels=True)
    prediction = instances(truth.points, [whole.mask(k) for k in half], [NAMES[k] for k in half])
    coverage = combine(rules, {"a": score_scene(rules, truth, prediction, None)}).coverage
    n_scored = 6 if name == "replica-mesh-ex6" else 7
    assert coverage == {"0.025": 1 / n_scored, "0.05": 1 / n_scored, "0.1": 1 / n_scored}


def test_the_number_of_predictions_is_reported() -> None:
    result = combine(ROOM, noisy_scores("rooms-semantic", 2))
    assert result.n_predictions == {"rooms/0": 8, "rooms/1": 8}


# ---- bytes


def test_equal_scores_pack_to_equal_bytes_at_any_time(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = {name: score_scene(load_protocol(name), *noisy(0), None) for name in (*SEMANTIC, *INSTANCE)}
    first = pack_scores(scores)
    monkeypatch.setattr(time, "time", lambda: 2e9)
    assert pack_scores(dict(reversed(scores.items()))) == first


def test_packed_scores_hold_no_pickle_and_come_back_whole() -> None:
    scores = {name: score_scene(load_protocol(name), *noisy(0), None) for name in (*SEMANTIC, *INSTANCE)}
    data = pack_scores(scores)
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        assert all(archive[key].dtype != object for key in archive.files)
    assert pack_scores(unpack_scores(data)) == data


@pytest.mark.parametrize("cut", [0, 10, 500])
def test_damaged_counts_are_a_data_error(cut: int) -> None:
    data = pack_scores({"rooms-semantic": score_scene(ROOM, *noisy(0), None)})
    with pytest.raises(DataError, match="counts: are damaged"):
        unpack_scores(data[:cut])


def test_a_result_has_no_nan_in_its_json() -> None:
    result = combine(load_protocol("rooms-instance"), noisy_scores("rooms-instance", 2))
    text = json.dumps(result.to_json(), allow_nan=False)
    assert '"sofa": {"AP": null' in text


# ---- what cannot be scored


def test_a_prediction_without_labels_and_features_is_refused() -> None:
    prediction = replace(truth_as_prediction(room(), with_labels=True), labels=None)
    with pytest.raises(PredictionError, match="neither labels nor features"):
        score_scene(ROOM, room(), prediction, ENCODER)


def test_features_without_an_encoder_are_refused() -> None:
    with pytest.raises(PredictionError, match="no encoder"):
        score_scene(ROOM, room(), truth_as_prediction(room(), with_labels=False), None)


def test_features_of_another_encoder_are_refused() -> None:
    prediction = replace(truth_as_prediction(room(), with_labels=False), features=np.ones((8, 3), np.float32))
    with pytest.raises(PredictionError, match="features have 3 dimensions, the encoder 'one-hot' has 70"):
        score_scene(ROOM, room(), prediction, ENCODER)


@pytest.mark.parametrize("name", ["rooms-semantic", "rooms-instance", "replica-openmask3d"])
def test_a_confidence_that_is_no_number_is_refused(name: str) -> None:
    scores = np.full(8, 0.5)
    scores[3] = np.nan
    prediction = replace(truth_as_prediction(room(), with_labels=True), scores=scores)
    with pytest.raises(PredictionError, match="instance 3 has the confidence nan"):
        score_scene(load_protocol(name), room(), prediction, None)


def test_points_that_are_no_numbers_are_refused() -> None:
    points = room().points.copy()
    points[7, 1] = np.nan
    with pytest.raises(PredictionError, match="not finite"):
        score_scene(ROOM, room(), replace(truth_as_prediction(room(), with_labels=True), points=points), None)


def test_a_truth_of_another_kind_is_refused() -> None:
    prediction = truth_as_prediction(room(), with_labels=True)
    with pytest.raises(DataError, match="scores the truth 'mesh-vertices', this one is 'face-corners'"):
        score_scene(ROOM, replace(room(), variant="face-corners"), prediction, None)
    scannet = replace(room(), labels=LabelSet("scannet", (5,), ("chair",)))
    with pytest.raises(DataError, match="scores the label space 'replica', the truth has 'scannet'"):
        score_scene(ROOM, scannet, prediction, None)


def test_scores_of_another_version_are_refused() -> None:
    score = score_scene(ROOM, *noisy(0), None)
    newer: ProtocolRules = ROOM.model_copy(update={"version": ROOM.version + 1})
    with pytest.raises(
        DataError, match="rooms/a: was scored under rooms-semantic version 1, not rooms-semantic version 2; score"
    ):
        combine(newer, {"rooms/a": score})
    with pytest.raises(DataError, match="no scene was scored"):
        combine(ROOM, {})


def test_an_instance_id_that_spills_into_the_next_class_is_refused() -> None:
    truth = replace(room(), instance=np.where(room().instance == 2, 1000, room().instance).astype(np.int32))
    with pytest.raises(DataError, match="instance id 1000 would spill into the next class"):
        score_scene(load_protocol("rooms-instance"), truth, truth_as_prediction(room(), with_labels=True), None)
