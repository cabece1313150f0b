"""What a model meant by a free-form answer: a name and a description, one name, or an answer with object ids.

Answers come with quotes, JSON, Markdown fences, prose around them, or as a refusal; what holds nothing of use is None.
Every pattern reads a bounded text.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from su3d_bench.core.errors import printable
from su3d_bench.perception.embedded.text import words

MOST_READ = 8000  # characters of an answer; a name, a caption or an answer stands within
MOST_NAME_CHARACTERS, MOST_NAME_WORDS = 60, 5
MOST_CAPTION_CHARACTERS = 500
MOST_OBJECTS_TRIED = 20

_QUOTE = "`'\"‘’‚‛“”„´*_"
_REFUSAL = re.compile(
    r"\b(sorry|apologi[sz]e|as an ai|i (can|could) ?not|i can['’]?t|i am (not able|unable)|i['’]m (not able|unable)"
    r"|unable to (identify|determine|assist|help|provide|recogni[sz]e|see)|cannot (identify|determine|assist|help|"
    r"provide|recogni[sz]e|see|be (identified|determined))|can['’]t (assist|help|identify)|not possible to|no image|"
    r"too (blurry|dark|small) to|unidentifiable|unrecogni[sz]able)\b",
    re.IGNORECASE,
)
_FENCE = re.compile(r"```[a-zA-Z]*")
_QUOTED_PAIR = re.compile(
    rf"(?<!\w)[{_QUOTE}]+(?P<name>[^\n:]{{1,80}}?)[{_QUOTE}]+\s*(?:[:：=]|[-–—]+>?)\s*(?P<caption>[^\n]{{1,2000}})"
)
_LABELLED = re.compile(
    rf"[{_QUOTE}]*\b(?P<key>name|object|label|title|description|caption)\b[{_QUOTE}]*\s*[:：=]\s*"
    rf"(?P<value>[^\n]{{1,2000}}?)(?=[,;]?\s*[{_QUOTE}]*\b(?:description|caption)\b[{_QUOTE}]*\s*[:：=]|\n|$)",
    re.IGNORECASE,
)
_BARE_PAIR = re.compile(
    r"^[-*•\d.\s]*(?P<name>[^\n:.,;!?]{1,60}?)\s*(?:[:：]|\s[-–—]+\s)\s*(?P<caption>[^\n]{3,2000})$", re.M
)
_PROSE = re.compile(
    r"\b(?:this|it|that|the (?:object|image|picture|crop|item)(?: in the [a-z]+)?)(?: is| shows| depicts| contains"
    r"| appears to be| looks like| seems to be|['’]s)(?: a picture of| an image of)? (?:an? |the |some )"
    r"(?P<name>[a-z][a-z'’\- ]{1,50}?)"
    r"(?=[.,;!\n]|$| (?:with|that|which|in|on|of|at|against|next|made|standing|placed)\b)",
    re.IGNORECASE,
)
_NAME_LEAD = re.compile(
    r"^(?:the |a |an )?(?:single |best |final |most (?:suitable|appropriate|fitting) |suitable |assigned )*"
    r"(?:name|answer|label)(?: (?:for|of) (?:the|this) object)?(?: (?:is|would be|could be))?\s*[:：]?\s*",
    re.IGNORECASE,
)
# Words of sentences: no name of a thing has them.
_NO_NAME = frozenset(
    (
        "is", "are", "was", "be", "am", "i", "you", "we", "it", "its", "they", "cannot", "could", "would", "should",
        "not", "no", "sorry", "based", "list", "given", "names", "name", "assign", "description", "unknown", "none",
        "null", "error", "unclear", "which", "that", "this", "there", "because", "however", "since", "as", "if",
        "please", "sure", "here",
    )
)  # fmt: skip
_NO_OBJECT = frozenset({"object", "objects", "thing", "item", "image", "n/a"})
_KEYS_OF_NAME = ("name", "object", "label", "title", "object_name")
_KEYS_OF_CAPTION = ("description", "caption", "desc", "details")
_KEYS_OF_ERRORS = frozenset({"error", "message", "refusal", "reason", "status"})
# Ids are of 64 bits: a part of a segment has one of a dozen digits (opensu3d/postprocess.py).
_ID = r"\d{1,18}(?!\d)"
_OBJECT_ID = re.compile(rf"(?:#|\b(?:ids?|objects?)[\s_:#=\[(]*)({_ID}(?:\s*(?:,|and|&)\s*#?{_ID})*)", re.IGNORECASE)


@dataclass(frozen=True)
class Described:
    """A name, and a description that may be empty."""

    name: str
    description: str


@dataclass(frozen=True)
class Answered:
    """An answer in words, the ids of the objects that it names and of what these were held against, the reasons."""

    text: str
    object_ids: tuple[int, ...]
    reasons: str
    reference_ids: tuple[int, ...] = ()


def is_refusal(text: str) -> bool:
    """Whether ``text`` says that it will not or cannot answer."""
    return _REFUSAL.search(text[:400]) is not None


def described(text: str) -> Described | None:
    """Name and description of the first object that an answer describes.

    >>> described("`office chair':`A black chair on wheels.'")
    Described(name='office chair', description='A black chair on wheels.')
    >>> described("I'm sorry, I can't help with that.") is None
    True
    """
    plain = _unfenced(text)
    pair = _from_json(plain) or _from_quotes(plain) or _from_labels(plain)
    if pair is None and not is_refusal(plain):
        pair = _from_bare_pair(plain) or _from_prose(plain)
    return pair


def chosen_name(text: str, names: Sequence[str]) -> str | None:
    """The name that an answer settles on: one of ``names``, in their spelling, or a short noun phrase of its own."""
    plain = _unfenced(text).strip()
    candidates = [*_json_names(plain), *_lines_without_lead(plain), *_quoted(plain)]
    by_words: dict[tuple[str, ...], str] = {}
    for name in names:
        by_words.setdefault(words(name), name)
    for candidate in candidates:
        if candidate and words(candidate) in by_words:
            return by_words[words(candidate)]
    mentioned = _mentioned(plain, by_words)
    if len(mentioned) == 1:
        return mentioned[0]
    if is_refusal(plain):
        return None
    return next((name for name in map(clean_name, candidates) if name and len(name.split()) <= 4), None)


def answered(text: str, known_ids: Sequence[int]) -> Answered | None:
    """The answer of a model that was asked for JSON with ``answer`` and ``object_ids``; from prose where it gave that.

    Ids that are none of ``known_ids`` are left out.
    """
    plain = _unfenced(text).strip()
    if not plain:
        return None
    known = set(known_ids)
    for value in _json_objects(plain):
        answer = value.get("answer")
        if not isinstance(answer, str | int | float | bool):
            continue
        reasons = value.get("reasoning", "")
        shown = ("yes" if answer else "no") if isinstance(answer, bool) else str(answer)
        object_ids = _ids(value.get("object_ids", value.get("ids", ())), known)
        return Answered(
            printable(shown, 1000),
            object_ids,
            printable(reasons if isinstance(reasons, str) else "", 2000),
            tuple(number for number in _ids(value.get("reference_ids", ()), known) if number not in object_ids),
        )
    groups = [match[1] for match in _OBJECT_ID.finditer(plain)]
    numbers = dict.fromkeys(int(number) for group in groups for number in re.findall(r"\d+", group))
    return Answered(printable(plain, 1000), tuple(number for number in numbers if number in known), "")


def _ids(listed: Any, known: Collection[int]) -> tuple[int, ...]:
    """Those of ``listed`` that are ``known``, each once."""
    given = [str(value) for value in listed if isinstance(value, int | str)] if isinstance(listed, list) else []
    numbers = dict.fromkeys(int(value.lstrip("#")) for value in given if re.fullmatch(rf"#?{_ID}", value))
    return tuple(number for number in numbers if number in known)


def clean_name(text: str) -> str | None:
    """``text`` as a name: lower case, without quotes, article and full stop; None where it is no noun phrase.

    >>> clean_name('"The Office Chair".'), clean_name("I cannot tell")
    ('office chair', None)
    """
    if len(text) > 4 * MOST_NAME_CHARACTERS:
        return None
    name = " ".join(text.strip(_QUOTE + " .,;:!?()[]{}<>#-\n\t").split()).lower()
    name = re.sub(r"^(?:an?|the|some)\s+", "", name).replace("**", "").replace("`", "")
    parts = re.findall(r"[^\W\d_]+", name)
    if not parts or len(name) > MOST_NAME_CHARACTERS or len(name.split()) > MOST_NAME_WORDS:
        return None
    if (
        not name.isprintable()
        or re.search(r"[{}\[\]<>|\\=:;?!\"]", name)
        or set(parts) & _NO_NAME
        or name in _NO_OBJECT
    ):
        return None
    return name


def _clean_caption(text: str) -> str:
    return printable(text.strip(_QUOTE + " \n\t,{}"), MOST_CAPTION_CHARACTERS)


def _unfenced(text: str) -> str:
    return _FENCE.sub("", text[:MOST_READ])


def _json_objects(text: str) -> Iterator[dict[str, Any]]:
    """The JSON objects in ``text``, those inside prose too; Python's spelling of one counts."""
    decoder, start = json.JSONDecoder(), 0
    for _ in range(MOST_OBJECTS_TRIED):
        start = text.find("{", start)
        if start < 0:
            return
        try:
            value, end = decoder.raw_decode(text, start)
        except (ValueError, RecursionError):
            value, end = _python_object(text, start), start + 1
        if isinstance(value, dict):
            yield value
        start = max(end, start + 1)


