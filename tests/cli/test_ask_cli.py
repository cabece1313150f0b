"""The commands ``su3d-bench query ask`` and ``su3d-bench runs refine``."""

from __future__ import annotations

import itertools
import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chat_server import KEY, Answered, ChatServer
from scored_room import instances

from su3d_bench.cli.main import main
from su3d_bench.core.files.atomic import write_json
from su3d_bench.core.maps import Instances
from su3d_bench.questions.refining import FilterConfig
from su3d_bench.reports.pictures import figures as reasoning_picture
from su3d_bench.store.predictions import write_prediction
from su3d_bench.store.run_folder import JobFolder, RunFolder

SCENE = "rooms/made"
QUICK = ["max_retries=1", "timeout_s=1.0", "max_failures_in_a_row=50"]


def cube(x: float, y: float, z: float, side: float) -> np.ndarray:
    """Points on a grid in a cube."""
    steps = np.linspace(0, side, 6)
    return np.stack(np.meshgrid(x + steps, y + steps, z + steps), axis=-1).reshape(-1, 3).astype(np.float32)


def made_map() -> Instances:
    """A bed, two sinks and a lamp on the bed; the nearer sink has id 30."""
    clouds = [cube(0, 0, 0, 1.0), cube(3, 0, 0, 0.5), cube(0, 2, 0, 0.5), cube(0.3, 0.3, 1.0, 0.2)]
    first = np.cumsum([0, *map(len, clouds)])
    masks = [np.arange(a, b) for a, b in itertools.pairwise(first)]
    made = instances(np.concatenate(clouds), masks, None)
    return replace(
        made,
        names=("bed", "sink", "sink", "lamp"),
        captions=("a bed in a scene", "a white sink in a scene", "a grey sink in a scene", ""),
        boxes=np.array([[c.min(axis=0), c.max(axis=0)] for c in clouds]),
        centroids=np.array([c.mean(axis=0) for c in clouds]),
        ids=np.array([10, 20, 30, 40], np.int32),
        view_indptr=np.array([0, 3, 4, 5, 6]),
        views=np.zeros((6, 2), np.int32),
        view_names=("bed", "sofa", "sofa", "sink", "basin", "lamp"),
        view_scores=np.array([0.6, 0.5, 0.4, 0.9, 0.9, 0.9]),
    )


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobFolder:
    """A run in the folder ``runs/made`` below the working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    job = RunFolder(Path("runs/made")).job(SCENE, "opensu3d")
    job.prepare()
    write_prediction(job.prediction, made_map())
    write_json(Path("runs/made/run.json"), {"scenes": [SCENE], "methods": ["opensu3d"]})
    return job


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip drawing pictures, which takes a second."""
    monkeypatch.setattr(reasoning_picture, "draw_reasoning", lambda *words: None)


@pytest.fixture
def server(chat: ChatServer) -> ChatServer:
    chat.answer = lambda body: Answered('{"answer": "the grey sink", "object_ids": [30, 10]}')
    return chat


def llm(server: ChatServer, *more: str) -> list[str]:
    settings = [f"perception.language.{one}" for one in QUICK]
    return ["--question-solver", "llm", "--model", "tiny", "--base-url", server.url, *more, "--set", *settings]


def test_question_is_answered_with_ids_and_a_picture(job: JobFolder, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "ask", SCENE, "Which sink is closer to bed?"]) == 0
    printed = capsys.readouterr()
    assert printed.out == "sink #30 is closer to bed #10: 1.79 m between centres; sink #20 2.77 m\n"
    picture = job.pictures / "ask-which-sink-is-closer-to-bed.png"
    assert f"picture: {picture}" in printed.err
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_undetermined_answer_is_reported_and_not_drawn(job: JobFolder, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "ask", SCENE, "I am cold, what should I do?", "--out", "x.png"]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("I cannot settle this: ")
    assert "x.png: not drawn" in printed.err
    assert not Path("x.png").exists()


@pytest.mark.usefixtures("undrawn")
def test_viewpoint_determines_what_is_left(job: JobFolder, capsys: pytest.CaptureFixture[str]) -> None:
    answers = []
    for eye in (["-5", "1", "0"], ["5", "1", "0"]):
        assert main(["query", "ask", SCENE, "Is the bed left of the sink?", "--quiet", "--eye", *eye]) == 0
        answers.append(capsys.readouterr().out.split(":")[0])
    assert answers == ["no", "yes"]


