"""Generated questions judged without a person: whether an answer about one map is the true one about another."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.questions.reasoning.answers import Answer
from su3d_bench.questions.reasoning.generated import GeneratedQuestion

DISTANCE_M, DISTANCE_SHARE = 0.1, 0.1  # ours: a distance is right within 0.1 m or a tenth


def box_iou(a: Float64Array, b: Float64Array) -> float:
    """Intersection over union of two boxes (2, 3); 0 where both are empty."""
    shared = float(np.prod(np.clip(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0.0, None)))
    union = float(np.prod(a[1] - a[0]) + np.prod(b[1] - b[0])) - shared
    return shared / union if union > 0 else 0.0


def is_right(question: GeneratedQuestion, answer: Answer, same: Mapping[int, int]) -> bool:
    """Whether ``answer`` says what is true; its ids are those of the map whose objects ``same`` leads to the truth.

    Lists must be complete and hold nothing else; of a "which" question the first object counts. An answer in words
    alone is read for its yes or no, or its first number.
    """
    if not answer.is_settled:
        return False
    true = question.answer.value
    if true is None:
        ids = [same.get(object_id) for object_id in answer.object_ids]
        if question.kind.startswith(("what ", "between")):
            return set(ids) == set(question.answer.object_ids)
        return ids[:1] == list(question.answer.object_ids[:1])
    value = said_value(answer, true)
    if value is None:
        return False
    if isinstance(true, float):
        return abs(value - true) <= max(DISTANCE_M, DISTANCE_SHARE * true)
    return value == true


def said_value(answer: Answer, like: float | int | bool) -> float | int | bool | None:
    """What an answer says of the kind of ``like``, read from its words where it gives no value; None for nothing."""
    if answer.value is not None:
        return answer.value
    text = answer.text.lower()
    if isinstance(like, bool):
        word = re.search(r"\b(yes|no)\b", text)
        return None if word is None else word[1] == "yes"
    number = re.search(r"(?<![\w#.])\d+(?:\.\d+)?", text)
    return None if number is None else float(number[0])
