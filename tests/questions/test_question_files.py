"""Files of questions: own forms, those of ScanRefer, Nr3D and SQA3D, the paper's queries, hostile copies, the verb."""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from damage import damages, outcomes, truncations
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.cli.sheets import FIGURES
from su3d_bench.core.errors import DataError
from su3d_bench.questions.files.files import (
    PAPER,
    PAPER_FIGURES,
    csv_text,
    figure_texts,
    paper_queries,
    read_questions,
    toml_text,
    write_questions,
)
from su3d_bench.questions.model import KINDS, new_question

HOSTILE = ("<script>alert(1)</script>", '=HYPERLINK("x","y")', "\u202eright to left", '😀, "chair"', "x" * 10_000)
SET = tuple(new_question("rooms/a", KINDS[k % 4], text, (k + 1, k + 9), "made") for k, text in enumerate(HOSTILE))
SCANREFER = json.dumps(
    [
        {"scene_id": "scene0000_00", "object_id": "39", "object_name": "cabinet", "ann_id": "0",
         "description": "a white cabinet\nin the corner", "token": []},
        {"scene_id": "scene0000_00", "object_id": "4", "object_name": "cabinet", "ann_id": "1",
         "description": "a white cabinet in the corner", "token": []},
    ]
)  # fmt: skip
NR3D = (
    "stimulus_id,scan_id,instance_type,target_id,utterance,tokens,mentions_target_class\n"
    "scene0525_00-plant-2-9-4,scene0525_00,plant,9,\"The plant, far right\",\"['the', 'plant', 'right']\",True\n"
)
SQA_QUESTION = {"scene_id": "scene0380_00", "situation": "I sit.", "question": "What is in front?", "question_id": 7}
SQA3D = json.dumps({"questions": [SQA_QUESTION]})
SQA3D_ANSWERS = json.dumps({"annotations": [{"question_id": 7, "answers": [{"answer": "table"}]}]})


@pytest.mark.parametrize("name", ["q.toml", "q.csv"])
def test_a_written_set_is_read_as_it_was(tmp_path: Path, name: str) -> None:
    write_questions(tmp_path / name, SET)
    assert read_questions(tmp_path / name) == SET


def test_a_set_has_the_same_bytes_each_time() -> None:
    assert (toml_text(SET), csv_text(SET)) == (toml_text(list(SET)), csv_text(list(SET)))


def test_unknown_answers_stay_unknown(tmp_path: Path) -> None:
    unknown = (new_question("rooms/a", "property", "big pillow", None, "made"),)
    for name in ("q.toml", "q.csv"):
        write_questions(tmp_path / name, unknown)
        assert read_questions(tmp_path / name) == unknown


def test_a_query_file_without_kinds_is_a_set_of_instance_queries(tmp_path: Path) -> None:
    (tmp_path / "q.csv").write_text("scene,text,objects\nroom0,a seat,1 2\n")
    assert read_questions(tmp_path / "q.csv", "replica") == (
        new_question("replica/room0", "instance", "a seat", (1, 2), "q.csv"),
    )


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("q.csv", "scene,text,objects\nroom0,a seat,1\n", "row 2: of which dataset is scene 'room0'"),
        ("q.csv", "scene,text,objects,kind\na/b,seat,1,odd\n", "row 2: unknown kind 'odd'"),
        ("q.csv", "scene,text,objects\na/b,seat,1\na/b,seat,2\n", "row 3: 'seat' stands there twice"),
        ("q.csv", "scene,text,objects,kind,kind\na/b,seat,1,,\n", "the first line must be"),
        ("q.csv", "scene,text,objects\na/b," + "x" * 20_001 + ",1\n", "'scene' and 'text' must be words"),
        ("q.json", "{}", "is neither a list of descriptions"),
        ("q.json", "[" * 100_000, "not JSON"),
        ("q.json", "[]", "has 0 entries"),
        (
            "q.json",
            '[{"scene_id": "../x", "object_id": "1", "description": "a"}]',
            "entry 1: 'scene_id' must be a scene",
        ),
        ("q.json", '[{"scene_id": "s", "object_id": "-1", "description": "a"}]', "entry 1: 'object_id' must be"),
        ("q.json", '[{"scene_id": "s", "object_id": "1"}]', "entry 1: has no 'description'"),
        ("q.json", '{"questions": [3]}', "question 1: has no 'scene_id'"),
    ],
)
def test_what_is_no_set_is_one_line(tmp_path: Path, name: str, content: str, line: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError, match=line):
        read_questions(tmp_path / name)


