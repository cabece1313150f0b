"""``su3d-bench sheets make`` over several kinds, over maps without features, and with a language model that answers."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from chat_server import KEY, Answered, ChatServer, error
from made_sheets import METHODS, RUN
from painted import colour_perception

from su3d_bench.cli.main import main
from su3d_bench.core.maps import Instances
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.questions.model import question_id
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run
from su3d_bench.sheets.items import read_key, read_sheet
from su3d_bench.sheets.making.run_source import RunSource
from su3d_bench.store.predictions import read_prediction, write_prediction
from su3d_bench.store.run_folder import RunFolder

QUESTION = "How many chairs are there?"
ANSWER = '{"reasoning": "one is in the list", "answer": "There is 1 chair.", "object_ids": [0]}'


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("command")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.setenv("SU3D_DATA", str(path / "data"))
        patch.chdir(path)
        assert main(RUN) == 0
    (path / "asked.csv").write_text(f"scene,text,objects,kind\npainted/a,{QUESTION},,reasoning\n")
    return path


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the run, judged by the rules of the built-in rooms."""
    shutil.copytree(made / "run", tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(made / "data"))
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setattr(RunSource, "rules", lambda self, scene, kind: load_protocol(f"rooms-{kind}"))
    monkeypatch.setattr(finished_run, "encoder_of", lambda run, device="cpu": colour_perception().encoder)
    return tmp_path


@pytest.fixture
def server(chat: ChatServer) -> ChatServer:
    chat.answer = lambda body: Answered(ANSWER)
    return chat


def told(capsys: pytest.CaptureFixture[str], *words: str) -> list[dict[str, Any]]:
    capsys.readouterr()
    assert main(["sheets", "make", "run", "--json", *words]) == 0
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["sets"]
    return found


def asked(made: Path, server: ChatServer, *more: str) -> list[str]:
    quick = ["perception.language.max_retries=0"]
    words = ["--kind", "reasoning", "--questions", str(made / "asked.csv"), "--out", "out", "--solver", "llm"]
    return [*words, "--model", "tiny", "--base-url", server.url, *more, "--set", *quick]


def test_several_kinds_give_a_folder_each_and_what_one_kind_alone_gives(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = told(capsys, "--kind", "annotation", "reasoning", "--per-kind", "2", "--out", "all", "--jobs", "1")
    assert [one["kind"] for one in both] == ["annotation", "reasoning"]
    (alone,) = told(capsys, "--kind", "annotation", "--per-kind", "2", "--out", "alone")
    for name in ("sheet.json", "annotator-1/sheet.csv", "annotator-1/sheet.html", "annotator-1/sheet.xlsx"):
        assert (folder / "all" / "annotation" / name).read_bytes() == (folder / "alone" / name).read_bytes()
    assert alone["sheet_id"] == both[0]["sheet_id"] == read_key(folder / "all-key" / "annotation" / "key.json").sheet_id
    key = read_key(folder / "all-key" / "reasoning" / "key.json")
    assert key.answered_by == "the built-in solver" and key.sheet_id == both[1]["sheet_id"]
    assert {word for one in key.items for word in one.automatic.values()} <= {"right", "wrong"}
    assert any(one.automatic for one in key.items)


def test_methods_without_features_are_left_out_of_retrieval_alone(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def strip(method: str) -> None:
        job = RunFolder(Path("run")).job("painted/a", method)
        found = read_prediction(job.prediction)
        assert isinstance(found, Instances)
        write_prediction(job.prediction, replace(found, features=None))

    strip(METHODS[0])
    Path("chairs.csv").write_text("scene,text,objects,kind\npainted/a,chair,1,instance\n")
    words = ["sheets", "make", "run", "--kind", "retrieval", "annotation", "--per-kind", "1", "--out", "out"]
    words += ["--questions", "chairs.csv", "--jobs", "1"]
    assert main(words) == 0
    assert f"retrieval: left out {METHODS[0]}, which" in capsys.readouterr().err
    assert read_key(folder / "out-key" / "retrieval" / "key.json").methods == METHODS[1:]
    assert read_key(folder / "out-key" / "annotation" / "key.json").methods == METHODS
    for method in METHODS[1:]:
        strip(method)
    assert main(words) == 2
    assert "no map has features" in capsys.readouterr().err


def test_a_language_model_answers_reasoning_sheets_and_its_replies_stay(
    folder: Path, made: Path, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    (first,) = told(capsys, *asked(made, server))
    sheet, key = read_sheet(folder / "out" / "sheet.json"), read_key(folder / "out-key" / "key.json")
    assert {one.text for one in sheet.items} == {f"{QUESTION}\nAnswer: There is 1 chair."}
    assert key.answered_by == "tiny" and "tiny" not in (folder / "out" / "annotator-1" / "sheet.html").read_text()
    assert sorted(name for one in key.items for name in one.methods) == sorted(METHODS)
    n_asked = server.n_asked
    assert 1 <= n_asked <= len(METHODS)  # equal maps are asked about once
    (again,) = told(capsys, *asked(made, server, "--offline"))
    assert again["sheet_id"] == first["sheet_id"] and server.n_asked == n_asked


def test_the_truth_reads_the_words_of_a_language_model(
    folder: Path, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    counted = "How many sofas are there?"  # of the counts with one answer, the one that is drawn

    def answer(body: dict[str, Any]) -> Answered:
        is_count = body["messages"][-1]["content"].rstrip().endswith(counted)
        return Answered(ANSWER if is_count else '{"answer": "I cannot determine this", "object_ids": []}')

    server.answer = answer
    words = asked(folder, server)
    del words[2:4]  # questions made from the truth
    told(capsys, *words, "--methods", METHODS[0], "--per-kind", "2")
    key, sheet = read_key(folder / "out-key" / "key.json"), read_sheet(folder / "out" / "sheet.json")
    judged = {
        item.text.partition("\n")[0]: one.automatic["answer"] for item, one in zip(sheet.items, key.items, strict=True)
    }
    assert judged.pop(counted) == "right"
    assert set(judged.values()) == {"wrong"}


def test_why_a_model_gave_no_answer_does_not_reach_annotators(
    folder: Path, made: Path, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    server.answer = lambda body: error(400, "tiny is out of order")
    told(capsys, *asked(made, server))
    assert {one.text for one in read_sheet(folder / "out" / "sheet.json").items} == {f"{QUESTION}\nAnswer: (no answer)"}


def test_a_dry_run_tells_the_cost_and_makes_nothing(
    folder: Path, made: Path, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sheets", "make", "run", *asked(made, server, "--dry-run")]) == 0
    assert "request" in capsys.readouterr().out
    assert server.n_asked == 0 and not (folder / "out").exists()
    Path("gone.csv").write_text(f"question_id\n{question_id('painted/a', 'reasoning', QUESTION)}\n")
    assert main(["sheets", "make", "run", *asked(made, server, "--dry-run", "--leave-out", "gone.csv")]) == 0
    assert "0 requests" in capsys.readouterr().out


def test_flags_of_the_language_model_are_refused_where_nobody_is_asked(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, line in (
        (["--kind", "reasoning", "--offline"], "--offline: is for --solver llm alone"),
        (["--kind", "reasoning", "--model", "x"], "--model: is for --solver llm alone"),
        (["--kind", "retrieval", "--solver", "llm"], "add --kind reasoning"),
    ):
        assert main(["sheets", "make", "run", "--out", "out", *words]) == 2
        assert line in capsys.readouterr().err
