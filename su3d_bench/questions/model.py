"""What people, or a program, are asked of a scene, where they are known the objects that answer it, and an answer."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from typing import Any, Literal

KINDS = ("instance", "affordance", "property", "relative")
# Properties and relations that nothing else of the name lacks: the name alone gives the answer.
BY_NAME = {"property": "property by name", "relative": "relative by name"}
MADE_KINDS = (*KINDS, *BY_NAME.values())
REASONING = "reasoning"
ALL_KINDS = (*MADE_KINDS, REASONING)
_DIGEST_LENGTH = 12


def question_id(scene: str, kind: str, text: str) -> str:
    """A short key that is the same wherever the same question is asked of the same scene.

    >>> question_id("rooms/living0", "instance", "chair")
    '3f6958fff541'
    """
    return hashlib.sha256("\0".join((scene, kind, text)).encode()).hexdigest()[:_DIGEST_LENGTH]


@dataclass(frozen=True)
class Question:
    """One question to one scene.

    ``scene``: ``<dataset>/<scene>``; ``kind``: one of ``KINDS``, or ``reasoning``; ``answers``: ids of all instances
    of the ground truth that are right, ascending, None where nobody knows; ``source``: where the question comes from.
    ``reply``: the right answer in words, where a question has one besides objects; ``name`` and ``groups`` as in
    ``TextQuery``.
    """

    id: str
    scene: str
    kind: str
    text: str
    answers: tuple[int, ...] | None
    source: str
    reply: str = ""
    name: str = ""
    groups: tuple[str, ...] = ()

    @property
    def is_known(self) -> bool:
        """Whether an object is known that answers it."""
        return bool(self.answers)


def new_question(
    scene: str, kind: str, text: str, answers: tuple[int, ...] | None, source: str, reply: str = ""
) -> Question:
    """A question with the id that its scene, kind and text give it."""
    ascending = None if answers is None else tuple(sorted(set(answers)))
    return Question(question_id(scene, kind, text), scene, kind, text, ascending, source, reply)


@dataclass(frozen=True)
class Answer:
    """``text`` says it; ``object_ids`` are the answer, ``reference_ids`` what it was held against.

    ``value`` is the number of a count, the metres of a distance, the truth of a yes-no question, else None; ``notes``
    say what was assumed. Where ``is_settled`` is false, ``text`` says why.
    """

    text: str
    object_ids: tuple[int, ...] = ()
    reference_ids: tuple[int, ...] = ()
    value: float | int | bool | None = None
    kind: str = ""
    notes: tuple[str, ...] = ()
    is_settled: bool = True
    solver: Literal["built-in", "llm"] = "built-in"

    def said(self, like: float | int | bool) -> float | int | bool | None:
        """What it says of the kind of ``like``, read from its words where it gives no value; None for nothing."""
        if self.value is not None:
            return self.value
        if isinstance(like, bool):
            word = re.search(r"\b(yes|no)\b", self.text.lower())
            return None if word is None else word[1] == "yes"
        number = re.search(r"(?<![\w#.])\d+(?:\.\d+)?", self.text)
        return None if number is None else float(number[0])

    def to_json(self) -> dict[str, Any]:
        return {
            "answer": self.text,
            "object_ids": list(self.object_ids),
            "reference_ids": list(self.reference_ids),
            "value": self.value,
            "kind": self.kind,
            "is_settled": self.is_settled,
            "notes": list(self.notes),
            "solver": self.solver,
        }


def unsettled(reason: str, notes: tuple[str, ...] = ()) -> Answer:
    """The honest answer where geometry does not settle the question."""
    return Answer(f"I cannot settle this: {reason}", notes=notes, is_settled=False)
