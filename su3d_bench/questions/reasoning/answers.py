"""An answer to a question about a map, with what it rests on."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal


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
