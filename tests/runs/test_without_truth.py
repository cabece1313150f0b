"""A run over scenes that nothing scores says what it found, and once why nothing does."""

from __future__ import annotations

from pathlib import Path

import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.runs import scene as scene_run

PAINTED = f"{SCENES}/painted.py"
WORDS = [
    "run",
    "--scenes",
    f"{PAINTED}:Painted/b",
    "--methods",
    f"{PAINTED}:Collector",
    f"{PAINTED}:Collector@noise_m=0.3",
]
WORDS += ["--protocols", "rooms-semantic", "rooms-instance", "--set", "painted.fault=no-truth", "--jobs", "1"]
WORDS += ["--no-pictures", "--out", "out"]


@pytest.fixture(autouse=True)
def _painted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.chdir(tmp_path)


def test_what_was_found_stands_in_place_of_dashes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(WORDS) == 0
    said = capsys.readouterr()
    assert said.out.startswith("no protocol scores these scenes\n\n**Found, not scored**\n")
    rows = [line for line in said.out.splitlines() if line.startswith("| painted/b")]
    assert [row.split("|")[2].strip() for row in rows] == ["collector", "collector@noise_m=0.3"]
    assert all(" / " in row.split("|")[5] and row.split("|")[8].strip() != "-" for row in rows)
    why = "not scored under rooms-semantic, rooms-instance: painted/b: has no ground truth"
    assert [line for line in said.err.splitlines() if "not scored" in line] == [
        f"collector, collector@noise_m=0.3: {why}"
    ]
    log = next(Path("out").glob("scenes/*/collector/log.txt")).read_text()
    assert log.count("\n") == 3 and f"collector: {why}\n" in log
