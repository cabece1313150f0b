"""Corruptions of class names: what all have in common, hand-worked values of each, and the lists of words."""

from __future__ import annotations

import json
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from places import ROOT

from su3d_bench.core.english import last_word, plural, words
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.corruptions import names
from su3d_bench.corruptions.model import Corruption, generator

ROWS = {row.name: row for row in names.ROWS}
TABLE = parse_toml(file_text(ROOT / "su3d_bench/corruptions/names.toml"))
GROUPS = [group for groups in TABLE["synonyms"].values() for group in groups]


def _json(path: str) -> object:
    return json.loads((ROOT / "datasets" / path).read_text())


def _classes() -> dict[str, tuple[str, ...]]:
    scannet200, replica = _json("scannet/labels.json")["scannet200"], _json("replica/labels.json")  # type: ignore[index]
    homes = parse_toml(file_text(ROOT / "datasets/homes/classes.toml"))["classes"]
    rooms = (ROOT / "su3d_bench/perception/embedded/weights/vocabulary.txt").read_text().splitlines()
    return {
        "scannet200": tuple(row["name"] for row in scannet200),
        "replica": tuple(row["name"] for row in cast(list[dict[str, str]], replica)),
        "homes": tuple(homes),
        "rooms": tuple(line for line in rooms if line and not line.startswith("#")),
    }


CLASSES = _classes()


def changed(name: str, given: tuple[str, ...], value: float, seed: int = 2, scene: str = "scene") -> tuple[str, ...]:
    row = ROWS[name]
    return cast(tuple[str, ...], row.function(given, value, generator(row, seed, scene)))


def distance(given: tuple[str, ...], found: tuple[str, ...]) -> int:
    """How many names differ or were added."""
    return sum(a != b for a, b in zip(given, found, strict=False)) + len(found) - len(given)


@pytest.mark.parametrize("space", CLASSES)
@pytest.mark.parametrize("row", names.ROWS, ids=lambda row: row.name)
def test_each_severity_changes_or_adds_more_names_in_every_label_space(row: Corruption, space: str) -> None:
    given = CLASSES[space]
    results = [changed(row.name, given, row.value_at(severity)) for severity in range(6)]
    counts = [distance(given, result) for result in results]
    assert counts[0] == 0 and all(np.diff(counts) > 0), counts
    for low, high in pairwise(results):  # a name that changed stays changed, alike
        assert all(a == b for old, a, b in zip(given, low, high, strict=False) if a != old)
    for result in results:
        assert len({name.lower().replace("-", " ") for name in result}) == len(result)
        assert all(isinstance(name, str) and name.strip() == name and name for name in result)


@pytest.mark.parametrize("space", CLASSES)
def test_all_or_nearly_all_classes_have_another_name(space: str) -> None:
    given = CLASSES[space]
    shares = {name: distance(given, changed(name, given, 1.0)) / len(given) for name in ROWS if name != "distractors"}
    assert shares["synonyms"] > 0.75 and shares["typos"] == 1, shares
    assert shares["paraphrases"] > 0.98 and shares["plurals"] > 0.95, shares


@pytest.mark.parametrize("row", names.ROWS, ids=lambda row: row.name)
def test_one_seed_repeats_and_other_scenes_differ(row: Corruption) -> None:
    given = CLASSES["replica"]
    first = changed(row.name, given, row.value_at(2))
    assert first == changed(row.name, given, row.value_at(2))
    assert first != changed(row.name, given, row.value_at(2), scene="other")
    assert first != changed(row.name, given, row.value_at(2), seed=3)


@pytest.mark.parametrize("row", names.ROWS, ids=lambda row: row.name)
def test_names_that_nobody_knows_and_no_names_are_no_problem(row: Corruption) -> None:
    for given in ((), ("xqzzy",), ("x",), ("",)):
        assert len(changed(row.name, given, row.values[0])) == len(given) + (10 if row.name == "distractors" else 0)


