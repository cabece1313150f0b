"""Names of image regions by zero-shot classification, words in a prompt, and captions from a template."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.english import with_article
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from su3d_bench.perception.cache import content_key

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
_EDGES = ".,;:!?()[]{}<>/\\\"'\u201c\u201d\u2018\u2019-\u2013\u2014"  # around a word, but not part of it
_WORD = re.compile(r"[a-z0-9]+")


def words(text: str) -> tuple[str, ...]:
    """The lower-case words of ``text`` without articles, plurals reduced, at most ``N_WORDS``.

    A hyphen separates words, an apostrophe does not: "TV-screens" becomes "tv screen".

    >>> words("An indoor-plant next to the shelves")
    ('indoor', 'plant', 'next', 'to', 'shelf')
    """
    parts = _WORD.findall(text.lower().replace("'", "").replace("’", ""))
    return tuple(singular(word) for word in parts if word not in _ARTICLES)[:N_WORDS]


def unknown_words(text: str, known: Collection[str]) -> tuple[str, ...]:
    """The parts of ``text`` not in the ``known`` words, as written, each once; all of it if it has no word.

    >>> unknown_words("the Xqzzy on a shelf", {"on", "shelf"}), unknown_words("??", {"on"})
    (('Xqzzy',), ('??',))
    """
    parts = [part.strip(_EDGES) for part in text.split()]
    read = {part: words(part) for part in parts if part and part.lower() not in _ARTICLES}
    found = tuple(part for part, own in read.items() if not own or any(word not in known for word in own))
    return found if read else (text.strip(),)


def singular(word: str) -> str:
    """``word`` without an English plural ending; approximate, so that both forms share one row.

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
    """A row in 1..n_rows-1; the high bits are folded in, because FNV's low bits alone repeat on short words."""
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


Words = Mapping[str, tuple[str, ...]]
_TABLE: Mapping[str, Any] = parse_toml(file_text(Path(__file__).with_name("lexicon.toml")))
# Colour words with their sRGB values; chosen to be far apart in CIELAB.
COLOURS: tuple[tuple[str, tuple[int, int, int]], ...] = tuple(
    (name, (red, green, blue)) for name, (red, green, blue) in _TABLE["colour_values"].items()
)


class NamingConfig(BaseModel):
    """How regions are named: ``prompt`` with the name at ``{}``, compared with softmax ``temperature``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    prompt: str = Field(default="{} in a scene", pattern=r"\{\}")
    temperature: float = Field(default=0.05, gt=0)


def vocabulary() -> tuple[str, ...]:
    """The class names that regions can get: the classes that the encoder was trained on, in the order of the file."""
    weights = files("su3d_bench.perception.embedded.weights")
    return listed_words(weights.joinpath("vocabulary.txt").read_text(encoding="utf-8"))


def listed_words(text: str) -> tuple[str, ...]:
    """The words of a list, one per line, ignoring empty lines and those that begin with #."""
    lines = (line.strip() for line in text.splitlines())
    return tuple(line for line in lines if line and not line.startswith("#"))


def scene_caption(name: str, colour: str | None = None) -> str:
    """The template caption of a region: "a green chair in a scene"; without a name, "an object in a scene"."""
    name = name.strip() or "object"
    return f"{with_article(name if colour is None else f'{colour} {name}')} in a scene"


