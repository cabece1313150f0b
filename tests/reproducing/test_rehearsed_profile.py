"""Whose perception is rehearsed, on which device: said in the first line, and before anything is made."""

from __future__ import annotations

from pathlib import Path

import pytest

from su3d_bench.cli.main import main
from su3d_bench.core.errors import Su3dError
from su3d_bench.reproducing.asked import Asked, asked_runs, plan_of
from su3d_bench.reproducing.preflight import preflight
from su3d_bench.reproducing.recipe import load_recipe

ROOM = ["--rooms", "bedroom0", "--room-settings", "n_frames=8", "width=64", "height=48", "mesh_spacing_m=0.2"]
WORDS = ["reproduce", "opensu3d", "--table", "III", "--rehearse", *ROOM, "--dry-run"]


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("SU3D_DATA", "SU3D_MODELS", "SU3D_CACHE", "HF_HUB_CACHE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    return tmp_path / "out"


@pytest.mark.parametrize("device", ["gpu", "cuda:99"])
def test_a_device_that_is_not_here_is_one_line_before_anything_is_made(
    out: Path, capsys: pytest.CaptureFixture[str], device: str
) -> None:
    words = [word for word in WORDS if word != "--dry-run"]
    assert main([*words, "--out", str(out), "--device", device]) == 2
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.splitlines()) == 1 and device in said.err
    assert not out.exists()


def test_the_device_reaches_every_run_and_the_preflight(out: Path) -> None:
    recipe = load_recipe("opensu3d")
    asked = Asked("embedded", "embedded", device="cuda:99", values={})
    runs = asked_runs(recipe, recipe.experiments, asked)
    assert {run.dataset for run in runs} == {"replica", "scannet"}
    assert any(need.kind == "GPU memory" for need in preflight(runs).needs)
    for run in runs:
        with pytest.raises(Su3dError, match="device 'cuda:99'"):
            plan_of(run, out)
