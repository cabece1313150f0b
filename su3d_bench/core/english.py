"""English nouns in names, captions and questions: singular and plural, articles, head nouns, words to compare.

The tokenizer of the embedded text tower also reduces plurals, but roughly, and its trained weights depend on that;
questions and answers use this module.
"""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

_JOINED = re.compile(r"\s+(?:and|or)\s+|[,;/&|+]")
_WORD = re.compile(r"[a-z0-9]+")


@cache
def _known(kind: str) -> Any:
    """The words of a kind in ``english.toml``; ``by_several`` is ``irregular`` inverted."""
    if kind == "by_several":
        return {several: one for one, several in _known("irregular").items()}
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))[kind]


def words(text: str) -> tuple[str, ...]:
    """The lower-case words of a name or noun phrase, without articles, each in the singular.

    >>> words("The two sofas"), words("indoor-plants"), words("a canvas")
    (('two', 'sofa'), ('indoor', 'plant'), ('canvas',))
    """
    parts = _WORD.findall(text.lower().replace("'", "").replace("’", ""))
    return tuple(singular(word) for word in parts if word not in _known("articles"))


def last_word(name: str) -> str:
    """The head noun of a name: "paper towel" is a towel."""
    return (words(name) or ("",))[-1]


def singular(word: str) -> str:
    """The singular of a word; a singular word is returned unchanged.

    >>> [singular(word) for word in ("sofas", "vases", "buses", "bookshelves", "stoves", "glass", "cookies", "candies")]
    ['sofa', 'vase', 'bus', 'bookshelf', 'stove', 'glass', 'cookie', 'candy']
    """
    if not word.endswith("s") and word not in _known("by_several"):
        return word
    for several, one in _known("by_several").items():
        if word == several or (len(several) > 4 and word.endswith(several)):
            return f"{word[: -len(several)]}{one}"
    is_short = len(word) < 3 or (len(word) == 3 and word[1] in "aeiou")
    if is_short or word.endswith(("ss", "us", "is")) or word in _known("one_in_s"):
        return word
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(("sses", "shes", "ches", "xes", "zzes", "uses")) and word[:-1] not in _known("ends_in_use"):
        return word[:-2]
    return word[:-2] if word.endswith("es") and word[:-2] in _known("one_in_s") else word[:-1]


def plural(name: str) -> str:
    """The plural of a name; a plural name is returned unchanged.

    >>> [plural(name) for name in ("sofa", "knife block", "bus", "case of water bottles", "blinds", "candy")]
    ['sofas', 'knife blocks', 'buses', 'cases of water bottles', 'blinds', 'candies']
    """
    head, of, rest = name.partition(" of ")
    before, blank, word = head.rpartition(" ")
    return f"{before}{blank}{_plural_word(word)}{of}{rest}"


def _plural_word(word: str) -> str:
    if word in _known("always_plural") or word in _known("uncountable") or singular(word) != word:
        return word
    for one, several in _known("irregular").items():
        if word == one or (len(one) > 3 and word.endswith(one)):
            return f"{word[: -len(one)]}{several}"
    if word.endswith(("s", "x", "z", "ch", "sh")):
        return f"{word}es"
    return f"{word[:-1]}ies" if word.endswith("y") and word[-2:-1] not in tuple("aeiou") else f"{word}s"


def is_countable(name: str) -> bool:
    """Whether things of this name are counted."""
    return name not in _known("uncountable") and name.rpartition(" ")[2] not in _known("uncountable")


def is_plural(name: str) -> bool:
    """Whether the name takes a plural verb even for one thing: "which blinds are"."""
    head = name.partition(" of ")[0].rpartition(" ")[2]
    return head in _known("always_plural") or singular(head) != head


def with_article(noun: str) -> str:
    """A noun with "a" or "an", by its sound; plural and uncountable nouns, and those with an article, are unchanged.

    >>> with_article("indoor-plant"), with_article("utensil holder"), with_article("blinds"), with_article("LCD screen")
    ('an indoor-plant', 'a utensil holder', 'blinds', 'an LCD screen')
    """
    name = noun.strip().lower()
    if is_plural(name) or not is_countable(name) or name.partition(" ")[0] in _known("articles"):
        return noun
    return f"{'an' if _begins_with_vowel(noun.strip()) else 'a'} {noun}"


def _begins_with_vowel(name: str) -> bool:
    """Whether the first sound of ``name`` is a vowel."""
    first = (re.findall(r"[^\W_]+", name) or [""])[0]
    word = first.lower()
    if len(first) == 1 or (first.isupper() and len(first) <= 3) or word in _known("spelt_out"):
        return word[:1] in tuple("8aefhilmnorsx")
    if word[0:1].isdigit():
        return word.startswith("8") or re.match(r"1[18](\D|$)", word) is not None
    if word.startswith(tuple(_known("spoken_with_vowel"))):
        return True
    return word[:1] in tuple("aeiou") and not (
        word.startswith(tuple(_known("spoken_with_consonant"))) and not word.startswith(tuple(_known("not_uni")))
    )


def head_phrases(name: str) -> list[tuple[str, ...]]:
    """For each thing in a joined name, its words up to and including the head noun, each in the singular.

    >>> head_phrases("the tile walls of a room"), head_phrases("wall and floor"), head_phrases("floor lamp")
    ([('tile', 'wall')], [('wall',), ('floor',)], [('floor', 'lamp')])
    """
    bare = re.sub(r"\([^)]*\)", " ", name.lower())
    return [phrase for part in _JOINED.split(bare) if (phrase := _head_phrase(part))]


def _head_phrase(text: str) -> tuple[str, ...]:
    phrase = list(words(text))
    for place, word in enumerate(phrase):
        if word in _known("prepositions"):
            is_part = word == "of" and place > 0 and phrase[place - 1] in _known("parts")
            return _head_phrase(" ".join(phrase[place + 1 :])) if is_part else tuple(phrase[:place])
    while len(phrase) > 1 and (phrase[-1] in _known("parts") or phrase[-1].isdigit()):
        phrase.pop()
    return tuple(phrase)
