"""Locations of ScanNet's scans below the data root, in any common layout, and the official lists of scans.

A scan is a folder such as ``scene0000_00``. Its recording and annotations may be in folders of that name in
different places: frames are often exported next to the release.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from su3d_bench.core.system.files import file_text
from su3d_bench.datasets.recordings.file_dataset import SceneTree, find_scenes
from su3d_bench.datasets.scannet.truth import FIRST_TABLE_NAME, TABLE_NAME

# The scenes of OpenSU3D's evaluation, in the order of section IV-A.
PAPER_SCENES = ("scene0000_00", "scene0034_00", "scene0164_03", "scene0525_01", "scene0549_00")
# The scenes of OVO's evaluation, data/working/configs/ScanNet/eval_info.yaml at commit cf3b68e, same as in HOV-SG.
OVO_SCENES = ("scene0011_00", "scene0050_00", "scene0231_00", "scene0378_00", "scene0518_00")
SPLITS = ("train", "val", "test")
BASES = ("", "scannet", "ScanNet", "scannetv2", "ScanNetV2", "scannet_v2", "scannet200", "ScanNet200")
# "scans" and "scans_test" as created by the download script, "v2/scans" as on the server
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
# next to the scans: common places of the label table and of OpenScan's attributes
TABLE_FOLDERS = ("tasks", "metadata", "v2/tasks", "v1/tasks", "openscan", "OpenScan")
SCAN_NAME = re.compile(r"scene\d{4}_\d{2}")


def find_scans(root: Path) -> SceneTree:
    """Every scan in ``PLACES`` below ``root``; there may be none."""
    return find_scenes(root, PLACES, _is_scan, PAPER_SCENES)


def _is_scan(folder: Path) -> bool:
    return SCAN_NAME.fullmatch(folder.name) is not None or (folder / f"{folder.name}.sens").is_file()


def find_file(tree: SceneTree, scan: str, name: str) -> Path | None:
    """The file ``name`` of a scan, from the first of its folders that has it."""
    return next((path for folder in tree.folders.get(scan, ()) if (path := folder / name).is_file()), None)


def table_folders(tree: SceneTree) -> list[Path]:
    """Folders where the label table is looked for, nearest first: in, above and next to a folder with scans."""
    near = [path for place in tree.places for path in (place, *place.parents) if path.is_relative_to(tree.root)]
    near += [tree.root, *(tree.root / base for base in BASES if base)]
    return list(dict.fromkeys(folder / name for folder in near for name in (".", *TABLE_FOLDERS)))


def find_table(tree: SceneTree, name: str = TABLE_NAME) -> Path | None:
    return next((path for folder in table_folders(tree) if (path := folder / name).is_file()), None)


def label_tables(tree: SceneTree) -> list[Path]:
    """The tables of the second and of the first release, as far as available."""
    found = [find_table(tree, name) for name in (TABLE_NAME, FIRST_TABLE_NAME)]
    return [path for path in found if path is not None]


@cache
def split_scenes(split: str) -> tuple[str, ...]:
    """The scans of an official split in the order of its list: Tasks/Benchmark/scannetv2_<split>.txt of ScanNet."""
    return tuple(file_text(Path(__file__).parent / "splits" / f"scannetv2_{split}.txt").split())
