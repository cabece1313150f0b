"""Where compiled code cannot be kept, a run says why it is slow and what to do."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.runs import scene as scene_run
from su3d_bench.store import caches
from su3d_bench.store.caches import kernel_folders


def test_a_run_whose_kernels_cannot_be_kept_says_so_once_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    (tmp_path / "file").touch()
    closed = tmp_path / "file" / "numba"
    words = ["run", "--scenes", f"{SCENES}/painted.py:Painted/[ab]", "--methods", f"{SCENES}/painted.py:Collector"]
    words += ["--protocols", "rooms-semantic", "--no-pictures", "--jobs", "1", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    assert "compiled code" not in capsys.readouterr().err
    before = (tmp_path / "out" / "run.json").read_bytes()
    monkeypatch.setattr(caches, "kernel_folders", lambda: (closed, Path("/dev/null/numba")))
    assert main(words) == 0
    said = capsys.readouterr().err
    line = (
        f"su3d-bench: compiled code cannot be kept in any of {closed}, /dev/null/numba: every scene compiles it again"
    )
    assert said.count("compiled code") == 1
    assert line in said
    assert "; set NUMBA_CACHE_DIR to a folder that can be written\n" in said
    assert (tmp_path / "out" / "run.json").read_bytes() == before


def test_the_folders_are_those_that_numba_tries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "from su3d_bench.numerics import clusters\n"
        "from numba.core.caching import UserProvidedCacheLocator as told, InTreeCacheLocator as own\n"
        "from numba.core.caching import UserWideCacheLocator as wide\n"
        "print(*(one(lambda: 0, clusters.__file__).get_cache_path() for one in (told, own, wide)), sep='\\n')"
    )
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "told"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "wide"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    numbas = [Path(line) for line in done.stdout.splitlines()]
    told, own, wide = kernel_folders()
    assert (numbas[0].parent, numbas[1], numbas[2].parent) == (told, own, wide)
