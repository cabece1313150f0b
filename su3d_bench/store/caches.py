"""Whether what is compiled can be kept: where it cannot, every process compiles it again."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from su3d_bench.core.digests import PACKAGE_ROOT
from su3d_bench.core.errors import shown

SMALL_BYTES = 1 << 16  # a kept kernel has about as many: a full disk takes none


def kernel_folders() -> tuple[Path, ...]:
    """Where Numba keeps kernels, in the order in which it tries: where it is told, beside the code, for the user.

    As numba.core.caching, Numba 0.68, chooses.
    """
    told = os.environ.get("NUMBA_CACHE_DIR")
    own = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "numba").expanduser()
    return (*([Path(told)] if told else []), PACKAGE_ROOT / "numerics" / "__pycache__", own)


def why_slow() -> str | None:
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
