from __future__ import annotations

import argparse
import ast
import json
import os
import re
import shlex
import subprocess
import sys
from email import message_from_string
from pathlib import Path
from typing import Any

import pytest
from fuzz_words import verbs
from places import ROOT, SCENES

from su3d_bench.cli.main import build_parser, main
from su3d_bench.cli.output import answer_either, file_name_of, file_name_of_scene
from su3d_bench.core.errors import EXIT_INTERNAL, ConfigError
from su3d_bench.core.version import documentation
from su3d_bench.reports.pictures import maps

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
RUN = ["run", "--scenes", f"{PAINTED}/*", "--methods", COLLECTOR, "--protocols", "rooms-semantic", "--no-pictures"]
TYPED = shlex.join(RUN)
HEAVY = (
    "torch", "open3d", "open3d.cpu.pybind", "numba", "sklearn", "pandas", "matplotlib", "onnxruntime", "cv2", "scipy",
    "transformers", "openai", "psutil", "su3d_bench.predictions.formats", "su3d_bench.runs.plan",
)  # fmt: skip
# Of the 0.1 s for --help, two thirds are Python's own start.
AT_START = (*HEAVY, "numpy", "pydantic", "rich", "multiprocessing", "zipfile", "traceback", "difflib", "hashlib")


pytestmark = pytest.mark.usefixtures("painted_place")


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
def test_simple_commands_import_no_heavy_modules(words: list[str], unneeded: tuple[str, ...]) -> None:
    code = (
        "import sys; from su3d_bench.cli.main import main\n"
        f"code = main({words!r})\n"
        f"loaded = sorted(set({unneeded!r}) & set(sys.modules))\n"
        "print('\\nloaded:', ' '.join(loaded), code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1].split() == ["loaded:", "0"], done.stderr


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("su3d-bench re", {"report", "reproduce"}),
        ("su3d-bench query ", {"text", "ask", "make", "show", "score"}),
        ("su3d-bench report tables runs/demo --format ", {"text", "markdown", "latex", "csv", "html"}),
        ("su3d-bench run rooms/liv", {"rooms/living0", "rooms/living1"}),
        ("su3d-bench run --scenes re", {"replica/"}),
        ("su3d-bench run --methods conceptg", {"conceptgraphs", "conceptgraphs-detector"}),
        ("su3d-bench evaluate p --protocols rooms-se", {"rooms-semantic"}),
        ("su3d-bench evaluate p --dataset scan", {"scannet", "scannetpp"}),
        ("su3d-bench compare runs/b runs/", {"runs/a", "runs/b"}),
        ("su3d-bench report bundle runs/a --out pap", {"paper.zip"}),
    ],
)
def test_shell_completes_commands_and_values_without_heavy_imports(
    line: str, words: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for file in ("runs/a/run.json", "runs/b/run.json", "paper.zip"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text("")
    found = tmp_path / "found"
    environment = {
        "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(found),
        "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_COMP_WORDBREAKS": " ",
    }  # fmt: skip
    program = [sys.executable, "-X", "importtime", "-m", "su3d_bench"]
    done = subprocess.run(program, env=os.environ | environment, check=True, capture_output=True, text=True)
    assert not {row.rpartition("|")[2].strip() for row in done.stderr.splitlines()} & set(HEAVY)
    assert words <= {word.strip() for word in found.read_text().split("\n")}
    assert not {"run", "evaluate"} & {word.strip() for word in found.read_text().split("\n")}


def test_protocols_show_lists_every_rule(capsys: pytest.CaptureFixture[str]) -> None:
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
    ("words", "prog"),
    [
        ("", ""),
        ("help", ""),
        ("report", " report"),
        ("help run", " run"),
        ("help report tables", " report tables"),
        ("report help", " report"),
        ("dev registry help", " dev registry"),
    ],
)
def test_bare_call_and_help_show_the_help(words: str, prog: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.split()) == 0
    assert capsys.readouterr().out.startswith(f"usage: su3d-bench{prog} [-h]")


def test_help_of_every_command_and_group_shows_its_text_as_written(capsys: pytest.CaptureFixture[str]) -> None:
    commands = {words for words, _ in verbs()}
    for words in sorted(commands | {words[:1] for words in commands}):
        assert main([*words, "--help"]) == 0
        assert "%%" not in capsys.readouterr().out


def test_each_option_has_one_name_and_one_meaning_in_all_commands() -> None:
    meanings: dict[str, dict[tuple[str, str], str]] = {}
    names: dict[str, set[str]] = {}
    for words, parser in verbs():
        for action in parser._actions:
            if not action.option_strings or action.dest == "help":
                continue
            name, text = action.option_strings[0], str(action.help).partition(" (")[0]
            value = str(action.metavar).rpartition("=")[2]
            if name != "--out":  # its help says what is written
                meanings.setdefault(name, {}).setdefault((text, value), " ".join(words))
                names.setdefault(text, set()).add(name)
            noun = re.sub(r"ies$", "y", name[2:].removesuffix("s")).replace("-", "_").upper()
            if action.metavar == noun:
                assert (action.nargs is not None) == name.endswith("s"), (words, name)
    assert {name: uses for name, uses in meanings.items() if len(uses) > 1} == {}
    assert [several for several in names.values() if len(several) > 1] == []
    for name, uses in meanings.items():
        plural = meanings.get(f"{name}s", uses)
        assert {value for _, value in plural} == {value for _, value in uses}, name


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("run rooms/living0 --method oracle", "run: unknown argument '--method'; did you mean '--methods'?"),
        ("evaluate p --table-format csv", "evaluate: unknown argument '--table-format'; did you mean '--format'?"),
        ("rum", "unknown command 'rum'; did you mean 'run'? known: run, ablate, "),
        ("run --scene-s x", "run: unknown argument '--scene-s'; did you mean '--scenes'?; see su3d-bench run --help"),
        ("run --jobs x", "run: argument --jobs: x: expected an integer of 1 or more; see"),
        ("run --scenes replcia/*", "no scene matches 'replcia/*'; did you mean 'replica/*'?"),
        ("run --scenes nothing", "no scene matches 'nothing'; known datasets: homes, homes-sensor, homes-changing"),
        (f"{TYPED} --methods opensu3", "unknown method 'opensu3'; did you mean 'opensu3d'?"),
        (f"{TYPED} --methods {SCENES}/none.py:X", f"method '{SCENES}/none.py:X': no file {SCENES}/none.py"),
        (f"{TYPED} --profile orcale", "unknown profile 'orcale'; did you mean 'oracle'?"),
        (
            f"{TYPED} --protocols scannet-instance",
            "protocol 'scannet-instance' fits no scene of this run: it scores the labels of 'scannet', painted has "
            "those of 'replica'",
        ),
        (f"{TYPED} --set colector.drop=1", "--set colector.drop=1: 'colector' is not a method or dataset of this run"),
        (f"{TYPED} --set collector.dorp=1", "--set collector.dorp: unknown key 'dorp'; did you mean 'drop'?"),
        (f"{TYPED} --config none.toml", "none.toml: cannot read the configuration: No such file or directory"),
        ("protocols shwo", "protocols: unknown command 'shwo'; did you mean 'show'? known: list, show, "),
        ("report runs/demo", "report: unknown command 'runs/demo'; known: tables, timing, identity, changes, html, "),
        ("report tables r --tables VI", "report tables: unknown --tables 'VI'; did you mean 'V'? known: I, "),
        (
            f"query text {PAINTED}/a x",
            f"no run in runs/ has {PAINTED}/a by opensu3d; create one: su3d-bench run {PAINTED}/a --methods opensu3d",
        ),
        ("query text rooms/living0 '  '", "the text is empty; use for example"),
        ("query text rooms/living0 x --run r", "r: contains no run; name a run folder, see: su3d-bench runs list"),
        ("query text 'a plant' rooms/living0", "'a plant' is not a scene; give the scene first, then the text:"),
        ("run living0", "no scene matches 'living0'; did you mean 'rooms/living0'?"),
        ("run rooms", "'rooms' is a dataset; name its scenes, such as 'rooms/*'"),
        ("run --methods oracle rooms/living0", "--methods rooms/living0: is a scene; write it before the"),
        ("run --extend", "--extend: name the run with --out, such as --out runs/demo"),
        ("run --replace", "--replace: name the run with --out, such as --out runs/demo"),
        (f"{TYPED} --extend --out none", "--extend: none has no complete run.toml; omit --extend to start"),
    ],
)
def test_invalid_input_is_a_one_line_error_with_exit_code_2(
    words: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(shlex.split(words)) == 2
    answer = capsys.readouterr()
    assert answer.out == ""
    assert answer.err.startswith(f"su3d-bench: {line}")
    assert answer.err.count("\n") == 1


def test_misspelt_key_in_a_file_is_reported_with_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    Path("run.toml").write_text('scenes = ["rooms/living0"]\nmetod = ["opensu3d"]\n')
    assert main(["run", "--config", "run.toml"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("su3d-bench: run.toml:2: unknown key 'metod'; did you mean 'method'? known: scenes, ")


def test_debug_shows_the_traceback_before_the_message(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--debug", "--scenes", "nothing"]) == 2
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first == "Traceback (most recent call last):"
    assert last.startswith("su3d-bench: no scene matches 'nothing'")


def test_internal_error_is_one_line_with_exit_code_4(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from su3d_bench.core import registry

    monkeypatch.setattr(registry, "BUILT_IN", {})
    assert main(["methods"]) == EXIT_INTERNAL
    line = "su3d-bench: internal error: KeyError: 'method'; run again with --debug for the traceback\n"
    assert capsys.readouterr().err == line


def test_scenes_may_be_expanded_by_the_shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cam_params.json").write_text("{}")
    words = ["--scenes", f"{PAINTED}/a", f"{PAINTED}/b", "cam_params.json"]
    assert main([*RUN, *words, "--dry-run", "--json"]) == 0
    answer = capsys.readouterr()
    assert [one["scene"] for one in json.loads(answer.out)["jobs"]] == ["painted/a", "painted/b"]
    assert answer.err == "ignored, not scenes: cam_params.json\n"


def test_dry_run_shows_the_plan_and_does_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*RUN, "--dry-run"]) == 0
    text = capsys.readouterr().out
    assert text.count("6 updates, about") == 4
    assert "minutes with" in text
    assert "protocols: rooms-semantic; profile auto" in text
    assert not Path("runs").exists()


def test_dry_run_on_a_finished_run_marks_finished_jobs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*RUN, "--jobs", "1", "--scenes", f"{PAINTED}/a", "--out", "runs/x"]) == 0
    capsys.readouterr()
    assert main([*RUN, "--scenes", f"{PAINTED}/[ab]", "--extend", "--out", "runs/x", "--dry-run", "--json"]) == 0
    jobs = json.loads(capsys.readouterr().out)["jobs"]
    assert [(one["is_done"], one["is_measured"]) for one in jobs] == [(True, True), (False, True)]


def test_folder_name_depends_only_on_the_request() -> None:
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


def test_query_text_ranks_and_draws_map(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert answer.out == ""  # the ranking was printed before the picture was drawn
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


def test_map_without_features_cannot_be_queried(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*RUN, "--jobs", "1", "--scenes", f"{PAINTED}/a", "--quiet"]) == 0
    capsys.readouterr()
    assert main(["query", "text", "painted/a", "sofa", "--method", "oracle"]) == 2
    assert "query: the map has no features to compare with text" in capsys.readouterr().err


# options of several commands


def test_every_command_has_json_quiet_debug_and_two_examples() -> None:
    for words, parser in verbs():
        flags = {name for action in parser._actions for name in action.option_strings}
        assert {"--json", "--quiet", "--debug"} <= flags, words
        assert not {"--workers", "--threads", "--output"} & flags, words
        assert len((parser.epilog or "").splitlines()) == 3, words


@pytest.mark.parametrize(
    ("words", "is_printed", "file"),
    [
        (["compare", "a", "b"], False, None),
        (["compare", "a", "b", "--json"], True, None),
        (["compare", "a", "b", "--json", "new.json"], False, "new.json"),
        (["compare", "a", "b", "--json=new.json", "--per-class"], False, "new.json"),
    ],
)
def test_json_is_a_switch_or_names_a_file(words: list[str], is_printed: bool, file: str | None) -> None:
    arguments = build_parser().parse_args(words)
    assert (arguments.json, arguments.json_file) == (is_printed, None if file is None else Path(file))


def test_json_rejects_files_with_another_suffix() -> None:
    with pytest.raises(ConfigError, match=r"report verify: --json paper\.tex: expected a file that ends in \.json"):
        build_parser().parse_args(["report", "verify", "--json", "paper.tex"])


def test_json_file_is_written_in_addition_to_the_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "answers" / "rules.json"
    assert main(["protocols", "show", "rooms-semantic", "--json", str(file)]) == 0
    assert not capsys.readouterr().out.startswith("{")
    assert main(["protocols", "show", "rooms-semantic", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(file.read_text())


def test_undefined_number_is_null_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = argparse.Namespace(json=True, json_file=None)
    answer_either(arguments, {"x": [float("nan"), (float("inf"), 1.5)]}, "words")
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail) == {"x": [None, [None, 1.5]]}


def test_data_option_replaces_the_environment_variable_for_workers_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "other"))
    (tmp_path / "here").mkdir()
    assert main(["datasets", "list", "--data", "here", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["data_root"] == os.environ["SU3D_DATA"] == str(tmp_path / "here")
    for words in (["run", "--scenes", "replica/*"], ["evaluate", "here"], ["datasets", "check", "replica/*"]):
        assert main([*words, "--data", "nowhere"]) == 2
        error = capsys.readouterr().err
        assert "--data nowhere: no such folder" in error and error.count("\n") == 1
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "nowhere"))
    for words in (["run", "--scenes", "replica/room0"], ["datasets", "check", "replica/room0"]):
        assert main(words) == 2
        assert f"no scene in {tmp_path / 'nowhere'} (there is no such folder)" in capsys.readouterr().err


