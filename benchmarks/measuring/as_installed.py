"""The environment of a measured command: that of an installed program, whatever the current shell has."""

from __future__ import annotations

import os
from pathlib import Path


def as_installed(folder: Path) -> dict[str, str]:
    """An environment that caches Python's compiled modules below ``folder``, as for an installed program.

    The first command in it writes them and must not be measured.
    """
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"PYTHONPYCACHEPREFIX": str(folder)}
