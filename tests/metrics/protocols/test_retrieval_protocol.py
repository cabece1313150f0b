"""The retrieval and reasoning protocols: the object of an instance, hand-computed shares, and a run with them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scored_room import ENCODER, NAMES, OneHotEncoder, instances, nothing, room, truth_as_prediction

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.core.maps import Partition
from su3d_bench.evaluation.scoring import facts_of, score_on_objects
from su3d_bench.metrics.compatibility import content_incompatibility, kind_incompatibility
from su3d_bench.metrics.instance.score import covered_objects
from su3d_bench.metrics.protocols.loading import load_protocol, protocols_for, rules_file
from su3d_bench.metrics.questions.score import (
    ReasoningTruth,
    RetrievalTruth,
    ShareCounts,
    SolverAnswer,
    TextTarget,
    TrueAnswer,
    are_objects_right,
    first_instances,
    is_answer_right,
)
from su3d_bench.metrics.scoring import combine, metric_of, plain_json, score_scene
from su3d_bench.predictions.base import vertex_masks
from su3d_bench.questions import ground_truths
from su3d_bench.questions.appearance import Sight
from su3d_bench.questions.ground_truths import question_truth
from su3d_bench.runs.plan import protocols_of_run

RULES = load_protocol("rooms-retrieval")
REASONING = load_protocol("rooms-reasoning")
TRUTH = room()
# Objects 1..8 are NAMES in order: 2 and 3 are chairs, 4 the table, 5 the lamp.
ASKED = (
    TextTarget("instance", "chair", (2, 3)),
    TextTarget("instance", "lamp", (5,)),
    TextTarget("affordance", "lamp to read by", (5,)),
    TextTarget("property", "red table", (8,)),
    TextTarget("relative", "book on table", (7,)),
    TextTarget("relative", "cushion", (6,)),
)
QUESTIONS = RetrievalTruth(TRUTH, ASKED)
PERFECT = truth_as_prediction(TRUTH, with_labels=False)


def values(prediction: object, truth: RetrievalTruth = QUESTIONS) -> dict[str, float | None]:
    score = score_scene(RULES, truth, prediction, ENCODER)  # type: ignore[arg-type]
    known: dict[str, float | None] = plain_json(metric_of(RULES).combine([score.counts]))
    return known


@pytest.fixture
def all_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every true object is visible, without a colour."""
    seen = {int(instance): Sight(1.0, "") for instance in np.unique(TRUTH.instance)}
    monkeypatch.setattr(ground_truths, "sights", lambda dataset, scene, truth, min_vertices: seen)


def test_first_instance_is_right_if_assigned_to_an_answer() -> None:
    found = values(PERFECT)  # "red table" finds the table, which is not the answer; so does "book on table"
    assert [found[key] for key in RULES.headline] == [1.0, 1.0, 0.0, 0.5, 4 / 6]
    assert [found[f"n_{key}"] for key in RULES.headline] == [2, 1, 1, 2, 6]
    assert found["reachable"] == 1.0


def test_instance_is_assigned_to_the_object_it_covers_most() -> None:
    two = [np.flatnonzero((TRUTH.instance == 2) | (TRUTH.instance == 5))[20:], np.flatnonzero(TRUTH.instance == 0)]
    covered = covered_objects(RULES.transfer, TRUTH, instances(TRUTH.points, two, None))
    assert covered.main_object.tolist() == [5, 0]
    assert covered.n_shared[0, [1, 4]].tolist() == [130, 150]


def test_points_farther_than_5_cm_cover_nothing() -> None:
    moved = replace(PERFECT, points=PERFECT.points + np.float32(20.0))
    assert set(values(moved).values()) >= {0.0}
    assert values(moved)["all"] == values(moved)["reachable"] == 0.0


def test_empty_map_has_no_first_instance() -> None:
    assert first_instances(RULES, ["chair", "lamp"], nothing(room()), ENCODER).tolist() == [-1, -1]
    assert first_instances(RULES, [], PERFECT, ENCODER).tolist() == []
    for unnamed, encoder in ((replace(PERFECT, features=None), ENCODER), (PERFECT, None)):
        with pytest.raises(PredictionError, match="needs features and an encoder"):
            first_instances(RULES, ["chair"], unnamed, encoder)


def test_kind_without_questions_has_no_value() -> None:
    found = values(PERFECT, RetrievalTruth(TRUTH, ASKED[:1]))
    assert found["instance"] == found["all"] == 1.0
    assert found["relative"] is None  # not a number


