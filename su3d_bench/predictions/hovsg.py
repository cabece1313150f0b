"""Maps of HOV-SG: a cloud a file in ``objects/``, and a row of features for each.

Source: HOV-SG at commit 71a8069. Object i is row i of the features. Its loader counts the files and reads those from 0
on, which loses the last ones where a number is missing; here the number is read from the name.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError, PredictionError, converted, reading, shown
from su3d_bench.formats.arrays import MOST_MASKS, checked_points, feature_table, without_nonfinite
from su3d_bench.formats.pcd import read_pcd_points
from su3d_bench.formats.ply import read_ply
from su3d_bench.formats.torch_zip import read_torch
from su3d_bench.predictions.base import ONES, SceneFolders, ScenePrediction, instances_of

FEATURES = "mask_feats.pt"
OBJECTS = "objects"
OBJECT_FILE = re.compile(r"pcd_(0|[1-9]\d{0,8})\.(ply|pcd)")


class HovSg(SceneFolders):
    name = "hovsg"
    summary = "HOV-SG's objects/pcd_<i>.ply (or .pcd) with mask_feats.pt, row i of object i"
    noun, first, second = "map", FEATURES, OBJECTS

    def recognise(self, path: Path) -> str | None:
        return f"it holds {FEATURES} beside {OBJECTS}/" if super().recognise(path) else None

    def scene_of(self, folder: Path, path: Path) -> str:
        return folder.absolute().name

    def read_scene(self, place: Path, scene: str) -> ScenePrediction:
        table = feature_table(read_torch(place / FEATURES), place / FEATURES)
        files = _object_files(place / OBJECTS)
        numbers = sorted(files)
        if numbers and numbers[-1] >= len(table):
            raise PredictionError(
                f"{shown(files[numbers[-1]])}: object {numbers[-1]} has no feature, {FEATURES} has {len(table)} rows; "
                "both must be of one map"
            )
        features, remarks = without_nonfinite(table[numbers], "objects")
        instances = instances_of(
            [checked_points(read_cloud(files[number]), shown(files[number])) for number in numbers],
            shown(place),
            features=features,
            labels=None,
            names=tuple(f"object {number}" for number in numbers),
            captions=("",) * len(numbers),
            ids=numbers,
        )
        remarks += _gap_remarks(numbers, len(table))
        return ScenePrediction(scene, self.name, place, instances, (ONES, *remarks))


def read_cloud(file: Path) -> np.ndarray:
    """The points (N, 3) of a .ply or .pcd file, as they are; ``PredictionError`` where it is damaged."""
    where = shown(file)
    with converted(DataError, PredictionError):
        if file.suffix == ".pcd":
            return read_pcd_points(file, where)
        vertices = read_ply(file, where).element("vertex")
    columns = {} if vertices is None else vertices.columns
    axes = [columns.get(axis) for axis in "xyz"]
    coordinates = [axis for axis in axes if isinstance(axis, np.ndarray)]
    if len(coordinates) != len(axes):
        raise PredictionError(f"{where}: its vertices have no x, y and z; expected a cloud of points")
    return np.stack([axis.astype(np.float64) for axis in coordinates], axis=1)


def _object_files(folder: Path) -> dict[int, Path]:
    """The cloud of each object by its number."""
    with reading(shown(folder)):
        names = [entry.name for entry in folder.iterdir() if entry.is_file()]
    files: dict[int, Path] = {}
    for name in sorted(names):
        match = OBJECT_FILE.fullmatch(name)
        if match is None:
            continue
        if files.setdefault(int(match[1]), folder / name) != folder / name:
            raise PredictionError(f"{shown(folder)}: object {match[1]} is there as .ply and .pcd; keep one of them")
    if len(files) > MOST_MASKS:
        raise PredictionError(f"{shown(folder)}: holds {len(files)} objects; is it damaged?")
    return files


def _gap_remarks(numbers: list[int], n_rows: int) -> tuple[str, ...]:
    is_there = np.zeros(n_rows, np.bool_)
    is_there[numbers] = True
    missing = np.flatnonzero(~is_there).tolist()
    if not missing:
        return ()
    remarks = [f"{len(missing)} rows of {FEATURES} have no object file and are not used ({some(missing)})"]
    lost = [number for number in numbers if number >= len(numbers)]
    if lost:
        remarks.append(f"the original's loader would not read the last {len(lost)} objects ({some(lost)})")
    return tuple(remarks)


def some(numbers: Sequence[int]) -> str:
    """The first of ``numbers`` for a message.

    >>> some([1, 2, 3, 4, 5, 6])
    '1, 2, 3, 4, 5, ...'
    """
    return ", ".join(str(number) for number in numbers[:5]) + (", ..." if len(numbers) > 5 else "")
