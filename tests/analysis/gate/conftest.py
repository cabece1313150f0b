"""The run that the gate's tests start from, and what it taught."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from gated_runs import WORDS, timed
from painted import colour_perception

from su3d_bench.analysis.gate.reference import Reference, learn
from su3d_bench.cli.main import main
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.finished import read_run


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gate") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        assert main([*WORDS, "--out", str(folder)]) == 0
    timed(folder)
    return folder


@pytest.fixture(scope="module")
def reference(made: Path) -> Reference:
    return learn([read_run(made)])


@pytest.fixture(scope="module")
def learnt(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The reference as the command writes it."""
    path = tmp_path_factory.mktemp("gate") / "reference.json"
    assert main(["check", "--learn", str(made), "--out", str(path)]) == 0
    return path


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "run")
    return tmp_path / "run"
