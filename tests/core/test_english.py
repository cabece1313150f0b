"""Singular and plural of every class, articles, and words of questions."""

from __future__ import annotations

import doctest
import json
import tomllib
from typing import Any

import pytest
from places import ROOT

from su3d_bench.core import english
from su3d_bench.core.english import is_countable, is_plural, plural, with_article, words
from su3d_bench.perception.embedded.lexicon import SYNONYMS, vocabulary
from su3d_bench.questions.scene_map import plain_name


def texts_in(value: Any) -> set[str]:
    if isinstance(value, str):
        return {value}
    parts = [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []
    return {text for part in parts for text in texts_in(part)}


def every_name() -> list[str]:
    """The classes of every label set, the vocabulary of region names, and synonyms of classes."""
    names = {*vocabulary(), *(other for others in SYNONYMS.values() for other in others)}
    for path in (ROOT / "su3d_bench/metrics/rules").glob("classes.*.toml"):
        names |= {row[1] for row in tomllib.loads(path.read_text(encoding="utf-8"))["classes"]}
    for dataset in ("replica", "scannet"):
        names |= texts_in(json.loads((ROOT / "datasets" / dataset / "labels.json").read_text(encoding="utf-8")))
    return sorted({plain_name(name).lower() for name in names if len(name) < 40})


def test_plural_of_every_class_reduces_to_its_name() -> None:
    names = every_name()
    assert len(names) > 300
    assert [name for name in names if words(plural(name)) != words(name)] == []


def test_docstring_examples_are_correct() -> None:
    assert doctest.testmod(english).failed == 0


def test_always_plural_and_uncountable_nouns() -> None:
    assert (is_plural("blinds"), is_plural("pile of books"), is_plural("stairs"), is_plural("bus")) == (
        True, False, True, False,
    )  # fmt: skip
    assert (with_article("blinds"), with_article("furniture"), with_article("hourglass")) == (
        "blinds", "furniture", "an hourglass",
    )  # fmt: skip
    assert not is_countable("toilet paper") and is_countable("paper towel")


@pytest.mark.parametrize(
    ("noun", "expected"),
    [
        ("bed", "a bed"), ("indoor-plant", "an indoor-plant"), ("umbrella", "an umbrella"), ("urn", "an urn"),
        ("utensil-holder", "a utensil-holder"), ("utility cart", "a utility cart"), ("hourglass", "an hourglass"),
        ("unidentified object", "an unidentified object"), ("unicorn", "a unicorn"),
        ("110-inch screen", "a 110-inch screen"), ("LCD screen", "an LCD screen"), ("USB hub", "a USB hub"),
        ("TV", "a TV"), ("x-ray", "an x-ray"), ("blinds", "blinds"), ("the bed", "the bed"),
    ],
)  # fmt: skip
def test_article_follows_pronunciation(noun: str, expected: str) -> None:
    assert with_article(noun) == expected
