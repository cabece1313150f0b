"""Corruptions of the class names that a map is searched with: other names for the same things, and more names.

A share is of the names that can change at all, rounded to a whole number of names, and a name that changes at one
severity is changed alike at every higher one. No name becomes equal to another of the list. The words and their sources
are in ``names.toml``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numpy.random import Generator

from su3d_bench.core.english import is_countable, last_word, plural, words
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.corruptions.model import Corruption

Names = tuple[str, ...]
KEY_ROWS = ("qwertyuiop", "asdfghjkl", "zxcvbnm")  # of a keyboard; neighbours in a row are hit by mistake


@cache
def _table() -> Any:
    return parse_toml(file_text(Path(__file__).with_suffix(".toml")))


@cache
def _groups() -> dict[str, Names]:
    """The group of synonyms of each name, the name itself included."""
    return {name: tuple(group) for groups in _table()["synonyms"].values() for group in groups for name in group}


@cache
def _descriptions() -> dict[str, str]:
    described = {_plain(name): text for name, text in _table()["descriptions"].items()}
    return {name: text for key, text in described.items() for name in _groups().get(key, (key,))}


@cache
def _everyday_nouns() -> Names:
    return tuple(name for text in _table()["distractors"].values() for name in " ".join(text.split()).split("; "))


def _plain(name: str) -> str:
    return name.lower().replace("-", " ").replace("_", " ").strip()


def _same_names(name: str) -> Names:
    plain = _plain(name)
    return _groups().get(plain, (plain,))


def _replaced(names: Names, share: float, rng: Generator, candidates: Callable[[str], list[str]]) -> Names:
    """Names with a share of those that have ``candidates`` replaced by one of these."""
    result, taken = list(names), {_plain(name) for name in names}
    new: dict[int, str] = {}
    for place in rng.permutation(len(names)):
        free = [text for text in candidates(names[place]) if _plain(text) not in taken]
        if free:
            new[place] = free[rng.integers(len(free))]
            taken.add(_plain(new[place]))
    for place in list(new)[: round(share * len(new))]:
        result[place] = new[place]
    return tuple(result)


def synonyms(names: Names, share: float, rng: Generator) -> Names:
    return _replaced(names, share, rng, lambda name: [text for text in _same_names(name) if text != _plain(name)])


def paraphrases(names: Names, share: float, rng: Generator) -> Names:
    """Names replaced by what the thing is or is for: "a seat for one person"."""
    return _replaced(names, share, rng, lambda name: [*filter(None, [_descriptions().get(_plain(name))])])


def plurals(names: Names, share: float, rng: Generator) -> Names:
    return _replaced(names, share, rng, lambda name: [plural(name)] if is_countable(_plain(name)) else [])


def typos(names: Names, share: float, rng: Generator) -> Names:
    """Names with one error: two letters exchanged, one left out, doubled, or hit on a neighbouring key."""
    return _replaced(names, share, rng, lambda name: sorted(_misspelt(name)))


def _misspelt(name: str) -> set[str]:
    """Every name with one error after the first letter, which is rarely wrong."""
    found = set()
    for place in range(1, len(name)):
        before, letter, rest = name[:place], name[place], name[place + 1 :]
        if not letter.isalpha():
            continue
        found |= {before + rest, before + letter + letter + rest}
        if rest[:1].isalpha():
            found.add(before + rest[0] + letter + rest[1:])
        row = next((row for row in KEY_ROWS if letter.lower() in row), "")
        at = row.find(letter.lower())
        found |= {before + key + rest for key in row[max(at - 1, 0) : at + 2] if key != letter.lower()}
    return found - {name}


def distractors(names: Names, n_added: float, rng: Generator) -> Names:
    """The names, then ``n_added`` everyday nouns, fewer if the list ends.

    None is a given name, a synonym of one, or a kind of one by its last word: no "towel rack" beside "rack".
    """
    same = {text for name in names for text in _same_names(name)}
    heads, spelt = {last_word(text) for text in same}, {words(text) for text in same}
    nouns = [noun for noun in _everyday_nouns() if last_word(noun) not in heads and words(noun) not in spelt]
    return (*names, *(nouns[place] for place in rng.permutation(len(nouns))[: round(n_added)]))


SHARES = (0.2, 0.4, 0.6, 0.8, 1.0)
ROWS: tuple[Corruption, ...] = (
    Corruption(
        "names", "synonyms", "names", synonyms, "share of names with synonyms", SHARES,
        "ours: even steps up to all; synsets of WordNet 3.1 and common household English",
    ),
    Corruption(
        "names", "paraphrases", "names", paraphrases, "share of names with descriptions", SHARES,
        "ours: even steps up to all",
    ),
    Corruption(
        "names", "typos", "names", typos, "share of names", SHARES,
        "ours: even steps up to all; the kinds of error are those of Damerau 1964 (Communications of the ACM 7)",
    ),
    Corruption("names", "plurals", "names", plurals, "share of countable names", SHARES, "ours: even steps up to all"),
    Corruption(
        "names", "distractors", "names", distractors, "names added", (10, 50, 200, 800, 1600),
        "ours: up to a list of the size of LVIS (1,203 categories) or THINGS (1,854 concepts)", is_whole=True,
    ),
)  # fmt: skip
