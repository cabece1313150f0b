"""The surroundings of a measured command: those of an installed program, whatever the shell of the measurer has."""

from __future__ import annotations

import os
from pathlib import Path


def as_installed(folder: Path) -> dict[str, str]:
    """The environment with Python's compiled modules kept below ``folder``: an installed program finds them.

    The first command in it writes them, and is not to be measured.
    """
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"PYTHONPYCACHEPREFIX": str(folder)}
