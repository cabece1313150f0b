"""Timing report: reading the update times of a run, summaries, and the printed report."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted_runs import painted_run

from su3d_bench.cli.main import main
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.costs import UpdateTimes, summarise
from su3d_bench.numerics.statistics import growth_exponent
from su3d_bench.runs.finished import read_run, read_update_times
from su3d_bench.store.records import MapCost


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return painted_run(tmp_path_factory.mktemp("timing") / "run", "--anytime", "0.5", "0.1", "--seen-so-far")


def times(total_ms: Float64Array, **columns: Float64Array) -> UpdateTimes:
    return UpdateTimes("r", "d/s", "m", {**columns, "total_ms": total_ms}, (), None, None)


def stages_of(summary: Any) -> dict[str, Any]:
    return {one.name: one for one in summary.stages}


def test_growth_distinguishes_noisy_constant_and_noisy_root() -> None:
    sizes = np.linspace(1e4, 1e6, 200)
    noise = np.exp(np.random.default_rng(0).normal(0, 0.1, 200))
    flat, root = growth_exponent(sizes, 20.0 * noise), growth_exponent(sizes, np.sqrt(sizes) * noise)
    assert flat is not None and flat.low < 0 < flat.high and flat.words == "constant per update"
    assert root is not None and root.low < 0.5 < root.high and root.words == "grows"


def test_percentiles_exclude_warm_up_and_shares_include_it() -> None:
    total = np.array([100.0, 50.0, 10.0, 10.0, 20.0, 30.0])
    summary = summarise([times(total, match_ms=total / 2, frame=np.arange(0, 60, 10.0))], warm_up=2)
    stage = stages_of(summary)["total"]
    assert (stage.n, stage.p50, stage.worst, stage.first) == (4, 15.0, 30.0, 75.0)
    assert stage.p95 == pytest.approx(28.5)  # 0.85 of the way from 20 to 30
    assert stages_of(summary)["match"].share == 0.5
    assert summary.updates_per_s == pytest.approx(6 / 0.22)
    assert summary.frames_per_s == pytest.approx(60 / 0.22)


def test_sizes_are_maxima_over_scenes_and_finish_is_of_the_final_maps() -> None:
    first = times(np.ones(2), n_points=np.array([7.0, 5.0]), map_bytes=np.array([10.0, 90.0]))
    second = times(np.ones(3))
    maps = tuple(MapCost(n_updates=n, finish_ms=ms) for n, ms in ((1, 50.0), (2, 4.0)))
    first = replace(first, maps=maps, peak_rss_bytes=400)
    second = replace(second, maps=maps[:1], peak_rss_bytes=300, device_bytes=20)
    found = summarise([first, second])
    assert (found.n_points, found.map_bytes, found.peak_rss_bytes, found.device_bytes) == (7, 90, 400, 20)
    assert (found.finish_ms, summarise([first]).finish_ms) == (50.0, 4.0)
    assert summarise([first, replace(second, peak_rss_bytes=500)]).peak_rss_bytes == 500
    none = summarise([times(np.ones(3))])
    assert (none.n_points, none.map_bytes, none.peak_rss_bytes, none.device_bytes, none.finish_ms) == (None,) * 5


def test_map_time_excludes_reading_and_perception() -> None:
    one = times(np.full(4, 10.0), decode_ms=np.full(4, 3.0), encode_ms=np.full(4, 4.0), match_ms=np.full(4, 2.0))
    np.testing.assert_array_equal(one.ms("map"), 2.0)


def test_growth_is_fitted_against_points_and_against_instances() -> None:
    sizes = np.arange(1.0, 41.0)
    summary = summarise([times(sizes**1.5, n_points=1e4 * sizes**3, n_instances=sizes)], warm_up=0)
    total = stages_of(summary)["total"]
    assert (total.against_points.exponent, total.against_instances.exponent) == pytest.approx((0.5, 1.5))
    assert stages_of(summarise([times(sizes, n_points=sizes)]))["total"].against_instances is None


def test_run_records_sizes_memory_and_cost_of_every_map(run: Path) -> None:
    (first, second) = read_update_times(read_run(run), "collector")
    assert [first.scene, second.scene] == ["painted/a", "painted/b"]
    assert len(first) == 6
    assert (first.columns["rss_bytes"] > 1e6).all()
    assert [one.n_updates for one in first.maps] == [1, 3, 6]
    assert first.peak_rss_bytes is not None and first.peak_rss_bytes >= first.columns["rss_bytes"].max() / 2
    assert all(isinstance(one, MapCost) and one.finish_ms >= 0 for one in first.maps)


def test_intermediate_maps_are_scored_in_metrics_json(run: Path) -> None:
    results = json.loads((run / "metrics.json").read_text())["results"]
    for one in results:
        assert [midway["share"] for midway in one["anytime"]] == [0.1, 0.5]
        assert set(one["anytime"][0]["metrics"]) == set(one["result"]["metrics"])
    coverage = [midway["metrics"]["mAcc"] for midway in results[0]["anytime"]]
    assert coverage[0] <= coverage[1] <= results[0]["result"]["metrics"]["mAcc"]


def test_timing_report_prints_tables_and_writes_plots(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", "timing", str(run), "--out", str(tmp_path), "--warm-up", "1"]) == 0
    shown = capsys.readouterr().out
    assert shown.count("| collector |") == 1 + 2 * 3 * 4 + 2  # three curves of two protocols, with areas; costs
    lines = [[cell.strip() for cell in line.split("|")] for line in shown.splitlines()]
    seen = [row[5:] for row in lines if row[3:5] == ["rooms-semantic", "seen so far: ceiling"]]
    assert [row[0] for row in seen] == ["10 %", "50 %", "100 %", "area"] and {row[2] for row in seen} == {"100.0"}
    assert "12 updates of 2 scenes" in shown
    assert "| exponent by instances |" in shown
    stages = list(csv.DictReader((tmp_path / "timing.csv").open()))
    assert {"points_exponent", "instances_exponent", "instances_low", "instances_high"} <= {*stages[0]}
    assert {"map", "total"} <= {row["stage"] for row in stages}
    assert all(int(row["n"]) == 10 and float(row["p50_ms"]) >= 0 for row in stages)
    assert (tmp_path / "timing.md").read_text().startswith(str(run))
    (method,) = csv.DictReader((tmp_path / "methods.csv").open())
    assert float(method["real_time_factor"]) == pytest.approx(float(method["frames_per_s"]) / 30)
    assert int(method["peak_rss_bytes"]) > 1e6
    for name in ("update-cost", "update-course", "memory", "stages", "anytime"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        pdf = (tmp_path / f"{name}.pdf").read_bytes()
        assert pdf.startswith(b"%PDF") and b"/CIDFontType2" in pdf and b"/Type3" not in pdf  # TrueType fonts
