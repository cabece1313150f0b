"""Unfinished files: their names, their locks, and the removal of those of killed processes."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import PIPE

import pytest
from hypothesis import given
from hypothesis import strategies as st

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import make_folder, replacing, write_text
from su3d_bench.core.files.locks import clear_unfinished, is_unfinished, unfinished_folder
from su3d_bench.store.run_folder import RunFolder, folder_of_scene, scene_of_folder

LEFT = ".page.html.0123456789ab.unfinished"
WRITERS = {
    "a file": "with replacing(place / 'page.html') as stream:\n stream.write(b'half'); stream.flush(); wait()",
    "a shared file": "with filling(place / 'entry.npz') as stream:\n stream.write(b'half'); stream.flush(); wait()",
    "a folder": "with whole_folder(place / 'x') as folder:\n (folder / 'half').write_text('x'); wait()",
}


@contextmanager
def writer(kind: str, place: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that is writing."""
    code = (
        "import sys; from pathlib import Path\nfrom su3d_bench.core.files.atomic import filling, replacing\n"
        "from su3d_bench.predictions.export import whole_folder\nplace = Path(sys.argv[1])\n"
        f"def wait():\n print('writing', flush=True); sys.stdin.read()\n{WRITERS[kind]}"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(place)], stdin=PIPE, stdout=PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "writing\n"
        try:
            yield process
        finally:
            process.kill()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("kind", WRITERS)
def test_next_writer_removes_unfinished_files_of_killed_but_not_of_running_processes(kind: str, tmp_path: Path) -> None:
    with writer(kind, tmp_path) as process:
        (left,) = names(tmp_path)
        assert is_unfinished(left)
        make_folder(tmp_path)
        assert names(tmp_path) == [left], "its writer is running"
        process.kill()
        process.wait()
        assert names(tmp_path) == [left]
        make_folder(tmp_path)
        assert names(tmp_path) == []


def test_only_unfinished_files_of_the_program_are_removed(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("kept")
    for name in (".notes.tmp", ".page.html.123.tmp", ".x.unfinished", "page.html.0123456789ab.unfinished"):
        (tmp_path / name).write_text("of another program")
    (tmp_path / ".link.0123456789ab.unfinished").symlink_to(tmp_path / "kept")
    os.mkfifo(tmp_path / ".pipe.0123456789ab.unfinished")
    before = names(tmp_path)
    (tmp_path / LEFT).write_text("half")
    (tmp_path / ".x.0123456789ab.unfinished").mkdir()
    clear_unfinished(tmp_path)
    assert names(tmp_path) == before


def test_disk_without_locks_is_written_but_never_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def without_locks(handle: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", without_locks)
    (tmp_path / LEFT).write_text("half, or still being written")
    write_text(tmp_path / "page.html", "whole")
    with unfinished_folder(tmp_path / "x") as folder:
        assert folder.is_dir()
    make_folder(tmp_path)
    assert names(tmp_path) == [LEFT, "page.html"]


def test_lock_file_replaces_the_folder_lock_if_folders_cannot_be_locked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = fcntl.flock

    def of_files_alone(handle: int, operation: int) -> None:
        if os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(errno.EBADF, "Bad file descriptor")
        lock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", of_files_alone)
    with unfinished_folder(tmp_path / "x") as folder:
        clear_unfinished(tmp_path)
        assert folder.is_dir()
    with (
        RunFolder(tmp_path / "run").locked(),
        pytest.raises(StoreError, match="another run is writing here; wait for it"),
        RunFolder(tmp_path / "run").locked(),
    ):
        pass
    shutil.rmtree(tmp_path / "run")
    (tmp_path / ".x.0123456789ab.unfinished").mkdir()
    clear_unfinished(tmp_path)
    assert names(tmp_path) == []


@pytest.mark.parametrize("name", ["x" * 240, "\N{GREEK SMALL LETTER ALPHA}" * 120])
def test_longest_file_names_can_be_written(name: str, tmp_path: Path) -> None:
    with replacing(tmp_path / name) as stream:
        (place,) = tmp_path.iterdir()
        assert is_unfinished(place.name)
        stream.write(b"whole")
    assert names(tmp_path) == [name]


ADDRESSES = st.tuples(
    st.text("ab._%/-", min_size=1).filter(lambda text: "/" not in text), st.text("ab._%/-", min_size=1)
).map("/".join)


@given(ADDRESSES)
def test_scene_address_is_recovered_from_its_folder_name(address: str) -> None:
    name = folder_of_scene(address)
    assert "/" not in name
    assert scene_of_folder(name) == address


@pytest.mark.parametrize("part", ["scenes", "scenes/rooms.a", "scenes/rooms.a/m", "scenes/rooms.a/m/pictures"])
def test_job_files_are_never_written_through_a_link(part: str, tmp_path: Path) -> None:
    job = RunFolder(tmp_path / "run").job("rooms/a", "m")
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "run" / part
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path / "elsewhere")
    for write in (job.prepare, lambda: job.picture("query-x.png")):
        with pytest.raises(StoreError, match=f"{link}: is a link, but a run writes only to its own folders"):
            write()
    assert not list((tmp_path / "elsewhere").iterdir())
