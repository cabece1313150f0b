"""Parse replies of language models: a name and description, one name, or an answer with object ids.

Servers that support a schema answer in JSON. Other answers are searched for JSON, then for the format in the paper's
prompt; an answer without usable content is None. Every pattern reads a text of bounded length.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from su3d_bench.core.errors import printable
from su3d_bench.perception.embedded.lexicon import words

MAX_READ = 8000  # characters read per answer, enough for a name, a caption or an answer
MAX_NAME_CHARACTERS, MAX_NAME_WORDS = 60, 5
MAX_CAPTION_CHARACTERS = 500
MAX_OBJECTS_TRIED = 20

_QUOTE = "`'\"‘’‚‛“”„´*_"
_REFUSAL = re.compile(
    r"\b(sorry|apologi[sz]e|as an ai|i (can|could) ?not|i can['’]?t|i am (not able|unable)|i['’]m (not able|unable)"
    r"|unable to (identify|determine|assist|help|provide|recogni[sz]e|see)|cannot (identify|determine|assist|help|"
    r"provide|recogni[sz]e|see|be (identified|determined))|can['’]t (assist|help|identify)|not possible to|no image|"
    r"too (blurry|dark|small) to|unidentifiable|unrecogni[sz]able)\b",
    re.IGNORECASE,
)
_FENCE = re.compile(r"```[a-zA-Z]*")
# Name: X, Description: Y, with or without quotes, on one line or two
_COLON = rf"[{_QUOTE}]*[ \t]*(?::|[ \t][-–—]+[ \t])"
_LABELLED = re.compile(
    rf"\b(?:name|object){_COLON}\s*(?P<name>[^\n:]{{1,80}}?)[.,;\s{_QUOTE}]*"
    rf"\b(?:description|caption){_COLON}\s*(?P<caption>[^\n]{{1,2000}})",
    re.IGNORECASE,
)
_QUOTED_PAIR = re.compile(
    rf"(?<!\w)[{_QUOTE}]+(?P<name>[^\n:]{{1,80}}?)[{_QUOTE}]+\s*(?:[:：=]|[-–—]+>?)\s*(?P<caption>[^\n]{{1,2000}})"
)
_BARE_PAIR = re.compile(
    r"^[-*•\d.\s]*(?P<name>[^\n:.,;!?]{1,60}?)\s*(?:[:：]|\s[-–—]+\s)\s*(?P<caption>[^\n]{3,2000})$", re.M
)
_NAME_LEAD = re.compile(r"^(?:the )?(?:[a-z]+ ){0,2}(?:name|answer|label)(?: is)?\s*[:：]?\s*", re.IGNORECASE)
# Words of sentences, which no object name contains.
_NO_NAME = frozenset(
    (
        "is", "are", "was", "be", "am", "i", "you", "we", "it", "its", "they", "cannot", "could", "would", "should",
        "not", "no", "sorry", "based", "list", "given", "names", "name", "assign", "description", "unknown", "none",
        "null", "error", "nothing", "which", "that", "this", "there", "because", "however", "since", "as", "if",
        "please", "sure", "here",
    )
)  # fmt: skip
_UNNAMED = re.compile(
    r"\b(un(identif|recogni[sz]|determin|detect|defin|specif|nam|clear|seen)|indetermin|indistinct|indiscern)"
)
# What precedes the name in an answer without a description: a key, or the beginning of a sentence.
_LEAD = re.compile(
    rf"^[\s{_QUOTE}]*(?:(?:name|object){_COLON}|(?:(?:this|it|the (?:object|image|item))"
    r"(?: (?:is|appears to be|looks like|shows)|['’]s)\b))",
    re.IGNORECASE,
)
# Last words of names that name nothing: "unidentified object", "blurry item".
_NO_OBJECT = frozenset({"object", "objects", "thing", "things", "item", "items", "image", "n/a"})
_KEYS_OF_ERRORS = frozenset({"error", "message", "refusal", "reason", "status"})
# Ids have 64 bits: a part of a segment has an id of about a dozen digits (opensu3d/postprocess.py).
_ID = r"\d{1,18}(?!\d)"
_OBJECT_ID = re.compile(rf"(?:#|\b(?:ids?|objects?)[\s_:#=\[(]*)({_ID}(?:\s*(?:,|and|&)\s*#?{_ID})*)", re.IGNORECASE)


class CaptionForm(BaseModel):
    """The JSON of a caption."""

    model_config = ConfigDict(extra="forbid")

    name: str
    description: str


class _Answer(BaseModel):
    """The JSON of an answer, as requested in the solver's prompt; lists may contain values that are not ids."""

    answer: bool | int | float | str
    object_ids: list[Any] = []
    reference_ids: list[Any] = []
    reasoning: str = ""


@dataclass(frozen=True)
class Described:
    """A name, and a description that may be empty."""

    name: str
    description: str


@dataclass(frozen=True)
class Answered:
    """An answer in words, the ids of its objects and of the reference objects, and the reasons."""

    text: str
    object_ids: tuple[int, ...]
    reasons: str
    reference_ids: tuple[int, ...] = ()


def is_refusal(text: str) -> bool:
    """Whether ``text`` is a refusal."""
    return _REFUSAL.search(text[:400]) is not None


