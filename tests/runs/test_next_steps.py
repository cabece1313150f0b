"""What stands at the end of a run: its pictures, and commands that work on it."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.runs import scene as scene_run

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.chdir(tmp_path)


def lines_of(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    run = ["run", "--scenes", f"{PAINTED}/a", "--protocols", "rooms-semantic", "rooms-instance", "--jobs", "1", *words]
    assert main(run) == 0
    return capsys.readouterr().err.splitlines()


def commands_in(lines: list[str]) -> list[list[str]]:
    return [shlex.split(line.removeprefix("next:"))[1:] for line in lines if " su3d-bench " in line]


def test_a_run_ends_with_its_pictures_and_commands_that_are_true_for_it(capsys: pytest.CaptureFixture[str]) -> None:
    lines = lines_of(capsys, "--methods", COLLECTOR, "oracle", "--out", "runs/of mine")
    start = lines.index("run folder: runs/of mine")
    pictures = lines[start + 1].removeprefix("pictures: ").partition(" and ")[0]
    assert Path(pictures).is_file() and lines[start + 1].endswith("more in runs/of mine/scenes/*/*/pictures")
    html, query, compare = commands_in(lines[start + 2 :])
    assert html == ["report", "html", "runs/of mine", "--out", "runs/of mine/page.html"]
    assert (
        query[0] == "query"
        and query[1].endswith("/a")
        and query[3:] == ["--run", "runs/of mine", "--method", "collector"]
    )
    assert query[2] in {"chair", "sofa", "table", "lamp", "plant", "book", "floor", "wall"}
    assert main(compare) == 0 and main([*html, "--no-maps", "--no-errors", "--quiet"]) == 0
