from __future__ import annotations

import argparse
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import build_parser, main
from su3d_bench.cli.output import file_name_of, file_name_of_scene
from su3d_bench.core.errors import EXIT_INTERNAL
from su3d_bench.reports.pictures import maps
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
RUN = ["run", "--scenes", f"{PAINTED}/*", "--methods", COLLECTOR, "--protocols", "rooms-semantic", "--no-pictures"]
HEAVY = (
    "torch", "open3d", "open3d.cpu.pybind", "numba", "sklearn", "pandas", "matplotlib", "onnxruntime", "cv2", "scipy",
    "transformers", "openai", "openpyxl", "psutil", "su3d_bench.predictions.formats", "su3d_bench.runs.plan",
)  # fmt: skip
# A tenth of a second is two thirds Python's own.
AT_START = (*HEAVY, "numpy", "pydantic", "rich", "multiprocessing", "zipfile", "traceback", "difflib", "hashlib")


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))


def verbs() -> dict[str, argparse.ArgumentParser]:
    actions = build_parser()._actions
    return next(dict(action.choices) for action in actions if isinstance(action, argparse._SubParsersAction))


def examples(parser: argparse.ArgumentParser) -> list[str]:
    assert parser.epilog is not None
    return [line.strip() for line in parser.epilog.splitlines() if line.strip().startswith("su3d-bench ")]