def described(text: str) -> Described | None:
    """Name and description of the first object that an answer describes.

    >>> described("`office chair':`A black chair on wheels.'")
    Described(name='office chair', description='A black chair on wheels.')
    >>> described("I'm sorry, I can't help with that.") is None
    True
    """
    plain = _FENCE.sub("", text[:MAX_READ])
    for value in _json_objects(plain):
        if _KEYS_OF_ERRORS.isdisjoint(value):
            pairs = [(value.get("name"), value.get("description", ""))] if "name" in value else list(value.items())
            if (found := next(filter(None, (_pair(*pair) for pair in pairs)), None)) is not None:
                return found
    patterns = [_LABELLED, _QUOTED_PAIR, *([] if is_refusal(plain) else [_BARE_PAIR])]
    unlabelled = _LEAD.sub("", plain)
    for match in (match for pattern in patterns for each in (unlabelled, plain) for match in pattern.finditer(each)):
        if (found := _pair(match["name"], match["caption"])) is not None:
            return found
    if unlabelled != plain:  # what follows the sentence or line of the name describes the object
        unlabelled = re.split(r"\n|[.;]\s", unlabelled.strip(), maxsplit=1)[0]
    name = None if is_refusal(plain) or "\n" in unlabelled.strip() else clean_name(unlabelled)
    return None if name is None else Described(name, "")


def chosen_name(text: str, names: Sequence[str]) -> str | None:
    """The name chosen by an answer: one of ``names``, in their spelling, or a short noun phrase of its own."""
    plain = _FENCE.sub("", text[:MAX_READ]).strip()
    label = next((value["name"] for value in _json_objects(plain) if isinstance(value.get("name"), str)), plain)
    stripped = [_LEAD.sub("", line).strip(_QUOTE + " ") for line in label.splitlines() if line.strip()]
    lines = [_NAME_LEAD.sub("", line) for line in stripped]
    by_words: dict[tuple[str, ...], str] = {}
    for name in names:
        by_words.setdefault(words(name), name)
    if lines and words(lines[-1]) in by_words:
        return by_words[words(lines[-1])]
    all_words = tuple(word for part in re.findall(r"[A-Za-z0-9'’\-]+", label) for word in words(part))
    hits = [one for one in by_words if one and _holds(all_words, one)]
    longest = [hit for hit in hits if not any(other != hit and _holds(other, hit) for other in hits)]
    if len(longest) == 1:
        return by_words[longest[0]]
    own = clean_name(lines[0]) if len(lines) == 1 and not is_refusal(plain) else None
    return own if own is not None and len(own.split()) <= 4 else None


def answered(text: str, known_ids: Sequence[int]) -> Answered | None:
    """The answer of a model that was asked for JSON with ``answer`` and ``object_ids``; prose is parsed too.

    Ids that are not in ``known_ids`` are dropped.
    """
    plain = _FENCE.sub("", text[:MAX_READ]).strip()
    if not plain:
        return None
    known = set(known_ids)
    for value in _json_objects(plain):
        try:
            form = _Answer.model_validate({"object_ids": value.get("ids", []), **value}, strict=True)
        except ValidationError:
            continue
        answer = ("yes" if form.answer else "no") if isinstance(form.answer, bool) else str(form.answer)
        ids = _ids(form.object_ids, known)
        references = tuple(number for number in _ids(form.reference_ids, known) if number not in ids)
        return Answered(printable(answer, 1000), ids, printable(form.reasoning, 2000), references)
    groups = [match[1] for match in _OBJECT_ID.finditer(plain)]
    numbers = dict.fromkeys(int(number) for group in groups for number in re.findall(r"\d+", group))
    return Answered(printable(plain, 1000), tuple(number for number in numbers if number in known), "")


def _ids(listed: list[Any], known: Collection[int]) -> tuple[int, ...]:
    """The ``known`` ids in ``listed``, without duplicates."""
    texts = [str(value) for value in listed if isinstance(value, int | str)]
    numbers = dict.fromkeys(int(value.lstrip("#")) for value in texts if re.fullmatch(rf"#?{_ID}", value))
    return tuple(number for number in numbers if number in known)


def clean_name(text: str) -> str | None:
    """``text`` as a name: lower case, without quotes, article and full stop; None if it is not a noun phrase.

    >>> clean_name('"The Office Chair".'), clean_name("I cannot tell")
    ('office chair', None)
    """
    if len(text) > 4 * MAX_NAME_CHARACTERS:
        return None
    name = " ".join(text.strip(_QUOTE + " .,;:!?()[]{}<>#-\n\t").split()).lower()
    name = re.sub(r"^(?:an?|the|some)\s+", "", name).replace("**", "").replace("`", "")
    parts = re.findall(r"[^\W\d_]+", name)
    is_short = len(name) <= MAX_NAME_CHARACTERS and len(name.split()) <= MAX_NAME_WORDS
    if not parts or not is_short or set(parts) & _NO_NAME or name.split()[-1] in _NO_OBJECT or _UNNAMED.search(name):
        return None
    return None if not name.isprintable() or re.search(r"[{}\[\]<>|\\=:;?!\"]", name) else name


def _json_objects(text: str) -> Iterator[dict[str, Any]]:
    """The JSON objects in ``text``, including those inside prose."""
    decoder, start = json.JSONDecoder(), 0
    for _ in range(MAX_OBJECTS_TRIED):
        start = text.find("{", start)
        if start < 0:
            return
        try:
            value, end = decoder.raw_decode(text, start)
        except (ValueError, RecursionError):
            value, end = None, start + 1
        if isinstance(value, dict):
            yield value
        start = end


def _pair(name: Any, caption: Any) -> Described | None:
    if not isinstance(name, str) or not isinstance(caption, str):
        return None
    cleaned = clean_name(name)
    caption = printable(caption.strip(_QUOTE + " \n\t,{}"), MAX_CAPTION_CHARACTERS)
    return None if cleaned is None else Described(cleaned, caption)


def _holds(whole: tuple[str, ...], part: tuple[str, ...]) -> bool:
    return any(whole[k : k + len(part)] == part for k in range(len(whole) - len(part) + 1))
