"""What is being written: one form of name, held by a lock that ends with its writer, so that others can clear the rest.

While ``page.html`` is written it lies beside its place as ``.page.html.<12 hexadecimal digits>.unfinished``; so does a
folder. Whoever makes a folder ready to write into (``make_folder``) removes what bears such a name there and is held
by nobody. Other names, links and what a living process holds are left alone, and so is everything on a disk without
locks. (``filelock`` 4.2 leaves a lock file in every folder, and without flock(2) its lock outlives its process.)
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
MAX_NAME_BYTES = 200  # of the name that is written; with the rest it stays within the 255 of common disks
LOCK_FILE = ".lock"
# What a lock on a folder itself gets from network disks, which lock files that are open for writing only: flock(2).
NO_FOLDER_LOCKS = (errno.EBADF, errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)
NO_LOCKS = (*NO_FOLDER_LOCKS, errno.ENOLCK)


def is_unfinished(name: str) -> bool:
    """Whether a file or folder of this name is one that was being written.

    >>> is_unfinished(".page.html.0123456789ab.unfinished"), is_unfinished(".notes.tmp")
    (True, False)
    """
    return FORM.fullmatch(name) is not None


def temporary_path(path: Path) -> Path:
    """Where ``path`` lies while it is written: another place at each call."""
    start = os.fsencode(path.name)[:MAX_NAME_BYTES].decode(errors="ignore")
    return path.with_name(f".{start}.{secrets.token_hex(6)}.unfinished")


def new_file(path: Path) -> tuple[Path, int]:
    """An unfinished file for ``path``: its place, and the file open for writing, which holds the lock."""
    while True:  # another process may clear the file in the moment between its making and its lock
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
    """An open file that holds the lock of ``folder`` until it is closed; one of ``LOCK_FILE`` where folders have none.

    Raises ``BlockingIOError`` where another process has it, unless this one ``waits``.
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
    """Whether a living process holds the lock of ``folder``; nothing is written to find out."""
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
    """A folder in which ``path`` is written, gone at the end of the block unless it was renamed by then."""

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
    """A folder that ``make`` made, and an open file that holds its lock; None on a disk without locks."""
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
    """Give the whole folder at ``place`` the name ``path`` once all of it is on the disk."""
    for above, _, names in os.walk(place, topdown=False):
        for name in names:
            sync_to_disk(Path(above, name))
        with suppress(OSError):  # not every disk brings folders to itself by request
            sync_to_disk(Path(above))
    os.replace(place, path)
    (path / LOCK_FILE).unlink(missing_ok=True)


def sync_to_disk(path: Path) -> None:
    """Wait until what was written into the file or folder ``path`` is on its disk."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def clear_unfinished(folder: Path) -> None:
    """Remove what killed processes left unfinished in ``folder``."""
    with suppress(OSError):  # what cannot be cleared is no fault of what is written next
        for name in filter(is_unfinished, os.listdir(folder)):
            with suppress(OSError):  # held, gone meanwhile, somebody else's, or on a disk without locks
                remove_unheld(folder / name)


def remove_unheld(place: Path) -> None:
    """Remove a file or folder; raises ``OSError`` where a living process holds it, or where nobody can tell."""
    mode = place.lstat().st_mode
    if stat.S_ISDIR(mode):
        handle = hold_folder(place)
        shutil.rmtree(place, ignore_errors=True)
        os.close(handle)
    elif stat.S_ISREG(mode):
        handle = _locked(os.open(place, os.O_RDWR | os.O_NOFOLLOW))
        place.unlink()
        os.close(handle)
