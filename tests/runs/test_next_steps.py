"""Output at the end of a run and about its settings: next commands and changed settings."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.config import Setting, Settings
from su3d_bench.runs.finished import FinishedRun, RunData
from su3d_bench.store.run_folder import RunFolder

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"


pytestmark = pytest.mark.usefixtures("painted_place")


def lines_of(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    run = ["run", "--scenes", f"{PAINTED}/a", "--protocols", "rooms-semantic", "rooms-instance", "--jobs", "1", *words]
    assert main(run) == 0
    return capsys.readouterr().err.splitlines()


def commands_in(lines: list[str]) -> list[list[str]]:
    return [shlex.split(line.removeprefix("next:"))[1:] for line in lines if " su3d-bench " in line]


def test_run_ends_with_pictures_and_next_commands_that_work(capsys: pytest.CaptureFixture[str]) -> None:
    lines = lines_of(capsys, "--methods", COLLECTOR, "oracle", "--out", "runs/of mine")
    start = lines.index("run folder: runs/of mine")
    pictures = lines[start + 1].removeprefix("pictures: ").partition(" and ")[0]
    assert Path(pictures).is_file() and lines[start + 1].endswith("more in runs/of mine/scenes/*/*/pictures")
    html, query, compare = commands_in(lines[start + 2 :])
    assert html == ["report", "html", "runs/of mine", "--out", "runs/of mine.html"]
    assert query[:2] == ["query", "text"] and query[2].endswith("/a")
    assert query[4:] == ["--run", "runs/of mine", "--method", "collector"]
    assert query[3] in {"chair", "sofa", "table", "lamp", "plant", "book", "floor", "wall"}
    assert main(compare) == 0 and main([*html, "--no-maps", "--no-errors", "--quiet"]) == 0


def run_with(**given: Any) -> FinishedRun:
    """A run whose folder is never read; ``__`` separates the parts of a path."""
    entries = tuple(Setting(tuple(name.split("__")), value, "run.toml:1") for name, value in given.items())
    record: Any = None
    return FinishedRun(RunFolder(Path("run")), record, {}, {}, record, RunData(Settings(entries), {}))


def test_changed_settings_are_listed_with_their_values() -> None:
    """The stride of a run is a changed setting of each method with a different one; an unknown method has none."""
    run = run_with(method__opensu3d__eps=0.05, method__opensu3d__top_m=5, method__opensu3d__border_px=20)
    assert run.changed("opensu3d") == ("eps = 0.05",)
    assert run_with(stride=10).changed("opensu3d") == ("stride = 10",)
    assert run_with(stride=40).changed("opensu3d") == run_with(stride=0).changed("opensu3d") == ()
    assert run_with(stride=10, method__mine__x=1).changed("mine") == ()
