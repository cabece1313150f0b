"""The oriented boxes of Replica's objects, from ``info_semantic.json`` alone, and whether the mesh agrees with them.

A box is given in its own axes (``abb``) and brought to the world by a rotation, a quaternion x y z w, and a
translation. Source: habitat-sim's reader of Replica scenes, and its test, which wants every face centre of an object
inside the object's box with 5 cm of slack.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array, OrientedBox
from su3d_bench.datasets.replica.mesh_truth import INFO_NAME, AnnotatedMesh, read_objects, shown, whole_number
from su3d_bench.numerics.geometry import rotations_of

SLACK_M = 0.05
UNIT_TOLERANCE = 1e-2  # the release writes unit quaternions in single precision
MOST_M = 1e6  # no box of a room is as far or as large; float64 stays exact to a nanometre


def read_boxes(path: Path, where: str) -> dict[int, OrientedBox]:
    """Object id -> its box in the world; objects without ``oriented_bbox`` are left out."""
    boxes: dict[int, OrientedBox] = {}
    for row in read_objects(path, where):
        object_id = whole_number(row, "id", f"{where}: {INFO_NAME}")
        if row.get("oriented_bbox") is not None:
            boxes[object_id] = _box(row["oriented_bbox"], f"{where}: {INFO_NAME}: object {object_id}")
    return boxes


def _box(content: Any, where: str) -> OrientedBox:
    try:
        abb, orientation = content["abb"], content["orientation"]
        lists = abb["center"], abb["sizes"], orientation["rotation"], orientation["translation"]
    except (KeyError, TypeError, IndexError) as error:
        raise DataError(
            f"{where}: 'oriented_bbox' is incomplete; expected abb (center, sizes) and orientation (rotation, "
            "translation)"
        ) from error
    names = ("center", "sizes", "rotation", "translation")
    centre, sizes, quaternion, translation = (
        _numbers(values, 4 if name == "rotation" else 3, f"{where}: '{name}'")
        for name, values in zip(names, lists, strict=True)
    )
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) < UNIT_TOLERANCE:
        raise DataError(f"{where}: 'rotation' has the length {length:g}; expected a unit quaternion x y z w")
    if (sizes < 0).any():
        raise DataError(f"{where}: 'sizes' are {sizes.tolist()}; expected 0 m or more")
    rotation = rotations_of((quaternion / length)[None])[0]
    return OrientedBox(rotation @ centre + translation, sizes, rotation)


def _numbers(values: Any, n: int, where: str) -> Float64Array:
    numbers = values if isinstance(values, list) else []
    if len(numbers) != n or any(isinstance(value, bool) or not isinstance(value, int | float) for value in numbers):
        raise DataError(f"{where} is {shown(values)} of length {len(numbers)}; expected {n} numbers")
    # an integer in JSON may have any length; comparing it does not overflow
    unfit = next((value for value in numbers if not -MOST_M <= value <= MOST_M), None)
    if unfit is not None:
        raise DataError(f"{where} holds {shown(unfit)}; expected numbers within {MOST_M:g} m")
    return np.array([float(value) for value in numbers])


def objects_outside_boxes(mesh: AnnotatedMesh, boxes: Mapping[int, OrientedBox]) -> dict[int, float]:
    """Object id -> how far, in metres, its farthest face centre lies beyond its box and the slack of 5 cm.

    The centre of a face is the mean of its corners. Objects without box or without face are left out.
    """
    lengths = mesh.corners.lengths
    owner = np.repeat(np.arange(len(lengths)), lengths)
    corners = mesh.vertices[mesh.corners.values].astype(np.float64)
    sums = np.stack([np.bincount(owner, corners[:, axis], len(lengths)) for axis in range(3)], axis=1)
    has_corners = lengths > 0
    centres = sums[has_corners] / lengths[has_corners, None]
    objects = mesh.object_of_face[has_corners]
    outside: dict[int, float] = {}
    for object_id, box in sorted(boxes.items()):
        excess = box.distance_outside(centres[objects == object_id])
        if len(excess) and excess.max() > SLACK_M:
            outside[object_id] = float(excess.max() - SLACK_M)
    return outside
