"""The oriented boxes of Replica's objects, from ``info_semantic.json`` alone, and whether the mesh agrees with them.

They are a ground truth of their own where the mesh is not here.

A box is given in its own axes (``abb``) and brought to the world by a rotation, a quaternion x y z w, and a
translation. Source: habitat-sim's reader of Replica scenes, and its test, which wants every face centre of an object
inside the object's box with 5 cm of slack.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.geometry import rotations_of
from su3d_bench.core.types import Float64Array, GroundTruth, ObjectBoxes, OrientedBox
from su3d_bench.datasets.replica.folders import replica_label_set
from su3d_bench.datasets.replica.mesh_truth import (
    INFO_NAME,
    AnnotatedMesh,
    read_object_classes,
    read_objects,
    shown,
    whole_number,
)

SLACK_M = 0.05
SPACING_M = 0.05  # of the points on the sides of boxes
LEAST_ALONG = 6  # points along one edge: the sides of the smallest thing then have 216, enough to count as an object
MOST_POINTS = 2_000_000
MOST_OBJECTS = 10_000  # the release has at most some hundreds in a scene
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


def object_boxes_of(path: Path, where: str) -> ObjectBoxes:
    """The boxes of the objects that have a class, at least one, by instance id: that of the object, plus 1."""
    classes, labels = read_object_classes(path, where), replica_label_set()
    found = read_boxes(path, where)
    boxes = {number + 1: found[number] for number in sorted(found) if classes[number] in labels.ids}
    if not boxes:
        raise GroundTruthMissing(f"{where}: no ground truth 'boxes'; no object of a class has a box in {INFO_NAME}")
    if len(boxes) > MOST_OBJECTS:
        raise DataError(f"{where}: {INFO_NAME}: {len(boxes)} objects have a box; expected at most {MOST_OBJECTS}")
    return ObjectBoxes(boxes, {instance: classes[instance - 1] for instance in boxes}, labels)


def box_truth(known: ObjectBoxes) -> GroundTruth:
    """Points on the sides of the boxes, each with the class and instance of its box."""
    most_along = max(LEAST_ALONG, int((MOST_POINTS / (6 * max(1, len(known.boxes)))) ** 0.5))
    parts = [_on_sides(box, most_along) for box in known.boxes.values()]
    sizes = [len(part) for part in parts]
    classes = np.array([known.class_of_instance[instance] for instance in known.boxes], np.int32)
    return GroundTruth(
        points=np.concatenate([np.zeros((0, 3)), *parts]).astype(np.float32),
        semantic=np.repeat(classes, sizes),
        instance=np.repeat(np.array(list(known.boxes), np.int32), sizes),
        labels=known.labels,
        variant="boxes",
        source=f"{INFO_NAME}, the oriented boxes of objects",
        boxes=known,
    )


def _on_sides(box: OrientedBox, most_along: int) -> Float64Array:
    """A grid (N, 3) on the six sides."""
    n_along = np.clip(np.ceil(box.sizes / SPACING_M) + 1, LEAST_ALONG, most_along).astype(np.int64)
    edges = [np.linspace(-0.5, 0.5, int(n)) * size for n, size in zip(n_along, box.sizes, strict=True)]
    parts = []
    for axis in range(3):
        u, v = (other for other in range(3) if other != axis)
        grid = np.stack(np.meshgrid(edges[u], edges[v], indexing="ij"), axis=-1).reshape(-1, 2)
        for side in (-0.5, 0.5):
            part = np.empty((len(grid), 3))
            part[:, axis], part[:, u], part[:, v] = side * box.sizes[axis], grid[:, 0], grid[:, 1]
            parts.append(part)
    on_sides: Float64Array = np.concatenate(parts) @ box.rotation.T + box.centre
    return on_sides


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
