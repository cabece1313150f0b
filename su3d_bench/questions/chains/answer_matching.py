"""Answers in words held against right ones, as Beacon3D holds them before it asks a language model.

Source: ``clean_answer``, ``answer_match`` and ``is_binary_question`` in utils.py of beacon-3d/beacon-3d at 9cd8f1f; the
cleaning is that of SQA3D. What seems odd is the original's: any right answer with "no" in it, north too, is one to a
question of yes or no, and an empty answer is a part of every right one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

_NUMBERS = (
    *("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"),
    *("eleven", "twelve", "thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty"),
)
_SPELLINGS = {
    "letf": "left", "let": "left", "tehre": "there", "brigth": "right", "brght": "right", "behine": "behind",
    "tv": "TV", "chai": "chair", "wasing": "washing", "waslked": "walked", "oclock": "o'clock",
}  # fmt: skip
# In this order: what one leaves is what the next sees.
_RULES: tuple[tuple[str, str], ...] = (
    (" +$", ""),
    ("^ +", ""),
    (" {2,}", " "),
    (r"\. {2,}", ". "),
    (r"[^a-zA-Z0-9,'\s\-:]+", ""),
    *((rf"\b{wrong}\b", right) for wrong, right in _SPELLINGS.items()),
    (r"\bo' +clock\b", "o'clock"),
    (r"\b0\b", "zero"),
    (r"\bnone\b", "zero"),
    *((rf"\b{number}\b", word) for number, word in enumerate(_NUMBERS) if number),
    (r"\b23\b", "twenty-three"),
    (r"\b([a-zA-Z]+)([0-9])\b", r"\g<1>"),
    *((rf"\b{article}\b ([a-zA-Z]+)", r"\g<1>") for article in ("a", "an", "the")),
    (r"\bbackwards\b", "backward"),
)
_COMPILED = [(re.compile(pattern), by) for pattern, by in _RULES]


def cleaned(answer: str) -> str:
    """An answer without articles and signs, small numbers in words.

    >>> cleaned(" The  2 chairs. ")
    'two chairs'
    """
    answer = answer.lower()
    for pattern, by in _COMPILED:
        answer = pattern.sub(by, answer)
    return answer


def match(given: str, right: Sequence[str]) -> tuple[bool, bool]:
    """Whether a cleaned answer is a right one (EM), and whether one is at least part of the other (EM-R).

    >>> match("white", ["off-white"]), match("white", ["white"]), match("red", ["white"])
    ((False, True), (True, True), (False, False))
    """
    for one in right:
        if given == one:
            return True, True
        a, b = "".join(given.split()), "".join(one.split())
        if a in b or b in a:
            return False, True
    return False, False


def is_yes_or_no(right: Sequence[str]) -> bool:
    """Whether a right answer holds "yes" or "no"."""
    return any(word in one.lower() for one in right for word in ("yes", "no"))
