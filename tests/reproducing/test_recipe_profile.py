"""Profile and device of a recipe are used in every run and checked before anything is written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_models import write_fetched
from written_scenes import made_in_layout

from su3d_bench.cli.main import main
from su3d_bench.core.errors import Su3dError
from su3d_bench.reproducing.recipe import RecipeRequest, asked_runs, load_recipe, plan_of

ROOM = ["n_frames=8", "width=64", "height=48", "mesh_spacing_m=0.2"]


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("SU3D_DATA", "SU3D_MODELS", "SU3D_CACHE", "HF_HUB_CACHE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    return tmp_path / "out"


@pytest.mark.proof
def test_profile_paper_runs_end_to_end_with_tiny_networks(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SU3D_MODELS", str(write_fetched(tmp_path / "models")))
    scene = made_in_layout("replica", tmp_path / "data", *ROOM)
    words = ["reproduce", "opensu3d", "--tables", "III", "--profile", "paper", "--jobs", "1", "--quiet"]
    assert main([*words, "--data", str(tmp_path / "data"), "--scenes", scene, "--out", str(out)]) == 0
    cells = json.loads((out / "compared.json").read_text())["cells"]
    assert cells and all(cell["measured"] is not None for cell in cells)
    runs = [json.loads(path.read_text()) for path in out.glob("runs/*/run.json")]
    assert {one["encoder"] for one in runs} >= {"ViT-L-14-336/openai"}


def test_device_is_passed_to_every_run(out: Path) -> None:
    recipe = load_recipe("opensu3d")
    asked = RecipeRequest("embedded", "embedded", device="cuda:99", values={})
    runs = asked_runs(recipe, recipe.experiments, asked)
    assert {run.dataset for run in runs} == {"replica", "scannet"}
    for run in runs:
        with pytest.raises(Su3dError, match="device 'cuda:99'"):
            plan_of(run, out)
