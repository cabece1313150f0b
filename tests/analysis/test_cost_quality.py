"""Cost and quality: which rows share a table and a figure, the Pareto front, and what counts as time per frame."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from painted_runs import painted_run

from su3d_bench.analysis.costs import cost_rows
from su3d_bench.cli.main import main
from su3d_bench.core.system import timing
from su3d_bench.reports.tables.costs import COSTS, CostRow, comparable_rows, cost_tables, front_of
from su3d_bench.reports.tables.model import Measured
from su3d_bench.runs.finished import read_run, read_update_times


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return painted_run(tmp_path_factory.mktemp("costs") / "run", "--set", "perception.cache=false")


def row(method: str, score: float | None, machine: str = "here", **costs: float) -> CostRow:
    measured = Measured(
        run=f"runs/{costs.get('rate_hz', 'waits')}", method=method, protocol="rooms-semantic", version=1,
        kind="semantic", headline=("mAcc",), metrics={"mAcc": score}, intervals={},
        per_scene={"rooms/a": {"mAcc": score}}, n_planned=1, caveat=None,
    )  # fmt: skip
    return CostRow(measured, machine, "data", dict.fromkeys(COSTS) | costs)


def test_rows_of_other_machines_are_in_tables_of_their_own_by_method_and_rising_rate() -> None:
    rows = [
        row("a", 0.5, frame_s=1.0),
        row("b", 0.4, frame_s=2.0),
        row("a", 0.3, rate_hz=9.0),
        row("a", 0.4, rate_hz=1.0),
    ]
    groups = comparable_rows([*rows, row("a", 0.9, "elsewhere", frame_s=0.1)])
    assert [[(one.score.method, one.costs["rate_hz"]) for one in group] for group in groups] == [
        [("a", 1.0), ("a", 9.0), ("a", None), ("b", None)],
        [("a", None)],
    ]
    first, second = cost_tables([*rows, row("a", 0.9, "elsewhere", frame_s=0.1)])
    assert first.caption.endswith("on here.") and second.caption.endswith("on elsewhere.")
    assert [cell.is_best for line in first.rows for cell in line.cells[2:]] == [False, False, True, False]
    assert [line.cells[0].text for line in first.rows] == ["1", "9", "-", "-"]


def test_the_front_has_rows_that_no_cheaper_or_equal_row_reaches() -> None:
    rows = [row("slow", 0.5, frame_s=3.0), row("fast", 0.1, frame_s=1.0), row("same", 0.5, frame_s=2.0)]
    rows += [row("worse", 0.2, frame_s=2.0), row("unknown", None, frame_s=0.1), row("untimed", 0.9)]
    assert [one.score.method for _, _, one in front_of(rows, "frame_s")] == ["fast", "same"]


def test_time_per_frame_excludes_reading_and_is_unknown_if_perception_may_be_read_from_files(
    run: Path, tmp_path: Path
) -> None:
    (first, _) = times = read_update_times(read_run(run), "collector")
    np.testing.assert_allclose(first.frame_ms or (), first.columns["total_ms"] - first.columns["decode_ms"])
    (semantic, _) = cost_rows([read_run(run)], {(read_run(run).name, "collector"): times})
    pooled = np.concatenate([one.frame_ms or () for one in times])
    assert semantic.costs["frame_s"] == pytest.approx(np.median(pooled) / 1e3)
    maps = [path.stat().st_size for path in run.rglob("prediction.npz")]
    assert semantic.costs["saved_mib"] == max(maps) / 2**20
    cached = painted_run(tmp_path / "cached", scenes="a")
    assert [one.frame_ms for one in read_update_times(read_run(cached), "collector")] == [None]


def test_timing_writes_the_costs_of_each_machine_and_its_latex_is_verified(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(run, "here")
    shutil.copytree(run, "there")
    record = json.loads(Path("there/run.json").read_text())
    Path("there/run.json").write_text(json.dumps(record | {"hardware": "another machine"}))
    assert main(["report", "timing", "here", "there", "--out", "out"]) == 0
    assert capsys.readouterr().out.count("**Cost and quality**") == 4  # two machines, two protocols
    assert [Path(f"out/cost-quality-{k}.pdf").is_file() for k in range(1, 6)] == [True] * 4 + [False]
    rows = list(csv.DictReader(Path("out/costs.csv").read_text().splitlines()))
    assert {one["machine"] for one in rows} == {record["hardware"], "another machine"}
    assert all(float(one["frame_s"]) > 0 and float(one["peak_mib"]) > 1 and one["rate_hz"] == "" for one in rows)
    assert main(["report", "verify", "out/costs.tex"]) == 0
    changed = Path("out/costs.tex").read_text().replace("method=collector", "method=other", 1)
    Path("out/costs.tex").write_text(changed)
    assert main(["report", "verify", "out/costs.tex"]) == 1


def test_the_machine_names_its_gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "GPUS", tmp_path)
    without = timing.hardware_line()
    for folder in ("0000:01:00.0", "0000:02:00.0"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "information").write_text("Model: \t\t NVIDIA H200\nIRQ:   \t\t 12\n")
    assert timing.hardware_line() == f"{without}, 2 x NVIDIA H200"
