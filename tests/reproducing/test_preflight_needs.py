"""What the preflight reports as missing if data are only partly available."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from su3d_bench.cli.main import main
from su3d_bench.reproducing.preflight import Need, preflight
from su3d_bench.reproducing.recipe import RecipeRequest, asked_runs, load_recipe

ROOM = ["--set", "n_frames=8", "width=64", "height=48", "mesh_spacing_m=0.2"]


def missing_meshes(methods: tuple[str, ...]) -> list[Need]:
    asked = RecipeRequest("embedded", "embedded", scenes={"replica": ("replica/bedroom0",)}, values={})
    (run,) = asked_runs(load_recipe("openmask3d"), load_recipe("openmask3d").chosen(["replica"]), asked)
    return [need for need in preflight([replace(run, methods=methods)], Path("none")).needs if need.kind == "mesh"]


def test_size_of_missing_data_includes_files_of_all_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path))
    assert main(["reproduce", "sam3d", "--profile", "embedded", "--encoder", "embedded", "--dry-run"]) == 1
    text = capsys.readouterr().out
    assert "replica-meshes" in text and "33,859,047,808" in text
    assert "9 requirements missing, about 46.30 GB to fetch" in text  # 12.44 GB of frames, 33.86 GB of meshes


def test_missing_scan_mesh_is_reported_for_methods_that_require_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    words = ["--layout", "replica", "--scenes", "bedroom0", *ROOM, "--jobs", "1", "--quiet"]
    assert main(["datasets", "make", "rooms", *words, "--out", str(tmp_path / "data")]) == 0
    both = ("openmask3d", "sam3d", "conceptgraphs")
    assert missing_meshes(both) == []
    (tmp_path / "data/Replica/bedroom0_mesh.ply").unlink()
    (need,) = missing_meshes((*both, "sam3d@ensemble"))
    assert need.is_required and not need.is_available and need.how == "su3d-bench datasets fetch replica"
    assert need.name == "replica/bedroom0: the scan's mesh"
    assert "bedroom0_mesh.ply is missing" in need.remark
    assert need.remark.endswith("required by openmask3d, sam3d@ensemble")
    assert missing_meshes(("sam3d", "conceptgraphs")) == []
