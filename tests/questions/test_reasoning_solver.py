"""The built-in solver and its grammar, on a scene small enough to solve by hand and on a generated room."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bedroom_map import bedroom, box, thing
from places import CASES
from scored_room import instances

from su3d_bench.core.errors import PredictionError
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.score import RefinedNames, TrueAnswer, are_objects_right, is_answer_right
from su3d_bench.perception.language.captioner import STRATEGY
from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig, Reply
from su3d_bench.questions import solver as solving
from su3d_bench.questions.generated import generate_questions
from su3d_bench.questions.model import Answer
from su3d_bench.questions.question_files import paper_queries
from su3d_bench.questions.scene_map import MapObject, SceneMap, map_of
from su3d_bench.questions.solver import LanguageSolver, Solver, by_language_model, context_for, given_answer


@pytest.fixture(scope="module")
def solver() -> Solver:
    return Solver(bedroom())


@pytest.mark.parametrize(
    ("question", "ids", "value"),
    [
        # Centroids: bed (1, 0.8), sinks (0.25, 4.25, 0.9) and (6.25, 0.25, 0.9): 3.59 m and 5.32 m away.
        ("Which sink is closer to bed?", (9,), None),
        ("which is closer to the bed, the table or the basket?", (6,), None),
        ("Is the table or the basket nearest to the bed?", (6,), None),
        ("Which sink is closer to bed, kitchen sink or bathroom sink?", (9,), None),
        ("Is the table closer to the bed than the basket?", (6, 13), True),
        ("Is the basket closer to the bed than the table?", (13, 6), False),
        ("What is the nearest object to the nightstand?", (3,), None),
        ("find the lamp farthest from the bed", (4,), None),
        ("How many cups are on the table?", (7, 8), 2),
        ("Count the lamps", (3, 4), 2),
        ("How many pianos are there?", (), 0),
        ("Is there a piano?", (), False),
        ("Is there a cup on the table?", (7, 8), True),
        ("Is the lamp on the nightstand?", (3,), True),
        ("What is on the nightstand?", (3,), None),
        ("What is under the table?", (5,), None),
        ("What is above the bed?", (15,), None),
        ("What is next to the bed?", (2,), None),
        ("How many piles of cups are there?", (7, 8), 2),
        ("Is there a paper towel near, sink?", (17,), True),
        ("which lamp is on the nightstand next to the bed?", (3,), None),
        ("What is between the bed and the basket?", (6,), None),
        ("Which lamp is the tallest?", (4,), None),
        ("What is the largest object?", (1,), None),
        ("Where is the red lamp?", (3,), None),
        ("Please tell me, how many white lamps are there?", (4,), 1),
        ("Is there a fridge?", (), False),
        ("How many bed side tables do you see?", (), 0),
        ("how many furniture are there", (1, 2, 6, 11), 4),
    ],
)
def test_geometric_questions_are_answered(
    solver: Solver, question: str, ids: tuple[int, ...], value: float | None
) -> None:
    found = solver.answer(question)
    assert found.is_decided, found.text
    assert (found.object_ids, found.value) == (ids, value)


@pytest.mark.parametrize(
    ("question", "text"),
    [
        ("Is there a fridge?", "no: there is no fridge"),
        ("Is there a cup on the bed?", "no: there is no cup on the bed"),
        ("How many chairs are there?", "0: there are no chairs"),
        ("Which lamp is the largest?", "lamp #4 is the larger: a box of 0.144 m³; lamp #3: a box of 0.016 m³"),
        ("What is the tallest object?", "shelf #11 is the tallest: 1.8 m tall; lamp #4: 1.6 m tall; "
         "table #6: 0.7 m tall; picture #15: 0.6 m tall"),
    ],
)  # fmt: skip
def test_answers_are_plain_sentences(solver: Solver, question: str, text: str) -> None:
    assert solver.answer(question).text == text


@pytest.mark.parametrize(
    ("question", "reason"),
    [
        ("I am feeling cold, what should I do?", "the built-in solver cannot read the question"),
        ("", "the built-in solver cannot read"),
        ("Which chair is closer to the bed?", "the map has no 'chair'"),
        ("What is between the bed?", "'between' needs two objects"),
        ("How far is the bed from the bed?", "one object in the map"),
    ],
)
def test_unsettled_questions_are_reported(solver: Solver, question: str, reason: str) -> None:
    found = solver.answer(question)
    assert not found.is_decided
    assert found.text.startswith("I cannot settle this: ")
    assert reason in found.text
    assert found.object_ids == ()


def test_left_depends_on_viewpoint_and_is_noted() -> None:
    # From the origin looking along +x, the object with the greater y is on the left.
    scene = SceneMap((thing(1, "chair", box(2, 0.5, 0, 0.2, 0.2, 1)), thing(2, "sofa", box(2, -0.5, 0, 0.2, 0.2, 1))))
    near = Solver(scene, np.zeros(3)).answer("Is the chair left of the sofa?")
    assert near.value is True
    assert near.notes == ("left and right as seen from the given eye (0.00, 0.00)",)
    assert Solver(scene, np.array([5.0, 0.0, 0.0])).answer("Is the chair left of the sofa?").value is False
    assert Solver(scene, np.array([5.0, 0.0, 0.0])).answer("Is the chair to the right of the sofa?").value is True
    assert "middle of the map" in Solver(scene).answer("Is the chair left of the sofa?").notes[0]
    assert Solver(scene, np.zeros(3)).answer("What is to the left of the sofa?").object_ids == (1,)


def test_unknown_noun_falls_back_to_encoder_with_a_note() -> None:
    def nearest(noun: str, names: Sequence[str]) -> tuple[str, float]:
        assert "floor" not in names
        return ("bed", 0.9) if noun == "bunk" else ("table", 0.7)

    asked = Solver(bedroom(), None, nearest)
    found = asked.answer("Which sink is closer to the bunk?")
    assert found.object_ids == (9,)
    assert found.notes[0] == ("the map has no 'bunk'; used 'bed', the nearest name by the text encoder (cosine 0.90)")
    assert not asked.answer("Which sink is closer to the harp?").is_decided


def test_yes_no_and_numbers_are_parsed_from_text_answers() -> None:
    assert Answer("There are 2 cups (ID #7 and #8)").as_value(2) == 2
    assert Answer("There are 3").as_value(2) == 3
    assert Answer("No, there is none").as_value(True) is False
    assert Answer("perhaps").as_value(True) is None
    assert Answer("about 3.7 m").as_value(3.68) == 3.7
    assert Answer("3", value=4).as_value(2) == 4


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> SceneMap:
    truth = Rooms(tmp_path_factory.mktemp("data")).truth("kitchen0")
    return SceneMap(
        tuple(
            MapObject(o.id, o.class_name, "", np.array(o.centre), np.array([o.box_min, o.box_max]), o.id - 1)
            for o in truth.objects
        )
    )


def test_generated_questions_are_answered_correctly(room: SceneMap) -> None:
    questions = generate_questions(room, n_each=4, seed=3)
    assert questions == generate_questions(room, n_each=4, seed=3)
    assert {one.kind for one in questions} >= {"closer", "nearest", "distance", "count", "what on", "is on"}
    solver = Solver(room)
    for one in questions:
        again = solver.answer(one.text)
        assert (again.object_ids, again.value) == (one.answer.object_ids, one.answer.value)
    assert {one.answer.value for one in questions if one.kind.startswith("is ")} == {True, False}
    assert not any("left of" in one.text for one in generate_questions(room, n_each=4))


def test_nearest_object_answer_matches_all_distances(room: SceneMap) -> None:
    centres = np.array([one.centroid for one in room.objects])
    for one in generate_questions(room, n_each=8, seed=1):
        if one.kind not in ("closer", "farthest"):
            continue
        (reference,), (best,) = one.answer.reference_ids, one.answer.object_ids
        same = [o for o in room.objects if o.name == room.by_id(best).name]
        away = {o.id: float(np.linalg.norm(o.centroid - centres[reference - 1])) for o in same}
        assert best == (max if one.kind == "farthest" else min)(away, key=lambda key: away[key])


def test_map_names_are_n_prime_then_label_then_n() -> None:
    made = replace(
        instances(np.zeros((2, 3), np.float32), [np.array([0]), np.array([1])], ["", "couch"]),
        names=("lamp", "sofa"),
        boxes=np.array([[[0, 0, 0], [1, 1, 1]], [[0, 0, 0], [np.nan, 1, 1]]], np.float32),
    )
    assert [one.name for one in map_of(made).objects] == ["lamp"]  # an instance without a finite box is excluded
    sound = replace(made, boxes=np.zeros((2, 2, 3), np.float32))
    assert [one.name for one in map_of(sound).objects] == ["lamp", "couch"]
    assert [one.name for one in map_of(sound, RefinedNames(("a", "b"), "test")).objects] == ["a", "b"]
    with pytest.raises(PredictionError, match="duplicate instance ids"):
        map_of(replace(sound, ids=np.array([3, 3], np.int32)))


class Said:
    """A language model with one fixed reply."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.requests: list[ChatRequest] = []

    def ask_all(self, requests: Sequence[ChatRequest]) -> list[Reply]:
        self.requests += requests
        return [Reply(self.text, "stop")] * len(requests)


