"""The seven answered questions of the paper's page: what geometry settles, and how a model's words are read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from places import CASES

from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.score import TrueAnswer, are_objects_right, is_answer_right
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig, Reply
from su3d_bench.questions.question_files import paper_queries
from su3d_bench.questions.scene_map import MapObject, SceneMap
from su3d_bench.questions.solver import Solver, by_language_model, given_answer

PAGE = json.loads((CASES / "page_reasoning.json").read_text())["cases"]
RULES = load_protocol("replica-reasoning").answers
each_case = pytest.mark.parametrize("case", PAGE, ids=[case["question"] for case in PAGE])


def map_of(case: Any) -> SceneMap:
    """The objects that the page shows, each a box of the case's size about its centroid; row k is the k-th."""
    things = []
    for row, one in enumerate(case["objects"]):
        centre, half = np.array(one["centroid"], np.float64), np.array(one["size"], np.float64) / 2
        box = np.stack([centre - half, centre + half])
        things.append(MapObject(one["id"], one["name"], one["caption"], centre, box, row))
    return SceneMap(tuple(things))


def truth_of(case: Any) -> TrueAnswer:
    return TrueAnswer(case["question"], "page", case["value"], tuple(sorted(case["object_ids"])))


def objects_of_rows(scene: SceneMap) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Each instance stands for the object that bears its id."""
    return np.array(scene.ids, np.int64)


class Said:
    """A language model that says what the page shows."""

    def __init__(self, case: Any) -> None:
        self.case = case
        self.requests: list[ChatRequest] = []

    def ask_all(self, requests: Sequence[ChatRequest]) -> list[Reply]:
        self.requests += requests
        told = {name: self.case[name] for name in ("object_ids", "reference_ids")}
        return [Reply(json.dumps({"reasoning": "as shown", "answer": self.case["told"], **told}), "stop")]


def test_there_are_seven_and_they_are_asked_of_the_paper_s_scenes() -> None:
    assert len(PAGE) == 7
    asked = [question for question in paper_queries() if question.kind == "reasoning" and question.reply]
    assert {(one.scene, one.text) for one in asked} == {(one["scene"], one["question"]) for one in PAGE}


@each_case
def test_the_built_in_solver_gives_the_page_s_answer_or_says_that_it_cannot(case: Any) -> None:
    scene = map_of(case)
    found = Solver(scene).answer(case["question"])
    assert found.is_settled is case["is_settled_by_geometry"]
    if found.is_settled:
        given, true = given_answer(truth_of(case), found, scene), truth_of(case)
        assert RULES is not None and is_answer_right(RULES, true, given, objects_of_rows(scene))
        assert are_objects_right(true, given, objects_of_rows(scene))


@each_case
def test_the_page_s_answer_in_a_model_s_words_is_right_and_another_is_wrong(case: Any) -> None:
    scene, model = map_of(case), Said(case)
    solver = by_language_model(model, LanguageConfig())
    (found,) = solver.ask(scene, [case["question"]])
    given, true = given_answer(truth_of(case), found, scene), truth_of(case)
    assert RULES is not None and is_answer_right(RULES, true, given, objects_of_rows(scene))
    assert are_objects_right(true, given, objects_of_rows(scene))
    assert list(found.reference_ids) == case["reference_ids"]
    assert all(f'"ID": {one["id"]}' in model.requests[0].text for one in case["objects"])
    wrong = {**case, "told": "No, 77 of them", "object_ids": [one["id"] for one in case["objects"]][:1]}
    (found,) = by_language_model(Said(wrong), LanguageConfig()).ask(scene, [case["question"]])
    assert not is_answer_right(RULES, true, given_answer(true, found, scene), objects_of_rows(scene))


def test_the_distances_that_the_page_prints_are_those_between_centroids() -> None:
    by_question = {case["question"]: map_of(case) for case in PAGE}

    def away(question: str, a: int, b: int) -> float:
        scene = by_question[question]
        return float(np.linalg.norm(scene.by_id(a).centroid - scene.by_id(b).centroid))

    assert away("What is the distance between sofa with blanket and door?", 299, 18) == pytest.approx(
        28.784837**0.5, abs=1e-4
    )
    sinks = "Which sink is closer to bed, kitchen sink or bathroom sink?"
    assert (away(sinks, 60, 530), away(sinks, 60, 179)) == pytest.approx((6.0575, 3.4216), abs=1e-3)
    assert away("Is there a toilet paper near, toilet?", 437, 181) == pytest.approx(0.7222, abs=1e-3)
    kitchen = by_question["Where is kitchen?"]
    mean = np.mean([thing.centroid for thing in kitchen.objects], axis=0)
    assert mean == pytest.approx([5.764824, 7.638832, 1.106762], abs=2e-3)  # the model's sums are off by a millimetre
