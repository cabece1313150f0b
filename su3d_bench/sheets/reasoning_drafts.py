"""Answers about maps as they are put before people, by the built-in solver or by a language model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.plain_text import printable
from su3d_bench.core.types import Instances
from su3d_bench.metrics.instance.covered_objects import Covered
from su3d_bench.metrics.protocols import ProtocolRules
from su3d_bench.metrics.questions.score import are_objects_right, is_answer_right
from su3d_bench.metrics.questions.truths import GivenAnswer, ReasoningTruth, TrueAnswer
from su3d_bench.perception.language.chat import ChatRequest
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.perception.language.config import LanguageConfig
from su3d_bench.questions.model import REASONING, Question, question_id
from su3d_bench.questions.reasoning.answers import Answer, unsettled
from su3d_bench.questions.reasoning.judging import said_value
from su3d_bench.questions.reasoning.language_solver import LanguageSolver
from su3d_bench.questions.reasoning.named_objects import nearest_by
from su3d_bench.questions.reasoning.scene_map import SceneMap, map_of
from su3d_bench.questions.reasoning.solver import Solver
from su3d_bench.questions.refined import refined_names
from su3d_bench.questions.truths import question_truth
from su3d_bench.sheets.drafts import MOST_TEXT, Draft, also, id_of, judged
from su3d_bench.sheets.run_source import RunSource, mask_digest

NO_ANSWER = "(no answer)"
AskMap = Callable[[SceneMap, Sequence[str]], Sequence[Answer]]


def built_in(encoder: Encoder | None) -> AskMap:
    """Answers by geometry alone; ``encoder`` finds the nearest name."""

    def ask(scene: SceneMap, questions: Sequence[str]) -> Sequence[Answer]:
        solver = Solver(scene, None, None if encoder is None else nearest_by(encoder))
        return [solver.answer(one) for one in questions]

    return ask


def by_language_model(model: LanguageModel, config: LanguageConfig) -> AskMap:
    """Answers of a language model, several questions at once."""
    return lambda scene, questions: LanguageSolver(scene, model, config).answers(questions)


def requests_into(found: list[ChatRequest], model: LanguageModel, config: LanguageConfig) -> AskMap:
    """Puts what a language model would be asked into ``found`` and asks nobody."""

    def ask(scene: SceneMap, questions: Sequence[str]) -> Sequence[Answer]:
        solver = LanguageSolver(scene, model, config)
        found.extend(solver.request(one) for one in questions)
        return [unsettled("not asked")] * len(questions)

    return ask


def reasoning_drafts(
    source: RunSource, scene: str, given: Sequence[Question] | None, per_kind: int, ask: AskMap
) -> list[Draft]:
    """The answers about each map, one draft for all maps of which the same is said.

    Asked are the questions of kind ``reasoning`` that are ``given``, else ``per_kind`` of each template, made from the
    ground truth.
    """
    rules = source.rules(scene, "reasoning")
    known = () if given is not None else _known(source, scene, rules, per_kind)
    texts = [one.text for one in known]
    if given is not None:
        texts = [one.text for one in given if one.scene == scene and one.kind == REASONING]
    groups: dict[bytes, Draft] = {}
    for method in source.methods:
        instances = source.instances(scene, method)
        refined = refined_names(source.run.folder.job(scene, method), instances)
        a_map = map_of(instances, None if refined is None else refined.names)
        covered = source.covered(scene, rules, instances) if known else None
        shown = _Shown(scene, method, instances, a_map)
        for place, (text, answer) in enumerate(zip(texts, ask(a_map, texts), strict=True)):
            rows = shown.rows(answer.object_ids)
            key = text.encode() + b"\0" + told(answer).encode() + mask_digest(instances, rows)
            if key in groups:
                groups[key] = also(groups[key], method, shown.instance_id(rows))
                continue
            automatic = {}
            if covered is not None and rules is not None:
                automatic = _judged_answer(rules, known[place], answer, rows, covered)
            groups[key] = shown.draft(text, known[place].kind if known else REASONING, answer, automatic)
    return list(groups.values())


def _known(source: RunSource, scene: str, rules: ProtocolRules | None, per_kind: int) -> Sequence[TrueAnswer]:
    """Questions made from the ground truth of a scene, with their answers."""
    truth = source.truth(scene, rules)
    if rules is None or truth is None:
        raise ConfigError(
            f"{printable(scene, 100)}: has no ground truth that questions could be made from; name a file of "
            "questions of kind reasoning with --questions FILE"
        )
    with_fewer = rules.model_copy(update={"per_kind": per_kind})
    made: Any = question_truth(with_fewer, source.dataset(scene), scene.partition("/")[2], truth)
    assert isinstance(made, ReasoningTruth)
    return made.asked


def told(answer: Answer) -> str:
    """The answer as people see it: why a language model gave none names the model, which they must not see."""
    is_without = answer.solver == "llm" and not answer.is_settled
    return NO_ANSWER if is_without else answer.text


class _Shown:
    """A map of a method whose answers become drafts."""

    def __init__(self, scene: str, method: str, instances: Instances, a_map: SceneMap) -> None:
        self._scene, self._method, self._instances = scene, method, instances
        self._row_of = {one.id: one.row for one in a_map.objects}
        names = [""] * len(instances)
        for one in a_map.objects:
            names[one.row] = one.shown
        self._names = tuple(names)

    def rows(self, ids: Sequence[int]) -> tuple[int, ...]:
        return tuple(self._row_of[one] for one in ids)

    def instance_id(self, rows: Sequence[int]) -> int:
        """That of the only instance; -1 of several or none."""
        return id_of(self._instances, rows[0]) if len(rows) == 1 else -1

    def draft(self, question: str, kind: str, answer: Answer, automatic: Mapping[str, str]) -> Draft:
        rows, text = self.rows(answer.object_ids), told(answer)
        asks = ("answer", "objects") if rows else ("answer",)
        return Draft(
            kind="reasoning",
            scene=self._scene,
            methods=(self._method,),
            instance_ids=(self.instance_id(rows),),
            rows=rows,
            title=(question, f"Answer: {text}"),
            text=f"{printable(question, MOST_TEXT)}\nAnswer: {printable(text, MOST_TEXT)}",
            asks=asks,
            question_id=question_id(self._scene, REASONING, question),
            question_kind=kind,
            automatic={ask: value for ask, value in automatic.items() if ask in asks},
            others=self.rows(answer.reference_ids),
            names=self._names,
        )


def _judged_answer(
    rules: ProtocolRules, true: TrueAnswer, answer: Answer, rows: Sequence[int], covered: Covered
) -> dict[str, str]:
    assert rules.answers is not None
    given = GivenAnswer(_value(true, answer), np.array(rows, np.int64), answer.is_settled)
    main = covered.main_object
    found = {"answer": judged(is_answer_right(rules.answers, true, given, main))}
    if true.object_ids:
        found["objects"] = judged(are_objects_right(true, given, main))
    return found


def _value(true: TrueAnswer, answer: Answer) -> float | int | bool | None:
    """What the answer says; the words of a language model are read for their yes or no, or their first number."""
    if true.value is None or answer.solver == "built-in":
        return answer.value
    said = said_value(answer, true.value)
    is_count = said is not None and not isinstance(true.value, float | bool) and said == int(said)
    return int(said) if is_count and said is not None else said