def test_a_synonym_comes_from_the_group_of_the_name_and_is_no_other_given_name() -> None:
    assert changed("synonyms", ("sofa", "wall"), 1.0) == ("couch", "wall")
    assert changed("synonyms", ("sofa", "couch"), 1.0) == ("sofa", "couch")
    assert changed("synonyms", ("TV-screen",), 1.0) == ("television screen",)
    found = {changed("synonyms", ("backpack",), 1.0, seed)[0] for seed in range(40)}
    assert found == {"knapsack", "rucksack", "haversack"}


def test_a_paraphrase_describes_a_thing_and_its_synonyms_without_the_name() -> None:
    assert changed("paraphrases", ("chair", "couch"), 1.0) == (
        "a seat for one person",
        "a long soft seat for several people",
    )
    assert changed("paraphrases", ("sofa", "couch"), 1.0).count("a long soft seat for several people") == 1
    for key, text in TABLE["descriptions"].items():
        assert last_word(key.replace("-", " ")) not in words(text), key
    assert len(set(TABLE["descriptions"].values())) == len(TABLE["descriptions"])


def test_plurals_are_english_and_leave_what_is_not_counted() -> None:
    given = ("shelf", "knife block", "mouse", "paper", "blinds", "tissue box")
    assert changed("plurals", given, 1.0) == ("shelves", "knife blocks", "mice", "paper", "blinds", "tissue boxes")
    assert all(
        plural(name) == new or name == new for name, new in zip(given, changed("plurals", given, 0.5), strict=True)
    )


def test_a_typing_error_is_one_of_four_kinds_after_the_first_letter() -> None:
    found = {changed("typos", ("bed",), 1.0, seed)[0] for seed in range(400)}
    exchanged, left_out, doubled = {"bde"}, {"bd", "be"}, {"beed", "bedd"}
    neighbours = {"bwd", "brd", "bes", "bef"}
    assert found == exchanged | left_out | doubled | neighbours
    assert all(
        new[0] == old[0] for old, new in zip(CLASSES["homes"], changed("typos", CLASSES["homes"], 1.0), strict=True)
    )
    assert changed("typos", ("bed", "bd", "be", "bde", "beed", "bedd", "bwd", "brd", "bes"), 1.0)[0] in ("bed", "bef")


def test_distractors_follow_the_given_names_and_are_none_of_them() -> None:
    given = ("sword", "kitten")
    found = changed("distractors", given, 1600)
    assert found[:2] == given and len(set(found)) == len(found) == 1602
    assert not {"sword", "kitten"} & set(found[2:])
    assert changed("distractors", given, 50) == found[:52]


def test_distractors_are_no_synonyms_and_no_kinds_of_given_names() -> None:
    assert "bread knife" not in changed("distractors", ("knife",), 1600)
    found = changed("distractors", ("pole", "mallets"), 5000)
    assert {"ski pole", "fishing pole", "telephone pole", "mallet"}.isdisjoint(found[2:])
    assert {"ski pole", "mallet"} <= set(changed("distractors", ("sofa",), 5000))
    for space, given in CLASSES.items():
        same = {words(text) for name in given for group in GROUPS if name.replace("-", " ") in group for text in group}
        same |= {words(name.replace("-", " ")) for name in given}
        assert not [name for name in changed("distractors", given, 1600)[len(given) :] if words(name) in same], space


def test_every_synonym_is_in_one_group_and_every_distractor_is_there_once() -> None:
    assert [name for name, n in Counter(name for group in GROUPS for name in group).items() if n > 1] == []
    nouns = [noun for text in TABLE["distractors"].values() for noun in " ".join(text.split()).split("; ")]
    assert [noun for noun, n in Counter(words(noun) for noun in nouns).items() if n > 1] == []
    assert {
        noun for noun in nouns if noun != noun.lower() or not noun.replace(" ", "").replace("-", "").isalpha()
    } == set()
    assert not {name for group in GROUPS for name in group} & set(nouns)
    assert len(nouns) > 1600


def test_the_list_of_words_stays_compact() -> None:
    text = Path(names.__file__).with_suffix(".toml").read_text()
    assert max(map(len, text.splitlines())) <= 120 and len(text.splitlines()) < 1000
