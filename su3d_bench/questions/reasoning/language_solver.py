"""Questions answered by a language model that is given the map without points and features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from su3d_bench.perception.language.captioner import reason_of
from su3d_bench.perception.language.chat import ChatRequest, Reply
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.perception.language.config import LanguageConfig
from su3d_bench.perception.language.parsing import answered, is_refusal
from su3d_bench.questions.reasoning.answers import Answer, unsettled
from su3d_bench.questions.reasoning.prompting import Context, ask_request, context_for
from su3d_bench.questions.reasoning.scene_map import SceneMap


class LanguageSolver:
    """Asks the text model with the paper's prompting strategy."""

    def __init__(self, scene: SceneMap, model: LanguageModel, config: LanguageConfig) -> None:
        self._scene = scene
        self._model = model
        self._config = config

    def request(self, question: str) -> ChatRequest:
        """What is asked of the model."""
        return ask_request(context_for(self._scene, question, self._config), question, self._config)

    def answer(self, question: str) -> Answer:
        """The model's answer and the objects that it names; its failure or refusal as an unsettled one."""
        return self.answers([question])[0]

    def answers(self, questions: Sequence[str]) -> list[Answer]:
        """The answers in the order of ``questions``, several of which may be under way at once."""
        contexts = [context_for(self._scene, question, self._config) for question in questions]
        requests = [ask_request(*both, self._config) for both in zip(contexts, questions, strict=True)]
        replies = self._model.ask_all(requests)
        return [self._answer(*both) for both in zip(contexts, replies, strict=True)]

    def _answer(self, context: Context, reply: Reply) -> Answer:
        notes = tuple(note for note in (context.note, _dropped(reply.dropped)) if note)
        parsed = None if reply.failure else answered(reply.text, [thing.id for thing in context.objects])
        if parsed is None or (not parsed.object_ids and is_refusal(parsed.text)):
            return replace(unsettled(f"{self._config.text_model}: {reason_of(reply)}", notes), solver="llm")
        if reply.finish_reason == "length":
            notes += ("the answer was cut at max_answer_tokens",)
        if not parsed.object_ids:
            notes += ("the answer names no object of the map",)
        if parsed.reasons:
            notes += (f"reasoning: {parsed.reasons}",)
        return Answer(parsed.text, parsed.object_ids, kind="llm", notes=notes, solver="llm")


def _dropped(names: tuple[str, ...]) -> str:
    return f"the server does not take {', '.join(names)}; the model ran without" if names else ""
