"""The commands ``su3d-bench dev doctor`` and ``dev completion``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from su3d_bench.cli import doctor
from su3d_bench.cli.main import main


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[dict[str, Any], str]]:
    """Stub results of loading libraries."""
    for name in ("SU3D_DATA", "SU3D_CACHE", "SU3D_MODELS", "TMPDIR"):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.chdir(tmp_path)
    found: dict[str, tuple[dict[str, Any], str]] = {"torch": ({"cuda": "12.8", "gpus": ["NVIDIA H200"]}, "")}
    monkeypatch.setattr(doctor, "loaded", lambda package: found.get(package, ({}, "")))
    return found


def test_doctor_passes_on_a_complete_machine_and_leaves_no_files(
    machine: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["dev", "doctor", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    checks = {one["what"]: one for one in value["checks"]}
    assert value["can_run"] is True
    assert {"Python", "open3d", "cache", "dataset rooms", "cores", "memory"} <= checks.keys()
    assert "NVIDIA H200" in checks["torch"]["found"]
    assert checks["dataset replica"]["state"] == "note"
    assert not (tmp_path / "runs").exists()
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".su3d-doctor-")]


def test_unloadable_library_or_unwritable_folder_is_missing(
    machine: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    machine["open3d"] = {}, "OSError: libGL.so.1: cannot open shared object file"
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "file" / "cache"))
    assert main(["dev", "doctor", "--json"]) == 1
    missing = {one["what"] for one in json.loads(capsys.readouterr().out)["checks"] if one["state"] == "missing"}
    assert missing == {"open3d", "cache"}


def test_library_that_crashes_does_not_crash_the_doctor(monkeypatch: pytest.MonkeyPatch) -> None:
    codes = {
        "open3d": "import os; os.kill(os.getpid(), 11)",
        "numba": "import no_such_module",
        "torch": "print('unrelated output'); found = {'gpus': []}",
    }
    monkeypatch.setattr(doctor, "LOADED", codes)
    assert doctor.loaded("open3d") == ({}, "ended by signal 11 while it was loaded")
    assert doctor.loaded("numba")[1] == "ModuleNotFoundError: No module named 'no_such_module'"
    assert doctor.loaded("torch") == ({"gpus": []}, "")
