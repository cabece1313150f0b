"""The folders of a data root in which scenes of a dataset may lie, each met once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from su3d_bench.datasets.recordings.made_rooms import read_marker


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


def scenes_in(
    root: Path, names: Iterable[str], is_scene: Callable[[Path], bool]
) -> tuple[tuple[Path, ...], Mapping[str, Path], frozenset[str]]:
    """The folders of these names that hold scenes, the folder of each scene, the first place first, and made ones."""
    folder_of: dict[str, Path] = {}
    places, made = [], set[str]()
    for place, children in folders_in(root, names):
        scenes = [child for child in children if is_scene(child)]
        if scenes:
            rooms = read_marker(place)
            places.append(place)
            made |= {scene.name for scene in scenes if scene.name in rooms}
        for scene in scenes:
            folder_of.setdefault(scene.name, scene)
    return tuple(places), dict(sorted(folder_of.items())), frozenset(made)
