"""Sheets on which annotators judge questions from ground truth: created, drawn, scored, and excluded afterwards."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from bedroom_map import placed
from painted import LABELS, Painted
from painted_runs import PAINTED
from simulated_annotators import SET_ID

from su3d_bench.cli.main import main
from su3d_bench.human_eval.answers import Judgement, check_key
from su3d_bench.human_eval.drafts import question_drafts, reference_ids
from su3d_bench.human_eval.items import (
    ANSWER_COLUMNS,
    ARGUABLE,
    ASKS,
    RIGHT,
    WRONG,
    Key,
    KeyItem,
    Sheet,
    new_item,
    read_key,
    read_sheet,
)
from su3d_bench.human_eval.scores import ANY_KIND, WHOLE, Scores, score, whole_verdicts
from su3d_bench.human_eval.sources import TruthSource, ground_truth_of_addresses
from su3d_bench.questions.generated import generate_questions
from su3d_bench.questions.ground_truths import fullest_truth, scene_objects
from su3d_bench.questions.model import GENERATED_KINDS, REASONING, question_id
from su3d_bench.questions.scene_map import SceneMap

SCENE = f"{PAINTED}/a"
PARTS = tuple(ask.name for ask in ASKS["questions"])
HOSTILE = '=HYPERLINK("x") <script>alert(1)</script> \u202eabc'


@pytest.fixture(autouse=True)
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def source() -> TruthSource:
    return ground_truth_of_addresses([SCENE])


def painted_objects() -> Any:
    dataset = Painted(Path(), Painted.Options())
    return scene_objects(dataset, "a", fullest_truth(dataset, "a"), 100)


# Creating


def test_reference_of_a_negative_answer_is_the_last_name_in_the_text() -> None:
    # Two tables, a vase on each and one on the floor far away, a coffee table with a lamp, a desk with a cup.
    scene = SceneMap(
        (
            placed(1, "table", (0.0, 0.0, 0.0), (1.0, 1.0, 0.7)),
            placed(2, "table", (6.0, 0.0, 0.0), (1.0, 1.0, 0.7)),
            placed(3, "vase", (0.4, 0.4, 0.7), (0.2, 0.2, 0.3)),
            placed(4, "vase", (9.0, 9.0, 0.0), (0.2, 0.2, 0.3)),
            placed(5, "coffee table", (3.0, 3.0, 0.0), (1.0, 0.5, 0.4)),
            placed(6, "lamp", (3.2, 3.2, 0.4), (0.2, 0.2, 0.4)),
            placed(7, "desk", (9.0, 0.0, 0.0), (1.0, 0.5, 0.7)),
            placed(8, "cup", (9.4, 0.2, 0.7), (0.1, 0.1, 0.1)),
        )
    )
    made = {one.text: one for one in generate_questions(scene, n_each=20)}
    no, yes = (made[f"Is there a {name} on the coffee table?"] for name in ("cup", "lamp"))
    assert no.answer.value is False and reference_ids(no, scene) == [5]
    assert yes.answer.object_ids == (6,) and reference_ids(yes, scene) == [5]


def test_each_kind_and_template_has_the_ground_truth_answer(source: TruthSource) -> None:
    drafts = question_drafts(source, "painted/a", 2)
    made = [one for one in drafts if one.question_kind in GENERATED_KINDS]
    reasoned = [one for one in drafts if one.question_kind not in GENERATED_KINDS]
    asked = {one.text.split("\n")[0].removeprefix("Find: "): one for one in made}
    assert max(Counter(one.question_kind for one in drafts).values()) == 2
    assert {one.question_kind for one in made} == {"instance", "property by name"}
    true = generate_questions(painted_objects(), n_each=2)
    result = ["no" if one.answer.value is False else re.sub(r" #\d+", "", one.answer.text) for one in true]
    assert [one.text for one in reasoned] == [
        f"{one.text}\nAnswer: {words}" for one, words in zip(true, result, strict=True)
    ]
    assert len({one.question_id for one in drafts}) == len(drafts)
    for text, one in asked.items():
        assert one.question_id == question_id("painted/a", one.question_kind, text)
        assert LABELS.names[one.rows[0]] in one.text.split("Answer: ")[1] and len(one.rows) == 1
    for one, question in zip(reasoned, true, strict=True):
        assert one.question_id == question_id("painted/a", REASONING, question.text)
        assert [one.names[row] for row in one.rows] == [
            painted_objects().by_id(k).name for k in question.answer.object_ids
        ]
    assert all(one.asks == PARTS and one.methods == (one.question_kind, ANY_KIND) for one in drafts)
    assert not any(one.automatic for one in drafts)


def test_question_sheets_need_no_run(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["sheets", "make", "--kinds", "questions", "--scenes", SCENE, "--jobs", "1", "--per-kind", "1"]
    assert main([*words, "--annotators", "2", "--overlap", "1", "--out", "out", "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)["sets"]
    sheet, key = read_sheet(Path("out/sheet.json")), read_key(Path("out-key/key.json"))
    check_key(sheet, key)
    assert result["kind"] == sheet.kind == "questions" and result["n_questions"] == 3 * len(sheet.items)
    assert [len(share.item_ids) for share in sheet.annotators] == [len(sheet.items)] * 2
    assert key.methods[-1] == ANY_KIND and set(key.methods[:-1]) == {one.question_kind for one in key.items}
    page = Path("out/annotator-1/sheet.html").read_text()
    assert not [one.question_id for one in key.items if one.question_id in page]
    listed = key.items[0].question_id
    Path("gone.csv").write_text(f"question_id\n{listed}\n")
    assert main([*words, "--exclude-ids", "gone.csv", "--out", "without", "--quiet"]) == 0
    assert listed not in {one.question_id for one in read_key(Path("without-key/key.json")).items}


# Scoring


def question_set(kinds: Sequence[str]) -> tuple[Sheet, Key]:
    set_id = "questions" + SET_ID
    items, keys = [], []
    for k, kind in enumerate(kinds):
        name = f"item-{k:04d}"
        items.append(new_item(set_id, name, f"{HOSTILE} {k}", PARTS, [f"{name}.png"], ["ab"]))
        made_id = question_id("rooms/a", kind, f"{k}")
        keys.append(KeyItem(name, "rooms/a", (kind, ANY_KIND), (k, k), made_id, kind, {}, {}))
    sheet = Sheet(set_id, "questions", 7, ASKS["questions"], tuple(items), ())
    return sheet, Key(set_id, "questions", "", "", (*dict.fromkeys(kinds), ANY_KIND), "", tuple(keys))


KINDS_ASKED = ("instance", "instance", "closer", "closer")
ANN = ((RIGHT,) * 3, (RIGHT, ARGUABLE, RIGHT), (RIGHT, RIGHT, WRONG), (RIGHT,) * 3)
BOB = ((RIGHT,) * 3, (RIGHT, ARGUABLE, RIGHT), (RIGHT, RIGHT, WRONG), (ARGUABLE, RIGHT, WRONG))


def judgements(sheet: Sheet, **printed: Sequence[tuple[str, str, str]]) -> list[Judgement]:
    return [
        Judgement(item.id, who, ask, answer)
        for k, item in enumerate(sheet.items)
        for place, ask in enumerate(PARTS)
        for who, of_items in printed.items()
        for answer in [of_items[k][place]]
    ]


def scored() -> tuple[Sheet, Key, Scores]:
    sheet, key = question_set(KINDS_ASKED)
    check_key(sheet, key)
    return sheet, key, score(sheet, key, judgements(sheet, ann=ANN, bob=BOB))


def test_question_score_is_the_worst_of_its_parts() -> None:
    sheet, _ = question_set(KINDS_ASKED)
    whole = [one.answer for one in whole_verdicts(judgements(sheet, ann=BOB), 3)]
    assert whole == [RIGHT, ARGUABLE, WRONG, WRONG]
    unfinished = judgements(sheet, ann=BOB)[:-1]
    assert len(list(whole_verdicts(unfinished, 3))) == 3


def test_shares_of_right_are_counted_per_kind_of_question() -> None:
    _, _, found = scored()
    shares = {(cell.method, cell.metric): cell.value for cell in found.cells}
    assert {cell.judge for cell in found.cells} == {"people"} and found.tests == () == found.confusions
    of = {
        (kind, metric): shares[kind, metric] for kind in ("instance", "closer", "all") for metric in (WHOLE, ARGUABLE)
    }
    assert of == {
        ("instance", WHOLE): 0.5, ("instance", ARGUABLE): 0.5,
        ("closer", WHOLE): 0.25, ("closer", ARGUABLE): 0.0,
        ("all", WHOLE): 0.375, ("all", ARGUABLE): 0.25,
    }  # fmt: skip
    assert [shares["closer", part] for part in PARTS] == [0.75, 1.0, 0.25]
    assert [shares["instance", part] for part in PARTS] == [1.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("answers", "is_settled"),
    [
        ((RIGHT, RIGHT, WRONG), True),
        ((RIGHT, WRONG), False),  # a tie
        ((RIGHT, RIGHT, ARGUABLE, WRONG), False),  # not more than half
        ((WRONG, WRONG, RIGHT), False),  # the majority finds it wrong
    ],
)
def test_majority_settles_questions_that_most_find_right(
    answers: tuple[str, ...], is_settled: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["sheets", "make", "--kinds", "questions", "--scenes", SCENE, "--jobs", "1", "--per-kind", "1", "--quiet"]
    assert main([*words, "--annotators", str(len(answers)), "--overlap", "1", "--out", "out"]) == 0
    sheet = read_sheet(Path("out/sheet.json"))
    rows = [",".join(ANSWER_COLUMNS)]
    for item in sheet.items:
        for share, answer in zip(sheet.annotators, answers, strict=True):
            first = answer if item is sheet.items[0] else RIGHT  # they disagree on one item only
            given = zip(PARTS, (first, RIGHT, RIGHT), strict=True)
            rows += [f"{sheet.id},{item.id},{share.name},{ask},{one},{item.check}" for ask, one in given]
    Path("answers.csv").write_text("\n".join(rows))
    score_words = ["sheets", "score", "answers.csv", "--key", "out-key", "--disputed", "disputed.csv"]
    assert main(score_words) == 0 and len(Path("disputed.csv").read_text().splitlines()) == 2
    capsys.readouterr()
    assert main([*score_words, "--majority"]) == 0
    assert len(Path("disputed.csv").read_text().splitlines()) == (1 if is_settled else 2)
    assert f"{int(is_settled)} rating" in capsys.readouterr().err
