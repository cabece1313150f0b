"""Sweeps: the variants of a request, and one run of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.runs.ablation import ablation_rows, read_rows

PAINTED = f"{SCENES}/painted.py"


def test_sweep_of_the_paper_has_nine_rows_and_defaults_name_the_method_itself() -> None:
    rows = ablation_rows(
        "opensu3d", ["m=1,5,10", "k=1,3,5", "ratios=[0.1,1,1.1],[0.8,1,1.2],[0.5,1,1.5]"], is_grid=False
    )
    assert [(row.parameter, row.value) for row in rows[:4]] == [("m", "1"), ("m", "5"), ("m", "10"), ("k", "1")]
    assert [row.method for row in rows if row.is_default] == ["opensu3d"] * 3
    assert rows[0].method == "opensu3d@top_m=1"
    assert rows[5].method == "opensu3d@crop_ratios=[0.8,1.0,1.2,1.4,1.6]"
    assert len({row.method for row in rows}) == 7


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        (["n=1"], "opensu3d has no setting 'n'"),
        (["top_n=1"], "did you mean 'top_m'"),
        (["m"], "expected KEY=VALUE"),
        (["m="], "expected KEY=VALUE"),
        (["m=0"], "--vary m=0: input should be greater"),
        (["k=0.5"], "crop levels must be an integer"),
        (["m=" + ",".join(map(str, range(1, 1100)))], "1099 variants; one run can have at most 1000"),
    ],
)
def test_invalid_sweep_is_rejected(vary: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=f"(?i){message}"):
        ablation_rows("opensu3d", vary, is_grid=False)


def test_sweep_is_one_run_with_its_rows_stored_beside_it(painted_place: Path) -> None:
    words = ["ablate", "--method", f"{PAINTED}:Collector", "--vary", "stride=1,2", "drop=0,1", "--no-pictures"]
    words += ["--scenes", f"{PAINTED}:Painted/a", "--protocols", "rooms-semantic", "--jobs", "1"]
    assert main([*words, "--out", "out"]) == 0
    rows = read_rows(painted_place / "out")
    assert [row.method for row in rows] == ["collector", "collector@stride=2", "collector", "collector@drop=1"]
    results = json.loads((painted_place / "out" / "metrics.json").read_text())["results"]
    assert [one["method"] for one in results] == ["collector", "collector@stride=2", "collector@drop=1"]
