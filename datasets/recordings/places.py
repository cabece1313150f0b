"""The folders of a data root in which scenes of a dataset may lie, each met once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path


def folders_in(root: Path, names: Iterable[str]) -> Iterator[tuple[Path, list[Path]]]:
    """Each folder of these names below ``root`` that can be read, and its sub-folders in the order of their names.

    One that two names lead to comes once: by a link, or on a file system that takes scannet and ScanNet for one.
    """
    seen = set[tuple[int, int]]()
    for place in (root / name for name in names):
        try:
            identity = place.stat().st_dev, place.stat().st_ino
            children = sorted(child for child in place.iterdir() if child.is_dir())
        except OSError:
            continue
        if identity not in seen:
            seen.add(identity)
            yield place, children
