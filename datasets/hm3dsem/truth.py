"""The ground truth of a walk: ``scene_info.json`` with floors, rooms and objects, and the cloud of each object.

Files and keys are those written by create_hm3dsem_walks_gt.py of hovsg/HOV-SG (commit 71a8069) and read by its
hm3dsem_evaluator.py reads. The semantic mesh of HM3D, whose objects are texture colours, is not read: the clouds
were created from what the walk saw of it.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from su3d_bench.core.errors import DataError, PredictionError, converted, printable
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float32Array, Floor, GroundTruth, LabelSet, Places, Room
from su3d_bench.formats.arrays import MAX_POINTS, checked_points, read_text
from su3d_bench.formats.json_models import FileModel, Lengths, Metres, Point, WholeNumber, read_json
from su3d_bench.formats.ply import read_ply
from su3d_bench.metrics.protocols.loading import CLASS_TABLES

INFO_NAME, OBJECTS = "scene_info.json", "objects"
LABEL_SPACE, VARIANT = "hm3dsem", "hovsg-objects"
MAX_OBJECTS = 100_000
HEADER = "HM3D Semantic Annotations"
AGAIN = "create the ground truth again with HOV-SG's tool"


@cache
def label_set() -> LabelSet:
    """The categories of HM3DSem's objects, numbered from 1 in the order of HOV-SG's list."""
    rows = parse_toml(file_text(CLASS_TABLES / "hm3dsem.toml"))["classes"]
    return LabelSet(LABEL_SPACE, tuple(int(row[0]) for row in rows), tuple(str(row[1]) for row in rows))


class Level(FileModel):
    id: WholeNumber
    lower: Metres
    upper: Metres


class Region(FileModel):
    """A room; ``category`` is its human annotation, HOV-SG's tools vote over its objects."""

    floor_id: WholeNumber
    bev_region_points: Annotated[list[Point], Field(min_length=1)]
    min_height: Metres
    max_height: Metres
    mean_height: Metres
    category: str | None = None
    voted_category: str | None = None


class WalkObject(FileModel):
    id: WholeNumber
    category: str
    hex: str
    region_id: WholeNumber
    obb_center: Point
    obb_dims: Lengths


class WalkInfo(FileModel):
    """The content of ``scene_info.json``, in file order."""

    levels: list[Level]
    regions: list[Region]
    objects: Annotated[list[WalkObject], Field(min_length=1, max_length=MAX_OBJECTS)]

    @model_validator(mode="after")
    def _check_ids(self) -> WalkInfo:
        if len({one.id for one in self.objects}) != len(self.objects):
            raise ValueError("an object is listed twice")
        if not {room.floor_id for room in self.regions} <= {level.id for level in self.levels}:
            raise ValueError("a 'floor_id' does not match a level")
        return self


def read_truth(folder: Path, where: str) -> GroundTruth:
    """The clouds of all objects one after another, with the floors and rooms of the walk in ``folder``.

    Instance ids number the objects in file order from 1; a category not in HOV-SG's list is class 0.
    """
    info = read_info(folder / INFO_NAME, where)
    clouds = [read_cloud(folder / OBJECTS / f"{one.id}.ply", where) for one in info.objects]
    sizes = [len(cloud) for cloud in clouds]
    if sum(sizes) > MAX_POINTS:
        raise DataError(f"{where}: {OBJECTS}/ has {sum(sizes)} points; {AGAIN}")
    labels = label_set()
    id_of = dict(zip(labels.names, labels.ids, strict=True))
    return GroundTruth(
        np.concatenate([np.zeros((0, 3), np.float32), *clouds]),
        np.repeat(np.array([id_of.get(one.category, 0) for one in info.objects], np.int32), sizes),
        np.repeat(np.arange(1, len(clouds) + 1, dtype=np.int32), sizes),
        labels,
        VARIANT,
        f"{INFO_NAME} and the clouds in {OBJECTS}/",
        places=places_of(info),
    )


def read_info(path: Path, where: str) -> WalkInfo:
    """The content of ``scene_info.json``; ``where`` begins each message."""
    return read_json(path, f"{where}: {path.name}", WalkInfo, AGAIN)


def places_of(info: WalkInfo) -> Places:
    """The floors, the rooms, and the boxes of the objects, counted from 1."""
    floors = {level.id: Floor(level.lower, level.upper) for level in info.levels}
    rooms = (
        Room(np.array(one.bev_region_points, np.float64), one.min_height, one.max_height, one.mean_height,
             one.category or one.voted_category or "")
        for one in info.regions
    )  # fmt: skip
    boxes = {number: np.array([one.obb_center, one.obb_dims]) for number, one in enumerate(info.objects, 1)}
    return Places(tuple(floors.values()), tuple(rooms), boxes)


def read_cloud(path: Path, where: str) -> Float32Array:
    """The points (N, 3) of an object, at least one."""
    where = f"{where}: {path.parent.name}/{path.name}"
    vertices = read_ply(path, where).element("vertex")
    columns = {} if vertices is None else vertices.columns
    axes = [axis for axis in (columns.get(name) for name in "xyz") if isinstance(axis, np.ndarray)]
    if len(axes) != 3:
        raise DataError(f"{where}: its vertices lack x, y or z; {AGAIN}")
    with converted(PredictionError, DataError):
        points = checked_points(np.stack([axis.astype(np.float64) for axis in axes], axis=1), where)
    if not len(points):
        raise DataError(f"{where}: has no points; {AGAIN}")
    return points


def read_annotation(path: Path, where: str) -> dict[int, tuple[str, str, int]]:
    """Object id -> colour, category and region of a ``.semantic.txt``: a heading, then ``id,colour,"category",region``.

    The category is the text between the quotation marks, including commas.
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
        if rows.setdefault(row[0], row[1]) != row[1] or len(rows) > MAX_OBJECTS:
            raise DataError(f"{where}:{number}: object {row[0]} is listed twice; copy the file again")
    return rows


def check_annotation(info: WalkInfo, annotation: Mapping[int, tuple[str, str, int]], where: str) -> None:
    """Raise ``DataError`` if an object of the walk differs from the scene's annotation."""
    for one in info.objects:
        own = one.hex, one.category, one.region_id
        if annotation.get(one.id) != own:
            found = printable(f"colour, category and region are {own} and {annotation.get(one.id)}", 120)
            raise DataError(
                f"{where}: {INFO_NAME}: object {one.id} differs from the scene's .semantic.txt ({found}); {AGAIN}"
            )