def test_scanrefer_objects_are_one_more_than_its_ids_and_equal_sentences_share_answers(tmp_path: Path) -> None:
    (tmp_path / "ScanRefer.json").write_text(SCANREFER)
    text = "a white cabinet in the corner"
    assert read_questions(tmp_path / "ScanRefer.json") == (
        replace(new_question("scannet/scene0000_00", "relative", text, (5, 40), "ScanRefer"), name="cabinet"),
    )


def test_nr3d_is_known_by_its_columns(tmp_path: Path) -> None:
    (tmp_path / "nr3d.csv").write_text(NR3D)
    assert read_questions(tmp_path / "nr3d.csv") == (
        replace(
            new_question("scannet/scene0525_00", "relative", "The plant, far right", (10,), "Nr3D"),
            groups=("easy", "view-dependent"),
        ),
    )


def test_sqa3d_takes_its_answers_from_the_file_beside_it(tmp_path: Path) -> None:
    questions = tmp_path / "v1_balanced_questions_val_scannetv2.json"
    questions.write_text(SQA3D)
    text = "I sit. What is in front?"
    asked = new_question("scannet/scene0380_00", "reasoning", text, None, "SQA3D")
    assert read_questions(questions) == (asked,)
    (tmp_path / "v1_balanced_sqa_annotations_val_scannetv2.json").write_text(SQA3D_ANSWERS)
    assert read_questions(questions)[0].reply == "table"


def test_one_question_of_sqa3d_with_two_answers_keeps_both_and_they_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    questions = tmp_path / "v1_balanced_questions_val_scannetv2.json"
    questions.write_text(json.dumps({"questions": [SQA_QUESTION, {**SQA_QUESTION, "question_id": 8}]}))
    replies = [{"question_id": k, "answers": [{"answer": word}]} for k, word in ((7, "table"), (8, "desk"))]
    (tmp_path / "v1_balanced_sqa_annotations_val_scannetv2.json").write_text(json.dumps({"annotations": replies}))
    assert [one.reply for one in read_questions(questions)] == ["table or desk"]
    assert main(["query", "show", str(questions)]) == 0
    shown = capsys.readouterr().out
    assert "1 question on 1 scene (1 reasoning); 0 with known answers, 1 with one in words" in shown
    assert 'What is in front?  -> "table or desk"' in shown


OPENEQA = [{"question": "What is red?", "answer": "the box", "category": "x", "episode_history": "scannet-v0/002"}]
SCANQA = [{"question": "What is red?", "answers": ["box"], "object_ids": [3], "scene_id": "scene0000_00"}]
NR3D_ROW = {"item_id": "nr3d_0", "scan_id": "scene0000_00", "target_id": 9, "utterance": "the plant"}


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("open-eqa-v0.json", OPENEQA, "OpenEQA's questions, .*; write scene, text and objects"),
        ("scannet_qa.json", SCANQA, r"ScanQA's form, answered in words; of Beacon3D give metadata_\*_qa.json"),
        ("scannet_grounding.json", [NR3D_ROW | {"target_id": [9]}], r"give .*Beacon3D's metadata_\*_grounding.json"),
        ("nr3d.json", [NR3D_ROW], "Nr3D, Sr3D or Beacon3D's list as JSON; give nr3d.csv"),
        ("scanrefer.jsonl", NR3D_ROW, "one JSON object a line, .*; give ScanRefer_filtered_train.json or nr3d.csv"),
        ("nr3d.json", f"{json.dumps(NR3D_ROW)}\n{json.dumps(NR3D_ROW)}\n", "one JSON object a line"),
        ("nr3d.csv", "scan_id,utterance\nscene0000_00,plant\n", "row 2: has no 'target_id'"),
        ("ScanRefer_filtered_train.txt", "scene0000_00\nscene0000_01\n", "a list of scenes, .*; give its .json"),
        ("scenes.json", ["scene0000_00"], "a list of scenes; give the file of their descriptions"),
        ("v1_sqa_annotations.json", json.loads(SQA3D_ANSWERS), "SQA3D's answers; give the file of questions beside it"),
        ("predicted.json", [{"scene_id": "scene0000_00", "object_id": 1, "bbox": []}], "boxes predicted for ScanRefer"),
    ],
)
def test_known_files_that_are_not_read_are_refused_with_what_to_do(
    tmp_path: Path, name: str, content: object, line: str
) -> None:
    (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(DataError, match=f"{name}: .*{line}"):
        read_questions(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content"),
    [("q.json", SCANREFER), ("q.csv", NR3D), ("s.json", SQA3D), ("q.toml", toml_text(SET[:2]))],
)
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path: Path, name: str, content: str) -> None:
    path = tmp_path / name

    def read(damaged: bytes) -> object:
        path.write_bytes(damaged)
        return read_questions(path)

    for copies in (truncations(content.encode()), damages(content.encode(), 300)):
        _, n_refused = outcomes(read, copies, must_name=name)
        assert n_refused > 10


