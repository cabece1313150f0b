"""Question files: own formats, ScanRefer, Nr3D and SQA3D, the paper's queries, hostile copies, and the command."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from damage import damages, outcomes, truncations
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError
from su3d_bench.questions.model import KINDS, new_question
from su3d_bench.questions.question_files import (
    paper_queries,
    read_questions,
    toml_text,
    write_questions,
)

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
def test_question_set_round_trips(tmp_path: Path, name: str) -> None:
    write_questions(tmp_path / name, SET)
    assert read_questions(tmp_path / name) == SET


def test_scanrefer_ids_are_shifted_and_equal_sentences_are_merged(tmp_path: Path) -> None:
    (tmp_path / "ScanRefer.json").write_text(SCANREFER)
    text = "a white cabinet in the corner"
    assert read_questions(tmp_path / "ScanRefer.json") == (
        replace(new_question("scannet/scene0000_00", "relative", text, (5, 40), "ScanRefer"), name="cabinet"),
    )


def test_nr3d_is_detected_by_its_columns(tmp_path: Path) -> None:
    (tmp_path / "nr3d.csv").write_text(NR3D)
    assert read_questions(tmp_path / "nr3d.csv") == (
        replace(
            new_question("scannet/scene0525_00", "relative", "The plant, far right", (10,), "Nr3D"),
            groups=("easy", "view-dependent"),
        ),
    )


def test_sqa3d_answers_are_read_from_the_annotation_file(tmp_path: Path) -> None:
    questions = tmp_path / "v1_balanced_questions_val_scannetv2.json"
    questions.write_text(SQA3D)
    text = "I sit. What is in front?"
    asked = new_question("scannet/scene0380_00", "reasoning", text, None, "SQA3D")
    assert read_questions(questions) == (asked,)
    (tmp_path / "v1_balanced_sqa_annotations_val_scannetv2.json").write_text(SQA3D_ANSWERS)
    assert read_questions(questions)[0].reply == "table"


@pytest.mark.parametrize(
    ("name", "content"),
    [("q.json", SCANREFER), ("q.csv", NR3D), ("s.json", SQA3D), ("q.toml", toml_text(SET[:2]))],
)
def test_damaged_files_are_read_or_give_one_line_error(tmp_path: Path, name: str, content: str) -> None:
    path = tmp_path / name

    def read(damaged: bytes) -> object:
        path.write_bytes(damaged)
        return read_questions(path)

    for copies in (truncations(content.encode()), damages(content.encode(), 300)):
        _, n_refused = outcomes(read, copies, must_name=name)
        assert n_refused > 10


def test_paper_queries_are_asked_for_its_13_scenes() -> None:
    found = paper_queries()
    assert len({one.scene for one in found}) == 13
    assert Counter(one.kind for one in found if one.scene == "replica/room0") == {
        "instance": 24, "affordance": 13, "property": 13, "relative": 18, "reasoning": 5,
    }  # fmt: skip
    assert not any(one.is_known for one in found)
    assert len({one.id for one in found}) == len(found)


def test_command_generates_questions_from_classes_boxes_and_frames(
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


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("q.toml", "query = 3"),
        ("q.toml", '[[query]]\nscene = "a/b"\ntext = "x"\nobjects = ["1"]\n'),
        ("q.csv", "scene,text,objects\na/b,chair,one\n"),
        ("q.json", "{"),
        ("q.json", "[]"),
        ("q.json", '[{"scene_id": "../x", "object_id": "1", "description": "a"}]'),
        ("q.jsonl", '{"scan_id": "a"}\n{"scan_id": "b"}\n'),
        ("nr3d.csv", "scan_id,utterance\nscene0000_00,plant\n"),
    ],
)
def test_invalid_question_set_error_names_the_file(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(DataError) as caught:
        read_questions(tmp_path / name, "replica")
    assert str(caught.value).startswith(str(tmp_path / name)) and "\n" not in str(caught.value)
