"""A run over scenes that nothing scores says what it found, and once why nothing does."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.reports.tables.run import Unscored, not_scored_lines
from su3d_bench.runs import resume as finished_scenes
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
    for module in (scene_run, finished_scenes):
        monkeypatch.setattr(module, "build_perception", colour_perception)
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


def test_tables_page_and_json_say_it_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*WORDS, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["found"]
    assert [one["scene"] for one in found] == ["painted/b", "painted/b"]
    assert found[0]["n_instances"] == sum(n for _, n in found[0]["names"]) > 0
    assert found[0]["n_updates"] > 0 and found[0]["update_ms"] >= 0
    assert "found" not in json.loads(Path("out/metrics.json").read_text())  # which holds no time
    assert main(["report", "tables", "out"]) == 0
    assert "**Found, not scored**" in capsys.readouterr().out
    assert main(["report", "tables", "out", "--protocols", "rooms-instance"]) == 2
    assert "no scene was scored" in capsys.readouterr().err
    assert main(["report", "html", "out", "--no-maps", "--out", "page.html", "--quiet"]) == 0
    data = json.loads(Path("page.html").read_text().split('id="data">')[1].split("</script>")[0])
    assert data["results"] == [] and len(data["found"]) == 2 and len(data["runs"][0]["unscored"]) == 1


def test_reasons_that_differ_in_their_scene_alone_are_one_line() -> None:
    reasons = [
        Unscored(f"d/{scene}", method, protocol, f"d/{scene}: no truth; /data/{scene}/mesh.ply is missing")
        for protocol in ("p", "q")
        for scene in ("a0", "a1", "a2")
        for method in ("m", "n")
    ]
    other = Unscored("d/a0", "m", "r", "needs a class for every point")
    assert not_scored_lines([*reasons, other]) == [
        "m, n: not scored under p, q: d/a0: no truth; /data/a0/mesh.ply is missing (and alike in 2 more)",
        "m: not scored under r: d/a0: needs a class for every point",
    ]