@pytest.mark.parametrize(
    ("words", "unneeded"),
    [
        (["--help"], AT_START),
        (["--version"], AT_START),
        (["run", "--help"], AT_START),
        (["protocols"], (*HEAVY, "numpy")),
        (["methods"], HEAVY),
        (["datasets", "list"], HEAVY),
        (["models", "list"], HEAVY),
    ],
)
def test_answers_that_need_nothing_load_nothing_heavy(words: list[str], unneeded: tuple[str, ...]) -> None:
    code = (
        "import sys; from su3d_bench.cli.main import main\n"
        f"code = main({words!r})\n"
        f"loaded = sorted(set({unneeded!r}) & set(sys.modules))\n"
        "print('\\nloaded:', ' '.join(loaded), code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1].split() == ["loaded:", "0"], done.stderr


@pytest.mark.parametrize("verb", ["run", "evaluate", "query", "datasets", "methods", "protocols", "runs", "report"])
def test_the_examples_of_every_verb_parse(verb: str) -> None:
    for example in examples(verbs()[verb]):
        arguments = build_parser().parse_args(shlex.split(example)[1:])
        assert arguments.verb == verb


def test_a_protocol_shows_every_rule(capsys: pytest.CaptureFixture[str]) -> None:
    from su3d_bench.metrics.protocols.loading import load_protocol

    assert main(["protocols", "show", "rooms-semantic"]) == 0
    text = capsys.readouterr().out
    rules = load_protocol("rooms-semantic")
    for name in rules.model_dump(exclude={"transfer", "prompt_names", "classes"}):
        assert f"\n{name} " in f"\n{text}"
    assert "transfer.candidates" in text
    assert all(entry.name in text for entry in rules.classes)
    assert rules.digest in text


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["rum"], "unknown verb 'rum'; did you mean 'run'? known: run, ablate, "),
        ([], "the following arguments are required: VERB; see su3d-bench --help"),
        (
            ["run", "--scene-s", "x"],
            "run: unknown argument '--scene-s'; did you mean '--scenes'?; see su3d-bench run --help",
        ),
        (["run", "--jobs", "x"], "run: argument --jobs: x: expected an integer of 1 or more; see"),
        (["run", "--scenes", "replcia/*"], "no scene matches 'replcia/*'; did you mean 'replica/*'?"),
        (["run", "--scenes", f"{PAINTED}/e"], f"no scene matches '{PAINTED}/e'; did you mean '{PAINTED}/d'?"),
        (["run", "--scenes", "nothing"], "no scene matches 'nothing'; known datasets: rooms, replica"),
        ([*RUN, "--methods", "opensu3"], "unknown method 'opensu3'; did you mean 'opensu3d'?"),
        ([*RUN, "--methods", f"{SCENES}/painted.py:Colector"], f"method '{SCENES}/painted.py:Colector': "),
        ([*RUN, "--methods", f"{SCENES}/none.py:X"], f"method '{SCENES}/none.py:X': there is no file {SCENES}/none.py"),
        ([*RUN, "--profile", "orcale"], "unknown profile 'orcale'; did you mean 'oracle'?"),
        ([*RUN, "--protocols", "room-semantic"], "unknown protocol 'room-semantic'; did you mean 'rooms-semantic'?"),
        (
            [*RUN, "--protocols", "scannet-instance"],
            "protocol 'scannet-instance' fits no scene of this run: it scores the labels of 'scannet', painted has "
            "those of 'replica'",
        ),
        ([*RUN, "--set", "colector.drop=1"], "--set colector.drop=1: 'colector' is no method or dataset of this run"),
        ([*RUN, "--set", "collector.dorp=1"], "--set collector.dorp: unknown key 'dorp'; did you mean 'drop'?"),
        ([*RUN, "--set", "collector.drop=x"], "--set collector.drop: collector.drop = 'x': input should be a valid"),
        ([*RUN, "--stride", "-1"], "--stride: stride = -1: input should be greater than or equal to 0"),
        ([*RUN, "--config", "none.toml"], "none.toml: cannot read the configuration: No such file or directory"),
        (["protocols", "shwo"], "protocols: unknown action 'shwo'; did you mean 'show'? known: list, show, "),
        (
            ["protocols", "show", "rooms-semantics"],
            "unknown protocol 'rooms-semantics'; did you mean 'rooms-semantic'?",
        ),
        (
            ["report", "runs/demo"],
            "report: unknown action 'runs/demo'; known: tables, timing, html, ",
        ),
        (
            ["report", "tables", "r", "--table", "VI"],
            "report tables: unknown --table 'VI'; did you mean 'V'? known: I, ",
        ),
        (
            ["report", "tables", "r", "--format", "docx"],
            "report tables: unknown --format 'docx'; known: text, markdown, latex, csv, html; see ",
        ),
        ([*RUN, "--solver", "me"], "run: unknown --solver 'me'; known: built-in, llm; see "),
        (["methods", "show", "orcle"], "unknown method 'orcle'; did you mean 'oracle'?"),
        (
            ["query", "text", f"{PAINTED}/a", "x"],
            f"no run in runs/ holds {PAINTED}/a by opensu3d; make one: su3d-bench run {PAINTED}/a --methods opensu3d",
        ),
        (["query", "text", "rooms/living0", "  "], "the text is empty; say what to look for"),
        (["query", "text", "rooms/living0", "x", "--top", "0"], "query text: argument --top: 0: expected an integer"),
        (
            ["query", "text", "rooms/living0", "x", "--run", "r"],
            "r: holds no run; name the folder of one: su3d-bench runs list",
        ),
        (
            ["query", "text", "a plant", "rooms/living0"],
            "'a plant' is no scene: the scene comes first, then the text;",
        ),
        (
            ["query", "ask", "A plant?", "rooms/living0"],
            "'A plant?' is no scene: the scene comes first, then the text;",
        ),
        (["run", "living0"], "no scene matches 'living0'; did you mean 'rooms/living0'?"),
        (["run", "--scenes", "livng0"], "no scene matches 'livng0'; did you mean 'rooms/living0'?"),
        (["ablate", "livi*", "--vary", "m=1"], "no scene matches 'livi*'; did you mean 'rooms/livi*'?"),
        (["run", "rooms"], "'rooms' is a dataset; name its scenes, such as 'rooms/*'"),
        (["run", "--methods", "oracle", "rooms/living0"], "--methods rooms/living0: is a scene; write it before the"),
        (["run", "--extend"], "--extend: say which run with --out, such as --out runs/demo"),
        (["run", "--replace"], "--replace: say which run with --out, such as --out runs/demo"),
        ([*RUN, "--extend", "--out", "none"], "--extend: none holds no run.toml of a run; leave --extend out to begin"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    answer = capsys.readouterr()
    assert answer.out == ""
    assert answer.err.startswith(f"su3d-bench: {line}")
    assert answer.err.count("\n") == 1


def test_a_misspelt_key_in_a_file_is_named_with_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    Path("run.toml").write_text('scenes = ["rooms/living0"]\nmetod = ["opensu3d"]\n')
    assert main(["run", "--config", "run.toml"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("su3d-bench: run.toml:2: unknown key 'metod'; did you mean 'method'? known: scenes, ")


def test_debug_shows_the_traceback_above_the_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--debug", "--scenes", "nothing"]) == 2
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first == "Traceback (most recent call last):"
    assert last.startswith("su3d-bench: no scene matches 'nothing'")


def test_an_internal_error_is_one_line_and_exit_code_4(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from su3d_bench.core import registry

    monkeypatch.setattr(registry, "BUILT_IN", {})
    assert main(["methods"]) == EXIT_INTERNAL
    line = "su3d-bench: internal error: KeyError: 'method'; run again with --debug for the traceback\n"
    assert capsys.readouterr().err == line


def test_a_closed_pipe_is_no_error() -> None:
    python = shlex.quote(sys.executable)
    command = f"{python} -m su3d_bench protocols show scannet200-instance | head -1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "0"
    assert done.stderr == ""


def test_scenes_may_be_expanded_by_the_shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cam_params.json").write_text("{}")
    words = ["--scenes", f"{PAINTED}/a", f"{PAINTED}/b", "cam_params.json"]
    assert main([*RUN, *words, "--dry-run", "--json"]) == 0
    answer = capsys.readouterr()
    assert [one["scene"] for one in json.loads(answer.out)["jobs"]] == ["painted/a", "painted/b"]
    assert answer.err == "not scenes, left out: cam_params.json\n"


def test_a_dry_run_says_what_would_be_done_and_does_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*RUN, "--dry-run"]) == 0
    text = capsys.readouterr().out
    assert text.count("6 updates, about") == 4
    assert "minutes with" in text
    assert "protocols: rooms-semantic; profile auto" in text
    assert not Path("runs").exists()


def test_a_dry_run_over_a_finished_run_knows_what_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*RUN, "--jobs", "1", "--scenes", f"{PAINTED}/a", "--out", "runs/x"]) == 0
    capsys.readouterr()
    assert main([*RUN, "--scenes", f"{PAINTED}/[ab]", "--extend", "--out", "runs/x", "--dry-run", "--json"]) == 0
    jobs = json.loads(capsys.readouterr().out)["jobs"]
    assert [(one["is_done"], one["is_measured"]) for one in jobs] == [(True, True), (False, True)]


