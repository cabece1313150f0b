"""The data root in a store: which scenes are there, and which files each of them needs.

Datasets look for scenes by the names of files. So a plan is made over an *outline*: the tree of the store as empty
files. A job gets the real files of its scene alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.core.files.scratch import TemporaryFolder
from su3d_bench.runs.parts import Part, build_dataset
from su3d_bench.runs.remote.folder import RemoteFolder

MOST_SHARED_BYTES = 1 << 26  # label tables and camera files; the largest has 1 MB


@dataclass(frozen=True)
class RemoteData:
    """The data root in a store, and by scene (``<dataset>/<scene>``) the files that a job needs, with their sizes."""

    url: str
    files: Mapping[str, Mapping[str, int]]


@dataclass(frozen=True)
class DataPlace:
    """Where a plan looks for scenes: the data root, or the outline of the one at ``url``, with the sizes there."""

    root: Path
    url: str | None = None
    sizes: Mapping[str, int] = field(default_factory=dict)

    def needed(self, datasets: Iterable[Part]) -> RemoteData | None:
        """What the scenes of ``datasets`` need; None where the data root is here."""
        if self.url is None:
            return None
        files: dict[str, Mapping[str, int]] = {}
        for part in datasets:
            of_scenes = files_of_scenes(self.sizes, build_dataset(part, self.root).scenes())
            files |= {f"{part.name}/{scene}": sizes for scene, sizes in of_scenes.items()}
        return RemoteData(self.url, files)


@contextmanager
def data_place(url: str) -> Iterator[DataPlace]:
    """The outline of the store at ``url``, for the time of the block."""
    sizes = RemoteFolder(url).files()
    if not sizes:
        raise ConfigError(f"SU3D_DATA={url}: holds no file; name the folder that holds the datasets")
    with TemporaryFolder("su3d-outline-") as folder:
        for below in {str(Path(name).parent) for name in sizes}:
            make_folder(folder / below)
        for name in sizes:
            (folder / name).touch()
        yield DataPlace(folder, url, sizes)


def files_of_scenes(sizes: Mapping[str, int], scenes: Sequence[str]) -> dict[str, dict[str, int]]:
    """Files and sizes by scene of one dataset: those named after it or in a folder so named, and those of no scene.

    A folder or file is named after a scene whatever stands around the name between separators and however the name
    itself is separated: ``room0_mesh.ply`` and ``room_0/`` are of ``room0``. Files of no scene count where they are
    beside scenes, in the same folder of the root, and are small.
    """
    of_key: dict[str, list[str]] = {}
    for scene in scenes:
        of_key.setdefault(_key(scene), []).append(scene)
    owners = {name: _owner(name, of_key) for name in sizes}
    tops = {_top(name) for name, owner in owners.items() if owner is not None}
    shared = {
        name: sizes[name]
        for name, owner in owners.items()
        if owner is None and _top(name) in tops and sizes[name] <= MOST_SHARED_BYTES
    }
    files: dict[str, dict[str, int]] = {scene: dict(shared) for scene in scenes}
    for name, owner in owners.items():
        for scene in of_key.get(owner or "", ()):  # those whose names differ in separators alone get each other's too
            files[scene][name] = sizes[name]
    return files


def _top(name: str) -> str:
    return name.partition("/")[0] if "/" in name else ""


def _owner(name: str, of_key: Mapping[str, Sequence[str]]) -> str | None:
    for part in name.split("/"):
        for key in _keys(part):
            if key in of_key:
                return key
    return None


def _keys(part: str) -> Iterable[str]:
    """What ``part`` may be named after, the longest first."""
    words = [word for word in re.split(r"[._-]+", part) if word]
    for n in range(len(words), 0, -1):
        yield from ("".join(words[k : k + n]) for k in range(len(words) - n + 1))


def _key(scene: str) -> str:
    return "".join(re.split(r"[._-]+", scene))
