"""Label n': one name for an instance out of the names that its best views gave it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from su3d_bench.core.english import words
from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Instances
from su3d_bench.perception.language.captioner import REFINE, REFINE_FORM, list_of_names, reason_of
from su3d_bench.perception.language.chat import ChatRequest
from su3d_bench.perception.language.client import LanguageModel
from su3d_bench.perception.language.config import LanguageConfig
from su3d_bench.perception.language.parsing import chosen_name

MOST_ANSWER_TOKENS = 200  # a name needs few; models that think aloud need more
Source = Literal["model", "vote", "label"]


@dataclass(frozen=True)
class TopNames:
    """The names of an instance's ``m`` best views, best first, with their prediction scores; ``label`` is n."""

    label: str
    names: tuple[str, ...]
    scores: tuple[float, ...]


@dataclass(frozen=True)
class RefinedName:
    """Label n' of an instance and who chose it; ``label``: n stayed, for the ``reason`` given."""

    name: str
    source: Source
    reason: str
    key: str = ""


def top_names(instances: Instances, m: int) -> list[TopNames]:
    """Names of the ``m`` views of highest prediction score of each instance; ties: the earlier view."""
    if instances.view_names is None or instances.view_scores is None:
        raise PredictionError("this map keeps no names of its views; make it anew with a method that does (opensu3d)")
    tops = []
    for k, label in enumerate(instances.names):
        first, last = int(instances.view_indptr[k]), int(instances.view_indptr[k + 1])
        scores = np.asarray(instances.view_scores[first:last], np.float64)
        order = [first + int(row) for row in np.argsort(-scores, kind="stable")[:m]]
        names = [(instances.view_names[row].strip(), float(instances.view_scores[row])) for row in order]
        named = [(name, score) for name, score in names if name]
        tops.append(TopNames(label, tuple(name for name, _ in named), tuple(score for _, score in named)))
    return tops


def vote(top: TopNames) -> RefinedName:
    """The name with the greatest sum of prediction scores; ties: the one with the best view.

    Names that differ in case, hyphens or plural alone count together, under the spelling of the best view. No language
    model takes part: names of different words stay different.

    >>> vote(TopNames("sofa", ("sofa", "couch", "couch"), (0.9, 0.5, 0.5))).name
    'couch'
    """
    if not top.names:
        return RefinedName(top.label, "label", "no view has a name")
    totals: dict[tuple[str, ...], float] = {}
    spelling: dict[tuple[str, ...], str] = {}
    for name, score in zip(top.names, top.scores, strict=True):
        key = words(name) or (name,)
        totals[key] = totals.get(key, 0.0) + score
        spelling.setdefault(key, name)
    best = max(totals.values())
    return RefinedName(next(spelling[key] for key, total in totals.items() if total == best), "vote", "")


class ModelRefiner:
    """Asks the text model for a single name, with the paper's prompt."""

    def __init__(self, model: LanguageModel, config: LanguageConfig) -> None:
        self._model = model
        self._config = config

    def requests(self, tops: Sequence[TopNames]) -> list[ChatRequest]:
        """One request for each instance that has a name."""
        config = self._config
        return [
            ChatRequest(
                "refine",
                config.text_model,
                f"{REFINE}. {REFINE_FORM}",
                list_of_names(top.names),
                max_answer_tokens=min(config.max_answer_tokens, MOST_ANSWER_TOKENS),
                temperature=config.temperature,
                seed=config.seed,
            )
            for top in tops
            if top.names
        ]

    def refine(self, tops: Sequence[TopNames]) -> list[RefinedName]:
        """n' of each instance: the model's name where it can be used, else n with the reason."""
        requests = self.requests(tops)
        answers = iter(zip(requests, self._model.ask_all(requests), strict=True))
        refined = []
        for top in tops:
            if not top.names:
                refined.append(RefinedName(top.label, "label", "no view has a name"))
                continue
            request, reply = next(answers)
            name = None if reply.failure else chosen_name(reply.text, top.names)
            if name is None:
                refined.append(RefinedName(top.label, "label", reason_of(reply), request.key))
            else:
                refined.append(RefinedName(name, "model", "", request.key))
        return refined