def test_the_same_request_has_the_same_folder_and_another_one_another() -> None:
    from su3d_bench.cli.run import settings_of
    from su3d_bench.runs.plan import make_plan

    def folder(*more: str) -> Path:
        arguments = build_parser().parse_args([*RUN, *more])
        return make_plan(settings_of(arguments), arguments.set, arguments.out).folder.path

    assert folder() == folder("--jobs", "1") == folder("--quiet")
    assert len({folder(), folder("--seed", "1"), folder("--set", "collector.drop=1"), folder("--limit", "3")}) == 4
    assert folder().parent == Path("runs")
    assert folder().name.startswith("painted-auto-")


def test_json_answers_are_the_metrics_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*RUN, "--jobs", "1", "--json", "--quiet", "--out", "out"]) == 0
    answer = capsys.readouterr()
    assert answer.out == Path("out/metrics.json").read_text()
    assert answer.err == ""


def test_pictures_of_different_texts_and_scenes_have_different_names() -> None:
    texts = ["red sofa", "Red sofa", "red-sofa", "red sofa?", " red sofa", "\u690d\u7269", "?", "", "a" * 70, "a" * 71]
    for names in ([file_name_of(text, "text") for text in texts], [file_name_of(text, "question") for text in texts]):
        assert len(set(names)) == len(texts)
        assert all(re.fullmatch(r"[a-z0-9-]+", name) for name in names)
    assert file_name_of("red sofa", "text") == file_name_of("Red sofa?", "question") == "red-sofa"
    addresses = ["a/b", "a-b/c", "a/b-c", "a/b/c", "../a/b", "a/b c"]
    assert len({file_name_of_scene(address) for address in addresses}) == len(addresses)
    assert file_name_of_scene("replica/room0") == "replica-room0"


def test_a_query_ranks_the_map_and_draws_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finished_run, "encoder_of", lambda run, device="cpu": colour_perception().encoder)
    assert main([*RUN, "--jobs", "1", "--scenes", f"{PAINTED}/a"]) == 0
    capsys.readouterr()
    words = ["query", "text", "painted/a", "a red sofa", "--method", "collector"]
    before: list[str] = []
    draw = maps.draw_heat_map

    def draw_later(*words: Any) -> None:
        before.append(capsys.readouterr().out)
        draw(*words)

    monkeypatch.setattr(maps, "draw_heat_map", draw_later)
    assert main(words) == 0
    (ranking_first,) = before
    answer = capsys.readouterr()
    assert answer.out == ""  # the ranking stood before the picture was drawn
    assert ranking_first.splitlines()[1].split()[0] == "1"
    assert ranking_first.splitlines()[1].endswith("  sofa")
    picture = answer.err.removeprefix("heat map: ").strip()
    assert picture.endswith("collector/pictures/query-a-red-sofa.png")
    assert Path(picture).read_bytes().startswith(b"\x89PNG")
    assert main([*words, "--json", "--top", "2", "--out", "here/heat.png"]) == 0
    ranking: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["ranking"]
    assert ranking[0]["name"] == "sofa"
    assert ranking[0]["similarity"] == pytest.approx(1.0)
    assert len(ranking) == 2
    assert Path("here/heat.png").is_file()


def test_a_map_without_features_cannot_be_queried(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finished_run, "encoder_of", lambda run, device="cpu": colour_perception().encoder)
    assert main([*RUN, "--jobs", "1", "--scenes", f"{PAINTED}/a", "--quiet"]) == 0
    capsys.readouterr()
    assert main(["query", "text", "painted/a", "sofa", "--method", "oracle"]) == 2
    assert "query: this map has no features to compare a text with" in capsys.readouterr().err
