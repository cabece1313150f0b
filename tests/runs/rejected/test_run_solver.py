"""A language model as the solver of a run: asked once, stored with the run, named next to its numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chat_server import KEY, Answered, Body, ChatServer
from painted_runs import COLLECTOR, PAINTED

from su3d_bench.cli.main import main
from su3d_bench.questions.scene_map import MapObject, SceneMap
from su3d_bench.questions.solver import Solver
from su3d_bench.store.run_folder import RunFolder

RUN = ["run", "--scenes", f"{PAINTED}/a", "--methods", COLLECTOR, "--no-pictures", "--jobs", "1", "--quiet"]
ASKED = ["--protocols", "rooms-reasoning"]


@pytest.fixture
def folder(painted_place: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    return painted_place


@pytest.fixture
def server(chat: ChatServer) -> ChatServer:
    chat.answer = geometry
    return chat


def geometry(body: Body) -> Answered:
    """The reply of a language model that reasons as the built-in solver does, in words only."""
    listed, _, question = body["messages"][-1]["content"].partition("\n\nQuestion: ")
    lines = [json.loads(line) for line in listed.splitlines() if line.startswith("{")]
    scene = SceneMap(
        tuple(
            MapObject(
                line["ID"], line["Name"], "", np.array(line["Centroid"]), np.array(line["Bounding Box"], np.float64)
            )
            for line in lines
        )
    )
    found = Solver(scene).answer(question)
    value = {True: "yes", False: "no"}.get(found.value) if isinstance(found.value, bool) else found.value
    words = found.text if value is None else str(value)
    record = {"answer": words, "object_ids": found.object_ids, "reference_ids": found.reference_ids}
    return Answered(json.dumps(record))


def llm(server: ChatServer, *more: str) -> list[str]:
    settings = {"base_url": server.url, "text_model": "tiny", "max_retries": 0}
    record = [f"perception.language.{name}={value}" for name, value in settings.items()]
    return [*RUN, *ASKED, "--question-solver", "llm", "--out", "run", *more, "--set", *record]


def result(folder: Path) -> Any:
    (found,) = json.loads((folder / "metrics.json").read_text())["results"]
    return found["result"]


def test_language_model_answers_in_a_run_and_each_reply_is_requested_once(
    folder: Path, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*RUN, *ASKED, "--out", "geometry"]) == 0
    assert main(llm(server)) == 0
    by_geometry, by_model = result(folder / "geometry"), result(folder / "run")
    assert by_model["metrics"] == by_geometry["metrics"]
    assert by_model["metrics"]["n_answer"] > 5
    assert by_geometry["warnings"][0] == "painted/a: answers by the built-in solver"
    assert by_model["warnings"][0] == "painted/a: answers by the language model tiny"
    n_asked = server.n_asked
    assert n_asked == len(list((folder / "run" / "language").glob("*.json")))
    metrics = (folder / "run" / "metrics.json").read_bytes()
    RunFolder(folder / "run").job("painted/a", "collector").counts.unlink()  # to be scored again
    assert main(llm(server, "--offline")) == 0
    assert (server.n_asked, (folder / "run" / "metrics.json").read_bytes()) == (n_asked, metrics)
    capsys.readouterr()
    assert main(["report", "tables", "geometry", "run", "--tables", "reasoning", "--format", "markdown"]) == 0
    table = capsys.readouterr().out
    assert "answers by the built-in solver, ground truth" in table
    assert "answers by the language model tiny, ground truth" in table
    assert table.count("70 questions over Replica and ScanNet together") == 2


def test_offline_uses_only_stored_replies(folder: Path, server: ChatServer, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(llm(server, "--offline")) == 2
    assert "no stored reply to this ask request of model 'tiny'" in capsys.readouterr().err
    assert server.n_asked == 0


def test_missing_key_is_an_error_before_anything_starts(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    assert main([*RUN, *ASKED, "--question-solver", "llm", "--out", "hosted"]) == 2
    assert "$OPENAI_API_KEY is not set; set it to the key of api.openai.com" in capsys.readouterr().err
    assert not (folder / "hosted").exists()
