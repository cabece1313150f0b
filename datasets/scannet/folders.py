"""Where scans of ScanNet lie below the data root, in whichever layout they were put there, and which scans there are.

A scan is a folder such as ``scene0000_00``. Its recording and its annotations may lie in folders of that name in
different places: frames are often exported beside the release.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from su3d_bench.core.system.files import file_text
from su3d_bench.datasets.recordings.file_dataset import SceneTree, folders_in, read_marker
from su3d_bench.datasets.scannet.truth import FIRST_TABLE_NAME, TABLE_NAME

# The scenes of OpenSU3D's evaluation, in the order of its section IV-A.
PAPER_SCENES = ("scene0000_00", "scene0034_00", "scene0164_03", "scene0525_01", "scene0549_00")
# The scenes of OVO's evaluation, data/working/configs/ScanNet/eval_info.yaml at commit cf3b68e, which HOV-SG has too.
OVO_SCENES = ("scene0011_00", "scene0050_00", "scene0231_00", "scene0378_00", "scene0518_00")
SPLITS = ("train", "val", "test")
BASES = ("", "scannet", "ScanNet", "scannetv2", "ScanNetV2", "scannet_v2", "scannet200", "ScanNet200")
# "scans" and "scans_test" as the download script makes them, "v2/scans" as the server has them
SUBFOLDERS = (
    "",
    "scans",
    "scans_test",
    "v2/scans",
    "v1/scans",
    "public/v2/scans",
    *(f"scans/{split}" for split in SPLITS),
    *SPLITS,
    "validation",
)
PLACES = tuple(dict.fromkeys("/".join(part for part in (b, s) if part) or "." for b in BASES for s in SUBFOLDERS))
# beside the scans, where some keep the label table, and OpenScan's attributes
TABLE_FOLDERS = ("tasks", "metadata", "v2/tasks", "v1/tasks", "openscan", "OpenScan")
SCAN_NAME = re.compile(r"scene\d{4}_\d{2}")
EXPORTS = ("pose", "data/pose", "exported", "_info.txt")  # what tells a folder with exported frames


@dataclass(frozen=True)
class ScanFolders(SceneTree):
    """Scans in the order of the paper's, then every other; ``folders`` of each, the first place first."""

    folders: Mapping[str, tuple[Path, ...]]

    def find_file(self, scan: str, name: str) -> Path | None:
        """The file ``name`` of a scan, from the first of its folders that has it."""
        return next((path for folder in self.folders[scan] if (path := folder / name).is_file()), None)

    def find_label_table(self, name: str = TABLE_NAME) -> Path | None:
        """The label table: in a folder with scans, above one, or in the usual folders beside them."""
        return next((path for folder in self.table_folders() if (path := folder / name).is_file()), None)

    def label_tables(self) -> list[Path]:
        """That of the second release and that of the first, as far as they are here."""
        found = [self.find_label_table(name) for name in (TABLE_NAME, FIRST_TABLE_NAME)]
        return [path for path in found if path is not None]

    def table_folders(self) -> list[Path]:
        """Where the label table is looked for, the nearest to the scans first."""
        near = [path for place in self.places for path in (place, *place.parents) if path.is_relative_to(self.root)]
        near += [self.root, *(self.root / base for base in BASES if base)]
        return list(dict.fromkeys(folder / name for folder in near for name in (".", *TABLE_FOLDERS)))


def find_scans(root: Path) -> ScanFolders:
    """Every scan in ``PLACES`` below ``root``; none is no error here."""
    folders: dict[str, list[Path]] = {}
    places, made = [], set[str]()
    for place, children in folders_in(root, PLACES):
        rooms = read_marker(place)
        scans = [child for child in children if _is_scan(child, rooms)]
        if scans:
            places.append(place)
            made |= {scan.name for scan in scans if scan.name in rooms}
        for scan in scans:
            folders.setdefault(scan.name, []).append(scan)
    first = [scan for scan in PAPER_SCENES if scan in folders]
    found = {scan: tuple(folders[scan]) for scan in (*first, *sorted(set(folders) - set(first)))}
    return ScanFolders(root, tuple(places), {scan: paths[0] for scan, paths in found.items()}, frozenset(made), found)


def _is_scan(folder: Path, rooms: Mapping[str, str]) -> bool:
    if SCAN_NAME.fullmatch(folder.name) or (folder / f"{folder.name}.sens").is_file():
        return True
    # Rooms in the layout of another dataset have a marker of the same name.
    return folder.name in rooms and any((folder / part).exists() for part in EXPORTS)


@cache
def split_scenes(split: str) -> tuple[str, ...]:
    """The scans of an official split in the order of its list: Tasks/Benchmark/scannetv2_<split>.txt of ScanNet."""
    return tuple(file_text(Path(__file__).parent / "splits" / f"scannetv2_{split}.txt").split())