def test_partition_scores_like_its_instances() -> None:
    owner = TRUTH.instance.astype(np.int32) - 1
    assert PERFECT.features is not None
    assert values(Partition(TRUTH.points, owner, PERFECT.features)) == values(PERFECT)


def test_chance_and_names_alone_are_shares_of_all_questions() -> None:
    asked = (TextTarget("instance", "chair", (2, 3), 0.25, 0.5), TextTarget("instance", "lamp", (5,), 0.125, 1.0))
    found = values(PERFECT, RetrievalTruth(TRUTH, (*asked, TextTarget("property", "red table", (4,), 0.5, 0.25))))
    assert (found["chance_instance"], found["names-alone_instance"]) == (0.1875, 0.75)
    assert (found["chance_property"], found["names-alone_property"]) == (0.5, 0.25)
    assert (found["chance_all"], found["chance_relative"]) == (0.875 / 3, None)


def test_texts_answered_by_the_name_alone_are_separate() -> None:
    kinds = (("property by name", 4), ("relative by name", 4), ("relative by name", 8))  # "red table" finds the table
    found = values(
        PERFECT, RetrievalTruth(TRUTH, (*ASKED, *(TextTarget(kind, "red table", (i,)) for kind, i in kinds)))
    )
    assert (found["by name"], found["n_by name"]) == (2 / 3, 3)
    assert (found["all"], found["n_all"]) == (4 / 6, 6)


def test_scenes_pool_by_their_questions() -> None:
    few = RetrievalTruth(TRUTH, ASKED[:1])
    asked = {"a": QUESTIONS, "b": few}
    result = combine(RULES, {scene: score_scene(RULES, one, PERFECT, ENCODER) for scene, one in asked.items()})
    assert result.metrics["all"] == 5 / 7
    assert result.metrics == result.pooled
    assert result.per_scene["b"]["all"] == 1.0
    assert result.intervals["all"] == (0.0, 1.0)  # of 4/6 and 1/1: two scenes are uninformative


def test_map_without_features_gives_a_reason_for_retrieval() -> None:
    labelled = truth_as_prediction(TRUTH, with_labels=True)
    assert "needs features" in str(kind_incompatibility(RULES, labelled))
    with pytest.raises(PredictionError, match="needs features"):
        score_scene(RULES, QUESTIONS, labelled, ENCODER)


def test_protocols_of_questions_run_only_where_they_are_named(tmp_path: Path) -> None:
    assert not {"rooms-retrieval", "rooms-annotation", "rooms-reasoning"} & set(protocols_for("rooms"))
    assert protocols_of_run(["rooms-retrieval"], ["rooms"]) == {"rooms": ("rooms-retrieval",)}
    own = own_questions_of_a_dataset(tmp_path)
    with pytest.raises(ConfigError, match="needs a dataset with questions and answers, which replica"):
        protocols_of_run([own], ["replica"])


def own_questions_of_a_dataset(folder: Path) -> str:
    """The path of the rooms' rules, but with the questions of the dataset itself."""
    text = rules_file("rooms-retrieval").read_text().replace('questions = "generated"', 'questions = "dataset"')
    text = text.replace('synonyms = "lexicon"', "").replace('name = "rooms-retrieval"', 'name = "own-retrieval"')
    (folder / "questions.toml").write_text(text)
    return str(folder / "questions.toml")


def test_questions_of_the_dataset_are_used(tmp_path: Path, all_is_seen: None) -> None:
    class Knowing:
        name = "knowing"

        def queries(self, scene: str) -> list[SimpleNamespace]:
            return [SimpleNamespace(kind="instance", text="a chair", answers=(2, 3))]

    rules = load_protocol(own_questions_of_a_dataset(tmp_path))
    truth = question_truth(rules, Knowing(), "made", TRUTH)
    assert isinstance(truth, RetrievalTruth)
    assert [(asked.text, asked.answers) for asked in truth.asked] == [("a chair", (2, 3))]
    assert (truth.asked[0].by_chance, truth.asked[0].by_name) == (2 / 7, 1.0)


@pytest.mark.parametrize(
    ("value", "given", "is_right"),
    [
        (2, 2, True), (2, 3, False), (True, True, True), (True, 1, False), (2.0, 2.24, True), (2.0, 2.26, False),
        (10.0, 10.9, True), (2.0, None, False),
    ],
)  # fmt: skip
def test_answer_is_right_within_the_tolerance(value: float, given: float | None, is_right: bool) -> None:
    assert REASONING.answers is not None
    true, record = TrueAnswer("?", "count", value, ()), SolverAnswer(given, np.zeros(0, np.int64), True)
    assert is_answer_right(REASONING.answers, true, record, np.zeros(0, np.int64)) is is_right
    assert not is_answer_right(REASONING.answers, true, replace(record, is_decided=False), np.zeros(0, np.int64))