def test_prompt_contains_the_six_paper_rules_and_all_objects() -> None:
    assert len(STRATEGY) == 6 and all(rule in solving.system_prompt() for rule in STRATEGY)
    model = Said('{"reasoning": "3.59 < 5.32", "answer": "the kitchen sink", "object_ids": [9, 999]}')
    found = LanguageSolver(bedroom(), model, LanguageConfig()).answer("Which sink is closer to bed?")
    assert (found.text, found.object_ids, found.solver) == ("the kitchen sink", (9,), "llm")
    lines = [json.loads(line) for line in model.requests[0].text.splitlines() if line.startswith("{")]
    assert [line["ID"] for line in lines] == list(bedroom().ids)
    assert lines[0] == {
        "ID": 1, "Name": "bed", "Description": "", "Centroid": [1.0, 0.8, 0.25],
        "Bounding Box": [[0.0, 0.0, 0.0], [2.0, 1.6, 0.5]],
    }  # fmt: skip


def test_oversized_map_is_truncated_by_relevance_with_a_note() -> None:
    filler = [thing(100 + k, "plate", box(9, k, 0, 0.1, 0.1, 0.1)) for k in range(300)]
    scene = SceneMap((*filler, *bedroom().objects))
    config = LanguageConfig(context_tokens=2000, max_answer_tokens=200)
    context = context_for(scene, "Which sink is closer to bed?", config)
    assert {1, 9, 10} <= {one.id for one in context.objects}
    assert 3 < len(context.objects) < 100
    found = LanguageSolver(scene, Said("sink #9"), config).answer("Which sink is closer to bed?")
    assert found.object_ids == (9,)
    assert found.notes[0].startswith(
        f"the map has 318 objects, more than fit into the model's context; it got the {len(context.objects)} "
    )
    assert {one.id for one in solving.by_relevance(scene, "Which sink is closer to bed?")[:3]} == {1, 9, 10}
    assert context_for(bedroom(), "x", LanguageConfig()).note == ""