def colour_word(rgb: UInt8Array, mask: BoolArray) -> str | None:
    """The colour word nearest in CIELAB to the median colour under ``mask``; None for an empty mask.

    For a large mask about a thousand evenly spread pixels are used.
    """
    import cv2

    inside = np.flatnonzero(mask)
    if not len(inside):
        return None
    pixels = rgb.reshape(-1, 3)[inside[:: 1 + len(inside) // 1000]]
    table = np.array([value for _, value in COLOURS], np.float32)
    samples = np.concatenate([np.median(pixels, axis=0)[None].astype(np.float32), table]) / np.float32(255)
    lab = cv2.cvtColor(samples[None], cv2.COLOR_RGB2LAB)[0]
    # Shading changes lightness far more than hue, so lightness counts half.
    difference = (lab[1:] - lab[0]) * np.array([0.5, 1.0, 1.0], np.float32)
    return COLOURS[int(np.argmin((difference**2).sum(axis=1)))][0]


@dataclass(frozen=True)
class Names:
    """One name and its softmax confidence (K,) float64 per region."""

    names: tuple[str, ...]
    confidences: Float64Array


class PromptedWords:
    """A list of ``words`` in a prompt, with "{}" as the placeholder; encoded at the first use."""

    def __init__(self, encoder: Encoder, words: Sequence[str], prompt: str) -> None:
        self.words = tuple(words)
        self._encoder = encoder
        self._prompt = prompt

    def similarity(self, features: Float32Array) -> Float64Array:
        """The cosines (K, W) of ``features`` (K, D) of images with the words."""
        # einsum sums in the same order for any number of threads; a matrix product may not.
        similarity: Float64Array = np.einsum("kd,wd->kw", features.astype(np.float64), self._features)
        return similarity

    @cached_property
    def _features(self) -> Float64Array:
        prompts = [self._prompt.replace("{}", with_article(word)) for word in self.words]
        return self._encoder.encode_texts(prompts).astype(np.float64)


class Namer:
    """Zero-shot classifier over the embedded vocabulary."""

    def __init__(self, config: NamingConfig, encoder: Encoder, words: tuple[str, ...] | None = None) -> None:
        self._temperature = config.temperature
        self._words = PromptedWords(encoder, vocabulary() if words is None else words, config.prompt)
        self.digest = content_key("namer", config.model_dump_json(), encoder.digest, *self._words.words)

    def name(self, features: Float32Array) -> Names:
        """The most probable word for each of the ``features`` (K, D) of crops at ratio 1.0."""
        logits = self._words.similarity(features) / self._temperature
        weights = np.exp(logits - logits.max(axis=1, keepdims=True)) if len(logits) else logits
        best = weights.argmax(axis=1) if len(logits) else np.zeros(0, np.intp)
        confidences = 1.0 / weights.sum(axis=1)
        return Names(tuple(self._words.words[index] for index in best), confidences)


def _words(section: str) -> Words:
    return {name: tuple(words) for name, words in _TABLE[section].items()}


SYNONYMS = _words("synonyms")  # other names that mean this class and no other
KIND_OF = {kind: name for name, kinds in _words("kinds").items() for kind in kinds}  # a coffee table is a table
GROUPS = _words("groups")  # words that cover several classes
AFFORDANCES = _words("uses")  # a phrase and every class of which it is true
ROOM_NAMES = _words("rooms")
COLOUR_WORDS, SIZE_WORDS, RELATION_WORDS = map(_words, ("colours", "sizes", "relations"))
SURFACES = frozenset(_TABLE["surfaces"])  # nearly everything stands on these; captions prefer another neighbour
MATERIALS = tuple(_TABLE["materials"])
# The training captions around a name; ``{a}`` stands for the name with its article.
CLASS_TEMPLATES = ("{a} in a scene", "an image of {a}", "{}", "{a}", "{} in scene", "a picture of {a}", "there is {a}")
ANYTHING = ("thing", "object", "item")


def class_words(class_name: str) -> tuple[str, ...]:
    """Every name of a class, its own first: "tv screen", "tv", "television", ..."""
    return (class_name.replace("-", " "), *SYNONYMS.get(class_name, ()))


@cache
def trained_words() -> frozenset[str]:
    """All words that training captions may contain, as tokenized."""
    names = frozenset(vocabulary())
    texts = [*CLASS_TEMPLATES, *ANYTHING, *(word for name in names for word in class_words(name))]
    texts += [text for table in (GROUPS, AFFORDANCES) for text, own in table.items() if not names.isdisjoint(own)]
    texts += ["room", *(name for name, _ in COLOURS), *MATERIALS]
    for table in (ROOM_NAMES, COLOUR_WORDS, SIZE_WORDS, RELATION_WORDS):
        texts += [word for spellings in table.values() for word in spellings]
    return frozenset(word for text in texts for word in words(text))
