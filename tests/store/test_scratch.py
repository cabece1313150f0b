"""Scratch space: what was put in comes out, in memory or on disk, and a full disk is said."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from su3d_bench.core.files.atomic import Scratch


@pytest.mark.parametrize("most_in_memory_bytes", [1 << 20, 1])
def test_rows_come_out_as_they_were_put_in(most_in_memory_bytes: int) -> None:
    scratch = Scratch(most_in_memory_bytes)
    generator = np.random.default_rng(0)
    arrays: list[NDArray[Any]] = [
        generator.normal(size=(5, 7)),
        np.arange(9, dtype=np.int32),
        np.empty((0, 3)),
        np.arange(12.0)[::2],
    ]
    stored = [scratch.put(array) for array in arrays]
    for array, one in zip(arrays, stored, strict=True):
        everything = one.rows(0, len(array))
        assert everything.dtype == array.dtype
        np.testing.assert_array_equal(everything, array)
    np.testing.assert_array_equal(stored[0].rows(2, 4), arrays[0][2:4])
    with pytest.raises(IndexError, match="rows 4 to 6 of 5"):
        stored[0].rows(4, 6)
    scratch.close()


def _open_files(folder: Path) -> list[str]:
    """This process's open files that lay in ``folder``, nameless ones too."""
    links = (os.path.realpath(link) for link in Path("/proc/self/fd").iterdir())
    return [link for link in links if link.startswith(str(folder))]


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are listed on Linux alone")
def test_what_is_much_lies_on_disk_under_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    scratch = Scratch(1000)
    scratch.put(np.zeros(100))
    assert list(_open_files(tmp_path)) == []
    scratch.put(np.zeros(100))
    assert len(_open_files(tmp_path)) == 1
    assert list(tmp_path.iterdir()) == []
    scratch.close()
