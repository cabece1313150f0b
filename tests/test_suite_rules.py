"""Rules for the tests themselves: unique names, existing modules, no sleeping."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

from places import ROOT, TESTS

FILES = sorted(TESTS.rglob("*.py"))
# Exceptions where time matters: the one loop that waits, a slow dataset and method, a program whose duration is
# measured, and programs that are killed.
MAY_SLEEP = {
    "waiting.py",
    "painted.py",
    "test_command_runners.py",
    "test_interrupted_runs.py",
    "test_regression_costs.py",
}


def test_no_two_files_have_the_same_name() -> None:
    # Test folders are not packages: each file is a module by its name only.
    twice = [name for name, n in Counter(file.name for file in FILES).items() if n > 1]
    assert twice == []


def test_every_test_named_on_a_page_exists() -> None:
    there = {name for file in FILES for name in re.findall(r"^def (test_\w+)", file.read_text(), re.MULTILINE)}
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").rglob("*.md")]
    code = re.compile(r"`(?:[\w/]+/)?(test_\w+)(?:\.py)?`")
    named = {(page.name, name) for page in pages for name in code.findall(page.read_text())}
    assert len(named) > 7
    assert sorted(one for one in named if one[1] not in there | {file.stem for file in FILES}) == []


def test_no_test_waits_by_sleeping() -> None:
    assert {file.name for file in FILES if re.search(r"\bsleep\(", file.read_text())} - {
        Path(__file__).name
    } == MAY_SLEEP


def test_programs_in_texts_import_existing_names() -> None:
    """Imports in the text of a program that a test starts, which no other tool checks."""
    names = {
        name
        for file in (*FILES, *(ROOT / "benchmarks").rglob("*.py"))
        for name in re.findall(r"\b(?:from|import) (su3d_bench(?:\.\w+)+)", file.read_text())
    }
    assert names
    assert sorted(name for name in names if not _exists(name)) == []


def test_every_file_of_benchmarks_finds_its_imports() -> None:
    program = (
        "import importlib, sys; sys.path.insert(0, 'benchmarks/measuring'); import folders\n"
        "for name in folders.PROGRAMS.keys() - {'kill_program'}:\n"  # that one starts working when imported
        "    importlib.import_module(name)"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]


def _exists(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False
