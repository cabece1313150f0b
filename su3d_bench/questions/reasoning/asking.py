"""Who answers questions about a map, by geometry or by a language model, and what the answer says to a protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.core.interfaces import Encoder
from su3d_bench.metrics.questions.score import GivenAnswer, TrueAnswer
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.perception.language.config import LanguageConfig
from su3d_bench.questions.reasoning.answers import Answer
from su3d_bench.questions.reasoning.language_solver import LanguageSolver
from su3d_bench.questions.reasoning.named_objects import nearest_by
from su3d_bench.questions.reasoning.scene_map import SceneMap
from su3d_bench.questions.reasoning.solver import Solver

AskMap = Callable[[SceneMap, Sequence[str]], Sequence[Answer]]
BUILT_IN = "the built-in solver"


@dataclass(frozen=True)
class MapSolver:
    """Who answers questions about a map, by name."""

    name: str
    ask: AskMap


def built_in(encoder: Encoder | None) -> AskMap:
    """Answers by geometry alone; ``encoder`` finds the nearest name."""

    def ask(scene: SceneMap, questions: Sequence[str]) -> Sequence[Answer]:
        solver = Solver(scene, None, None if encoder is None else nearest_by(encoder))
        return [solver.answer(question) for question in questions]

    return ask


def by_language_model(model: LanguageModel, config: LanguageConfig) -> MapSolver:
    """Answers of a language model, several questions at once."""
    name = f"the language model {printable(config.text_model, 100)}"
    return MapSolver(name, lambda scene, questions: LanguageSolver(scene, model, config).answers(questions))


def given_answer(true: TrueAnswer, answer: Answer, scene: SceneMap) -> GivenAnswer:
    """What ``answer`` about ``scene`` says of the kind of ``true``."""
    rows = [scene.by_id(object_id).row for object_id in answer.object_ids]
    return GivenAnswer(_value(true, answer), np.array(rows, np.int64), answer.is_settled)


def _value(true: TrueAnswer, answer: Answer) -> float | int | bool | None:
    """What the answer says; the words of a language model are read for their yes or no, or their first number."""
    if true.value is None or answer.solver == "built-in":
        return answer.value
    value = answer.said(true.value)
    is_count = value is not None and not isinstance(true.value, float | bool) and value == int(value)
    return int(value) if is_count and value is not None else value
