"""Rule attribution: its ends are the run's numbers, its steps sum to the difference."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from painted_runs import COLLECTOR, painted_run, see_painted

from su3d_bench.analysis.rule_attribution import RuleStepper
from su3d_bench.cli.main import main
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.runs.finished import read_run


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two methods, one of which has an imperfect map."""
    return painted_run(tmp_path_factory.mktemp("walk") / "run", methods=(COLLECTOR, f"{COLLECTOR}@drop=1"))


@pytest.fixture(autouse=True)
def _words(monkeypatch: pytest.MonkeyPatch) -> None:
    see_painted(monkeypatch)


def test_each_rule_gets_its_share_and_the_reverse_direction_negates_it(made: Path, tmp_path: Path) -> None:
    lines = ['extends = "rooms-semantic"', 'name = "mine"', 'ignore = ["wall", "floor", "ceiling", "chair"]']
    (tmp_path / "mine.toml").write_text("\n".join([*lines, 'vocabulary = "all"', "[transfer]", "cap_m = 0.001"]))
    first, second = load_protocol("rooms-semantic"), load_protocol(str(tmp_path / "mine.toml"))
    there = RuleStepper.of(first, second, f"{made}:collector@drop=1").walk()
    back = RuleStepper.of(second, first, f"{made}:collector@drop=1").walk()
    result = read_run(made).results["collector@drop=1", "rooms-semantic"].result
    assert result is not None and {name: result.metrics[name] for name in there.start} == there.start == back.end
    shares = {step.rules: step.adds["mAcc"].share for step in there.steps}
    assert shares.keys() == {("ignore",), ("vocabulary",), ("transfer.cap_m",)}
    assert abs(shares["ignore",]) > 0.01
    assert shares["transfer.cap_m",] == 0.0  # the map has the points of the ground truth
    assert {step.rules: -step.adds["mAcc"].share for step in back.steps} == pytest.approx(shares, abs=1e-12)


def test_protocols_diff_prints_a_table_draws_a_plot_and_writes_json(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["protocols", "diff", "rooms-instance", "replica-openmask3d", "--run", f"{made}:collector"]
    assert main([*words, "--jobs", "1", "--out", str(tmp_path / "walk.png")]) == 0
    shown = capsys.readouterr().out
    assert "classes, ignore" in shown and "transfer.evaluation_voxel_m" in shown
    assert (tmp_path / "walk.png").read_bytes().startswith(b"\x89PNG")
    assert main([*words, "--jobs", "1", "--json"]) == 0
    value: Any = json.loads(capsys.readouterr().out)
    assert (value["first"], value["walk"]["n_orders"]) == ("rooms-instance", None)
    assert {rule for step in value["walk"]["steps"] for rule in step["rules"]} <= {
        one["rule"] for one in value["differing"]
    }