def test_objects_are_right_if_instances_match_exactly_them() -> None:
    main_object = np.array([4, 4, 9])
    true = TrueAnswer("which?", "nearest", None, (4,))
    for rows, is_right in (([0], True), ([0, 1], True), ([0, 2], False), ([], False)):
        assert are_objects_right(true, SolverAnswer(None, np.array(rows, np.int64), True), main_object) is is_right


def test_ground_truth_answers_its_own_questions(all_is_seen: None) -> None:
    truth = question_truth(REASONING, SimpleNamespace(name="rooms"), "made", TRUTH)
    assert isinstance(truth, ReasoningTruth)
    assert len(truth.asked) > 10
    whole = truth_as_prediction(TRUTH, with_labels=True)
    parts = [TRUTH.points[whole.mask(k)] for k in range(len(whole))]
    boxes = np.array([[np.percentile(c, 1, axis=0), np.percentile(c, 99, axis=0)] for c in parts], np.float32)
    oracle = replace(whole, boxes=boxes, centroids=np.array([c.mean(axis=0) for c in parts], np.float32))
    score = score_scene(REASONING, truth, oracle, None)
    found = metric_of(REASONING).combine([score.counts])
    assert (found["answer"], found["objects"]) == (1.0, 1.0)
    wrong = replace(oracle, labels=tuple(reversed(oracle.labels or ())))
    assert metric_of(REASONING).combine([score_scene(REASONING, truth, wrong, None).counts])["answer"] < 1


def test_generated_questions_find_their_objects_by_name(all_is_seen: None) -> None:
    rules = load_protocol("replica-retrieval")
    truth = question_truth(rules, SimpleNamespace(name="replica"), "made", TRUTH)
    assert isinstance(truth, RetrievalTruth)
    answers = {one.text: one.answers for one in truth.asked if one.kind == "instance"}
    assert answers["chair"] == (2, 3)
    assert set(NAMES) - {"wall"} <= set(answers)
    encoder = OneHotEncoder()
    score = score_scene(rules, truth, PERFECT, encoder)
    assert metric_of(rules).combine([score.counts])["reachable"] == 1.0


def test_a_run_scores_variants_under_the_protocols_of_questions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    words = (
        "run --scenes rooms/bathroom0 --methods opensu3d@scheme1 opensu3d@scheme4 --profile oracle --limit 3 --jobs 1"
    )
    words += " --no-pictures --quiet --set rooms.width=160 --set rooms.height=120 --set rooms.n_frames=80"
    words += " --protocols rooms-retrieval rooms-annotation rooms-reasoning --out"
    assert main([*words.split(), str(tmp_path / "run")]) == 0
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())["results"]
    by_name = {(one["method"], one["protocol"]): one for one in metrics}
    assert len(by_name) == 6
    first = by_name["opensu3d@scheme1", "rooms-retrieval"]["result"]
    assert first["metrics"]["n_all"] == sum(first["metrics"][f"n_{kind}"] for kind in RULES.headline[:4]) > 50
    assert by_name["opensu3d@scheme1", "rooms-retrieval"]["ceiling"] is None  # the oracle's map has no features
    assert by_name["opensu3d@scheme4", "rooms-annotation"]["ceiling"]["label n"] == 1.0
    assert by_name["opensu3d@scheme4", "rooms-reasoning"]["ceiling"]["answer"] > 0.9
    assert "rooms-retrieval" in capsys.readouterr().out
    sides = [f"{tmp_path / 'run'}:opensu3d@scheme{k}" for k in (1, 4)]
    assert main(["compare", *sides, "--protocols", "rooms-retrieval"]) == 0
    assert "relative" in capsys.readouterr().out


def test_external_predictions_score_like_a_run(all_is_seen: None) -> None:
    rules = load_protocol("replica-retrieval")
    dataset = SimpleNamespace(name="replica")
    truth = question_truth(rules, dataset, "made", TRUTH)
    outcome = score_on_objects(rules, truth, "made", PERFECT, ENCODER)
    score = score_scene(rules, truth, PERFECT, ENCODER)
    assert isinstance(outcome.score.counts, ShareCounts)
    assert isinstance(score.counts, ShareCounts)
    assert outcome.score.counts.n_right.tolist() == score.counts.n_right.tolist()
    masks = vertex_masks("none", [], None)
    assert "needs a map with its own points" in str(content_incompatibility(rules, facts_of(masks)))
