"""A finished run as a table of pandas."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.finished import read_run


def test_the_frame_holds_what_metrics_json_holds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    words = ["run", "--scenes", f"{SCENES}/painted.py:Painted/*", "--methods", f"{SCENES}/painted.py:Collector"]
    words += ["oracle", "--protocols", "rooms-semantic", "rooms-instance", "--jobs", "1", "--no-pictures", "--quiet"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    frame = read_run(tmp_path / "run").to_frame()
    results = json.loads((tmp_path / "run/metrics.json").read_text())["results"]
    assert len(frame) == sum(len(result["result"]["metrics"]) for result in results) > 0
    by_name = frame.set_index(["method", "protocol", "metric"])
    for result in results:
        for metric, value in result["result"]["metrics"].items():
            row = by_name.loc[(result["method"], result["protocol"], metric)]
            interval = result["result"]["intervals"].get(metric) or (None, None)
            shown = [value, *interval, result["ceiling"].get(metric)]
            np.testing.assert_array_equal(
                row[["value", "low", "high", "ceiling"]].astype(float), np.array(shown, float)
            )
            assert row["n_scenes"] == len(result["result"]["scenes"])
