"""Sheets on which people judge questions that the ground truth made: made, pictured, scored, and left out again."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_sheets import PAINTED, RUN
from painted import LABELS, Painted, colour_perception
from PIL import Image
from simulated_annotators import SET_ID

from su3d_bench.analysis.tables import measured_results
from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.questions.files.files import read_questions
from su3d_bench.questions.files.left_out import read_left_out
from su3d_bench.questions.model import MADE_KINDS, REASONING, question_id
from su3d_bench.questions.reasoning.answers import Answer
from su3d_bench.questions.reasoning.generated import GeneratedQuestion, generate_questions
from su3d_bench.questions.truths import fullest_truth, scene_objects
from su3d_bench.reports.tables.judged import sheet_tables
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run
from su3d_bench.sheets.items import (
    ARGUABLE,
    ASKS,
    RIGHT,
    WRONG,
    AnnotatorShare,
    Key,
    KeyItem,
    Sheet,
    new_item,
    read_key,
    read_sheet,
    write_key,
    write_sheet,
)
from su3d_bench.sheets.judging.answers import Judgement, check_key
from su3d_bench.sheets.judging.scores import OF_ALL_KINDS, Scores, read_scores, score
from su3d_bench.sheets.judging.verdicts import WHOLE, whole_verdicts
from su3d_bench.sheets.making import question_drafts as question_drafts_module
from su3d_bench.sheets.making.drawing import SceneDrafts, draw_all, draw_scene
from su3d_bench.sheets.making.question_drafts import question_drafts
from su3d_bench.sheets.making.truth_source import TruthSource, truth_of_addresses, truth_of_run

SCENE = f"{PAINTED}/a"
PARTS = tuple(ask.name for ask in ASKS["questions"])
HOSTILE = '=HYPERLINK("x") <script>alert(1)</script> \u202eabc'


@pytest.fixture(autouse=True)
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def source() -> TruthSource:
    return truth_of_addresses([SCENE])


def painted_objects() -> Any:
    dataset = Painted(Path(), Painted.Options())
    return scene_objects(dataset, "a", fullest_truth(dataset, "a"), 100)


# Made


def test_what_a_no_was_held_against_is_outlined(source: TruthSource, monkeypatch: pytest.MonkeyPatch) -> None:
    denied = GeneratedQuestion("Is there a lamp on the sofa?", "is on", Answer("no: the map has none", value=False))
    monkeypatch.setattr(question_drafts_module, "generate_questions", lambda objects, n_each: (denied,))
    (draft,) = [one for one in question_drafts(source, "painted/a", 1) if one.question_kind == "is on"]
    assert draft.text.endswith("Answer: no") and not draft.rows
    assert [draft.names[row] for row in draft.others] == ["sofa"]


def test_each_kind_and_template_is_asked_with_the_answer_of_the_truth(source: TruthSource) -> None:
    drafts = question_drafts(source, "painted/a", 2)
    made = [one for one in drafts if one.question_kind in MADE_KINDS]
    reasoned = [one for one in drafts if one.question_kind not in MADE_KINDS]
    asked = {one.text.split("\n")[0].removeprefix("Find: "): one for one in made}
    assert max(Counter(one.question_kind for one in drafts).values()) == 2
    assert {one.question_kind for one in made} == {"instance", "property by name"}
    true = generate_questions(painted_objects(), n_each=2)
    told = ["no" if one.answer.value is False else re.sub(r" #\d+", "", one.answer.text) for one in true]
    assert [one.text for one in reasoned] == [
        f"{one.text}\nAnswer: {words}" for one, words in zip(true, told, strict=True)
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
    assert all(one.asks == PARTS and one.methods == (one.question_kind, OF_ALL_KINDS) for one in drafts)
    assert not any(one.automatic for one in drafts)


def test_the_map_of_a_truth_has_every_instance_of_it(source: TruthSource) -> None:
    found, truth = source.instances("painted/a"), source.truth("painted/a")
    assert found.names == LABELS.names and found.ids.tolist() == [1, 2, 3, 4]
    assert [truth.instance[found.mask(k)].tolist() for k in range(4)] == [
        [k + 1] * int((truth.instance == k + 1).sum()) for k in range(4)
    ]


def test_what_is_left_out_makes_room_for_others_of_its_kind(source: TruthSource) -> None:
    before = question_drafts(source, "painted/a", 2)
    gone = {next(one.question_id for one in before if one.question_kind == kind) for kind in ("instance", "nearest")}
    after = question_drafts(source, "painted/a", 2, gone)
    assert not gone & {one.question_id for one in after}
    kinds = [Counter(one.question_kind for one in drafts) for drafts in (before, after)]
    assert kinds[0] - kinds[1] == Counter({"nearest": 1}) and not kinds[1] - kinds[0]


def test_the_objects_that_answer_are_outlined_in_a_frame(source: TruthSource) -> None:
    drafts = question_drafts(source, "painted/a", 1)
    (answered, *_) = [one for one in drafts if one.question_kind == "nearest"]
    assert answered.others and not set(answered.others) & set(answered.rows)
    (picture,) = draw_all(source, [answered], 1)
    pixels = np.asarray(Image.open(BytesIO(picture)).convert("RGB")).astype(int)
    assert (np.abs(pixels - [255, 64, 200]).sum(axis=2) < 60).mean() > 0.001
    again = draw_scene(SceneDrafts(source.opener, {0: answered}), lambda event: None)
    assert again == {0: picture}


def test_scenes_are_drawn_side_by_side_as_one_after_the_other() -> None:
    both = truth_of_addresses([SCENE, f"{PAINTED}/b"])
    drafts = [question_drafts(both, scene, 1)[0] for scene in both.scenes]
    assert draw_all(both, drafts, 2) == draw_all(both, drafts, 1)


def test_sheets_of_questions_need_no_run(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["sheets", "make", "--kind", "questions", "--scenes", SCENE, "--jobs", "1", "--per-kind", "1"]
    assert main([*words, "--annotators", "2", "--overlap", "1", "--out", "out", "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["sets"]
    sheet, key = read_sheet(Path("out/sheet.json")), read_key(Path("out-key/key.json"))
    check_key(sheet, key)
    assert told["kind"] == sheet.kind == "questions" and told["n_questions"] == 3 * len(sheet.items)
    assert [len(share.item_ids) for share in sheet.annotators] == [len(sheet.items)] * 2
    assert key.methods[-1] == OF_ALL_KINDS and set(key.methods[:-1]) == {one.question_kind for one in key.items}
    page = Path("out/annotator-1/sheet.html").read_text()
    assert not [one.question_id for one in key.items if one.question_id in page]
    listed = key.items[0].question_id
    Path("gone.csv").write_text(f"question_id\n{listed}\n")
    assert main([*words, "--leave-out", "gone.csv", "--out", "without", "--quiet"]) == 0
    assert listed not in {one.question_id for one in read_key(Path("without-key/key.json")).items}


def test_sheets_of_a_run_may_have_questions_among_the_kinds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.setattr(finished_run, "encoder_of", lambda run, device="cpu": colour_perception().encoder)
    assert main(RUN) == 0
    words = ["sheets", "make", "run", "--jobs", "1", "--per-kind", "1", "--quiet", "--kind"]
    assert main([*words, "annotation", "questions", "--out", "both"]) == 0
    assert main([*words, "questions", "--out", "alone"]) == 0
    for name in ("sheet.json", "annotator-1/sheet.html"):
        assert Path("both/questions", name).read_bytes() == Path("alone", name).read_bytes()
    key = read_key(Path("alone-key/key.json"))
    assert (key.run, read_key(Path("both-key/annotation/key.json")).run) == ("run", "run")
    assert truth_of_run(Path("run")).opener().scenes == ("painted/a",)
    Path("asked.csv").write_text(
        "scene,text,objects,kind\npainted/a,chair,1,instance\npainted/a,sofa,2,instance\n"
        "painted/a,How many chairs are there?,,reasoning\npainted/a,How many sofas are there?,,reasoning\n"
    )
    gone = [
        question_id("painted/a", "instance", "sofa"),
        question_id("painted/a", REASONING, "How many chairs are there?"),
    ]
    Path("gone.csv").write_text("\n".join(["question_id", *gone]))
    more = ["retrieval", "reasoning", "--questions", "asked.csv", "--leave-out", "gone.csv", "--out", "less"]
    assert main([*words, *more]) == 0
    shown = [
        {one.text.split("\n")[0] for one in read_sheet(Path("less", kind, "sheet.json")).items} for kind in more[:2]
    ]
    assert shown == [{"chair"}, {"How many sofas are there?"}]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--kind", "questions"], "needs --scenes"),
        (["--kind", "questions", "retrieval", "--scenes", SCENE], "RUN: name the folder of a run"),
        (["--kind", "retrieval", "--scenes", SCENE], "RUN: name the folder of a run"),
        (["--kind", "questions", "--scenes", SCENE, "--questions", "paper"], "--questions: sheets of kind questions"),
        (["--kind", "questions", "--scenes", SCENE, "--methods", "x"], "--methods: no method has a part"),
        (["--kind", "questions", "--scenes", SCENE, "--solver", "llm"], "add --kind reasoning"),
        (["--kind", "questions", "--scenes", "rooms/nowhere*"], "no scene matches 'rooms/nowhere*'"),
        (["--kind", "questions", "--scenes", SCENE, "--leave-out", "none.csv"], "none.csv is missing"),
        (["run", "--kind", "annotation", "--leave-out", "none.csv"], "--leave-out: annotation sheets"),
    ],
)
def test_what_cannot_be_asked_is_one_line(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sheets", "make", *words, "--out", "out"]) == 2
    told = capsys.readouterr().err
    assert line in told and len(told.splitlines()) == 1
    assert not Path("out").exists()


def test_a_scene_without_truth_is_refused(source: TruthSource, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(source.dataset("painted/a")), "variants", ())
    with pytest.raises(GroundTruthMissing, match="painted/a: the dataset has no ground truth"):
        question_drafts(source, "painted/a", 1)


# Scored


def question_set(kinds: Sequence[str], annotators: Sequence[str]) -> tuple[Sheet, Key]:
    set_id = "questions" + SET_ID
    items, keys = [], []
    for k, kind in enumerate(kinds):
        name = f"item-{k:04d}"
        items.append(new_item(set_id, name, f"{HOSTILE} {k}", PARTS, [f"{name}.png"], ["ab"]))
        made_id = question_id("rooms/a", kind, f"{k}")
        keys.append(KeyItem(name, "rooms/a", (kind, OF_ALL_KINDS), (k, k), made_id, kind, {}, {}))
    shares = tuple(AnnotatorShare(name, tuple(one.id for one in items)) for name in annotators)
    sheet = Sheet(set_id, "questions", 7, ASKS["questions"], tuple(items), shares)
    return sheet, Key(set_id, "questions", "", "", (*dict.fromkeys(kinds), OF_ALL_KINDS), "", tuple(keys))


KINDS_ASKED = ("instance", "instance", "closer", "closer")
ANN = ((RIGHT,) * 3, (RIGHT, ARGUABLE, RIGHT), (RIGHT, RIGHT, WRONG), (RIGHT,) * 3)
BOB = ((RIGHT,) * 3, (RIGHT, ARGUABLE, RIGHT), (RIGHT, RIGHT, WRONG), (ARGUABLE, RIGHT, WRONG))


def judgements(sheet: Sheet, **said: Sequence[tuple[str, str, str]]) -> list[Judgement]:
    return [
        Judgement(item.id, who, ask, answer)
        for k, item in enumerate(sheet.items)
        for place, ask in enumerate(PARTS)
        for who, of_items in said.items()
        for answer in [of_items[k][place]]
    ]


def scored() -> tuple[Sheet, Key, Scores]:
    sheet, key = question_set(KINDS_ASKED, ("ann", "bob"))
    check_key(sheet, key)
    return sheet, key, score(sheet, key, judgements(sheet, ann=ANN, bob=BOB))


def test_a_question_is_as_right_as_the_worst_of_its_parts() -> None:
    sheet, _ = question_set(KINDS_ASKED, ("ann",))
    whole = [one.answer for one in whole_verdicts(judgements(sheet, ann=BOB))]
    assert whole == [RIGHT, ARGUABLE, WRONG, WRONG]


def test_shares_of_right_are_counted_by_kind_of_question() -> None:
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


def test_annotators_agree_on_parts_and_on_the_whole() -> None:
    _, _, found = scored()
    equal = {one.ask: (one.agreement.n_equal, one.agreement.n_items) for one in found.agreements}
    assert equal == {"sense": (3, 4), "wording": (4, 4), "answer": (3, 4), WHOLE: (3, 4)}
    assert found.annotators == {"ann": 12, "bob": 12} and found.n_judged == 4


def test_what_is_disputed_or_wrong_is_looked_at_again() -> None:
    _, _, found = scored()
    assert [(one.item_id, one.ask, one.reason) for one in found.second_looks] == [
        ("item-0001", "wording", "not right"),
        ("item-0002", "answer", "not right"),
        ("item-0003", "sense", "annotators disagree"),
        ("item-0003", "answer", "annotators disagree"),
    ]


def test_tables_have_a_row_for_each_kind() -> None:
    _, _, found = scored()
    tables = {one.name: one for one in sheet_tables(asdict(found))}
    assert list(tables) == ["questions-rooms", "agreement", "pairs"]
    table = tables["questions-rooms"]
    assert table.head == "kind" and table.columns == ("sense", "wording", "answer", WHOLE, ARGUABLE)
    assert [row.label for row in table.rows] == ["instance (people)", "closer (people)", "all (people)"]
    assert [row.label for row in tables["agreement"].rows] == [*PARTS, WHOLE]
    assert not any("ground truth" in note.lower() for note in table.notes)


@pytest.fixture
def answered(tmp_path: Path) -> tuple[Key, list[str]]:
    """The files of two annotators, and the words that score them."""
    sheet, key = question_set(KINDS_ASKED, ("ann", "bob"))
    (tmp_path / "key").mkdir()
    (tmp_path / "sheet").mkdir()
    write_sheet(tmp_path / "sheet", sheet)
    write_key(tmp_path / "key", key)
    checks = {item.id: item.check for item in sheet.items}
    for name, said in (("ann", ANN), ("bob", BOB)):
        with (tmp_path / f"{name}.csv").open("w", newline="") as stream:
            rows = csv.writer(stream)
            rows.writerow(("sheet_id", "item_id", "annotator", "question", "answer", "check"))
            for one in judgements(sheet, **{name: said}):
                rows.writerow((sheet.id, one.item_id, name, one.ask, one.answer, checks[one.item_id]))
    return key, ["sheets", "score", "ann.csv", "bob.csv", "--key", "key"]


def test_what_not_everybody_calls_right_is_written_for_leave_out(
    answered: tuple[Key, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    key, words = answered
    assert main([*words, "--disputed", "disputed.csv", "--out", "scores"]) == 0
    told = capsys.readouterr()
    assert "2 where annotators disagree, 2 that nobody calls right" in told.out and "disputed.csv" in told.err
    ids = [item.question_id for item in key.items]
    assert read_left_out(Path("disputed.csv")) == frozenset(ids[1:])
    with Path("disputed.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["question_id"] for row in rows] == ids[1:]
    assert rows[2]["why"] == "sense: arguable, right; answer: right, wrong" and rows[2]["kind"] == "closer"
    assert all(row["text"].startswith("'=") and "\u202e" not in row["text"] for row in rows)
    assert read_scores(Path("scores")).kind == "questions"
    assert {row.method for row in measured_results([Path("scores")])} == {"instance", "closer", OF_ALL_KINDS}
    assert main(["report", "tables", "scores"]) == 0
    assert main([*words[:2], "--key", "key", "--disputed", "x.csv"]) == 2
    assert "--disputed: lists what people say" in capsys.readouterr().err
    assert not Path("x.csv").exists()


def test_disputed_questions_are_not_made_again(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["query", "make", "--scenes", SCENE, "--per-kind", "2", "--out"]
    assert main([*words, "all.toml"]) == 0
    before = read_questions(Path("all.toml"))
    gone = before[0]
    Path("gone.csv").write_text(f"\ufeffkind;question_id\r\n{gone.kind};{gone.id}\r\n;\r\n", newline="")
    assert main([*words, "rest.toml", "--leave-out", "gone.csv"]) == 0
    assert "1 left out" in capsys.readouterr().err
    after = read_questions(Path("rest.toml"))
    assert gone not in after and len(after) == len(before)  # another one takes its place


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "the first line must name one column question_id"),
        ("id\n3f6958fff541\n", "the first line must name one column question_id"),
        ("question_id,question_id\n", "the first line must name one column question_id"),
        ("question_id\n1.2E+11\n", "row 2: '1.2E+11' is no id of a question"),
        ("text,question_id\nchair\n", "row 2: '' is no id of a question"),
        ('question_id\n"3f69', "not CSV"),
        ("question_id\n\x1b[2J\n", "row 2: '\\x1b[2J' is no id of a question"),
    ],
)
def test_a_list_that_is_none_is_refused(content: str, told: str) -> None:
    Path("gone.csv").write_text(content)
    with pytest.raises(DataError) as caught:
        read_left_out(Path("gone.csv"))
    assert told in str(caught.value) and "\x1b" not in str(caught.value)


def test_an_empty_list_leaves_out_nothing() -> None:
    Path("gone.csv").write_text("question_id,text\n\n,\n")
    assert read_left_out(Path("gone.csv")) == frozenset()
    with pytest.raises(DataError, match="is missing"):
        read_left_out(Path("none.csv"))


def test_one_question_of_a_template_is_asked_where_its_answers_are_yes_and_no() -> None:
    kinds = [Counter(one.kind for one in generate_questions(painted_objects(), n_each=n)) for n in (1, 2)]
    assert set(kinds[0]) == set(kinds[1]) and set(kinds[0].values()) == {1}
