"""From a text to the integers that the embedded text tower reads; deterministic, with no vocabulary file.

A word becomes two hashed rows of the embedding table (two, so that words that share one row still differ) and the
hashed rows of its 4-grams, by which spellings that were never trained lean on those that were.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import lru_cache

import numpy as np

from su3d_bench.core.types import Int64Array

N_WORDS = 16
N_GRAMS = 8
N_IDS = 2 + N_GRAMS
WORD_ROWS = 2048
GRAM_ROWS = 2048
N_ROWS = WORD_ROWS + GRAM_ROWS
PADDING = 0
DIM = 128  # of the space that both towers of the embedded encoder map to
TOKENIZER_VERSION = "1"

_ARTICLES = frozenset({"a", "an", "the"})
_NOT_PLURAL = ("ss", "us", "is", "as")
_EDGES = ".,;:!?()[]{}<>/\\\"'\u201c\u201d\u2018\u2019-\u2013\u2014"  # around a word, and no part of it
_WORD = re.compile(r"[a-z0-9]+")


def words(text: str) -> tuple[str, ...]:
    """The lower-case words of ``text`` without articles, plurals reduced, at most ``N_WORDS``.

    A hyphen parts words, an apostrophe does not: "TV-screens" reads as "tv screen".

    >>> words("An indoor-plant next to the shelves")
    ('indoor', 'plant', 'next', 'to', 'shelf')
    """
    parts = _WORD.findall(text.lower().replace("'", "").replace("’", ""))
    return tuple(singular(word) for word in parts if word not in _ARTICLES)[:N_WORDS]


def unknown_words(text: str, known: Collection[str]) -> tuple[str, ...]:
    """What of ``text`` is none of the ``known`` words, as it is written, each once; all of it where nothing is a word.

    >>> unknown_words("the Xqzzy on a shelf", {"on", "shelf"}), unknown_words("??", {"on"})
    (('Xqzzy',), ('??',))
    """
    parts = [part.strip(_EDGES) for part in text.split()]
    read = {part: words(part) for part in parts if part and part.lower() not in _ARTICLES}
    found = tuple(part for part, own in read.items() if not own or any(word not in known for word in own))
    return found if read else (text.strip(),)


def singular(word: str) -> str:
    """``word`` without an English plural ending; close enough to put both forms on one row.

    >>> [singular(word) for word in ("plants", "dishes", "shelves", "candies", "glass")]
    ['plant', 'dish', 'shelf', 'candy', 'glass']
    """
    if len(word) < 4 or not word.endswith("s") or word.endswith(_NOT_PLURAL):
        return word
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith("lves"):
        return word[:-3] + "f"
    if word.endswith(("sses", "shes", "ches", "xes")):
        return word[:-2]
    return word[:-1]


def fnv1a(text: str) -> int:
    """The 32-bit FNV-1a hash of ``text`` in UTF-8 (Fowler, Noll, Vo; http://www.isthe.com/chongo/tech/comp/fnv)."""
    value = 2166136261
    for byte in text.encode("utf-8"):
        value = ((value ^ byte) * 16777619) & 0xFFFFFFFF
    return value


def _spread(text: str, n_rows: int) -> int:
    """A row in 1..n_rows-1; the high bits are folded in, for FNV's low bits alone repeat on short words."""
    value = fnv1a(text)
    return 1 + ((value >> 15) ^ value) % (n_rows - 1)


@lru_cache(maxsize=65536)
def word_ids(word: str) -> tuple[int, ...]:
    """The ``N_IDS`` table rows of one word: two for the word, then its 4-grams, then padding."""
    whole = (_spread("1" + word, WORD_ROWS), _spread("2" + word, WORD_ROWS))
    marked = f"<{word}>"
    grams = [marked[start : start + 4] for start in range(max(1, len(marked) - 3))][:N_GRAMS]
    rows = tuple(WORD_ROWS + _spread(gram, GRAM_ROWS) for gram in grams)
    return whole + rows + (PADDING,) * (N_GRAMS - len(rows))


@lru_cache(maxsize=65536)
def _text_ids(text: str) -> Int64Array:
    ids = np.full((N_WORDS, N_IDS), PADDING, np.int64)
    for position, word in enumerate(words(text)):
        ids[position] = word_ids(word)
    ids.setflags(write=False)
    return ids


def token_ids(texts: Sequence[str]) -> Int64Array:
    """Table rows (N, N_WORDS, N_IDS) int64 of ``texts``, padded with ``PADDING``."""
    if not len(texts):
        return np.zeros((0, N_WORDS, N_IDS), np.int64)
    return np.stack([_text_ids(text) for text in texts])
