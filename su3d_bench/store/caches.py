"""What is kept to be quick: what the cache folder holds, by kind, and whether compiled code can be kept at all."""

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
from su3d_bench.core.files.locks import is_locked

MEGABYTE, GIGABYTE = 10**6, 10**9
_HEX = "[0-9a-f]"
SMALL_BYTES = 1 << 16  # a kept kernel has about as many: a full disk takes none


def kernel_folders() -> tuple[Path, ...]:
    """Where Numba keeps kernels, in the order in which it tries: where it is told, beside the code, for the user.

    As numba.core.caching, Numba 0.68, chooses.
    """
    told = os.environ.get("NUMBA_CACHE_DIR")
    own = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "numba").expanduser()
    return (*([Path(told)] if told else []), PACKAGE_ROOT / "numerics" / "__pycache__", own)


def cache_warning() -> str | None:
    """A line that says that no kernel can be kept, and what to do; None where one can."""
    folders = kernel_folders()
    if any(map(_takes_files, folders)):
        return None
    tried = ", ".join(map(shown, folders))
    return (
        f"compiled code cannot be kept in any of {tried}: every scene compiles it again, which takes longer than "
        "many a scene; set NUMBA_CACHE_DIR to a folder that can be written"
    )


def _takes_files(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(SMALL_BYTES))
            file.flush()
    except (OSError, RuntimeError):  # of a home that nobody knows
        return False
    return True


@dataclass(frozen=True)
class CacheKind:
    """One kind of what the cache folder keeps: the folder's name, the form of a file's path in it, and what it is.

    ``form`` is a regular expression. ``is_paid``: it is not computed again but asked for anew, which may cost money.
    """

    name: str
    form: str
    what: str
    is_paid: bool = False


_PERCEPTION = f"{_HEX}{{2}}/{_HEX}{{64}}\\.npz"
_RUN = f"[^/]*-{_HEX}{{8}}/(run\\.toml|[a-z]+\\.json|(scenes|language)/.+|\\.lock)"
_REPLY = f"(images/)?{_HEX}+\\.(json|png)"
_KINDS = (
    CacheKind("perception", _PERCEPTION, "what was found in frames: runs over the same frames are many times as fast"),
    CacheKind("model-digests", f"{_HEX}{{32}}\\.json", "digests of weights, which take seconds a gigabyte"),
    CacheKind("runs", _RUN, "the small files of runs that are kept in a store such as s3://"),
    CacheKind("replies", _REPLY, "replies of language models outside a run, which may have cost money", is_paid=True),
)
KINDS = {kind.name: kind for kind in _KINDS}


@dataclass(frozen=True)
class CacheEntry:
    """A file of a kind: its path below the kind's folder, its size, and when it was written (seconds since 1970)."""

    name: str
    n_bytes: int
    written: float


def cache_entries(root: Path, kind: CacheKind) -> Iterator[CacheEntry]:
    """The files of ``kind`` below ``root``; what has another form, and what is behind a link, is passed over."""
    top = root / kind.name
    for place, folders, names in () if top.is_symlink() else os.walk(top):
        folders.sort()
        for path in (Path(place, name) for name in sorted(names)):
            name = path.relative_to(top).as_posix()
            with suppress(FileNotFoundError):  # gone meanwhile
                status = path.lstat()
                if stat.S_ISREG(status.st_mode) and re.fullmatch(kind.form, name):
                    yield CacheEntry(name, status.st_size, status.st_mtime)


def clear_cache(root: Path, kind: CacheKind, *, before: float = math.inf) -> tuple[int, int]:
    """Remove the files of ``kind`` that were written before a time; how many, and their bytes.

    Folders stay, for a run may be about to write there; so does what a living process holds.
    """
    top, held = root / kind.name, dict[str, bool]()
    n_files = n_bytes = 0
    for entry in cache_entries(root, kind):
        run = entry.name.partition("/")[0]
        if kind.name == "runs" and run not in held:
            held[run] = is_locked(top / run)
        if entry.written >= before or held.get(run, False):
            continue
        remove_file(top / entry.name)
        n_files, n_bytes = n_files + 1, n_bytes + entry.n_bytes
    return n_files, n_bytes


def size_text(n_bytes: int) -> str:
    """A size as people say it.

    >>> size_text(1_234_567_890), size_text(56_700_000), size_text(1200)
    ('1.2 GB', '56.7 MB', '0.0 MB')
    """
    return f"{n_bytes / GIGABYTE:.1f} GB" if n_bytes >= GIGABYTE else f"{n_bytes / MEGABYTE:.1f} MB"