def test_messages_name_pages_of_the_documentation_not_files_of_the_repository() -> None:
    named = re.compile(r"\bdocs/[\w/-]+\.md")
    for file in (
        file for name in ("su3d_bench", "datasets", "baselines", "reports") for file in (ROOT / name).rglob("*")
    ):
        if file.suffix == ".py":
            tree = ast.parse(file.read_text())
            described = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            texts = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in described]
            assert not [node.value for node in texts if named.search(str(node.value))], file
        elif file.parent.name == "templates" or file.suffix in (".js", ".html"):
            assert file.is_dir() or not named.search(file.read_text()), file


@pytest.mark.parametrize(
    ("fields", "place"),
    [("", "page a/b of the documentation"), ("Project-URL: Documentation, https://x.org/y/\n", "https://x.org/y/a/b/")],
)
def test_address_of_the_documentation_is_that_of_the_package(
    fields: str, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.metadata.metadata", lambda name: message_from_string(fields))
    assert documentation("a/b") == place


def test_other_systems_are_refused_in_one_line() -> None:
    code = "import sys; sys.platform = 'win32'; import su3d_bench"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr == "su3d-bench: needs Linux or macOS; on Windows use WSL\n"


@pytest.mark.parametrize("width_cm", [8, 17])
def test_every_figure_has_its_printed_width_and_8_pt_type(width_cm: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*RUN, "--jobs", "1", "--scenes", f"{PAINTED}/a", "--out", "runs/one"]) == 0
    for words in (
        "query text painted/a sofa --run runs/one --method collector",
        "query ask painted/a 'How many chairs are there?' --run runs/one --method collector",
        f"datasets show {PAINTED}/a",
        "report attribution runs/one",
        "sheets pictures runs/one --texts sofa",
        "sheets pictures runs/one --draw labels",
        "sheets pictures runs/one --draw reasoning --texts 'How many chairs are there?'",
    ):
        assert main([*shlex.split(words), "--out", "figure.svg", "--width", f"{width_cm}cm", "--quiet"]) == 0, words
        text = Path("figure.svg").read_text(encoding="utf-8")
        (width_pt,) = re.findall(r'<svg [^>]*width="([0-9.]+)pt"', text)
        assert float(width_pt) == pytest.approx(width_cm / 2.54 * 72, abs=0.1), words
        sizes = set(re.findall(r"font(?:-size)?: (?:[a-z0-9]+ )?([0-9.]+)px", text))
        assert sizes <= {"8", "12"} and "8" in sizes, words  # 12: coloured squares of a legend
        Path("figure.svg").unlink()
    assert main(["query", "text", "painted/a", "sofa", "--width", "9cm"]) == 2
    assert "unknown --width '9cm'" in capsys.readouterr().err
