from __future__ import annotations

import json
from pathlib import Path

import pytest

from su3d_bench.cli.doctor import checks, libraries
from su3d_bench.cli.doctor.libraries import Loaded
from su3d_bench.cli.main import main

WHOLE = {
    "": Loaded({"missing": []}),
    "open3d": Loaded(),
    "numba": Loaded(),
    "opencv-python-headless": Loaded(),
    "onnxruntime": Loaded({"providers": ["CUDAExecutionProvider", "CPUExecutionProvider"]}),
    "torch": Loaded({"cuda": "12.8", "gpus": ["NVIDIA H200, 150 GB"]}),
}


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Loaded]:
    """What comes of loading libraries, in place of loading them."""
    for name in ("SU3D_DATA", "SU3D_CACHE", "SU3D_MODELS", "TMPDIR"):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.chdir(tmp_path)
    found = dict(WHOLE)
    monkeypatch.setattr(checks, "loaded", lambda packages: found)
    return found


def lines(capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    rows = [
        line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines() if line.startswith(("ok", "no", "mi"))
    ]
    return {row[1]: f"{row[0]} {row[2]}" for row in rows}


def test_a_whole_machine_passes(machine: dict[str, Loaded], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dev", "doctor"]) == 0
    text = capsys.readouterr().out
    assert text.endswith("\nthe main job can run\n")
    assert "GPU by torch            NVIDIA H200, 150 GB" in text
    assert "computes by CUDA, CPU" in text
    assert main(["dev", "doctor"]) == 0
    found = lines(capsys)
    assert found["cache"].startswith(f"ok {tmp_path}/SU3D_CACHE: ")
    assert found["runs"].startswith(f"ok {tmp_path}/runs (to be made)")
    assert found["models"].startswith("note 0 of ")
    assert main(["dev", "doctor", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["can_run"] is True
    assert {"Python", "open3d", "cache", "dataset rooms", "cores", "terminal"} <= {
        one["what"] for one in value["checks"]
    }
    assert not (tmp_path / "runs").exists(), "looking leaves nothing behind"
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".su3d-doctor-")]


def test_a_missing_system_library_is_named_with_its_package(
    machine: dict[str, Loaded], capsys: pytest.CaptureFixture[str]
) -> None:
    fault = "OSError: libGL.so.1: cannot open shared object file: No such file or directory"
    machine |= {"": Loaded({"missing": ["libGL.so.1"]}), "open3d": Loaded(fault=fault)}
    assert main(["dev", "doctor"]) == 1
    text = capsys.readouterr().out
    assert "missing  libGL.so.1" in text
    assert "apt-get install libgl1" in text
    assert f"cannot be loaded: {fault}" in text
    assert text.endswith("the main job cannot run: 2 things missing\n")
    machine |= {"open3d": Loaded()}
    assert main(["dev", "doctor"]) == 0
    assert lines(capsys)["libGL.so.1"].startswith("note ")


def test_what_only_an_extra_needs_is_no_fault(
    machine: dict[str, Loaded], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(checks, "requirements", lambda: {"numpy": "", "no-such-package": "models"})
    assert main(["dev", "doctor"]) == 0
    assert lines(capsys)["no-such-package"].endswith("pip install 'su3d-bench[models]'")
    monkeypatch.setattr(checks, "requirements", lambda: {"no-such-package": ""})
    assert main(["dev", "doctor"]) == 1


def test_a_folder_that_cannot_be_written_is_missing(
    machine: dict[str, Loaded], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "file" / "cache"))
    assert main(["dev", "doctor"]) == 1
    assert "cannot be written" in lines(capsys)["cache"]


def test_a_library_that_ends_its_process_ends_no_more_than_that(monkeypatch: pytest.MonkeyPatch) -> None:
    codes = {
        "open3d": "import os; os.kill(os.getpid(), 11)",
        "numba": "import no_such_module",
        "torch": "print('words of its own'); found = {'gpus': []}",
        "onnxruntime": "found = {'x' * 10: [1]}; import sys; sys.exit(3)",
    }
    monkeypatch.setattr(libraries, "LOADED", codes)
    monkeypatch.setattr(libraries, "SYSTEM_CODE", "import signal; signal.pause()")
    monkeypatch.setattr(libraries, "PATIENCE_S", 3.0)
    found = libraries.loaded(list(codes))
    assert found["open3d"].fault == "ended by signal 11 while it was loaded"
    assert found["numba"].fault == "ModuleNotFoundError: No module named 'no_such_module'"
    assert found["torch"] == Loaded({"gpus": []})
    assert found["onnxruntime"].fault
    assert found[""].fault == "took longer than 3 s to load"


def test_every_package_of_the_core_and_its_extras_is_looked_at() -> None:
    wanted = libraries.requirements()
    assert {"numpy", "open3d", "onnxruntime"} <= {name for name, extra in wanted.items() if not extra}
    assert wanted["torch"] == "models"
    assert set(libraries.LOADED) <= set(wanted)
