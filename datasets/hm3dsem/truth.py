"""The truth of a walk: ``scene_info.json`` with floors, rooms and objects, and the cloud of each object.

Files and keys are those that create_hm3dsem_walks_gt.py of hovsg/HOV-SG (commit 71a8069) writes and its
hm3dsem_evaluator.py reads. The semantic mesh of HM3D, whose objects are colours of a texture, is not read: the clouds
were made of what the walk saw of it.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, PredictionError, converted, printable
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float32Array, Float64Array, Floor, GroundTruth, LabelSet, Places, Room
from su3d_bench.datasets.hm3dsem.frames import INFO_NAME, OBJECTS
from su3d_bench.formats.arrays import MOST_POINTS, checked_points, parsed_json, read_text
from su3d_bench.formats.images import read_bytes
from su3d_bench.formats.ply import read_ply
from su3d_bench.metrics.protocols.loading import CLASS_TABLES

LABEL_SPACE, VARIANT = "hm3dsem", "hovsg-objects"
MOST_OBJECTS, MOST_ID = 100_000, 10**9
MOST_M = 1e6  # no wall of a building is as far
HEADER = "HM3D Semantic Annotations"
AGAIN = "create the ground truth again with HOV-SG's tool"


@cache
def label_set() -> LabelSet:
    """The categories of HM3DSem's objects, numbered by HOV-SG's list from 1."""
    rows = parse_toml(file_text(CLASS_TABLES / "hm3dsem.toml"))["classes"]
    return LabelSet(LABEL_SPACE, tuple(int(row[0]) for row in rows), tuple(str(row[1]) for row in rows))


@dataclass(frozen=True)
class WalkObject:
    """An object of ``scene_info.json``; ``box``: centre and sides (2, 3) m."""

    id: int
    category: str
    colour: str
    region: int
    box: Float64Array


@dataclass(frozen=True)
class WalkInfo:
    """What ``scene_info.json`` holds, in its order."""

    objects: tuple[WalkObject, ...]
    floors: tuple[Floor, ...]
    rooms: tuple[Room, ...]


def read_truth(folder: Path, where: str) -> GroundTruth:
    """The clouds of all objects one after another, with the floors and rooms of the walk in ``folder``.

    Instance ids count the objects in the order of the file from 1; a category that is not in HOV-SG's list is class 0.
    """
    info = read_info(folder / INFO_NAME, where)
    clouds = [read_cloud(folder / OBJECTS / f"{one.id}.ply", where) for one in info.objects]
    sizes = [len(cloud) for cloud in clouds]
    if sum(sizes) > MOST_POINTS:
        raise DataError(f"{where}: {OBJECTS}/ has {sum(sizes)} points; {AGAIN}")
    labels = label_set()
    id_of = dict(zip(labels.names, labels.ids, strict=True))
    boxes = {number: one.box for number, one in enumerate(info.objects, 1)}
    return GroundTruth(
        np.concatenate([np.zeros((0, 3), np.float32), *clouds]),
        np.repeat(np.array([id_of.get(one.category, 0) for one in info.objects], np.int32), sizes),
        np.repeat(np.arange(1, len(clouds) + 1, dtype=np.int32), sizes),
        labels,
        VARIANT,
        f"{INFO_NAME} and the clouds in {OBJECTS}/",
        places=Places(info.floors, info.rooms, boxes),
    )


def read_info(path: Path, where: str) -> WalkInfo:
    """What ``scene_info.json`` says; ``where`` begins each message."""
    where = f"{where}: {path.name}"
    content = parsed_json(read_bytes(path, where, AGAIN), where)
    tables = {key: _rows(content, key, where) for key in ("levels", "regions", "objects")}
    floors = {}
    for place, row in tables["levels"]:
        floors[_whole(row, "id", place)] = Floor(_number(row, "lower", place), _number(row, "upper", place))
    rooms = tuple(_room(row, place, floors) for place, row in tables["regions"])
    objects = tuple(_object(row, place) for place, row in tables["objects"])
    ids = [one.id for one in objects]
    if len(set(ids)) != len(ids):
        twice = next(number for number in ids if ids.count(number) > 1)
        raise DataError(f"{where}: object {twice} stands there twice; {AGAIN}")
    if not objects:
        raise DataError(f"{where}: has no object; {AGAIN}")
    return WalkInfo(objects, tuple(floors.values()), rooms)


def _room(row: Mapping[str, Any], place: str, floors: Mapping[int, Floor]) -> Room:
    if _whole(row, "floor_id", place) not in floors:
        raise DataError(f"{place}: 'floor_id' names no level; {AGAIN}")
    points = _numbers(row, "bev_region_points", place)
    if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
        raise DataError(
            f"{place}: 'bev_region_points' has the shape {points.shape}; expected rows of three, one at least"
        )
    lowest, highest, mean = (_number(row, f"{which}_height", place) for which in ("min", "max", "mean"))
    category = row.get("category") or row.get("voted_category") or ""
    if not isinstance(category, str):
        raise DataError(f"{place}: 'category' is {_shown(category)}; expected a text")
    return Room(points, lowest, highest, mean, category)


def _object(row: Mapping[str, Any], place: str) -> WalkObject:
    for key in ("category", "hex"):
        if not isinstance(row.get(key), str):
            raise DataError(f"{place}: '{key}' is {_shown(row.get(key))}; expected a text")
    centre, sides = _numbers(row, "obb_center", place), _numbers(row, "obb_dims", place)
    if centre.shape != (3,) or sides.shape != (3,) or (sides < 0).any():
        raise DataError(f"{place}: 'obb_center' and 'obb_dims' are no centre and sides of a box; {AGAIN}")
    return WalkObject(
        _whole(row, "id", place),
        row["category"],
        row["hex"],
        _whole(row, "region_id", place),
        np.stack([centre, sides]),
    )


def _rows(content: Any, key: str, where: str) -> list[tuple[str, dict[str, Any]]]:
    """The rows of a list of tables, each with what messages call it."""
    rows = content.get(key) if isinstance(content, dict) else None
    if not isinstance(rows, list) or len(rows) > MOST_OBJECTS:
        raise DataError(f"{where}: has no list '{key}' of at most {MOST_OBJECTS}; {AGAIN}")
    wrong = next((number for number, row in enumerate(rows) if not isinstance(row, dict)), None)
    if wrong is not None:
        raise DataError(f"{where}: {key}[{wrong}] is {_shown(rows[wrong])}; expected an object")
    return [(f"{where}: {key}[{number}]", row) for number, row in enumerate(rows)]


def _whole(row: Mapping[str, Any], key: str, where: str) -> int:
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MOST_ID:
        raise DataError(f"{where}: '{key}' is {_shown(value)}; expected a whole number from 0")
    return value


def _number(row: Mapping[str, Any], key: str, where: str) -> float:
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not -MOST_M <= value <= MOST_M:
        raise DataError(f"{where}: '{key}' is {_shown(value)}; expected metres")
    return float(value)


def _numbers(row: Mapping[str, Any], key: str, where: str) -> Float64Array:
    """The list, or list of lists, of numbers under ``key``."""
    try:
        values = np.array(row.get(key))
    except (ValueError, TypeError, RecursionError):
        values = np.array(None)
    if values.dtype.kind not in "if" or not (np.abs(values) <= MOST_M).all():
        raise DataError(f"{where}: '{key}' is no list of metres; {AGAIN}")
    return values.astype(np.float64)


def _shown(value: Any) -> str:
    return printable(str(value), 40)


def read_cloud(path: Path, where: str) -> Float32Array:
    """The points (N, 3) of an object, one at least."""
    where = f"{where}: {path.parent.name}/{path.name}"
    vertices = read_ply(path, where).element("vertex")
    columns = {} if vertices is None else vertices.columns
    axes = [axis for axis in (columns.get(name) for name in "xyz") if isinstance(axis, np.ndarray)]
    if len(axes) != 3:
        raise DataError(f"{where}: its vertices have no x, y and z; {AGAIN}")
    with converted(PredictionError, DataError):
        points = checked_points(np.stack([axis.astype(np.float64) for axis in axes], axis=1), where)
    if not len(points):
        raise DataError(f"{where}: has no point; {AGAIN}")
    return points


def read_annotation(path: Path, where: str) -> dict[int, tuple[str, str, int]]:
    """Object id -> colour, category and region of a ``.semantic.txt``: a heading, then ``id,colour,"category",region``.

    The category is taken between its quotation marks, commas and all.
    """
    where = f"{where}: {path.name}"
    lines = read_text(path, where).splitlines()
    if not lines or lines[0].strip() != HEADER:
        raise DataError(f"{where}: does not begin with '{HEADER}'; copy it from the release again")
    rows: dict[int, tuple[str, str, int]] = {}
    for number, line in enumerate(lines[1:], 2):
        try:
            (key, colour, category, region) = next(csv.reader([line], strict=True))
            row = int(key), (colour, category, int(region))
        except (ValueError, StopIteration, csv.Error):
            raise DataError(f'{where}:{number}: is {line[:60]!a}; expected id,colour,"category",region') from None
        if rows.setdefault(row[0], row[1]) != row[1] or len(rows) > MOST_OBJECTS:
            raise DataError(f"{where}:{number}: object {row[0]} stands there twice; copy the file again")
    return rows


def annotation_problem(info: WalkInfo, annotation: Mapping[int, tuple[str, str, int]], where: str) -> str | None:
    """A line where an object of the walk is not that of the scene's annotation."""
    for one in info.objects:
        own = one.colour, one.category, one.region
        if annotation.get(one.id) != own:
            return (
                f"{where}: {INFO_NAME}: object {one.id} is not that of the scene's .semantic.txt (colour, category and "
                f"region are {_shown(own)} and {_shown(annotation.get(one.id))}); {AGAIN}"
            )
    return None
