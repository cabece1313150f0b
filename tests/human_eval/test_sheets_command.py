"""``su3d-bench sheets make`` for several kinds, for maps without features, and with a language model that answers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from chat_server import KEY, Answered, ChatServer
from painted_runs import see_painted
from synthetic_sheets import METHODS

from su3d_bench.cli.main import main
from su3d_bench.human_eval.items import read_key, read_sheet
from su3d_bench.human_eval.sources import RunSource
from su3d_bench.metrics.protocols.loading import load_protocol

QUESTION = "How many chairs are there?"
ANSWER = '{"reasoning": "one is in the list", "answer": "There is 1 chair.", "object_ids": [0]}'


@pytest.fixture
def folder(painted_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the run, judged by the rules of the built-in rooms."""
    shutil.copytree(painted_folder / "run", tmp_path / "run")
    (tmp_path / "asked.csv").write_text(f"scene,text,objects,kind\npainted/a,{QUESTION},,reasoning\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(painted_folder / "data"))
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setattr(RunSource, "rules", lambda self, scene, kind: load_protocol(f"rooms-{kind}"))
    see_painted(monkeypatch)
    return tmp_path


@pytest.fixture
def server(chat: ChatServer) -> ChatServer:
    chat.answer = lambda body: Answered(ANSWER)
    return chat


def result(capsys: pytest.CaptureFixture[str], *words: str) -> list[dict[str, Any]]:
    capsys.readouterr()
    assert main(["sheets", "make", "run", "--json", *words]) == 0
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["sets"]
    return found


def asked(server: ChatServer, *more: str) -> list[str]:
    words = ["--kinds", "reasoning", "--questions", "asked.csv", "--out", "out", "--question-solver", "llm"]
    return [*words, "--model", "tiny", "--base-url", server.url, *more, "--set", "perception.language.max_retries=0"]


def test_each_kind_has_a_folder_equal_to_a_single_kind_run(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = result(capsys, "--kinds", "annotation", "reasoning", "--per-kind", "2", "--out", "all", "--jobs", "1")
    assert [one["kind"] for one in both] == ["annotation", "reasoning"]
    (alone,) = result(capsys, "--kinds", "annotation", "--per-kind", "2", "--out", "alone")
    for name in ("sheet.json", "annotator-1/sheet.csv", "annotator-1/sheet.html"):
        assert (folder / "all" / "annotation" / name).read_bytes() == (folder / "alone" / name).read_bytes()
    assert alone["sheet_id"] == both[0]["sheet_id"] == read_key(folder / "all-key" / "annotation" / "key.json").sheet_id
    key = read_key(folder / "all-key" / "reasoning" / "key.json")
    assert key.answered_by == "the built-in solver" and key.sheet_id == both[1]["sheet_id"]
    assert {word for one in key.items for word in one.automatic.values()} <= {"right", "wrong"}
    assert any(one.automatic for one in key.items)


def test_language_model_replies_to_reasoning_sheets_are_stored(
    folder: Path, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    (first,) = result(capsys, *asked(server))
    sheet, key = read_sheet(folder / "out" / "sheet.json"), read_key(folder / "out-key" / "key.json")
    assert {one.text for one in sheet.items} == {f"{QUESTION}\nAnswer: There is 1 chair."}
    assert key.answered_by == "tiny" and "tiny" not in (folder / "out" / "annotator-1" / "sheet.html").read_text()
    assert sorted(name for one in key.items for name in one.methods) == sorted(METHODS)
    n_asked = server.n_asked
    assert 1 <= n_asked <= len(METHODS)  # equal maps are asked about once
    (again,) = result(capsys, *asked(server, "--offline"))
    assert again["sheet_id"] == first["sheet_id"] and server.n_asked == n_asked
