"""Captions and the statements that they make."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.core import registry
from su3d_bench.perception.embedded.captions import (
    Caption,
    CropTruth,
    Neighbour,
    class_caption,
    class_words,
    draw_caption,
    fixed_captions,
    wrong_relation,
)
from su3d_bench.perception.embedded.lexicon import AFFORDANCES, GROUPS, SYNONYMS
from su3d_bench.perception.embedded.text import words
from su3d_bench.perception.embedded.training.targets import TruthTable

GREEN_PLANT = CropTruth("indoor-plant", "green", "ceramic", "small", (Neighbour("on", "shelf", "brown"),))
RED_SOFA = CropTruth("sofa", "red", "fabric", "large", (Neighbour("with", "cushion", "blue"),), "living")
WHOLE = CropTruth("", "", "", "", (Neighbour("with", "sofa", "red"),), "living")
TRUTHS = (GREEN_PLANT, RED_SOFA, WHOLE)


@pytest.mark.parametrize("truth", TRUTHS)
def test_every_drawn_caption_is_true(truth: CropTruth) -> None:
    rng = np.random.default_rng(0)
    captions = [draw_caption(truth, rng) for _ in range(300)]
    assert all(caption.is_true_of(truth) for caption in captions)
    assert len({caption.text for caption in captions}) > 10


def test_captions_tell_attributes_relations_and_uses_apart() -> None:
    assert Caption("plant on shelf", ("indoor-plant",), relation="on", others=("shelf",)).is_true_of(GREEN_PLANT)
    assert not Caption("plant on table", ("indoor-plant",), relation="on", others=("table",)).is_true_of(GREEN_PLANT)
    assert not Caption("shelf on plant", ("shelf",), relation="on", others=("indoor-plant",)).is_true_of(GREEN_PLANT)
    assert not Caption("a red plant", ("indoor-plant",), colour="red").is_true_of(GREEN_PLANT)
    sit = next(caption for caption in fixed_captions() if caption.text == "place to sit")
    assert sit.is_true_of(RED_SOFA)
    assert not sit.is_true_of(GREEN_PLANT)
    assert not sit.is_true_of(WHOLE)


def test_templates_use_the_right_article() -> None:
    rng = np.random.default_rng(1)
    texts = {class_caption("indoor-plant", rng).text for _ in range(200)}
    assert "an indoor plant in a scene" in texts
    assert "an image of an indoor plant" in texts
    assert not any(text.startswith("a indoor") for text in texts)


def test_table_answers_as_the_captions_do() -> None:
    rng = np.random.default_rng(2)
    table = TruthTable(TRUTHS)
    crops = np.arange(len(TRUTHS))
    captions = [draw_caption(TRUTHS[index % 3], rng) for index in range(200)]
    related = [caption for caption in captions if caption.relation and caption.classes]
    captions += [wrong_relation(caption, table.class_names, rng) for caption in related]
    captions += [*fixed_captions(), Caption("thing with colour unknown here", colour="mauve")]
    expected = np.array([[caption.is_true_of(truth) for truth in TRUTHS] for caption in captions])
    assert np.array_equal(table.matches(captions, crops), expected)


def test_no_two_classes_share_a_name() -> None:
    owners: dict[tuple[str, ...], str] = {}
    for name in SYNONYMS:
        for word in class_words(name):
            assert owners.setdefault(words(word), name) == name, word
    assert not {words(word) for word in GROUPS} & set(owners)


def test_lexicon_knows_the_rooms_classes_and_what_they_are_for() -> None:
    from su3d_bench.datasets.rooms.classes import CLASSES

    known = {room_class.name for room_class in CLASSES}
    named = {*SYNONYMS, *(name for names in (*AFFORDANCES.values(), *GROUPS.values()) for name in names)}
    assert named <= known
    assert registry.DATASETS["rooms"].startswith("su3d_bench.datasets.rooms.dataset")
