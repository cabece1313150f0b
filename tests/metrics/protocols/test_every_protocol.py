"""What holds under every protocol: the truth scores 1, an empty map 0, order is nothing, parts come to the whole."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import open_scene
import pytest
import scored_room

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import GroundTruth, ObjectBoxes, OrientedBox
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.open_vocabulary.score import QueryTruth
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.presence import SAMPLINGS
from su3d_bench.metrics.questions.score import PresenceQuery, PresenceTruth, RetrievalTruth, TextTarget
from su3d_bench.metrics.scoring import combine, metric_of, pack_scores, score_scene, unpack_scores

OF_ROOMS = (
    "rooms-semantic", "replica-mesh-ex6", "replica-openmask3d-semantic", "replica-hovsg", "replica-hovsg-exact",
    "replica-ovo51", "rooms-top-k", "rooms-instance", "replica-openmask3d", "rooms-panoptic", "rooms-relations",
)  # fmt: skip
OF_TEXTS = ("openlex3d-topn", "openlex3d-ranking", "query-ap", "openlex3d-queries")
OF_QUESTIONS = ("rooms-presence", "rooms-retrieval")
NAMES = (*OF_ROOMS, "replica-boxes", *OF_TEXTS, *OF_QUESTIONS)
ANSWERS = {"chair": (2,), "lamp": (5,), "table": (4,)}  # of two chairs the one that is ranked first
# what an empty map scores beside 0: where nothing is said to be there, half is right by chance
EMPTY = {
    "openlex3d-topn": {"missing": 1.0},
    "rooms-presence": {f"AUROC {sampling}": 0.5 for sampling in SAMPLINGS},
    "replica-boxes": {"class": np.nan},
}
PERFECT = {"openlex3d-topn": {"synonyms": 1.0}}
# where perfect masks of objects that meet, or of queries for several objects, need not reach 1
WITHOUT_CEILING = {"openlex3d-queries", "query-ap"}


def truth_of(name: str, seed: int) -> Any:
    rules = load_protocol(name)
    if name in OF_TEXTS:
        is_lex = rules.kind == "categories"
        made = open_scene.lex_truth(seed) if is_lex else open_scene.query_truth(seed)
        return replace(made, variant=rules.ground_truth, space=rules.label_space)
    truth = scored_room.room(seed, n_each=150 + 25 * (seed % 3))
    if rules.kind == "presence":
        asked = [(text, True) for text in ANSWERS] + [(text, False) for text in ("bed", "sofa", "toilet")]
        things = [PresenceQuery(text, sampling, is_there=there) for sampling in SAMPLINGS for text, there in asked]
        return PresenceTruth(truth, tuple(things), "made for a test")
    if rules.kind == "retrieval":
        kinds = rules.headline[:-1]  # the last is of all
        return RetrievalTruth(truth, tuple(TextTarget(kind, *answer) for kind in kinds for answer in ANSWERS.items()))
    if rules.kind == "boxes":
        ends = [[truth.points[truth.instance == k].min(axis=0), truth.points[truth.instance == k].max(axis=0)]
                for k in range(1, 9)]  # fmt: skip
        boxes = {k: OrientedBox((low + high) / 2, high - low, np.eye(3)) for k, (low, high) in enumerate(ends, 1)}
        classes = {k: scored_room.ID[name] for k, name in enumerate(scored_room.NAMES, 1)}
        return replace(truth, variant="boxes", boxes=ObjectBoxes(boxes, classes, truth.labels))
    is_known = np.isin(truth.semantic, [entry.id for entry in rules.classes])
    semantic, instance = (np.where(is_known, array, 0).astype(np.int32) for array in (truth.semantic, truth.instance))
    points = truth.points.copy()
    if rules.kind == "relations":  # the lamp on the table, or nothing is related
        points[truth.instance == 5] += np.array([-1, 0, 0.81], np.float32)
    return replace(truth, points=points, semantic=semantic, instance=instance, variant=rules.ground_truth)


def encoder_of(name: str) -> Any:
    return open_scene.ENCODER if name in OF_TEXTS else scored_room.ENCODER


def perfect(truth: Any, *, with_labels: bool = False) -> Instances:
    if isinstance(truth, PresenceTruth | RetrievalTruth):
        return scored_room.truth_as_prediction(truth.scene, with_labels=False)  # texts are held against features alone
    if isinstance(truth, GroundTruth):
        return scored_room.truth_as_prediction(truth, with_labels=with_labels)
    return open_scene.perfect(truth)


def noisy(truth: Any, seed: int) -> Instances:
    """Parts of the objects, each with a feature between its own and others, the second with that of the last."""
    rng = np.random.default_rng(seed)
    whole = perfect(truth)
    assert whole.features is not None
    masks = [whole.mask(k)[rng.random(len(whole.mask(k))) < rng.uniform(0.4, 1)] for k in range(len(whole))]
    features = whole.features + 0.7 * rng.random(whole.features.shape).astype(np.float32)
    features[1] = features[-1]
    return scored_room.instances(whole.points, masks, None, features, scores=list(rng.random(len(masks))))


def values(name: str, truth: Any, prediction: Instances) -> dict[str, float]:
    rules = load_protocol(name)
    found = combine(rules, {"a": score_scene(rules, truth, prediction, encoder_of(name))}).metrics
    return {value: found[value] for value in rules.headline}


@cache
def scores_of(name: str) -> dict[str, SceneScore]:
    """The scores of four noisy scenes."""
    truths = {f"scene {seed}": truth_of(name, seed) for seed in range(4)}
    rules, encoder = load_protocol(name), encoder_of(name)
    return {
        scene: score_scene(rules, truth, noisy(truth, seed), encoder)
        for seed, (scene, truth) in enumerate(truths.items())
    }


@pytest.mark.parametrize("name", NAMES)
def test_the_truth_scores_one_and_an_empty_map_nothing(name: str) -> None:
    truth = truth_of(name, 0)
    nothing = scored_room.instances(perfect(truth).points, [], None)
    headline = load_protocol(name).headline
    expected = dict.fromkeys(headline, 0.0) | EMPTY.get(name, {})
    assert values(name, truth, nothing) == pytest.approx(expected, abs=0, nan_ok=True)
    if name not in WITHOUT_CEILING:
        expected = dict.fromkeys(headline, 0.0) | PERFECT[name] if name in PERFECT else dict.fromkeys(headline, 1.0)
        assert values(name, truth, perfect(truth)) == expected
        assert values(name, truth, perfect(truth, with_labels=True)) == expected


def renumbered(truth: Any) -> Any:
    """The same truth with other numbers of objects, and its queries the other way round."""
    if isinstance(truth, PresenceTruth | RetrievalTruth):
        asked: Any = truth.asked[::-1]
        return replace(truth, asked=asked)
    if isinstance(truth, GroundTruth):
        boxes = truth.boxes and ObjectBoxes(
            {9 - k: box for k, box in truth.boxes.boxes.items()},
            {9 - k: one for k, one in truth.boxes.class_of_instance.items()}, truth.labels,
        )  # fmt: skip
        number = np.where(truth.instance > 0, 9 - truth.instance, 0).astype(np.int32)
        return replace(truth, instance=number, boxes=boxes)
    new = {one: 500 - one for one in (*open_scene.OBJECTS, 999)} | {-1: -1}
    truth = replace(truth, object_of_point=np.array([new[int(one)] for one in truth.object_of_point]))
    if isinstance(truth, QueryTruth):
        queries = [replace(one, object_ids=tuple(new[k] for k in one.object_ids)) for one in truth.queries]
        return replace(truth, queries=tuple(queries[::-1]))
    near = {new[one]: replace(of, clutter=tuple(new[k] for k in of.clutter)) for one, of in truth.objects.items()}
    return replace(truth, objects=near)


@pytest.mark.parametrize("name", NAMES)
def test_the_order_of_instances_and_the_numbers_of_objects_change_nothing(name: str) -> None:
    truth = truth_of(name, 3)
    prediction = noisy(truth, 3)
    order = np.random.default_rng(0).permutation(len(prediction))
    assert prediction.features is not None
    masks, scores = [prediction.mask(k) for k in order], prediction.scores[order].tolist()
    shuffled = scored_room.instances(prediction.points, masks, None, prediction.features[order], scores)
    before = values(name, truth, prediction)
    assert any(0 < value < 1 for value in before.values())
    after = values(name, renumbered(truth), shuffled)
    # AP25 may depend on the order of masks, as ScanNet's does
    assert {key: value for key, value in after.items() if key != "AP25"} == pytest.approx(
        {key: value for key, value in before.items() if key != "AP25"}, rel=1e-12
    )


@pytest.mark.parametrize("name", NAMES)
def test_scenes_come_to_the_same_from_their_files_and_in_whatever_order(name: str) -> None:
    rules, scores = load_protocol(name), scores_of(name)
    stored = {scene: unpack_scores(pack_scores({name: score}))[name] for scene, score in reversed(scores.items())}
    assert json.dumps(combine(rules, stored).to_json()) == json.dumps(combine(rules, scores).to_json())


@pytest.mark.parametrize("name", NAMES)
def test_scenes_drawn_several_times_count_as_so_many_scenes(name: str) -> None:
    metric, counts = metric_of(load_protocol(name)), [score.counts for score in scores_of(name).values()]
    weights = np.array([[1, 1, 1, 1], [0, 2, 1, 0], [0, 0, 0, 1]])
    drawn, classes = metric.resampled(counts, weights), metric.resampled_classes(counts, weights)
    for row, n_times in enumerate(weights):
        pooled = metric.pooled([one for one, n in zip(counts, n_times, strict=True) for _ in range(n)])
        assert {key: value[row] for key, value in drawn.items()} == pytest.approx(
            {key: pooled.values[key] for key in drawn}, rel=1e-9, nan_ok=True
        )
        for of_class, columns in classes.items():
            known = pooled.classes.get(of_class, {})
            known = {key: known.get(key, np.nan) for key in columns}
            assert {key: column[row] for key, column in columns.items()} == pytest.approx(known, rel=1e-9, nan_ok=True)
