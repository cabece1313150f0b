"""Output to terminals and logs: what is escaped, which output is covered, and output that is not read."""

from __future__ import annotations

import io
import json
import logging
import re
import subprocess
import sys

import pytest

from su3d_bench.cli.output import drawn_bars
from su3d_bench.core.safe_output import SafeStream, doors, escaped_json, one_line

HOSTILE = "\x1b[2Ja\r\u202eb\x9b\n::stop-commands::x ##[error]y"
ACTS = re.compile(r"[^\n\x20-\x7e]|^ *::|##\w*\[", re.MULTILINE)


@pytest.mark.parametrize("text", ["::error::x", "  ::error::x", "a\n::error::x", "a\r::error::x", "a\u2028 ::error::x"])
def test_commands_at_line_starts_are_escaped(text: str) -> None:
    stream = io.StringIO()
    door = SafeStream(stream)
    for character in text:
        door.write(character)
    door.flush()
    assert not ACTS.search(stream.getvalue()), stream.getvalue()
    assert not one_line(text).lstrip().startswith("::")


def test_unencodable_characters_are_escaped() -> None:
    contents = io.BytesIO()
    stream = io.TextIOWrapper(contents, encoding="ascii")
    door = SafeStream(stream)
    print("naïve", file=door)
    door.flush()
    assert contents.getvalue() == b"na\\xefve\n"


def test_escaped_json_reads_back_unchanged() -> None:
    value = {HOSTILE: [HOSTILE, "\U000e0041", 1.5, None, "naïve"]}
    for form in ({}, {"indent": 2}):
        text = escaped_json(value, **form)
        assert json.loads(text) == value
        assert all(line.isprintable() for line in text.split("\n")) and "##[" not in text


def test_logs_and_prints_of_libraries_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    with doors():
        print(HOSTILE, file=sys.stderr)
        print(HOSTILE)
        logging.lastResort.handle(logging.makeLogRecord({"msg": HOSTILE, "levelno": 30}))  # type: ignore[union-attr]
    printed = capsys.readouterr()
    assert printed.out.count("stop-commands") == 1 and printed.err.count("stop-commands") == 2
    assert not ACTS.search(printed.out + printed.err)


def test_writes_at_interpreter_exit_are_dropped(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with doors():
        kept = sys.stdout
        print("said", end="")
    kept.write("\x1b[0m\n")  # written by colorama on exit
    assert capsys.readouterr().out == "said"
    closed = io.StringIO()
    closed.close()
    assert not SafeStream(closed).isatty()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_bars_show_literal_names_and_messages_printed_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with doors(), drawn_bars(is_quiet=False) as bars:
        assert bars is not None
        bars.add_task(f"[/red]{HOSTILE}", total=2, remark="")
        print(f"[/b]{HOSTILE}", file=sys.stderr)
        bars.refresh()
    drawn = terminal.getvalue()
    assert "[/red]" in drawn and "[/b]" in drawn
    for mark in ("\x1b[2J", "\u202e", "\x9b", "##[", "\n::stop"):
        assert mark not in drawn


def shell(command: str) -> subprocess.CompletedProcess[str]:
    words = f'verb() {{ "{sys.executable}" -m su3d_bench "$@"; }}; {command}'
    return subprocess.run(["bash", "-c", words], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("command", "code", "n_lines"),
    [
        ("verb protocols > /dev/full", 2, 1),
        ("verb protocols > /dev/full 2> /dev/full", 2, 0),
        ("verb protocols >&- 2>&- <&-", 0, 0),
        ("verb protocols show scannet200-instance | head -1 > /dev/null; exit ${PIPESTATUS[0]}", 0, 0),
    ],
)
def test_unread_output_does_not_change_the_exit_code(command: str, code: int, n_lines: int) -> None:
    done = shell(command)
    assert (done.returncode, done.stderr.count("\n")) == (code, n_lines), done.stderr
    assert not n_lines or done.stderr.startswith("su3d-bench: stdout: write error (No space left on device); ")


def test_only_the_answer_is_on_stdout() -> None:
    text = """import os
from su3d_bench.core.safe_output import answer_stream, answers_apart, doors
with doors(), answers_apart():
    print("a")
    os.write(1, b"b")
    os.system("echo c")
    print("answer", file=answer_stream())
os.write(1, b"end")
"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert (done.stdout, sorted(done.stderr.split())) == ("answer\nend", ["a", "bc"])
