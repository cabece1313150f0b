"""What a language model is asked about a map, and how its words are read."""

from __future__ import annotations

import json
from collections.abc import Sequence

import pytest
from bedroom_map import bedroom, box, thing

from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig, Reply
from su3d_bench.questions.scene_map import SceneMap
from su3d_bench.questions.solver import LanguageSolver, by_relevance, context_for, system_prompt


class Said:
    """A language model that says one thing."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.requests: list[ChatRequest] = []

    def ask_all(self, requests: Sequence[ChatRequest]) -> list[Reply]:
        self.requests += requests
        return [Reply(self.text, "stop")] * len(requests)


def test_the_prompt_holds_the_paper_s_six_rules_and_every_object() -> None:
    for rule in (
        "Use `Name' & `Description' to understand object.",
        "Use `ID' to refer object.",
        "Use `Cartesian Coordinates'.",
        "Get `Centroid' & `Bounding Box' information.",
        "Compute `Euclidean Distance' if necessary.",
        "Assume `Tolerance' if necessary.",
    ):
        assert rule in system_prompt()
    model = Said('{"reasoning": "3.59 < 5.32", "answer": "the kitchen sink", "object_ids": [9, 999]}')
    found = LanguageSolver(bedroom(), model, LanguageConfig()).answer("Which sink is closer to bed?")
    assert (found.text, found.object_ids, found.solver) == ("the kitchen sink", (9,), "llm")
    lines = [json.loads(line) for line in model.requests[0].text.splitlines() if line.startswith("{")]
    assert [line["ID"] for line in lines] == list(bedroom().ids)
    assert lines[0] == {
        "ID": 1, "Name": "bed", "Description": "", "Centroid": [1.0, 0.8, 0.25],
        "Bounding Box": [[0.0, 0.0, 0.0], [2.0, 1.6, 0.5]],
    }  # fmt: skip


def test_a_map_larger_than_the_context_is_cut_by_relevance_and_it_is_said() -> None:
    filler = [thing(100 + k, "plate", box(9, k, 0, 0.1, 0.1, 0.1)) for k in range(300)]
    scene = SceneMap((*filler, *bedroom().objects))
    config = LanguageConfig(context_tokens=2000, max_answer_tokens=200)
    context = context_for(scene, "Which sink is closer to bed?", config)
    assert {1, 9, 10} <= {one.id for one in context.objects}
    assert 3 < len(context.objects) < 100
    found = LanguageSolver(scene, Said("sink #9"), config).answer("Which sink is closer to bed?")
    assert found.object_ids == (9,)
    assert found.notes[0].startswith(
        f"the map has 318 objects, more than the model reads at once; it was given the {len(context.objects)} "
    )
    assert {one.id for one in by_relevance(scene, "Which sink is closer to bed?")[:3]} == {1, 9, 10}
    assert context_for(bedroom(), "x", LanguageConfig()).note == ""


@pytest.mark.parametrize("text", ["I'm sorry, I can't help with that.", ""])
def test_a_model_that_refuses_leaves_the_question_unsettled(text: str) -> None:
    found = LanguageSolver(bedroom(), Said(text), LanguageConfig()).answer("Which sink is closer to bed?")
    assert not found.is_settled
    assert found.text.startswith("I cannot settle this: gpt-4-1106-preview: ")
