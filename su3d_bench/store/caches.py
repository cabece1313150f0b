"""The cache: the content of the cache folder by kind, and whether compiled code can be cached."""

from __future__ import annotations

import math
import os
import re
import stat
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.digests import PACKAGE_ROOT
from su3d_bench.core.errors import shown
from su3d_bench.core.files.atomic import remove_file

MEGABYTE, GIGABYTE = 10**6, 10**9
_HEX = "[0-9a-f]"
SMALL_BYTES = 1 << 16  # about the size of a cached kernel: fails on a full disk


def kernel_folders() -> tuple[Path, ...]:
    """The folders in which Numba caches kernels, in the order tried: NUMBA_CACHE_DIR, with the code, the user's cache.

    As in numba.core.caching, Numba 0.68.
    """
    configured = os.environ.get("NUMBA_CACHE_DIR")
    own = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "numba").expanduser()
    return (*([Path(configured)] if configured else []), PACKAGE_ROOT / "numerics" / "__pycache__", own)


def cache_warning() -> str | None:
    """A warning that no kernel can be cached, with the remedy; None if one can."""
    folders = kernel_folders()
    if any(map(_takes_files, folders)):
        return None
    tried = ", ".join(map(shown, folders))
    return (
        f"compiled code cannot be cached in any of {tried}: every scene compiles it again, which can take longer "
        "than the scene itself; set NUMBA_CACHE_DIR to a writable folder"
    )


def _takes_files(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(SMALL_BYTES))
            file.flush()
    except (OSError, RuntimeError):  # RuntimeError: unknown home folder
        return False
    return True


@dataclass(frozen=True)
class CacheKind:
    """One kind of cache content: the folder's name, the form of a file's path in it, and a description.

    ``form`` is a regular expression. ``is_paid``: it is not recomputed but requested again, which may cost money.
    """

    name: str
    form: str
    what: str
    is_paid: bool = False


_PERCEPTION = f"{_HEX}{{2}}/{_HEX}{{64}}\\.npz"
_REPLY = f"(images/)?{_HEX}+\\.(json|png)"
_KINDS = (
    CacheKind("perception", _PERCEPTION, "detections in frames: further runs on the same frames are many times faster"),
    CacheKind("model-digests", f"{_HEX}{{32}}\\.json", "digests of weights, which take seconds per gigabyte"),
    CacheKind("replies", _REPLY, "replies of language models outside a run, which may have cost money", is_paid=True),
)
KINDS = {kind.name: kind for kind in _KINDS}


@dataclass(frozen=True)
class CacheEntry:
    """A cached file: its path below the kind's folder, its size, and its modification time (seconds since 1970)."""

    name: str
    n_bytes: int
    written: float


def cache_entries(root: Path, kind: CacheKind) -> Iterator[CacheEntry]:
    """The files of ``kind`` below ``root``; files with another form of name and links are ignored."""
    top = root / kind.name
    for place, folders, names in () if top.is_symlink() else os.walk(top):
        folders.sort()
        for path in (Path(place, name) for name in sorted(names)):
            name = path.relative_to(top).as_posix()
            with suppress(FileNotFoundError):  # removed meanwhile
                status = path.lstat()
                if stat.S_ISREG(status.st_mode) and re.fullmatch(kind.form, name):
                    yield CacheEntry(name, status.st_size, status.st_mtime)


def clear_cache(root: Path, kind: CacheKind, *, before: float = math.inf) -> tuple[int, int]:
    """Remove the files of ``kind`` written before a time; returns their number and bytes.

    Folders stay, because a run may be about to write there.
    """
    old = [entry for entry in cache_entries(root, kind) if entry.written < before]
    for entry in old:
        remove_file(root / kind.name / entry.name)
    return len(old), sum(entry.n_bytes for entry in old)


def size_text(n_bytes: int) -> str:
    """A size in MB or GB.

    >>> size_text(1_234_567_890), size_text(56_700_000), size_text(1200)
    ('1.2 GB', '56.7 MB', '0.0 MB')
    """
    return f"{n_bytes / GIGABYTE:.1f} GB" if n_bytes >= GIGABYTE else f"{n_bytes / MEGABYTE:.1f} MB"
