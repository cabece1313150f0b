"""What the preflight reports as missing if data are only partly available."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from su3d_bench.cli.main import main
from su3d_bench.perception import profiles
from su3d_bench.perception.models.loading import provider_for
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


@pytest.mark.parametrize(
    ("profile", "memory_gb", "expected"),
    [
        ("paper", [24], 2),  # two processes fit, a third would only wait
        ("paper", [140], 2),
        ("paper", [12], 1),
        ("paper", [4], 1),
        ("paper", [24, 12], 3),
        ("paper", [], 16),  # CPU
        ("embedded", [24], 16),
    ],
)
def test_parallel_jobs_depend_on_number_and_memory_of_gpus(
    profile: str, memory_gb: list[int], expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 16)
    monkeypatch.setattr(profiles, "gpu_memory_bytes", lambda device: [10**9 * each for each in memory_gb])
    assert profiles.default_jobs(profile, profiles.PerceptionConfig()) == expected


def test_exported_models_use_the_gpu_if_onnxruntime_can(monkeypatch: pytest.MonkeyPatch) -> None:
    for known, expected in ((["CUDAExecutionProvider"], ("cuda", 1)), ([], ("cpu", 0))):
        monkeypatch.setattr("onnxruntime.get_available_providers", lambda known=known: [*known, "CPUExecutionProvider"])
        assert provider_for("cuda:1") == expected
        assert provider_for("cpu") == ("cpu", 0)


def test_missing_ram_plus_states_its_replacement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SU3D_DATA", "SU3D_MODELS", "HF_HUB_CACHE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    recipe = load_recipe("opensu3d")
    runs = asked_runs(recipe, recipe.chosen(["II"]), RecipeRequest(values={}))
    (need,) = [need for need in preflight(runs, tmp_path).needs if need.name == "ram-plus"]
    assert not need.is_required and need.remark == "replaced by the 20 most likely words of a list, by the encoder"
    assert need.how == "su3d-bench models fetch --profile paper, then tools/export_onnx.py ram-plus"


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
