"""The parts of the HTML report: computed in several processes, and with a reason where one cannot be computed."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from painted_runs import painted_run, see_painted
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import PredictionError
from su3d_bench.runs import finished as finished_run

WORDS = ("--texts", "chair", "table")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    made = painted_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    see_painted(monkeypatch)
    return made


def page() -> bytes:
    assert main(["report", "html", "run", "--out", "page.html", "--jobs", "1", *WORDS]) == 0
    return without_date(Path("page.html"))


def without_date(path: Path) -> bytes:
    """The page without its date and command."""
    content, n_found = re.subn(rb'<p class="made">.*</p>', b"", path.read_bytes())
    assert n_found == 1
    return content


def test_page_without_the_encoder_says_so(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_encoder(folder: Any, device: str = "cpu") -> Any:
        raise PredictionError("the encoder is not here")

    monkeypatch.setattr(finished_run, "encoder_of", no_encoder)
    assert b"the encoder is not here" in page()


@pytest.mark.proof
def test_parallel_processes_give_the_same_bytes(run: Path) -> None:
    first = page()
    command = [sys.executable, str(SCENES / "painted_cli.py"), "report", "html", "run", "--out", "two.html"]
    subprocess.run([*command, "--jobs", "2", *WORDS], check=True, timeout=300)
    assert without_date(Path("two.html")) == first
