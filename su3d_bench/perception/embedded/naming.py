"""Names of image regions by zero-shot classification, words in a prompt, and captions from a template."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.english import with_article
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, UInt8Array
from su3d_bench.perception.cache import content_key

# Colour words with the sRGB value that each stands for; chosen to be far apart in CIELAB.
COLOURS: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("black", (25, 25, 25)),
    ("grey", (128, 128, 128)),
    ("white", (235, 235, 235)),
    ("red", (180, 35, 35)),
    ("orange", (225, 125, 40)),
    ("yellow", (225, 200, 60)),
    ("green", (60, 140, 65)),
    ("blue", (50, 85, 170)),
    ("purple", (115, 60, 140)),
    ("pink", (225, 140, 170)),
    ("brown", (110, 70, 40)),
    ("beige", (215, 195, 160)),
)


class NamingConfig(BaseModel):
    """How regions get their names: ``prompt`` with the name at ``{}``, compared at softmax ``temperature``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    prompt: str = Field(default="{} in a scene", pattern=r"\{\}")
    temperature: float = Field(default=0.05, gt=0)


def vocabulary() -> tuple[str, ...]:
    """The class names that regions may be called, in the order of the list file."""
    text = files("su3d_bench.perception.embedded.weights").joinpath("vocabulary.txt").read_text(encoding="utf-8")
    return listed_words(text)


def listed_words(text: str) -> tuple[str, ...]:
    """The words of a list, one a line, empty lines and those that begin with # aside."""
    lines = (line.strip() for line in text.splitlines())
    return tuple(line for line in lines if line and not line.startswith("#"))


def scene_caption(name: str, colour: str | None = None) -> str:
    """The template caption of a region: "a green chair in a scene"; of one without a name, "an object in a scene"."""
    name = name.strip() or "object"
    return f"{with_article(name if colour is None else f'{colour} {name}')} in a scene"


def colour_word(rgb: UInt8Array, mask: BoolArray) -> str | None:
    """The colour word nearest in CIELAB to the median colour under ``mask``; None for an empty mask.

    Of a large mask some thousand evenly spread pixels are looked at.
    """
    import cv2

    inside = np.flatnonzero(mask)
    if not len(inside):
        return None
    pixels = rgb.reshape(-1, 3)[inside[:: 1 + len(inside) // 1000]]
    table = np.array([value for _, value in COLOURS], np.float32)
    samples = np.concatenate([np.median(pixels, axis=0)[None].astype(np.float32), table]) / np.float32(255)
    lab = cv2.cvtColor(samples[None], cv2.COLOR_RGB2LAB)[0]
    # Shading moves lightness far more than hue, so lightness counts for half.
    difference = (lab[1:] - lab[0]) * np.array([0.5, 1.0, 1.0], np.float32)
    return COLOURS[int(np.argmin((difference**2).sum(axis=1)))][0]


@dataclass(frozen=True)
class Names:
    """One name and its softmax confidence (K,) float64 a region."""

    names: tuple[str, ...]
    confidences: Float64Array


class PromptedWords:
    """A list of ``words`` in a prompt, with "{}" where the word stands; encoded at the first use."""

    def __init__(self, encoder: Encoder, words: Sequence[str], prompt: str) -> None:
        self.words = tuple(words)
        self._encoder = encoder
        self._prompt = prompt

    def similarity(self, features: Float32Array) -> Float64Array:
        """The cosines (K, W) of ``features`` (K, D) of images with the words."""
        # einsum sums in one order whatever the number of threads; a matrix product may not.
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
        """The likeliest word for each of the ``features`` (K, D) of crops at ratio 1.0."""
        logits = self._words.similarity(features) / self._temperature
        weights = np.exp(logits - logits.max(axis=1, keepdims=True)) if len(logits) else logits
        best = weights.argmax(axis=1) if len(logits) else np.zeros(0, np.intp)
        confidences = 1.0 / weights.sum(axis=1)
        return Names(tuple(self._words.words[index] for index in best), confidences)
