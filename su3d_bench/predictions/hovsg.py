"""Maps of HOV-SG: a cloud a file in ``objects/`` with a row of features for each; and its scene graphs, ``floors/``,
``rooms/`` and ``objects/`` with a cloud and a JSON file each.

Source: HOV-SG at commit 71a8069. Object i is row i of the features. Its loader counts the files and reads those from 0
on, which loses the last ones where a number is missing; here the number is read from the name. Objects of a graph
(``save`` of hovsg/graph/floor.py, room.py and object.py) come in the order of their files' names, as its loader has
them: where overlaps are equal, who is matched depends on it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, PredictionError, converted, printable, reading, shown
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import UP, Float32Array, Float64Array, Floor, Places, Room
from su3d_bench.formats.arrays import MOST_MASKS, MOST_POINTS, checked_points, feature_table, without_nonfinite
from su3d_bench.formats.pcd import read_pcd_points
from su3d_bench.formats.ply import read_ply
from su3d_bench.formats.torch_files import read_torch
from su3d_bench.predictions.base import ONES, Parsed, instances_of

FEATURES = "mask_feats.pt"
FLOORS, ROOMS, OBJECTS, GRAPH = "floors", "rooms", "objects", "graph"
NUMBERS = {FLOORS: r"\d{1,9}", ROOMS: r"\d{1,9}_\d{1,9}", OBJECTS: r"\d{1,9}_\d{1,9}_\d{1,9}"}
MOST_M, MOST_DIMENSIONS = 1e6, 1 << 14
AGAIN = "copy the graph again"
OBJECT_FILE = re.compile(r"pcd_(0|[1-9]\d{0,8})\.(ply|pcd)")


def hovsg(place: Path, scene: str) -> Parsed:
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
    return instances, (ONES, *remarks, *_gap_remarks(numbers, len(table)))


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


# ---- the scene graph


def scene_of_graph(folder: Path, path: Path) -> str:
    place = folder.absolute()
    return place.parent.name if place.name == GRAPH else place.name


def hovsg_graph(place: Path, scene: str) -> Parsed:
    floors = tuple(_floor(files) for files in _members(place, FLOORS).values())
    rooms = _members(place, ROOMS)
    objects = _members(place, OBJECTS)
    stray = next((name for name in objects if name.rpartition("_")[0] not in rooms), None)
    if stray is not None:
        raise PredictionError(f"{shown(place / OBJECTS)}: object {stray} is in no room of {ROOMS}/; {AGAIN}")
    tables = [_table(files) for files in objects.values()]
    embeddings = [_embedding(table, files) for table, files in zip(tables, objects.values(), strict=True)]
    features, remarks = _features(embeddings, place)
    instances = instances_of(
        [checked_points(read_cloud(files["ply"]), shown(files["ply"])) for files in objects.values()],
        shown(place),
        features=features,
        labels=None,
        names=tuple(f"object {name}" for name in objects),
        captions=tuple(_text(table, "name", files) for table, files in zip(tables, objects.values(), strict=True)),
        ids=range(len(objects)),
    )
    graph = Places(floors, tuple(_room(files) for files in rooms.values()))
    return replace(instances, places=graph), (ONES, *remarks)


def _members(place: Path, kind: str) -> dict[str, dict[str, Path]]:
    """Name -> its cloud and its JSON file, in the order of the clouds' names; both must be there."""
    folder = place / kind
    with reading(shown(folder)):
        files = sorted(entry.name for entry in folder.iterdir() if entry.is_file())
    found: dict[str, dict[str, Path]] = {}
    for ending in ("ply", "json"):
        for file in files:
            match = re.fullmatch(rf"({NUMBERS[kind]})\.{ending}", file, re.ASCII)
            if match is not None:
                found.setdefault(match[1], {})[ending] = folder / file
    alone = next((name for name, pair in found.items() if len(pair) < 2), None)
    if alone is not None:
        (there,) = found[alone].values()
        raise PredictionError(
            f"{shown(there)}: has no {'.json' if there.suffix == '.ply' else '.ply'} beside it; {AGAIN}"
        )
    if len(found) > MOST_MASKS:
        raise PredictionError(f"{shown(folder)}: holds {len(found)} {kind}; is it damaged?")
    return found