def _python_object(text: str, start: int) -> Any:
    end = text.find("}", start)
    if end < 0:
        return None
    try:
        return ast.literal_eval(text[start : end + 1])
    except (ValueError, SyntaxError, RecursionError, MemoryError, TypeError):
        return None


def _pair(name: Any, caption: Any) -> Described | None:
    if not isinstance(name, str) or not isinstance(caption, str):
        return None
    cleaned = clean_name(name)
    return None if cleaned is None else Described(cleaned, _clean_caption(caption))


def _from_json(text: str) -> Described | None:
    for value in _json_objects(text):
        lower = {str(key).lower(): text for key, text in value.items()}
        name = next((lower[key] for key in _KEYS_OF_NAME if isinstance(lower.get(key), str)), None)
        if name is not None:
            caption = next((lower[key] for key in _KEYS_OF_CAPTION if isinstance(lower.get(key), str)), "")
            return _pair(name, caption)
        if not _KEYS_OF_ERRORS & set(lower):
            pairs = (_pair(*item) for item in value.items())
            if (pair := next((pair for pair in pairs if pair), None)) is not None:
                return pair
    return None


def _from_quotes(text: str) -> Described | None:
    for match in _QUOTED_PAIR.finditer(text):
        if match["name"].strip(_QUOTE + " ").lower() in (*_KEYS_OF_NAME, *_KEYS_OF_CAPTION):
            continue
        if pair := _pair(match["name"], match["caption"]):
            return pair
    return None


