"""Maps of HOV-SG: a cloud a file in ``objects/`` with a row of features for each; and its scene graphs, ``floors/``,
``rooms/`` and ``objects/`` with a cloud and a JSON file each.

Source: HOV-SG at commit 71a8069. Object i is row i of the features. Its loader counts the files and reads those from 0
on, which loses the last ones where a number is missing; here the number is read from the name. Objects of a graph
(``save`` of hovsg/graph/floor.py, room.py and object.py) come in the order of their files' names, as its loader has
them: where overlaps are equal, who is matched depends on it.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from su3d_bench.core.errors import DataError, PredictionError, converted, printable, reading, shown, some
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import UP, Float32Array, Floor, Places, Room
from su3d_bench.formats.arrays import MAX_MASKS, as_float32, checked_points, feature_table, without_nonfinite
from su3d_bench.formats.pcd import read_pcd_points
from su3d_bench.formats.ply import read_ply
from su3d_bench.formats.torch_files import read_torch
from su3d_bench.predictions.base import ONES, Parsed, instances_of

FEATURES = "mask_feats.pt"
FLOORS, ROOMS, OBJECTS, GRAPH = "floors", "rooms", "objects", "graph"
NUMBERS = {FLOORS: r"\d{1,9}", ROOMS: r"\d{1,9}_\d{1,9}", OBJECTS: r"\d{1,9}_\d{1,9}_\d{1,9}"}
MAX_M, MAX_DIMENSIONS = 1e6, 1 << 14
AGAIN = "copy the graph again"
OTHER = {".ply": ".json", ".json": ".ply"}  # what lies beside each file
Fields = TypeVar("Fields", bound=BaseModel)
Metres = Annotated[float, Field(ge=-MAX_M, le=MAX_M)]
Feature = Annotated[list[float], Field(min_length=1, max_length=MAX_DIMENSIONS)]
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
    clouds = [read_points(files[number]) for number in numbers]
    names = [f"object {number}" for number in numbers]
    instances = instances_of(clouds, shown(place), features, names=names, ids=numbers)
    return instances, (ONES, *remarks, *_gap_remarks(numbers, len(table)))


def read_points(file: Path) -> Float32Array:
    """The points (N, 3) of a .ply or .pcd file in metres; ``PredictionError`` where it is damaged."""
    where = shown(file)
    with converted(DataError, PredictionError):
        if file.suffix == ".pcd":
            return checked_points(read_pcd_points(file, where), where)
        vertices = read_ply(file, where).element("vertex")
    columns = {} if vertices is None else vertices.columns
    axes = [axis for name in "xyz" if isinstance(axis := columns.get(name), np.ndarray)]
    if len(axes) < 3:
        raise PredictionError(f"{where}: its vertices have no x, y and z; expected a cloud of points")
    return checked_points(np.stack([axis.astype(np.float64) for axis in axes], axis=1), where)


def _object_files(folder: Path) -> dict[int, Path]:
    """The cloud of each object by its number."""
    with reading(shown(folder)):
        names = [entry.name for entry in folder.iterdir() if entry.is_file()]
    files: dict[int, Path] = {}
    for match in filter(None, map(OBJECT_FILE.fullmatch, sorted(names))):
        name = match[0]
        if files.setdefault(int(match[1]), folder / name) != folder / name:
            raise PredictionError(f"{shown(folder)}: object {match[1]} is there as .ply and .pcd; keep one of them")
    if len(files) > MAX_MASKS:
        raise PredictionError(f"{shown(folder)}: holds {len(files)} objects; is it damaged?")
    return files


def _gap_remarks(numbers: list[int], n_rows: int) -> tuple[str, ...]:
    missing = np.setdiff1d(np.arange(n_rows), numbers).astype(str).tolist()
    if not missing:
        return ()
    remarks = [f"{len(missing)} rows of {FEATURES} have no object file and are not used ({some(missing, 5)})"]
    lost = [str(number) for number in numbers if number >= len(numbers)]
    if lost:
        remarks.append(f"the original's loader would not read the last {len(lost)} objects ({some(lost, 5)})")
    return tuple(remarks)


# ---- the scene graph


def scene_of_graph(folder: Path, path: Path) -> str:
    place = folder.absolute()
    return place.parent.name if place.name == GRAPH else place.name


class _FloorFields(BaseModel, strict=True):
    vertices: Annotated[list[tuple[Metres, Metres, Metres]], Field(min_length=1)]  # the corners of its box


class _RoomFields(BaseModel, strict=True):
    room_zero_level: Metres
    room_height: Metres
    name: str | None = None


class _ObjectFields(BaseModel, strict=True):
    name: str | None = None
    embedding: Feature | Annotated[list[Feature], Field(min_length=1, max_length=1)] | Literal[""] = ""


def hovsg_graph(place: Path, scene: str) -> Parsed:
    floors = tuple(_floor(file) for file in _members(place, FLOORS).values())
    rooms, objects = _members(place, ROOMS), _members(place, OBJECTS)
    stray = next((name for name in objects if name.rpartition("_")[0] not in rooms), None)
    if stray is not None:
        raise PredictionError(f"{shown(place / OBJECTS)}: object {stray} is in no room of {ROOMS}/; {AGAIN}")
    tables = [_fields(file, _ObjectFields) for file in objects.values()]
    features, remarks = _features([_embedding(table) for table in tables], place)
    clouds = [read_points(file) for file in objects.values()]
    names, captions = [f"object {name}" for name in objects], [printable(table.name or "", 200) for table in tables]
    instances = instances_of(clouds, shown(place), features, names=names, captions=captions, ids=range(len(objects)))
    graph = Places(floors, tuple(map(_room, rooms.values())))
    return replace(instances, places=graph), (ONES, *remarks)


def _members(place: Path, kind: str) -> dict[str, Path]:
    """Name -> its cloud, in the order of the clouds' names; each has a JSON file beside it, and that a cloud."""
    folder = place / kind
    with reading(shown(folder)):
        entries = sorted(entry for entry in folder.iterdir() if entry.suffix in OTHER and entry.is_file())
    files = {entry: None for entry in entries if re.fullmatch(NUMBERS[kind], entry.stem, re.ASCII)}
    for file in files:
        if file.with_suffix(OTHER[file.suffix]) not in files:
            raise PredictionError(f"{shown(file)}: has no {OTHER[file.suffix]} beside it; {AGAIN}")
    if len(files) > 2 * MAX_MASKS:
        raise PredictionError(f"{shown(folder)}: holds {len(files)} files of {kind}; is it damaged?")
    return {file.stem: file for file in files if file.suffix == ".ply"}


