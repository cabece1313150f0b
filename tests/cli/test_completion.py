from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from fuzz_words import verbs

from su3d_bench.cli import completion
from su3d_bench.cli.main import main

ASKED = {
    "": {"run", "report", "datasets", "cache"},
    "re": {"report", "refine", "reproduce", "registry"},
    "report ": {"tables", "timing", "html", "samples", "rerun", "leaderboard", "bundle", "verify"},
    "report tables --form": {"--format"},
    "report tables runs/demo --format ": {"text", "markdown", "latex", "csv", "html"},
    "report tables --table II ": {"I", "II", "III", "IV", "V", "reasoning"},
    "sheets make x --kind retr": {"retrieval"},
    "new ": {"method", "dataset", "protocol", "registry"},
    "new dataset ": set[str](),
    "protocols ": {"list", "show", "diff"},
    "run --out ": set[str](),
    "compare runs/a ": set[str](),
    "datasets make --lay": {"--layout"},
}


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


@pytest.fixture
def program(tmp_path: Path, request: pytest.FixtureRequest) -> str:
    name: str = request.param
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed here")
    return found


def completed(words: list[str], text: str, folder: Path) -> set[str]:
    environment = {**os.environ, "HOME": str(folder), "TERM": "dumb"}
    done = subprocess.run(words, input=text, capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return {line for line in done.stdout.splitlines() if line}


@pytest.mark.parametrize("program", ["bash"], indirect=True)
@pytest.mark.parametrize("typed", ASKED)
def test_bash_completes(program: str, typed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = " ".join(map(completion.quoted, ["su3d-bench", *typed.split(" ")]))
    asked = f"COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); _su3d_bench\n"
    text = f'{script("bash", capsys)}\n{asked}printf "%s\\n" "${{COMPREPLY[@]}}"'
    found = completed([program, "--norc", "--noprofile", "-s"], text, tmp_path)
    assert found >= ASKED[typed] if not typed else found == ASKED[typed]


@pytest.mark.parametrize("program", ["zsh"], indirect=True)
@pytest.mark.parametrize("typed", ASKED)
def test_zsh_completes(program: str, typed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    last = typed.rpartition(" ")[2]
    words = " ".join(map(completion.quoted, ["su3d-bench", *typed.split(" ")]))
    # what zsh's own completion would do with the answer
    stubs = 'compdef() { :; }; _files() { :; }; compadd() { shift; print -rl -- "$@"; }\n'
    asked = f"ask() {{ words=({words}); CURRENT=${{#words}}; _su3d_bench; }}; ask"
    found = completed([program, "-f", "-s"], stubs + script("zsh", capsys) + asked, tmp_path)
    found = {word for word in found if word.startswith(last)}
    assert found >= ASKED[typed] if not typed else found == ASKED[typed]


@pytest.mark.parametrize("program", ["fish"], indirect=True)
@pytest.mark.parametrize("typed", [typed for typed in ASKED if ASKED[typed] and typed != "report tables --table II "])
def test_fish_completes(program: str, typed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Fish knows no flag with several values: of those the first alone."""
    text = script("fish", capsys) + f"complete -C {completion.quoted_for_fish(f'su3d-bench {typed}')}\n"
    found = {line.partition("\t")[0] for line in completed([program, "--no-config"], text, tmp_path)}
    assert found >= ASKED[typed]


def test_every_verb_and_shown_flag_is_known() -> None:
    from su3d_bench.cli.main import build_parser

    known = {verb.path: verb for verb in completion.verbs_of(build_parser())}
    for words, parser in verbs():
        shown = {name for one in parser._actions if one.help != argparse.SUPPRESS for name in one.option_strings}
        assert known[" ".join(words)].flags.keys() == shown


@pytest.mark.parametrize("shell", completion.SHELLS)
def test_words_that_a_shell_would_act_on_are_quoted(shell: str, tmp_path: Path) -> None:
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed here")
    hostile = ["$(touch made)", "`touch made`", "a'b", 'c"d', "e;touch made", "f\\g"]
    parser = argparse.ArgumentParser()
    parser.add_subparsers().add_parser("$(touch made)")
    parser.add_argument("--what'$(touch made)", choices=hostile, help="a 'help' $(touch made)")
    lines = {"bash": completion.bash, "zsh": completion.zsh, "fish": completion.fish}[shell]
    known = list(completion.verbs_of(parser))
    text = "\n".join(["compdef() { :; }" if shell == "zsh" else "", *lines(known)])
    if shell == "bash":
        text += "\nCOMP_WORDS=(x --what\\'\\$\\(touch\\ made\\) ''); COMP_CWORD=2; _su3d_bench\n"
        text += 'printf "%s\\n" "${COMPREPLY[@]}"'
    subprocess.run([program, "-s"] if shell != "fish" else [program], input=text, text=True, cwd=tmp_path, check=True)
    assert not (tmp_path / "made").exists()


def test_the_script_can_be_had_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "zsh", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert (value["shell"], value["script"].splitlines()[0]) == ("zsh", "#compdef su3d-bench")
