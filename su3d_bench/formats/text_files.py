"""Text and JSON files of others, of bounded size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import DataError
from su3d_bench.formats.images import read_bytes

MAX_TEXT_BYTES = 64 << 20  # a trajectory of 100 poses a second for an hour has 30 MB


def read_text(path: Path, where: str, advice: str = "copy the file again") -> str:
    """The text of a file; ``where`` names it and begins each message."""
    try:
        return read_bytes(path, where, advice, MAX_TEXT_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not a text file, byte {error.start} is not UTF-8; {advice}") from error


def parsed_json(content: bytes | str, where: str) -> Any:
    """What a JSON file holds."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: not JSON ({error}); copy the file again") from error
