"""Where scenes of ScanNet++ lie below the data root, which there are, and what lies beside them.

A scene is a folder such as ``data/036bce3393`` with ``iphone/`` and ``scans/``; ``metadata/`` and ``splits/`` lie
beside ``data/``. Both releases, v1 and v2, have this layout.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from su3d_bench.core.errors import DataError, ScenesMissing
from su3d_bench.datasets.recordings.places import scenes_in
from su3d_bench.datasets.scannetpp.labels import BENCHMARK_FOLDER, LIST_NAMES
from su3d_bench.formats.text_files import read_text

BASES = ("", "scannetpp", "ScanNetPP", "ScanNet++", "scannetpp_v2", "scannetpp_v1", "scannetpp/v2", "scannetpp/v1")
PLACES = tuple(f"{base}/data" if base else "data" for base in BASES)
SCENE_NAMES = r"[0-9a-f]{10}"
SPLITS_FOLDER = "splits"
IPHONE, SCANS = "iphone", "scans"
SCANNETPP_URL = "https://kaldir.vc.in.tum.de/scannetpp/"
MOST_SCENES = 100_000


@dataclass(frozen=True)
class SceneFolders:
    """``folder_of`` each scene; ``made`` are those that `datasets make` rendered; ``places``: the folders of scenes."""

    root: Path
    places: tuple[Path, ...]
    folder_of: Mapping[str, Path]
    made: frozenset[str]

    @property
    def releases(self) -> list[Path]:
        """The folders that hold ``data/``, ``metadata/`` and ``splits/``; a ``data/`` that is a link has two."""
        return list(dict.fromkeys(path.parent for place in self.places for path in (place, place.resolve())))

    def benchmark_folder(self, scene: str) -> Path | None:
        """Where the lists of the benchmark lie, beside the scene first; None where none has all of them."""
        near = self.folder_of[scene].parent.parent
        places = [release / BENCHMARK_FOLDER for release in (near, *self.releases)]
        return next((place for place in places if all((place / name).is_file() for name in LIST_NAMES)), None)

    @cached_property
    def splits(self) -> dict[str, tuple[str, ...]]:
        """The official splits that lie beside the scenes, by their files' names: ``nvs_sem_train``, ``nvs_sem_val``."""
        found: dict[str, tuple[str, ...]] = {}
        for release in self.releases:
            for path in sorted((release / SPLITS_FOLDER).glob("*.txt")):
                if re.fullmatch(r"[a-z0-9_]{1,40}", path.stem) and path.stem not in found:
                    found[path.stem] = read_split(path)
        return found


def read_split(path: Path) -> tuple[str, ...]:
    """The scenes that a split names, each once, in its order."""
    where = f"scannetpp: {SPLITS_FOLDER}/{path.name}"
    scenes = read_text(path, where).split()
    wrong = next((scene for scene in scenes if not re.fullmatch(SCENE_NAMES, scene)), None)
    if wrong is not None or len(scenes) > MOST_SCENES:
        raise DataError(f"{where}: {(wrong or '')[:40]!a} is no scene; expected one a line, such as 036bce3393")
    return tuple(dict.fromkeys(scenes))


def find_scenes(root: Path) -> SceneFolders:
    """Every scene in ``PLACES`` below ``root``; none is no error here."""
    return SceneFolders(root, *scenes_in(root, PLACES, _is_scene))


def _is_scene(folder: Path) -> bool:
    is_named = re.fullmatch(SCENE_NAMES, folder.name) is not None
    return is_named and ((folder / IPHONE).exists() or (folder / SCANS).exists())


def no_scenes(root: Path) -> ScenesMissing:
    """What to say where no scene was found."""
    return ScenesMissing(
        f"scannetpp: no scene in {root}/data or in scannetpp/data (a scene is a folder such as 036bce3393 with iphone/"
        f" and scans/); ask for the data at {SCANNETPP_URL}, set SU3D_DATA to where it is, or make rooms in this "
        f"layout: su3d-bench datasets make rooms --layout scannetpp --out {root}"
    )
