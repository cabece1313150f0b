"""Questions: their ids, what is generated from boxes and classes, labels and their other names, colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scored_room import ID, LABELS, room

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import GroundTruth
from su3d_bench.questions.colours import colour_word
from su3d_bench.questions.generator import chosen, generate
from su3d_bench.questions.known_objects import is_called, known_objects
from su3d_bench.questions.model import KINDS, Question, new_question, question_id
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap

HOSTILE = ("<script>alert(1)</script>", '=HYPERLINK("x","y")', "\u202eright to left", "😀 chair", "x" * 10_000)


def thing(one: int, name: str, low: tuple[float, float, float], size: tuple[float, float, float]) -> MapObject:
    box = np.array([low, np.add(low, size)], np.float64)
    return MapObject(one, name, "", box.mean(axis=0), box)


# A table with a vase on it, a rug under the table, a chair beside it, a big and a small cushion, a door and a bin.
THINGS = SceneMap(
    (
        thing(1, "rug", (0, 0, 0.0), (2.0, 2.0, 0.02)),
        thing(2, "table", (0.5, 0.5, 0.02), (1.0, 1.0, 0.7)),
        thing(3, "vase", (0.9, 0.9, 0.72), (0.2, 0.2, 0.3)),
        thing(4, "chair", (1.6, 0.5, 0.02), (0.5, 0.5, 0.9)),
        thing(5, "cushion", (5.0, 5.0, 0.0), (0.6, 0.6, 0.2)),
        thing(6, "cushion", (6.0, 6.0, 0.0), (0.3, 0.3, 0.1)),
        thing(7, "cushion", (7.0, 5.0, 0.0), (0.4, 0.4, 0.15)),
        thing(8, "bin", (4.0, 8.0, 0.0), (0.3, 0.3, 0.4)),
        thing(9, "sofa", (5.0, 8.0, 0.0), (1.0, 0.8, 0.8)),
        thing(10, "bed", (7.0, 8.0, 0.0), (1.0, 0.8, 0.5)),
    )
)
ASKED = {(one.kind, one.text): one.answers for one in generate("a/b", THINGS)}


def test_an_id_depends_on_scene_kind_and_text_alone() -> None:
    one = new_question("a/b", "instance", "chair", (3, 1, 3), "x")
    assert one == replace(new_question("a/b", "instance", "chair", (1, 3), "y"), source="x")
    assert len({question_id(*key) for key in (("a/b", "instance", "chair"), ("a/b", "property", "chair"))}) == 2


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"kind": "wrong\x1b"}, r"unknown kind 'wrong\\x1b'"),
        ({"id": "0"}, "its id '0' is not that of"),
        ({"answers": (2, 1)}, "must be instance ids above 0, ascending"),
        ({"answers": (0,)}, "must be instance ids above 0"),
    ],
)
def test_what_is_no_question_is_refused(change: dict[str, object], line: str) -> None:
    fields = {"scene": "a/b", "kind": "instance", "text": "chair", "answers": (1,), "source": "x", "reply": ""}
    fields["id"] = question_id("a/b", "instance", "chair")
    with pytest.raises(DataError, match=line):
        Question(**(fields | change))  # type: ignore[arg-type]


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_texts_are_data(text: str) -> None:
    assert new_question("a/b", "instance", text, None, "x").text == text
    assert not is_called(text, "sofa")


def test_every_answer_of_a_name_is_carried() -> None:
    assert ASKED["instance", "cushion"] == ASKED["instance", "throw pillow"] == (5, 6, 7)
    assert ASKED["instance", "couch"] == (9,)


def test_a_use_has_every_class_of_its_table() -> None:
    assert ASKED["affordance", "place to sit"] == (4, 9)
    assert ASKED["affordance", "place to throw trash"] == (8,)


def test_sizes_compare_with_others_of_the_name() -> None:
    assert ASKED["property", "large cushion"] == (5,)  # 0.072 m3 against the median's 0.024
    assert ASKED["property", "small cushion"] == (6,)


def test_relations_come_from_boxes() -> None:
    assert ASKED["relative", "vase on a table"] == (3,)
    assert ASKED["relative", "rug under a table"] == (1,)
    assert ASKED["relative", "chair next to a table"] == (4,)
    assert ("relative", "table under a vase") not in ASKED


def test_what_stands_between_two_single_things_is_asked() -> None:
    row = SceneMap(tuple(thing(k, name, (k * 0.8, 0, 0), (0.3, 0.3, 0.5)) for k, name in
                         ((1, "bin"), (2, "lamp"), (3, "sofa"))))  # fmt: skip
    asked = {one.text: one.answers for one in generate("a/b", row)}
    assert asked["lamp between the bin and the sofa"] == (2,)


def test_what_more_than_a_third_answers_is_dropped() -> None:
    same = SceneMap(tuple(thing(k, "chair", (k, 0, 0), (0.4, 0.4, 0.9)) for k in range(1, 4)))
    assert all(one.text != "chair" for one in generate("a/b", same))


def test_a_limit_draws_the_same_questions_whatever_the_rest() -> None:
    few = generate("a/b", THINGS, per_kind=3)
    assert few == generate("a/b", SceneMap(tuple(reversed(THINGS.objects))), per_kind=3)
    assert max(sum(one.kind == kind for one in few) for kind in KINDS) == 3
    every = [one for one in generate("a/b", THINGS) if one.kind == "instance"]
    assert set(chosen(every, 3)) <= set(chosen(every, 5))


def test_objects_are_named_after_most_of_their_vertices_and_small_ones_left_out() -> None:
    truth = room()
    semantic = truth.semantic.copy()
    semantic[truth.instance == 2] = np.where(np.arange(150) < 40, ID["table"], ID["chair"])
    smaller = truth.instance.copy()
    smaller[np.flatnonzero(truth.instance == 5)[:60]] = 0
    changed = GroundTruth(truth.points, semantic, smaller, LABELS, truth.variant, truth.source)
    names = {one.id: one.name for one in known_objects(changed, 100).objects}
    assert names == {2: "chair", 3: "chair", 4: "table", 6: "cushion", 7: "book", 8: "backpack"}  # no wall, no lamp


@pytest.mark.parametrize(
    ("label", "class_name", "is_right"),
    [
        ("couch", "sofa", True),
        ("Couches", "sofa", True),
        ("office chair", "chair", True),
        ("chair", "office chair", True),
        ("paper towel", "towel", False),
        ("towel", "paper-towel", False),
        ("furniture", "sofa", False),
        ("", "sofa", False),
        ("table", "sofa", False),
    ],
)
def test_a_label_is_right_by_the_lexicon(label: str, class_name: str, is_right: bool) -> None:
    assert is_called(label, class_name) is is_right


@pytest.mark.parametrize(
    ("rgb", "word"),
    [
        ((200, 40, 40), "red"), ((60, 140, 60), "green"), ((50, 90, 180), "blue"), ((30, 30, 32), "black"),
        ((235, 235, 230), "white"), ((130, 131, 133), "grey"), ((118, 74, 42), "brown"), ((214, 192, 156), "beige"),
        ((228, 192, 48), "yellow"), ((228, 118, 36), "orange"), ((122, 62, 152), "purple"), ((232, 138, 166), "pink"),
    ],
)  # fmt: skip
def test_the_colours_of_the_rooms_have_their_words(rgb: tuple[int, int, int], word: str) -> None:
    assert colour_word(np.tile(np.array(rgb, np.float64), (100, 1))) == word


def test_an_object_of_many_colours_has_no_word() -> None:
    half = np.tile([200.0, 40.0, 40.0], (50, 1))
    assert colour_word(np.concatenate([half, half[:, ::-1]])) == ""
