"""Questions: their ids, generation from boxes and classes, labels and synonyms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bedroom_map import placed
from scored_room import ID, LABELS, room

from su3d_bench.core.types import GroundTruth
from su3d_bench.questions.generated import generate_questions
from su3d_bench.questions.generator import accuracy_by_name, generate, may_be_confused
from su3d_bench.questions.model import new_question, question_id
from su3d_bench.questions.scene_map import MapObject, SceneMap, is_called, known_objects

# A table with a vase on it, a rug under the table, a chair beside it, a big and a small cushion, a door and a bin.
THINGS = SceneMap(
    (
        placed(1, "rug", (0, 0, 0.0), (2.0, 2.0, 0.02)),
        placed(2, "table", (0.5, 0.5, 0.02), (1.0, 1.0, 0.7)),
        placed(3, "vase", (0.9, 0.9, 0.72), (0.2, 0.2, 0.3)),
        placed(4, "chair", (1.6, 0.5, 0.02), (0.5, 0.5, 0.9)),
        placed(5, "cushion", (5.0, 5.0, 0.0), (0.6, 0.6, 0.2)),
        placed(6, "cushion", (6.0, 6.0, 0.0), (0.3, 0.3, 0.1)),
        placed(7, "cushion", (7.0, 5.0, 0.0), (0.32, 0.32, 0.1)),
        placed(8, "bin", (4.0, 8.0, 0.0), (0.3, 0.3, 0.4)),
        placed(9, "sofa", (5.0, 8.0, 0.0), (1.0, 0.8, 0.8)),
        placed(10, "bed", (7.0, 8.0, 0.0), (1.0, 0.8, 0.5)),
    )
)
ASKED = {(one.kind, one.text): one.answers for one in generate("a/b", THINGS)}


def test_question_id_depends_only_on_scene_kind_and_text() -> None:
    one = new_question("a/b", "instance", "chair", (3, 1, 3), "x")
    assert one == replace(new_question("a/b", "instance", "chair", (1, 3), "y"), source="x")
    assert len({question_id(*key) for key in (("a/b", "instance", "chair"), ("a/b", "property", "chair"))}) == 2


def test_sizes_compare_with_others_of_the_name() -> None:
    assert ASKED["property", "large cushion"] == (5,)  # 0.072 m3 against 0.010 and 0.009
    assert ("property", "small cushion") not in ASKED  # two are of one size


def test_relations_come_from_boxes() -> None:
    assert ASKED["relative by name", "vase on a table"] == (3,)
    assert ASKED["relative by name", "chair next to a table"] == (4,)


def test_each_relation_is_asked_once_and_both_ways_for_chains() -> None:
    doubled = {"table under a vase", "rug under a table", "table next to a chair", "table with a vase on it"}
    assert doubled.isdisjoint(text for _, text in ASKED)
    both = {one.text: one.answers for one in generate("a/b", THINGS, both=True)}
    assert both["table with a vase on it"] == both["table next to a chair"] == (2,)
    tucked = placed(11, "box", (0.7, 0.7, 0.0), (0.3, 0.3, 0.3))
    beneath = SceneMap((*(thing for thing in THINGS.objects if thing.name not in ("rug", "chair")), tucked))
    assert {one.text: one.answers for one in generate("a/b", beneath)}["box under a table"] == (11,)
    texts = {one.text for one in generate_questions(beneath, n_each=99)}
    assert "What is under the table?" in texts and "What is under the vase?" not in texts


def test_largest_needs_three_objects_and_a_visible_lead() -> None:
    def asked(*sides: float) -> set[str]:
        boxes = [placed(k, "box", (3.0 * k, 0, 0), (side, side, 0.5)) for k, side in enumerate(sides, 1)]
        return {one.text for one in generate_questions(SceneMap(tuple(boxes)), n_each=9) if one.kind == "largest"}

    assert asked(1.0, 0.5, 0.5) == {"Which box is the largest?"}
    assert asked(1.0, 0.5) == asked(1.0, 0.9, 0.5) == set()


def test_objects_are_not_counted_or_denied_if_another_may_have_the_name() -> None:
    desk = placed(11, "desk", (9, 9, 0), (1.2, 0.6, 0.7))
    lamps = [placed(k, "lamp", (k, 12, 0), (0.2, 0.2, 0.4)) for k in (12, 13)]  # another count than 0 and 1
    alone, beside = (
        {one.text for one in generate_questions(SceneMap((*THINGS.objects, *lamps, *more)), n_each=99)}
        for more in ((), (desk,))
    )
    assert "How many tables are there?" in alone and "How many tables are there?" not in beside
    assert "How many beds are there?" in beside and not any("pillow" in text for text in alone | beside)
    assert not any("How many cushions" in text for text in alone)  # the sofa may have some
    assert may_be_confused("cushion", "office chair") and not may_be_confused("chair", "cushion")
    blinds = SceneMap((*THINGS.objects, placed(11, "blinds", (9, 9, 1), (1.2, 0.1, 0.7))))
    assert not any("How many blinds" in one.text for one in generate_questions(blinds, n_each=99))


def test_closest_object_leads_between_centres_and_between_sides() -> None:
    bin_, small = placed(1, "bin", (0, 0, 0), (0.4, 0.4, 0.4)), placed(2, "cabinet", (1.0, 0, 0), (0.4, 0.4, 0.7))
    for x, is_asked in ((0.9, False), (3.0, True)):  # from its side, 0.5 m and 2.6 m from the bin; the small one 0.6 m
        large = placed(3, "cabinet", (x, 0, 0), (3.0, 0.4, 0.7))
        texts = {one.text for one in generate_questions(SceneMap((bin_, small, large)), n_each=99)}
        assert ("Which cabinet is closer to the bin?" in texts) is is_asked


def test_object_on_a_candidate_is_not_compared_by_distance() -> None:
    tables = [placed(k, "table", (3.0 * k, 0, 0), (0.6, 0.6, 0.6)) for k in (1, 2)]
    for z, is_asked in ((0.0, True), (0.6, False)):
        cup, bed = (
            placed(3, "cup", (3.2, 0.2 - 2 * (z == 0), z), (0.1, 0.1, 0.1)),
            placed(4, "bed", (9, 0, 0), (2, 2, 0.5)),
        )
        texts = {one.text for one in generate_questions(SceneMap((*tables, cup, bed)), n_each=99)}
        assert any(text.startswith("Which table is") and "the cup" in text for text in texts) is is_asked


def test_object_between_two_unique_objects_is_asked() -> None:
    row = SceneMap(tuple(placed(k, name, (k * 0.8, 0, 0), (0.3, 0.3, 0.5)) for k, name in
                         ((1, "bin"), (2, "lamp"), (3, "sofa"))))  # fmt: skip
    asked = {one.text: one.answers for one in generate("a/b", row)}
    assert asked["lamp between the bin and the sofa"] == (2,)


def row_of(*things: MapObject) -> dict[tuple[str, str], tuple[int, ...] | None]:
    """The questions on the given objects, with enough others that no question is too general."""
    others = [placed(100 + k, f"thing{k}", (20.0 + 3 * k, 20, 0), (0.5, 0.5, 0.5)) for k in range(9)]
    return {(one.kind, one.text): one.answers for one in generate("a/b", SceneMap((*things, *others)))}


def test_relation_shared_by_all_of_a_name_is_a_separate_kind() -> None:
    table, other_table = placed(1, "table", (0, 0, 0), (1, 1, 0.7)), placed(2, "desk", (4, 0, 0), (1, 1, 0.7))
    cup, other_cup = (
        placed(3, "cup", (0.4, 0.4, 0.7), (0.1, 0.1, 0.1)),
        placed(4, "cup", (4.4, 0.4, 0.7), (0.1, 0.1, 0.1)),
    )
    alone, both = row_of(table, other_table, cup), row_of(table, other_table, cup, other_cup)
    assert alone["relative by name", "cup on a table"] == (3,) and ("relative", "cup on a table") not in alone
    assert both["relative", "cup on a table"] == (3,) and ("relative by name", "cup on a table") not in both


def test_pair_near_a_threshold_is_not_asked_about() -> None:
    table = placed(1, "table", (0, 0, 0), (1, 1, 0.7))
    near, doubtful = (
        placed(2, "chair", (1.15, 0, 0), (0.5, 0.5, 0.9)),
        placed(2, "chair", (1.24, 0, 0), (0.5, 0.5, 0.9)),
    )
    assert row_of(table, near)["relative by name", "chair next to a table"] == (2,)
    assert not any(text == "chair next to a table" for _, text in row_of(table, doubtful))


def test_positions_of_cut_objects_are_not_asked() -> None:
    table, cup = placed(1, "table", (0, 0, 0), (1, 1, 0.7)), placed(2, "cup", (0.4, 0.4, 0.7), (0.1, 0.1, 0.1))
    lamp, sofa = placed(3, "lamp", (3, 0, 0), (0.3, 0.3, 1.5)), placed(4, "sofa", (6, 0, 0), (1, 1, 0.7))
    assert row_of(table, cup)["relative by name", "cup on a table"] == (2,)
    cut = row_of(replace(table, is_cut=True), cup)
    assert not any("on a table" in text for _, text in cut) and ("instance", "table") in cut
    objects = SceneMap((table, cup, lamp, sofa))
    whole = [made.text for made in generate_questions(objects, n_each=99)]
    seen = [
        made.text for made in generate_questions(SceneMap((table, cup, lamp, replace(sofa, is_cut=True))), n_each=99)
    ]
    assert any("distance" in text and "sofa" in text for text in whole)
    assert not any("sofa" in text for text in seen if "How many" not in text)


def test_objects_with_unclear_names_are_not_in_questions() -> None:
    truth = room()
    names = [{"book": "tissue-paper"}.get(name, name) for name in LABELS.names]
    changed = replace(truth, labels=replace(LABELS, names=tuple(names)))
    assert [one.id for one in known_objects(changed, 100).objects if not one.is_query_target] == [7]
    assert all(one.is_query_target for one in known_objects(truth, 100).objects)


def test_invisible_objects_are_not_in_questions_or_answers() -> None:
    table, cup = placed(1, "table", (0, 0, 0), (1, 1, 0.7)), placed(2, "cup", (0.4, 0.4, 0.7), (0.1, 0.1, 0.1))
    assert ("instance", "cup") in row_of(table, cup)
    hidden = row_of(table, replace(cup, is_query_target=False))
    assert not any("cup" in text for _, text in hidden)
    assert ("instance", "table") in hidden


def test_colour_or_material_is_asked_if_known_for_all_of_a_name() -> None:
    red, blue, plain, woven = (
        replace(placed(k, "chair", (4.0 * k, 0, 0), (0.5, 0.5, 0.9)), caption=caption)
        for k, caption in ((1, "red"), (2, "blue wooden"), (3, ""), (4, "wicker"))
    )
    assert row_of(red, blue)["property", "red chair"] == (1,)
    assert not any(text == "red chair" for _, text in row_of(red, plain))
    assert row_of(red)["property by name", "red chair"] == (1,)
    assert not any(text == "wooden chair" for _, text in row_of(red, blue))  # the red one may be of painted wood
    assert row_of(blue, woven)["property", "wooden chair"] == (2,)
    assert row_of(blue)["property by name", "wooden chair"] == (2,)


def test_name_only_baseline_equals_share_of_the_name() -> None:
    chairs = SceneMap(tuple(placed(k, "chair", (4.0 * k, 0, 0), (0.5, 0.5, 0.9)) for k in range(1, 5)))
    assert accuracy_by_name(new_question("a/b", "property", "red chair", (1,), "x"), chairs) == 0.25
    assert accuracy_by_name(new_question("a/b", "property by name", "old chair", (1, 2, 3, 4), "x"), chairs) == 1.0
    assert accuracy_by_name(new_question("a/b", "instance", "chair", (1, 2, 3, 4), "x"), chairs) == 1.0
    assert accuracy_by_name(new_question("a/b", "relative", "chair on a table", None, "x"), chairs) == 0.0


def test_questions_answered_by_over_a_third_are_dropped() -> None:
    same = SceneMap(tuple(placed(k, "chair", (k, 0, 0), (0.4, 0.4, 0.9)) for k in range(1, 4)))
    assert all(one.text != "chair" for one in generate("a/b", same))


def test_objects_take_majority_class_and_small_ones_are_excluded() -> None:
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
        ("office chair", "chair", True),
        ("chair", "office chair", True),
        ("paper towel", "towel", False),
        ("furniture", "sofa", False),
        ("", "sofa", False),
    ],
)
def test_label_correctness_follows_the_lexicon(label: str, class_name: str, is_right: bool) -> None:
    assert is_called(label, class_name) is is_right
