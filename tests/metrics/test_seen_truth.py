"""The ground truth restricted to seen points, and areas under curves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scored_room import headline, room, truth_as_prediction

from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectLabels, OpenLexTruth
from su3d_bench.metrics.open_vocabulary.score import QueryTruth, TextQuery
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.score import AnnotationTruth, RetrievalTruth, TextTarget
from su3d_bench.metrics.seen import area_under, clouds_of, reason_against, restricted

POINTS = np.arange(18, dtype=np.float32).reshape(6, 3)
TRUTH = GroundTruth(
    POINTS,
    np.array([3, 3, 7, 7, 0, 7], np.int32),
    np.array([5, 5, 9, 9, 0, 2], np.int32),
    LabelSet("mine", (3, 7), ("chair", "table")),
    "mesh-vertices",
    "by hand",
    every_semantic=np.array([[3], [3], [7], [7], [0], [7]], np.int32),
)
SEEN = np.array([True, False, False, False, True, True])


def test_only_seen_points_stay_and_objects_keep_their_ids() -> None:
    left = restricted(TRUTH, [SEEN])
    assert isinstance(left, GroundTruth) and left.every_semantic is not None
    np.testing.assert_array_equal(left.points, POINTS[[0, 4, 5]])
    assert (left.semantic.tolist(), left.instance.tolist()) == ([3, 0, 7], [5, 0, 2])
    assert left.every_semantic.tolist() == [[3], [0], [7]] and left.labels == TRUTH.labels


def test_evaluation_points_are_restricted_on_their_own() -> None:
    truth = replace(TRUTH, evaluation_points=POINTS[:2] + 1)
    assert [len(cloud) for cloud in clouds_of(truth)] == [6, 2]
    left = restricted(truth, [SEEN, np.array([False, True])])
    assert isinstance(left, GroundTruth) and left.evaluation_points is not None
    np.testing.assert_array_equal(left.evaluation_points, POINTS[1:2] + 1)


def test_texts_ask_for_seen_objects_only() -> None:
    asked = tuple(TextTarget("instance", text, answers, 0.5, 0.5) for text, answers in (("a", (5, 9)), ("b", (9,))))
    left = restricted(RetrievalTruth(TRUTH, asked), [SEEN])
    assert isinstance(left, RetrievalTruth) and left.scene.instance.tolist() == [5, 0, 2]
    assert [(one.text, one.answers) for one in left.asked] == [("a", (5,))]
    owner = np.array([5, 5, 9, 9, -1, 2], np.int64)
    queries = QueryTruth(POINTS, owner, (TextQuery("a", (5, 9)), TextQuery("b", (9,))), "v", "by hand")
    some = restricted(queries, [SEEN])
    assert isinstance(some, QueryTruth) and some.object_of_point.tolist() == [5, -1, 2]
    assert some.queries == (TextQuery("a", (5,)),)


def test_names_are_judged_for_seen_objects_only() -> None:
    named = AnnotationTruth(TRUTH, (2, 5, 9), lambda label, key: True, lambda instances: None)
    left = restricted(named, [SEEN])
    assert isinstance(left, AnnotationTruth) and left.object_ids == (2, 5)
    labels = {key: ObjectLabels(("chair",)) for key in (5, 9)}
    lexical = OpenLexTruth(POINTS, np.array([5, 5, 9, 9, -1, 5], np.int64), labels, ("chair",), "v", "by hand")
    some = restricted(lexical, [SEEN])
    assert isinstance(some, OpenLexTruth) and list(some.objects) == [5]


@pytest.mark.parametrize("name", ["rooms-reasoning", "rooms-presence", "replica-boxes"])
def test_protocols_about_the_complete_scene_name_the_reason(name: str) -> None:
    assert reason_against(load_protocol(name))
    assert reason_against(load_protocol("rooms-retrieval")) is None


@pytest.mark.parametrize(
    ("curve", "area"),
    [
        ([(0.25, 0.4), (1.0, 0.4)], 0.4),
        ([(0.5, 0.0), (0.75, 1.0), (1.0, 1.0)], 0.75),
        ([(0.2, None), (0.5, 0.0), (0.7, None), (1.0, 1.0)], 0.5),
        ([(0.5, 1.0), (1.0, None)], None),
        ([(1.0, 1.0)], None),
    ],
)
def test_area_is_the_mean_over_time(curve: list[tuple[float, float | None]], area: float | None) -> None:
    assert area_under(curve) == (area if area is None else pytest.approx(area))


@pytest.mark.parametrize("name", ["rooms-semantic", "rooms-instance", "rooms-panoptic"])
@pytest.mark.parametrize("is_map_empty", [False, True])
def test_scores_are_undefined_before_anything_is_seen(name: str, is_map_empty: bool) -> None:
    truth = room()
    left = restricted(truth, [np.zeros(len(truth.points), bool)])
    assert isinstance(left, GroundTruth)
    prediction = truth_as_prediction(left if is_map_empty else truth, with_labels=True)
    assert np.isnan(headline(name, left, prediction)).all()
