"""Whether compiled code can be cached, and sizes as text."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from su3d_bench.core.digests import PACKAGE_ROOT
from su3d_bench.core.errors import shown

MEGABYTE, GIGABYTE = 10**6, 10**9
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


def size_text(n_bytes: int) -> str:
    """A size in MB or GB.

    >>> size_text(1_234_567_890), size_text(56_700_000), size_text(1200)
    ('1.2 GB', '56.7 MB', '0.0 MB')
    """
    return f"{n_bytes / GIGABYTE:.1f} GB" if n_bytes >= GIGABYTE else f"{n_bytes / MEGABYTE:.1f} MB"
