"""The marker of scenes that `datasets make` rendered in the layout of another dataset."""

from __future__ import annotations

import json
from pathlib import Path

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_text

MARKER = "rooms.json"  # in the folder of the scenes


def read_marker(folder: Path) -> dict[str, str]:
    """Scene -> content key of the scenes in a folder that ``datasets make`` rendered; empty without a marker."""
    path = folder / MARKER
    if not path.is_file():
        return {}
    try:
        scenes = json.loads(file_text(path))["scenes"]
        return {str(scene): str(key) for scene, key in scenes.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{path}: not the marker that `su3d-bench datasets make` writes ({error}); delete it if the scenes were "
            "not made by it, otherwise make them again"
        ) from error
