"""Locks on unfinished files and folders: a lock ends with its writer, so that others can remove what was left.

``page.html`` is written in the same folder as ``.page.html.<12 hexadecimal digits>.unfinished``, and likewise a folder.
The next writer in that folder (``make_folder``) removes unlocked files and folders with such names. Other names, links
and whatever a running process has locked stay, and so does everything on a disk without locks. (``filelock`` 4.2 leaves
a lock file in every folder, and without flock(2) its lock outlives its process.)
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FORM = re.compile(r"\..*\.[0-9a-f]{12}\.unfinished", re.DOTALL)
MAX_NAME_BYTES = 200  # of the final name; with the rest it stays within the 255 bytes of common disks
LOCK_FILE = ".lock"
# Errors for a lock on a folder on network disks, which lock only files that are open for writing: flock(2).
NO_FOLDER_LOCKS = (errno.EBADF, errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)
NO_LOCKS = (*NO_FOLDER_LOCKS, errno.ENOLCK)


def is_unfinished(name: str) -> bool:
    """Whether this is the name of an unfinished file or folder.

    >>> is_unfinished(".page.html.0123456789ab.unfinished"), is_unfinished(".notes.tmp")
    (True, False)
    """
    return FORM.fullmatch(name) is not None


def temporary_path(path: Path) -> Path:
    """The temporary place of ``path`` while it is written, unique to each call."""
    start = os.fsencode(path.name)[:MAX_NAME_BYTES].decode(errors="ignore")
    return path.with_name(f".{start}.{secrets.token_hex(6)}.unfinished")


def new_file(path: Path) -> tuple[Path, int]:
    """A new unfinished file for ``path``: its place, and the file descriptor for writing, which holds the lock."""
    while True:  # another process may remove the file between its creation and its lock
        place = temporary_path(path)
        handle = os.open(place, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if place.exists():
                return place, handle
        except BlockingIOError:
            pass
        except OSError as error:
            if error.errno in NO_LOCKS:
                return place, handle
            os.close(handle)
            raise
        os.close(handle)


def hold_folder(folder: Path, *, waits: bool = False) -> int:
    """A file descriptor that locks ``folder`` until it is closed; of ``LOCK_FILE`` if folders cannot be locked.

    Raises ``BlockingIOError`` if another process holds the lock, unless ``waits``.
    """
    operation = fcntl.LOCK_EX if waits else fcntl.LOCK_EX | fcntl.LOCK_NB
    try:
        return _locked(os.open(folder, os.O_RDONLY | os.O_DIRECTORY), operation)
    except OSError as error:
        if error.errno not in NO_FOLDER_LOCKS:
            raise
    return _locked(os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666), operation)


def _locked(handle: int, operation: int = fcntl.LOCK_EX | fcntl.LOCK_NB) -> int:
    try:
        fcntl.flock(handle, operation)
    except BaseException:
        os.close(handle)
        raise
    return handle


def is_locked(folder: Path) -> bool:
    """Whether a running process holds the lock of ``folder``; writes nothing."""
    for place, kind in ((folder, os.O_DIRECTORY), (folder / LOCK_FILE, os.O_NOFOLLOW)):
        try:
            handle = os.open(place, os.O_RDONLY | kind)
        except OSError:
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # a disk without such locks
            continue
        finally:
            os.close(handle)
    return False


@contextmanager
def unfinished_folder(path: Path) -> Iterator[Path]:
    """A temporary folder for writing ``path``, removed at the end of the block unless it was renamed."""

    def made() -> Path:
        place = temporary_path(path)
        place.mkdir()
        return place

    place, handle = locked_folder(made)
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
        if handle is not None:
            os.close(handle)


def locked_folder(make: Callable[[], Path]) -> tuple[Path, int | None]:
    """A folder created by ``make``, and the file descriptor of its lock; None on a disk without locks."""
    while True:  # as in ``new_file``
        place = make()
        try:
            handle = hold_folder(place)
        except (BlockingIOError, FileNotFoundError):
            continue
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            return place, None
        if place.is_dir():
            return place, handle
        os.close(handle)


def publish(place: Path, path: Path) -> None:
    """Rename the finished folder at ``place`` to ``path`` after its content is synced to disk."""
    for above, _, names in os.walk(place, topdown=False):
        for name in names:
            sync_to_disk(Path(above, name))
        with suppress(OSError):  # not every disk can sync folders
            sync_to_disk(Path(above))
    os.replace(place, path)
    (path / LOCK_FILE).unlink(missing_ok=True)


def sync_to_disk(path: Path) -> None:
    """Sync the file or folder ``path`` to disk."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def clear_unfinished(folder: Path) -> None:
    """Remove unfinished files and folders of killed processes from ``folder``."""
    with suppress(OSError):  # a failed removal must not stop the next write
        for name in filter(is_unfinished, os.listdir(folder)):
            with suppress(OSError):  # locked, already removed, of another user, or on a disk without locks
                remove_unheld(folder / name)


def remove_unheld(place: Path) -> None:
    """Remove a file or folder; raises ``OSError`` if a running process has locked it, or may have."""
    mode = place.lstat().st_mode
    if stat.S_ISDIR(mode):
        handle = hold_folder(place)
        shutil.rmtree(place, ignore_errors=True)
        os.close(handle)
    elif stat.S_ISREG(mode):
        handle = _locked(os.open(place, os.O_RDWR | os.O_NOFOLLOW))
        place.unlink()
        os.close(handle)
