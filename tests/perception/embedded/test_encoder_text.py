"""The tokenizer of the embedded text tower."""

from __future__ import annotations

import doctest

import numpy as np
import pytest

from su3d_bench.datasets.rooms.classes import MATERIALS
from su3d_bench.perception.embedded import lexicon
from su3d_bench.perception.embedded import text as embedded_text
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
from su3d_bench.perception.embedded.text import (
    N_IDS,
    N_ROWS,
    N_WORDS,
    PADDING,
    fnv1a,
    token_ids,
)


def test_examples_in_docstrings_run() -> None:
    assert doctest.testmod(embedded_text).failed == 0


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("tv-screen", "tv screen"),
        ("Indoor-Plant", "indoor plants"),
        ("an image of a chair", "image of the chair"),
        ("computer's picture", "computers picture"),
        ("shelves", "shelf"),
    ],
)
def test_spellings_of_one_thing_have_the_same_ids(one: str, other: str) -> None:
    ids = token_ids([one, other])
    assert np.array_equal(ids[0], ids[1])


@pytest.mark.parametrize(
    ("one", "other"), [("plant on table", "table on plant"), ("glass", "glas"), ("cup", "cups of tea"), ("pan", "pot")]
)
def test_different_texts_have_different_ids(one: str, other: str) -> None:
    ids = token_ids([one, other])
    assert not np.array_equal(ids[0], ids[1])


def test_words_that_no_caption_holds_are_named() -> None:
    encoder = EmbeddedEncoder()
    captions = ["A couch on the wooden table", "bowl next to a lamp in scene", "something to type with", "tv-screens"]
    assert [encoder.unseen_words(text) for text in captions] == [()] * 4
    assert encoder.unseen_words('"Xqzzy", plant; xqzzy') == ("Xqzzy", "xqzzy")
    assert encoder.unseen_words("\u6905\u5b50") == ("\u6905\u5b50",)
    assert encoder.unseen_words("the") == ("the",)  # nothing that it reads


def test_the_words_for_materials_are_those_of_the_rooms() -> None:
    assert lexicon.MATERIALS == MATERIALS


def test_ids_have_the_documented_shape_and_range() -> None:
    ids = token_ids(["chair", "", "one two three four five six seven eight nine ten " * 3])
    assert ids.shape == (3, N_WORDS, N_IDS)
    assert ids.dtype == np.int64
    assert (ids[1] == PADDING).all()
    assert (ids[2, :, 0] != PADDING).all()
    assert ids.min() >= 0
    assert ids.max() < N_ROWS
    assert token_ids([]).shape == (0, N_WORDS, N_IDS)


def test_hash_is_fnv1a() -> None:
    # Test vectors of the FNV reference, http://www.isthe.com/chongo/tech/comp/fnv
    assert fnv1a("") == 0x811C9DC5
    assert fnv1a("a") == 0xE40C292C
    assert fnv1a("foobar") == 0xBF9CF968