def _fields(cloud: Path, model: type[Fields]) -> Fields:
    """What the JSON file beside a cloud says."""
    path = cloud.with_suffix(".json")
    with reading(shown(path)):
        content = file_bytes(path)
    try:
        return model.model_validate_json(content)
    except ValidationError as error:
        first = error.errors()[0]
        reason = printable(f"{'.'.join(map(str, first['loc'][:1]))}: {first['msg']}", 120)
        raise PredictionError(f"{shown(path)}: {reason.removeprefix(': ')}; {AGAIN}") from error


def _floor(cloud: Path) -> Floor:
    """The heights of a floor."""
    heights = np.array(_fields(cloud, _FloorFields).vertices)[:, UP]
    middle, height = heights.mean(), np.ptp(heights)
    return Floor(float(middle - height / 2), float(middle + height / 2))


def _room(cloud: Path) -> Room:
    fields, points = _fields(cloud, _RoomFields), read_points(cloud).astype(np.float64)
    if not len(points):
        raise PredictionError(f"{shown(cloud)}: has no points; {AGAIN}")
    low, height = fields.room_zero_level, fields.room_height
    return Room(points, low, low + height, low + height / 2, printable(fields.name or "", 200))


def _embedding(table: _ObjectFields) -> Float32Array | None:
    """The feature (D,) of an object; None where it has none."""
    values = np.array(table.embedding or None)
    return as_float32(values.reshape(-1)) if values.ndim else None


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