@pytest.mark.usefixtures("undrawn")
def test_model_reply_is_stored_in_the_run_and_reused(
    job: JobFolder, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["query", "ask", SCENE, "Which sink is closer to bed?", "--json", *llm(server)]
    assert main(words) == 0
    first = capsys.readouterr().out
    assert json.loads(first)["object_ids"] == [30, 10]
    assert json.loads(first)["solver"] == "llm"
    assert main(words) == 0
    assert capsys.readouterr().out == first
    assert main([*words, "--offline"]) == 0
    assert capsys.readouterr().out == first
    assert server.n_asked == 1
    stored = list(Path("runs/made/language").glob("*.json"))
    assert len(stored) == 1
    assert KEY not in stored[0].read_text()


def test_dry_run_reports_the_cost_and_sends_no_request(
    job: JobFolder, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["query", "ask", SCENE, "Where am I?", "--dry-run", "--question-solver", "llm"]) == 0
    assert "1 request, 0 of them already answered; 1 to send to gpt-6-luna: about " in capsys.readouterr().out
    assert main(["query", "ask", SCENE, "Where am I?", "--dry-run", *llm(server)]) == 0
    assert "no price in the table" in capsys.readouterr().out
    assert main(["query", "ask", SCENE, "Where am I?", "--dry-run"]) == 0
    assert "no language model is used: no cost" in capsys.readouterr().out
    assert server.n_asked == 0
    assert not Path("runs/made/language").exists()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (f"query ask {SCENE} ' '", "the question is empty"),
        ("query ask rooms/none x", "no run in runs/ has rooms/none by opensu3d"),
        (f"query text {SCENE} x --run runs/made --method opensud", "by opensud; did you mean 'opensu3d'?"),
        (f"query ask {SCENE} x --labels refined", "no labels n'; create them with su3d-bench runs refine"),
        (f"query ask {SCENE} x --eye nan 0 0", "expected three finite numbers (metres)"),
        (f"query ask {SCENE} x --question-solver llm --offline", "no stored reply to this ask request"),
        (
            f"query ask {SCENE} x --question-solver llm --base-url http://a:b@c/v1",
            "--base-url: language.base_url = 'http://a:b@c/v1': contains credentials or a query; set keys in",
        ),
        (
            f"query ask {SCENE} x --question-solver llm --set perception.cache=false",
            "only perception.language.KEY=VALUE can be set here",
        ),
    ],
)
def test_invalid_input_is_a_one_line_error(
    job: JobFolder, capsys: pytest.CaptureFixture[str], words: str, line: str
) -> None:
    assert main(shlex.split(words)) == 2
    printed = capsys.readouterr().err
    assert line in printed
    assert printed.count("\n") == 1


def test_missing_api_key_is_a_one_line_error(
    job: JobFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("OPENAI_API_KEY")
    assert main(["query", "ask", SCENE, "x", "--question-solver", "llm"]) == 2
    assert "su3d-bench: $OPENAI_API_KEY is not set" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_ask_uses_refined_labels_by_vote(job: JobFolder, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["runs", "refine", "runs/made"]) == 0
    printed = capsys.readouterr().out
    assert "rooms/made: 4 instances, 2 names changed" in printed
    assert "10  bed -> sofa" in printed
    assert "30  sink -> basin" in printed
    assert main(["query", "ask", SCENE, "Where is the sofa?", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["object_ids"], result["names"]) == ([10], "labels n' by vote")
    assert main(["query", "ask", SCENE, "Where is the sofa?", "--labels", "label"]) == 0
    assert "I cannot settle this" in capsys.readouterr().out


def test_refined_labels_by_a_model_are_requested_once(
    job: JobFolder, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    server.answer = lambda body: Answered("I'm sorry." if "basin" in body["messages"][1]["content"] else "furniture")
    words = ["runs", "refine", "runs/made", "--refiner", "model", "--model", "tiny", "--base-url", server.url]
    assert main(words) == 0
    printed = capsys.readouterr()
    assert "10  bed -> furniture" in printed.out
    assert "label n unchanged for 1 instance: the model refused" in printed.err
    records = (job.path / "refined_names.json").read_bytes()
    assert server.n_asked == 4
    assert main([*words, "--offline"]) == 0
    assert (job.path / "refined_names.json").read_bytes() == records
    assert server.n_asked == 4


def test_background_by_refined_label_is_excluded(
    job: JobFolder, server: ChatServer, capsys: pytest.CaptureFixture[str]
) -> None:
    server.answer = lambda body: Answered("tile wall" if "basin" in body["messages"][1]["content"] else "furniture")
    words = ["runs", "refine", "runs/made", "--refiner", "model", "--model", "tiny", "--base-url", server.url]
    assert main(words) == 0
    assert "30  excluded: 'tile wall' is background" in capsys.readouterr().out
    assert main(["query", "ask", SCENE, "How many things are there?", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["value"], result["object_ids"]) == (3, [10, 20, 40])
    assert result["names"] == "labels n' by tiny, without 1 excluded instance"
    assert main([*words, "--background-names", "bed"]) == 0
    assert "excluded" not in capsys.readouterr().out
    assert main([*words, "--max-map-fraction", "0.05", "--json"]) == 0
    records = json.loads(capsys.readouterr().out)[SCENE]
    assert records["filter"] == {"background_names": list(FilterConfig().background_names), "max_map_fraction": 0.05}
    assert [bool(one["left_out"]) for one in records["names"]] == [True, False, True, False]
    assert main([*words, "--max-map-fraction", "0"]) == 2
    assert "--max-map-fraction 0.0: expected a share above 0" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_nothing_is_written_through_a_symlink_in_place_of_a_job_folder(
    job: JobFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = tmp_path / "elsewhere"
    job.path.rename(elsewhere)
    job.path.symlink_to(elsewhere)
    before = {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()}
    for words in (["runs", "refine", "runs/made"], ["query", "ask", SCENE, "Where is the bed?"]):
        assert main(words) == 2
        assert capsys.readouterr().err.endswith(
            f"su3d-bench: {job.path}: is a link, but a run writes only to its own folders; remove the link\n"
        )
    assert {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()} == before
