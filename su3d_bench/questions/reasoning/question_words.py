"""English questions about places, read into what is asked; what cannot be read is None.

A small grammar: closer and farther, distances, counts, presence, relations, between, sizes, places.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Relation = Literal["on", "under", "in", "above", "next to", "near", "left of", "right of", "between", "with"]
Size = Literal["largest", "smallest", "tallest", "lowest", "longest", "highest"]

MOST_CHARACTERS = 400
# Each relation with its spellings, the longer ones first.
_SPELLINGS: tuple[tuple[Relation, str], ...] = (
    ("left of", r"(?:on|to|at) the left(?: hand)?(?: side)? of|left of"),
    ("right of", r"(?:on|to|at) the right(?: hand)?(?: side)? of|right of"),
    ("on", r"on top of|resting on|sitting on|standing on|lying on|placed on|upon|atop|on"),
    ("under", r"underneath|beneath|below|under"),
    ("next to", r"right next to|next to|beside|adjacent to|alongside"),
    ("near", r"close to|near to|nearby|near|around"),
    ("above", r"above|over"),
    ("in", r"inside of|inside|within|in"),
    ("between", r"in between|between"),
    ("with", r"with"),
)
_RELATION = re.compile("|".join(rf"(?P<r{k}>\b(?:{pattern})\b)" for k, (_, pattern) in enumerate(_SPELLINGS)))
_CLOSE, _FAR = r"clos(?:er|est)|near(?:er|est)", r"(?:farther|further|farthest|furthest)(?: away)?"
_HOW = rf"(?:the )?(?:(?P<close>{_CLOSE})|(?P<far>{_FAR}))"
_ENDS = r"(?:to|from)"
_ARE = r"(?:is|are|lies|lie|stands|stand|would be)"
_SIZES: tuple[tuple[Size, str], ...] = (
    ("largest", r"largest|biggest|larger|bigger"),
    ("smallest", r"smallest|littlest|smaller"),
    ("tallest", r"tallest|taller"),
    ("lowest", r"lowest|lower"),
    ("longest", r"longest|widest|longer|wider"),
    ("highest", r"highest|higher"),
)
_SIZE = "|".join(pattern for _, pattern in _SIZES)
_HERE = re.compile(
    r"\b(?:(?:in|inside|of|within|throughout) )?(?:the|this|my|our) (?:whole |entire )?"
    r"(?:room|scene|map|house|apartment|flat|place)\b(?! \w)|\bhere\b$"
)
_POLITE = re.compile(
    r"^(?:please|can you|could you|would you|tell me|do you know|i want to know|find out|show me|let me know)\b[ ,]*"
)
# Distances are between centres anyway.
_CENTRES = re.compile(
    r"(?:,? measured (?:between|from) (?:their |the )?cent(?:re|er)s?(?: to cent(?:re|er)s?)?|the cent(?:re|er)s? of )"
)
_EVERYTHING = r"(?:object|objects|thing|things|item|items|furniture item)"


@dataclass(frozen=True)
class Phrase:
    """A noun phrase: ``head``, and where it is restricted, the ``relation`` to ``others`` (two for "between")."""

    head: str
    relation: Relation | None = None
    others: tuple[Phrase, ...] = ()


@dataclass(frozen=True)
class Question:
    """What is asked: ``kind`` with its operands; which fields are set depends on the kind.

    ``extreme``: which of ``subject`` (or of ``options``) is closest to or farthest from ``other``. ``closer``: whether
    ``subject`` is closer to (farther from) ``other`` than ``options[0]``. ``size``: which of ``subject`` is largest.
    """

    kind: Literal["extreme", "closer", "distance", "count", "exists", "holds", "list", "size", "where"]
    subject: Phrase
    other: Phrase | None = None
    options: tuple[Phrase, ...] = ()
    relation: Relation | None = None
    farthest: bool = False
    size: Size | None = None


ANYTHING = Phrase("object")


def read_question(text: str) -> Question | None:
    """What ``text`` asks, or None.

    >>> read_question("Which sink is closer to bed?").subject
    Phrase(head='sink', relation=None, others=())
    """
    plain = _plain(text)
    if not plain:
        return None
    for reader in (_closer, _extreme, _distance, _count, _size, _where, _holds_or_exists, _list):
        question = reader(plain)
        if question is not None:
            return question
    return None


def _plain(text: str) -> str:
    plain = " ".join(text[: MOST_CHARACTERS + 1].lower().replace("’", "'").split())
    if len(plain) > MOST_CHARACTERS:
        return ""
    plain = plain.rstrip(" ?.!")
    while (shorter := _POLITE.sub("", plain)) != plain:
        plain = shorter
    plain = re.sub(r"\b(what|which|where|how|who)'s\b", r"\1 is", plain)
    plain = re.sub(r"\b(near|on|under|in|above|to|from|beside),\s", r"\1 ", plain)
    plain = _CENTRES.sub("", plain)
    return " ".join(_HERE.sub("", plain).split()).strip(" ,?.!")


def read_phrase(text: str) -> Phrase:
    """The noun phrase ``text``: "the lamp on a desk" is "lamp", on, "desk"."""
    phrase = re.sub(r"^(?:the|a|an|any|some|all|another|other|my|that|this)\s+", "", text.strip(" ,"))
    phrase = re.sub(r"^(?:the|a|an|other)\s+", "", phrase)
    relation_match = next((match for match in _RELATION.finditer(phrase) if match.start() > 0), None)
    if relation_match is None:
        return Phrase(phrase.strip())
    head = re.sub(r"\s+(?:that|which|who)?\s*(?:is|are|lies|stands|hangs|hanging|lying|standing|sitting)?$", "",
                  phrase[: relation_match.start()].strip())  # fmt: skip
    relation, rest = _relation_of(relation_match), phrase[relation_match.end() :].strip()
    return Phrase(head.strip(), relation, _operands(relation, rest)) if rest and head else Phrase(phrase.strip())


def _operands(relation: Relation, text: str) -> tuple[Phrase, ...]:
    if relation != "between":
        return (read_phrase(text),)
    first, joined, second = re.sub(r"^(?:the )?(?:two )", "", text).partition(" and ")
    return (read_phrase(first), read_phrase(second)) if joined else (read_phrase(first),)


def _relation_of(match: re.Match[str]) -> Relation:
    return next(name for k, (name, _) in enumerate(_SPELLINGS) if match[f"r{k}"] is not None)


def _options(text: str) -> tuple[Phrase, ...]:
    parts = re.split(r"\s*,\s*(?:or |and )?|\s+or\s+", text.strip(" ,:"))
    return tuple(read_phrase(re.sub(r"^(?:either|is it|the)\s+", "", part)) for part in parts if part.strip())


def _closer(plain: str) -> Question | None:
    match = re.fullmatch(rf"(?:is|are) (?P<a>.+?) {_HOW} {_ENDS} (?P<ref>.+?) than (?:to )?(?P<b>.+)", plain)
    if match is None:
        return None
    options = (read_phrase(match["b"]),)
    return Question("closer", read_phrase(match["a"]), read_phrase(match["ref"]), options, farthest=bool(match["far"]))


def _extreme(plain: str) -> Question | None:
    patterns = (
        rf"(?:which|what)(?: one)?(?: of the)?(?: (?P<a>(?!is |are ).+?))? {_ARE} {_HOW}(?: one| {_EVERYTHING})?"
        rf" {_ENDS} (?P<ref>.+)",
        rf"(?:which|what) (?:is|are) {_HOW} (?P<a>.+?) {_ENDS} (?P<ref>.+)",
        rf"(?:where (?:is|are)|find|show|give) {_HOW} (?P<a>.+?) {_ENDS} (?P<ref>.+)",
        rf"(?:where (?:is|are)|find|show|give|which is|what is) (?P<a>.+?) {_HOW} {_ENDS} (?P<ref>.+)",
        rf"{_HOW} (?P<a>.+?) {_ENDS} (?P<ref>.+)",
        rf"(?:is|are) (?P<options>.+? or .+?) {_HOW} {_ENDS} (?P<ref>.+)",
    )
    for pattern in patterns:
        match = re.fullmatch(pattern, plain)
        if match is None:
            continue
        groups = match.groupdict()
        ref, _, listed = re.sub(r"\s*[:;]\s*", ", ", match["ref"]).partition(", ")
        options = _options(groups.get("options") or listed)
        subject = read_phrase(groups["a"]) if groups.get("a") else ANYTHING
        if not options and " or " in ref:
            return None
        return Question("extreme", subject, read_phrase(ref), options, farthest=bool(match["far"]))
    return None


def _distance(plain: str) -> Question | None:
    patterns = (
        r"(?:what|how (?:large|big|long|much)) is the distance (?:between|from) (?P<a>.+?) (?:and|to) (?P<b>.+)",
        r"(?:distance (?:between|from)) (?P<a>.+?) (?:and|to) (?P<b>.+)",
        r"how (?:far|close|near)(?: away| apart)? (?:is|are) (?P<a>.+?) (?:away )?(?:from|to|and) (?P<b>.+?)"
        r"(?: apart)?",
    )
    for pattern in patterns:
        if match := re.fullmatch(pattern, plain):
            return Question("distance", read_phrase(match["a"]), read_phrase(match["b"]))
    return None


def _count(plain: str) -> Question | None:
    match = re.fullmatch(
        r"(?:how many (?P<a>.+?)(?: are| is| do| can)(?: there)?(?: you see| i have| we have)?(?P<rest> .+)?"
        r"|(?:how many|count(?: all)?|what is the number of|number of) (?P<b>.+))",
        plain,
    )
    if match is None:
        return None
    named = f"{match['a']}{match['rest'] or ''}" if match["a"] else match["b"]
    return Question("count", read_phrase(named))


def _size(plain: str) -> Question | None:
    patterns = (
        rf"(?:which|what|where) (?:is|are) (?:the )?(?P<size>{_SIZE})(?: of the| of all)?(?P<a> .+)?",
        rf"(?:which|what)(?: of the)? (?P<a>.+?) {_ARE} (?:the )?(?P<size>{_SIZE})(?: one)?",
        rf"(?:find |show )?(?:the )?(?P<size>{_SIZE}) (?P<a>.+)",
    )
    for pattern in patterns:
        if match := re.fullmatch(pattern, plain):
            size = next(name for name, spelt in _SIZES if re.fullmatch(spelt, match["size"]))
            named, _, listed = (match["a"] or "object").partition(", ")
            return Question("size", read_phrase(named), options=_options(listed), size=size)
    return None


def _where(plain: str) -> Question | None:
    match = re.fullmatch(r"(?:where (?:is|are|can i find|do i find)|locate|find|show) (?P<a>.+)", plain)
    return None if match is None else Question("where", read_phrase(match["a"]))


def _holds_or_exists(plain: str) -> Question | None:
    if match := re.fullmatch(r"(?:is|are) there (?P<a>.+)|(?:do|can) (?:i|you|we) (?:have|see|find) (?P<b>.+)", plain):
        return Question("exists", read_phrase(match["a"] or match["b"]))
    match = re.fullmatch(r"(?:is|are) (?P<a>.+)", plain)
    if match is None:
        return None
    phrase = read_phrase(match["a"])
    if phrase.relation is None:
        return None
    if len(phrase.others) == 1 and phrase.others[0].relation is None:
        return Question("holds", Phrase(phrase.head), phrase.others[0], relation=phrase.relation)
    return Question("holds", Phrase(phrase.head), options=phrase.others, relation=phrase.relation)


def _list(plain: str) -> Question | None:
    match = re.fullmatch(
        rf"(?:what|which)(?: (?P<a>(?!is |are ).+?))?(?: {_ARE}| there is| can be found| can i find)(?: there)?"
        r" (?P<rest>.+)",
        plain,
    )
    if match is None:
        return None
    head = match["a"] or "object"
    phrase = read_phrase(f"{head} {match['rest']}")
    return None if phrase.relation is None else Question("list", phrase)
