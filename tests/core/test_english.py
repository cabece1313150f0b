"""One and several of every class: what is asked is English, and what is understood is what was asked."""

from __future__ import annotations

import json
import re
import tomllib
from typing import Any

import pytest
from places import ROOT

from su3d_bench.core.english import is_countable, is_plural, plural, singular, with_article, words
from su3d_bench.perception.embedded.lexicon import SYNONYMS
from su3d_bench.perception.embedded.naming import vocabulary
from su3d_bench.questions.scene_map import plain_name


def texts_in(value: Any) -> set[str]:
    if isinstance(value, str):
        return {value}
    parts = [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []
    return {text for part in parts for text in texts_in(part)}


def every_name() -> list[str]:
    """The classes of every label set, the words that regions are called by, and other names of classes."""
    names = {*vocabulary(), *(other for others in SYNONYMS.values() for other in others)}
    for path in (ROOT / "su3d_bench/metrics/rules").glob("classes.*.toml"):
        names |= {row[1] for row in tomllib.loads(path.read_text(encoding="utf-8"))["classes"]}
    for dataset in ("replica", "scannet"):
        names |= texts_in(json.loads((ROOT / "datasets" / dataset / "labels.json").read_text(encoding="utf-8")))
    return sorted({plain_name(name).lower() for name in names if len(name) < 40})


def test_several_of_a_thing_give_its_name_back_for_every_class() -> None:
    names = every_name()
    assert len(names) > 300
    assert [name for name in names if words(plural(name)) != words(name)] == []


@pytest.mark.parametrize(
    ("one", "several"),
    [
        ("sofa", "sofas"), ("camera", "cameras"), ("shelf", "shelves"), ("bookshelf", "bookshelves"), ("box", "boxes"),
        ("couch", "couches"), ("dish", "dishes"), ("glass", "glasses"), ("bus", "buses"), ("vase", "vases"),
        ("knife", "knives"), ("stove", "stoves"), ("candy", "candies"), ("tray", "trays"), ("cookie", "cookies"),
        ("mouse", "mice"), ("tv", "tvs"), ("house", "houses"), ("case", "cases"), ("loaf", "loaves"),
    ],
)  # fmt: skip
def test_one_and_several(one: str, several: str) -> None:
    assert plural(one) == several
    if one != "glass":  # glasses are worn, too: what is called so already is one pair
        assert singular(several) == one
    assert singular(one) == one


@pytest.mark.parametrize("word", ["canvas", "gas", "lens", "glass", "mattress", "cactus", "iris", "his", "is", "as"])
def test_a_word_that_means_one_stays(word: str) -> None:
    assert singular(word) == word


def test_what_is_always_several_or_stuff_is_spoken_of_so() -> None:
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
        ("house", "a house"), ("orange chair", "an orange chair"), ("Office chair", "an Office chair"),
        ("unidentified object", "an unidentified object"), ("unicorn", "a unicorn"), ("urinal", "a urinal"),
        ("one-seater sofa", "a one-seater sofa"), ("ewer", "a ewer"), ("8-seat table", "an 8-seat table"),
        ("11-inch tablet", "an 11-inch tablet"), ("110-inch screen", "a 110-inch screen"),
        ("3-seat sofa", "a 3-seat sofa"),
        ("LCD screen", "an LCD screen"), ("lcd screen", "an lcd screen"), ("USB hub", "a USB hub"), ("TV", "a TV"),
        ("tv-screen", "a tv-screen"), ("x-ray", "an x-ray"), ("L-shaped sofa", "an L-shaped sofa"),
        ("U-shaped desk", "a U-shaped desk"), ("blinds", "blinds"), ("kitchen curtains", "kitchen curtains"),
        ("the bed", "the bed"), ("An old chair", "An old chair"), ("a-frame house", "an a-frame house"),
    ],
)  # fmt: skip
def test_the_article_is_the_one_that_is_spoken(noun: str, expected: str) -> None:
    assert with_article(noun) == expected


def test_the_program_has_one_function_for_the_article() -> None:
    files = [
        path for folder in ("su3d_bench", "reports", "datasets", "baselines") for path in (ROOT / folder).rglob("*.py")
    ]
    found = {
        path for path in files if re.search(r"def \w*article|tuple\(.aeiou.\)\s*and|\ban? if ", path.read_text("utf-8"))
    }
    assert {path.name for path in found} <= {"english.py", "page.py"}  # that one is HTML's