def test_refusal_of_the_model_leaves_the_question_unsettled() -> None:
    found = LanguageSolver(bedroom(), Said("I'm sorry, I can't help with that."), LanguageConfig()).answer(
        "Which sink is closer to bed?"
    )
    assert not found.is_decided
    assert found.text.startswith("I cannot settle this: gpt-6-luna: ")


PAGE = json.loads((CASES / "page_reasoning.json").read_text())["cases"]
RULES = load_protocol("replica-reasoning").answers
each_case = pytest.mark.parametrize("case", PAGE, ids=[case["question"] for case in PAGE])


def shown_map(case: Any) -> SceneMap:
    """The objects on the page, each with a box of the case's size around its centroid; row k is the k-th."""
    things = []
    for row, one in enumerate(case["objects"]):
        centre, half = np.array(one["centroid"], np.float64), np.array(one["size"], np.float64) / 2
        box = np.stack([centre - half, centre + half])
        things.append(MapObject(one["id"], one["name"], one["caption"], centre, box, row))
    return SceneMap(tuple(things))


def truth_of(case: Any) -> TrueAnswer:
    return TrueAnswer(case["question"], "page", case["value"], tuple(sorted(case["object_ids"])))


def objects_of_rows(scene: SceneMap) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Each instance stands for the object with its id."""
    return np.array(scene.ids, np.int64)


def page_model(case: Any) -> Said:
    """A language model that replies as on the page."""
    ids = {name: case[name] for name in ("object_ids", "reference_ids")}
    return Said(json.dumps({"reasoning": "as shown", "answer": case["told"], **ids}))


def test_seven_paper_questions_belong_to_paper_scenes() -> None:
    assert len(PAGE) == 7
    asked = [question for question in paper_queries() if question.kind == "reasoning" and question.reply]
    assert {(one.scene, one.text) for one in asked} == {(one["scene"], one["question"]) for one in PAGE}


@each_case
def test_builtin_solver_gives_published_answer_or_none(case: Any) -> None:
    scene = shown_map(case)
    found = Solver(scene).answer(case["question"])
    assert found.is_decided is case["is_settled_by_geometry"]
    if found.is_decided:
        given, true = given_answer(truth_of(case), found, scene), truth_of(case)
        assert RULES is not None and is_answer_right(RULES, true, given, objects_of_rows(scene))
        assert are_objects_right(true, given, objects_of_rows(scene))


@each_case
def test_paraphrased_published_answer_is_correct(case: Any) -> None:
    scene, model = shown_map(case), page_model(case)
    solver = by_language_model(model, LanguageConfig())
    (found,) = solver.ask(scene, [case["question"]])
    given, true = given_answer(truth_of(case), found, scene), truth_of(case)
    assert RULES is not None and is_answer_right(RULES, true, given, objects_of_rows(scene))
    assert are_objects_right(true, given, objects_of_rows(scene))
    assert list(found.reference_ids) == case["reference_ids"]
    assert all(f'"ID": {one["id"]}' in model.requests[0].text for one in case["objects"])
    wrong = {**case, "told": "No, 77 of them", "object_ids": [one["id"] for one in case["objects"]][:1]}
    (found,) = by_language_model(page_model(wrong), LanguageConfig()).ask(scene, [case["question"]])
    assert not is_answer_right(RULES, true, given_answer(true, found, scene), objects_of_rows(scene))