def _from_labels(text: str) -> Described | None:
    values: dict[str, str] = {}
    for match in _LABELLED.finditer(text):
        kind = "caption" if match["key"].lower() in _KEYS_OF_CAPTION else "name"
        values.setdefault(kind, match["value"])
    return _pair(values["name"], values.get("caption", "")) if "name" in values else None


def _from_bare_pair(text: str) -> Described | None:
    pairs = (_pair(match["name"], match["caption"]) for match in _BARE_PAIR.finditer(text))
    return next((pair for pair in pairs if pair), None)


def _from_prose(text: str) -> Described | None:
    match = _PROSE.search(text)
    if match is not None:
        return _pair(match["name"], text.strip())
    name = clean_name(text) if "\n" not in text.strip() else None
    return None if name is None else Described(name, "")


def _json_names(text: str) -> list[str]:
    names: list[str] = []
    for value in _json_objects(text):
        names += [str(value[key]) for key in _KEYS_OF_NAME if isinstance(value.get(key), str)]
        names += [name for name in value.values() if isinstance(name, str) and len(value) == 1]
    return names


def _lines_without_lead(text: str) -> list[str]:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return [_NAME_LEAD.sub("", line.strip(_QUOTE + " ")) for line in (lines if len(lines) <= 3 else lines[-1:])]


def _quoted(text: str) -> list[str]:
    quoted = re.findall(
        r"[`\"“‘]([^`\"“”‘’\n]{1,60})[`\"”’]|\*\*([^*\n]{1,60})\*\*|(?<!\w)'([^'\n]{1,60})'(?!\w)", text
    )
    phrases = list(dict.fromkeys("".join(groups) for groups in quoted))
    return phrases if len(phrases) == 1 else []


def _mentioned(text: str, by_words: Mapping[tuple[str, ...], str]) -> list[str]:
    """Names whose words stand in ``text`` one after the other; of two that overlap the longer one."""
    all_words = tuple(word for part in re.findall(r"[A-Za-z0-9'’\-]+", text) for word in words(part))
    hits = [name_words for name_words in by_words if name_words and _holds(all_words, name_words)]
    longest = [hit for hit in hits if not any(other != hit and _holds(other, hit) for other in hits)]
    return [by_words[hit] for hit in longest]


def _holds(whole: tuple[str, ...], part: tuple[str, ...]) -> bool:
    return any(whole[k : k + len(part)] == part for k in range(len(whole) - len(part) + 1))
