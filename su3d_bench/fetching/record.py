"""What was brought into a folder: address, size, SHA-256, and what it was held against, kept beside the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import read_json, write_json

STATE = ".fetched"  # below the folder of models or of data: what is under way, and the record
RECORD = "record.json"


@dataclass(frozen=True)
class Arrived:
    """One file as it came; ``held_against`` names what its content agreed with, empty where nobody states anything."""

    source: str
    name: str
    address: str
    n_bytes: int
    sha256: str
    held_against: tuple[str, ...]


def record_path(root: Path) -> Path:
    return root / STATE / RECORD


def recorded_sha256(root: Path, source: str, name: str) -> str | None:
    """The SHA-256 that the file had when it was first brought below ``root``; None where it never was."""
    entry = _read(root)["files"].get(f"{source}/{name}")
    sha256 = entry.get("sha256") if isinstance(entry, dict) else None
    return sha256 if isinstance(sha256, str) else None


def write_arrival(root: Path, arrived: Arrived) -> None:
    """Keep what is known of a file; the entry of an earlier one of its name is replaced."""
    content = _read(root)
    entry = asdict(arrived)
    if not arrived.held_against:
        entry["remark"] = "the publisher states no checksum: this is that of the first download"
    content["files"][f"{arrived.source}/{arrived.name}"] = entry
    write_json(record_path(root), content)


def unpacked_names(root: Path, source: str) -> tuple[str, ...]:
    """What an archive was unpacked to below its place when it was fetched; nothing where it never was."""
    names = _read(root)["unpacked"].get(source)
    return tuple(name for name in names if isinstance(name, str)) if isinstance(names, list) else ()


def write_unpacked(root: Path, source: str, names: Sequence[str]) -> None:
    """Keep what an archive was unpacked to."""
    content = _read(root)
    content["unpacked"][source] = list(names)
    write_json(record_path(root), content)


def _read(root: Path) -> dict[str, dict[str, Any]]:
    path = record_path(root)
    content = read_json(path) if path.exists() else {"files": {}, "unpacked": {}}
    if not isinstance(content, dict) or not all(isinstance(content.get(key), dict) for key in ("files", "unpacked")):
        raise StoreError(f"{path}: is no record of what was fetched; move it away to begin another")
    return content
