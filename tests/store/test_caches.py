"""If compiled code cannot be cached, a run reports why it is slow and what to do."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from su3d_bench.store import caches
from su3d_bench.store.caches import kernel_folders


def test_unwritable_kernel_cache_gives_a_warning_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    closed = tmp_path / "file" / "numba"
    monkeypatch.setattr(caches, "kernel_folders", lambda: (closed, Path("/dev/null/numba")))
    line = caches.cache_warning()
    assert line is not None and line.startswith(f"compiled code cannot be cached in any of {closed}, /dev/null/numba: ")
    monkeypatch.setattr(caches, "kernel_folders", lambda: (closed, tmp_path))
    assert caches.cache_warning() is None


def test_kernel_folders_match_those_of_numba(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "from su3d_bench.numerics import clusters\n"
        "from numba.core.caching import UserProvidedCacheLocator as given, InTreeCacheLocator as own\n"
        "from numba.core.caching import UserWideCacheLocator as wide\n"
        "print(*(one(lambda: 0, clusters.__file__).get_cache_path() for one in (given, own, wide)), sep='\\n')"
    )
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "told"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "wide"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    numbas = [Path(line) for line in done.stdout.splitlines()]
    result, own, wide = kernel_folders()
    assert (numbas[0].parent, numbas[1], numbas[2].parent) == (result, own, wide)
