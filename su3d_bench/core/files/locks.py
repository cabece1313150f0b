"""What is being written: one form of name, held by a lock that ends with its writer, so that others can clear the rest.

While ``page.html`` is written it lies beside its place as ``.page.html.<12 hexadecimal digits>.unfinished``; so does a
folder. Whoever makes a folder ready to write into (``make_folder``) removes what bears such a name there and is held
by nobody. Other names, links and what a living process holds are left alone, and so is everything on a disk without
locks, which cannot tell the living from the dead.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

FORM = re.compile(r"\..*\.[0-9a-f]{12}\.unfinished", re.DOTALL)
SHARED = "0" * 12  # in the name of what several processes would write alike, so that they meet
MOST_NAME_BYTES = 200  # of the name that is written; with the rest it stays within the 255 of common disks
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


def beside(path: Path, token: str | None = None) -> Path:
    """Where ``path`` lies while it is written: another place at each call, unless a ``token`` is given."""
    start = os.fsencode(path.name)[:MOST_NAME_BYTES].decode(errors="ignore")
    return path.with_name(f".{start}.{token or secrets.token_hex(6)}.unfinished")


def new_file(path: Path) -> tuple[Path, int]:
    """An unfinished file for ``path``: its place, and the file open for writing, which holds the lock."""
    while True:  # another process may clear the file in the moment between its making and its lock
        place = beside(path)
        handle = own_file(place, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        if handle is not None:
            return place, handle


def own_file(place: Path, flags: int, *, is_sure: bool = False) -> int | None:
    """The file at ``place``, open with its lock; None where another process has it, or has taken it away.

    On a disk without locks it is ours unless we must be ``is_sure``.
    """
    handle = os.open(place, flags | os.O_NOFOLLOW, 0o666)
    try:
        is_ours = _take(handle)
        if (is_ours or (is_ours is None and not is_sure)) and os.path.samestat(os.fstat(handle), place.lstat()):
            return handle
    except FileNotFoundError:
        pass
    except BaseException:
        os.close(handle)
        raise
    os.close(handle)
    return None


def _take(handle: int) -> bool | None:
    """Whether the lock of an open file is ours now; None where its disk has none."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return None
    return True


def hold_folder(folder: Path, *, waits: bool = False) -> int:
    """An open file that holds the lock of ``folder`` until it is closed; one of ``LOCK_FILE`` where folders have none.

    Raises ``BlockingIOError`` where another process has it, unless this one ``waits``.
    """
    operation = fcntl.LOCK_EX if waits else fcntl.LOCK_EX | fcntl.LOCK_NB
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, operation)
        return handle
    except OSError as error:
        os.close(handle)
        if error.errno not in NO_FOLDER_LOCKS:
            raise
    handle = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        fcntl.flock(handle, operation)
    except OSError:
        os.close(handle)
        raise
    return handle


def is_held(folder: Path) -> bool:
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
    place, handle = held_folder(partial(_made_beside, path))
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
        if handle is not None:
            os.close(handle)


def _made_beside(path: Path) -> Path:
    place = beside(path)
    place.mkdir()
    return place


def held_folder(make: Callable[[], Path]) -> tuple[Path, int | None]:
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


def become(place: Path, path: Path) -> None:
    """Give the whole folder at ``place`` the name ``path`` once all of it is on the disk."""
    for above, _, names in os.walk(place, topdown=False):
        for name in names:
            bring_to_disk(Path(above, name))
        with suppress(OSError):  # not every disk brings folders to itself by request
            bring_to_disk(Path(above))
    os.replace(place, path)
    (path / LOCK_FILE).unlink(missing_ok=True)


def bring_to_disk(path: Path) -> None:
    """Wait until what was written into the file or folder ``path`` is on its disk."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def clear_unfinished(folder: Path) -> None:
    """Remove what killed processes left unfinished in ``folder``."""
    with suppress(OSError):  # what cannot be cleared is no fault of what is written next
        with os.scandir(folder) as entries:
            left = [entry for entry in entries if is_unfinished(entry.name)]
        for entry in left:
            _remove_abandoned(entry)


def remove_unheld(folder: Path) -> None:
    """Remove a folder; raises ``OSError`` where a living process holds it, or where nobody can tell."""
    handle = hold_folder(folder)
    try:
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(handle)


def _remove_abandoned(entry: os.DirEntry[str]) -> None:
    with suppress(OSError):  # held, gone meanwhile, somebody else's, or on a disk without locks
        if entry.is_dir(follow_symlinks=False):
            remove_unheld(Path(entry))
        elif entry.is_file(follow_symlinks=False):
            held = own_file(Path(entry), os.O_RDWR, is_sure=True)
            if held is not None:
                os.unlink(entry)
                os.close(held)