def test_the_papers_queries_are_asked_of_its_13_scenes() -> None:
    found = paper_queries()
    assert len({one.scene for one in found}) == 13
    assert Counter(one.kind for one in found if one.scene == "replica/room0") == {
        "instance": 24, "affordance": 13, "property": 13, "relative": 18, "reasoning": 5,
    }  # fmt: skip
    assert not any(one.is_known for one in found)
    assert len({one.id for one in found}) == len(found)


def test_the_texts_of_both_figures_and_the_teaser_are_among_them() -> None:
    counts = [len(tomllib.loads(PAPER.read_text())["figures"][name]) for name in PAPER_FIGURES]
    assert counts == [16, 6, 2]  # as often as the page has them
    assert [len(figure_texts(name)) for name in PAPER_FIGURES] == [14, 6, 2]  # one text stands there three times
    texts = {one.text for one in paper_queries()}
    assert {text for name in PAPER_FIGURES for text in figure_texts(name)} <= texts
    assert {"an empty vase", "a picture on wall", "plant on shelf", "which sink is closer to bed?"} <= texts
    assert PAPER_FIGURES == FIGURES


def test_the_verb_shows_a_set_without_its_control_characters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_questions(tmp_path / "q.toml", SET)
    assert main(["query", "show", str(tmp_path / "q.toml")]) == 0
    shown = capsys.readouterr().out
    assert "5 questions on 1 scene (2 instance, 1 affordance, 1 property, 1 relative); 5 with known answers" in shown
    assert "\u202e" not in shown
    assert max(map(len, shown.splitlines())) < 200
    assert main(["query", "show", "paper", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)) == len(paper_queries())


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["mak"], "unknown action 'mak'; did you mean 'make'"),
        (["make"], "required: --scenes, --out"),
        (["make", "--scenes", "rooms/living0", "--out", "q.toml", "--per-kind", "0"], "--per-kind is 0"),
        (["make", "--scenes", "rooms/living0", "--out", "q.toml", "--source", "auot"], "did you mean 'auto'?"),
        (["make", "--scenes", "rooms/living0", "--out", "q.txt"], "is neither .toml nor .csv"),
        (["show"], "required: FILE"),
    ],
)
def test_wrong_requests_are_one_line(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", *words, "--quiet"]) == 2
    assert line in capsys.readouterr().err


def test_the_verb_makes_questions_from_classes_boxes_and_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes = f"{SCENES}/painted.py:Painted/a"
    words = ["query", "make", "--scenes", scenes, "--quiet"]
    assert main([*words, "--out", str(tmp_path / "q.toml")]) == 0
    assert "with known answers" in capsys.readouterr().out
    found = {one.text: one for one in read_questions(tmp_path / "q.toml")}
    assert found["chair"] == new_question("painted/a", "instance", "chair", (1,), "generated")
    assert [found[text].answers for text in ("red chair", "green sofa", "blue table")] == [(1,), (2,), (3,)]
    assert main([*words, "--per-kind", "1", "--out", str(tmp_path / "few.csv")]) == 0
    few = read_questions(tmp_path / "few.csv")
    assert max(Counter(one.kind for one in few).values()) == 1
    assert {one.id for one in few} <= {one.id for one in found.values()}