def _table(files: Mapping[str, Path]) -> dict[str, Any]:
    path = files["json"]
    with reading(shown(path)):
        content = file_bytes(path)
    try:
        table = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise PredictionError(f"{shown(path)}: not JSON ({printable(str(error), 80)}); {AGAIN}") from error
    if not isinstance(table, dict):
        raise PredictionError(f"{shown(path)}: is no JSON object; {AGAIN}")
    return table


def _floor(files: Mapping[str, Path]) -> Floor:
    """The heights of a floor, from the corners of its box."""
    corners = _numbers(_table(files), "vertices", files)
    if corners.ndim != 2 or corners.shape[1:] != (3,) or not len(corners):
        raise PredictionError(
            f"{shown(files['json'])}: 'vertices' has the shape {corners.shape}; expected corners of a box"
        )
    middle, height = corners[:, UP].mean(), np.ptp(corners[:, UP])
    return Floor(float(middle - height / 2), float(middle + height / 2))


def _room(files: Mapping[str, Path]) -> Room:
    table = _table(files)
    zero, height = (_numbers(table, key, files) for key in ("room_zero_level", "room_height"))
    if zero.shape or height.shape:
        raise PredictionError(f"{shown(files['json'])}: 'room_zero_level' and 'room_height' must be one number each")
    points = checked_points(read_cloud(files["ply"]), shown(files["ply"])).astype(np.float64)
    if not 0 < len(points) <= MOST_POINTS:
        raise PredictionError(f"{shown(files['ply'])}: has {len(points)} points; {AGAIN}")
    low, high, middle = float(zero), float(zero + height), float(zero + height / 2)
    return Room(points, low, high, middle, _text(table, "name", files))


def _numbers(table: Mapping[str, Any], key: str, files: Mapping[str, Path]) -> Float64Array:
    """The number, or list or table of numbers, under ``key``."""
    try:
        values = np.array(table.get(key))
    except (ValueError, TypeError, RecursionError):
        values = np.array(None)
    if values.dtype.kind not in "if" or not (np.abs(values) <= MOST_M).all():
        raise PredictionError(f"{shown(files['json'])}: '{key}' holds no metres; {AGAIN}")
    return values.astype(np.float64)


def _text(table: Mapping[str, Any], key: str, files: Mapping[str, Path]) -> str:
    value = table.get(key) or ""
    if not isinstance(value, str):
        raise PredictionError(f"{shown(files['json'])}: '{key}' is {printable(str(value), 40)}; expected a text")
    return printable(value, 200)


def _embedding(table: Mapping[str, Any], files: Mapping[str, Path]) -> Float32Array | None:
    """The feature (D,) of an object; None where it has none."""
    value = table.get("embedding", "")
    if value == "":
        return None
    try:
        feature = np.array(value)
    except (ValueError, TypeError, RecursionError):
        feature = np.array(None)
    if feature.ndim == 2 and len(feature) == 1:
        feature = feature[0]
    if feature.dtype.kind not in "if" or feature.ndim != 1 or not 0 < len(feature) <= MOST_DIMENSIONS:
        raise PredictionError(f"{shown(files['json'])}: 'embedding' is no list of numbers; {AGAIN}")
    with np.errstate(over="ignore"):
        return feature.astype(np.float32)


def _features(embeddings: list[Float32Array | None], place: Path) -> tuple[Float32Array | None, tuple[str, ...]]:
    """A row an object, zeros for those without a feature; None where no object has one."""
    sizes = {len(feature) for feature in embeddings if feature is not None}
    if len(sizes) > 1:
        raise PredictionError(
            f"{shown(place / OBJECTS)}: embeddings have {min(sizes)} and {max(sizes)} dimensions; all must "
            "be of one encoder"
        )
    if not sizes:
        return None, ()
    (n,) = sizes
    rows = [np.zeros(n, np.float32) if feature is None else feature for feature in embeddings]
    features, remarks = without_nonfinite(np.stack(rows), "objects")
    n_without = sum(feature is None for feature in embeddings)
    return features, (*remarks, *([f"objects without an embedding: {n_without}"] if n_without else []))
