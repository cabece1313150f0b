"""Faults in the files of a Replica scene, one line each (readers stop at the first fault), and its key.

Images are not checked here, but when frames are decoded.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.geometry import rotations_of
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Float64Array, GroundTruth, ObjectBoxes, OrientedBox
from su3d_bench.datasets.recordings.file_dataset import faults_of, shortened
from su3d_bench.datasets.recordings.recorded_frames import reading
from su3d_bench.datasets.replica.folders import replica_label_set
from su3d_bench.datasets.replica.frames import (
    check_frames_complete,
    read_camera,
    trajectory_lines,
)
from su3d_bench.datasets.replica.truth import INFO_NAME, MESH_NAME, AnnotatedMesh, Info, read_annotated_mesh, read_info
from su3d_bench.formats.images import PNG_SIGNATURE
from su3d_bench.formats.json_models import FileModel, Lengths, Metres, Point, checked_json
from su3d_bench.formats.poses import poses_of_lines

SLACK_M = 0.05
SPACING_M = 0.05  # of the points on the sides of boxes
MIN_EDGE_POINTS = 6  # points along an edge: the smallest box then has 216 on its sides, enough to count as an object
MAX_POINTS = 2_000_000
MAX_OBJECTS = 10_000  # the release has at most a few hundred per scene
UNIT_TOLERANCE = 1e-2  # the release writes unit quaternions in single precision


class BoxSize(FileModel):
    center: Point
    sizes: Lengths


class BoxOrientation(FileModel):
    rotation: Annotated[list[Metres], Field(min_length=4, max_length=4)]  # x y z w
    translation: Point


class ObjectBox(FileModel):
    """The ``oriented_bbox`` of an object."""

    abb: BoxSize
    orientation: BoxOrientation


def boxes_of(info: Info, where: str) -> dict[int, OrientedBox]:
    """Object id -> its box in the world; objects without ``oriented_bbox`` are excluded."""
    return {
        row.id: _box(row.oriented_bbox, f"{where}: {INFO_NAME}: object {row.id}")
        for row in info.objects
        if row.oriented_bbox is not None
    }


def _box(content: Any, where: str) -> OrientedBox:
    found = checked_json(content, where, ObjectBox)
    quaternion = np.array(found.orientation.rotation)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) < UNIT_TOLERANCE:
        raise DataError(f"{where}: 'rotation' has the length {length:g}; expected a unit quaternion x y z w")
    rotation = rotations_of((quaternion / length)[None])[0]
    centre = rotation @ np.array(found.abb.center) + np.array(found.orientation.translation)
    return OrientedBox(centre, np.array(found.abb.sizes), rotation)


def object_boxes_of(path: Path, where: str) -> ObjectBoxes:
    """The boxes of the objects that have a class (at least one) by instance id, which is the object id plus 1."""
    info, labels = read_info(path, where), replica_label_set()
    classes, found = info.class_of_object, boxes_of(info, where)
    boxes = {number + 1: found[number] for number in sorted(found) if classes[number] in labels.ids}
    if not boxes:
        raise GroundTruthMissing(f"{where}: no ground truth 'boxes'; no object with a class has a box in {INFO_NAME}")
    if len(boxes) > MAX_OBJECTS:
        raise DataError(f"{where}: {INFO_NAME}: {len(boxes)} objects have a box; expected at most {MAX_OBJECTS}")
    return ObjectBoxes(boxes, {instance: classes[instance - 1] for instance in boxes}, labels)


def box_truth(known: ObjectBoxes) -> GroundTruth:
    """Points on the sides of the boxes, each with the class and instance of its box."""
    most_along = max(MIN_EDGE_POINTS, int((MAX_POINTS / (6 * max(1, len(known.boxes)))) ** 0.5))
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
    n_along = np.clip(np.ceil(box.sizes / SPACING_M) + 1, MIN_EDGE_POINTS, most_along).astype(np.int64)
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

    The centre of a face is the mean of its corners. Objects without a box or a face are excluded.
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


PNG_HEAD_BYTES = 64  # signature and size chunk
PNG_TAIL_BYTES = 1024  # end of the pixels, and small trailing chunks


def render_problems(tree: Path, scene: str, where: str) -> Iterator[str]:
    """Faults of camera and trajectory of the scene in a render ``tree``, and missing images."""
    lines: list[str] = []
    yield from faults_of([lambda: read_camera(tree / "cam_params.json", where),
                          lambda: lines.extend(trajectory_lines(tree / scene / "traj.txt", where))])  # fmt: skip
    reads = [partial(poses_of_lines, [line], f"{where}: traj.txt", number) for number, line in enumerate(lines, 1)]
    yield from shortened(faults_of(reads), f"{where}: traj.txt")
    yield from faults_of([lambda: check_frames_complete(tree / scene, len(lines), where)])


def original_problems(original: Path | None, where: str) -> Iterator[str]:
    """Faults of the scene in the original release; none if it is absent or has only its boxes."""
    if original is None:
        return
    if not (original / INFO_NAME).exists():
        yield f"{where}: {INFO_NAME} is missing in {original}; copy it there"
        return
    try:
        boxes = boxes_of(read_info(original / INFO_NAME, where), where)
        if not (original / MESH_NAME).exists():
            return
        outside = objects_outside_boxes(read_annotated_mesh(original, where), boxes)
    except DataError as error:
        yield str(error)
        return
    lines = (
        f"{where}: {INFO_NAME}: object {object_id} has faces {beyond_m:.2f} m beyond its box and the slack of "
        f"{SLACK_M} m; the boxes belong to another mesh"
        for object_id, beyond_m in outside.items()
    )
    yield from shortened(lines, f"{where}: {INFO_NAME}")


def digest_of(files: Sequence[Path], images: Sequence[Path], where: str) -> str:
    """A key of the content of ``files``, and of the names, sizes and content of ``images``."""
    total = hashlib.sha256()
    with reading(where):
        for path in files:
            total.update(f"{path.name} {digest_file(path)}\n".encode())
        for path in images:
            total.update(f"{path.name} {image_key(path)}\n".encode())
    return total.hexdigest()


def image_key(path: Path) -> str:
    """A key of an image: of every byte or, for a PNG, of its size and its checksum near the end.

    The pixels of a PNG are a zlib stream, which ends with the Adler-32 of the uncompressed rows. Not detected:
    other pixels with the same checksum (1 in 2**32) and size, and damage within a PNG, which the frame reader
    rejects because the chunk checksum fails.
    """
    with opened(path) as file:
        head = file.read(PNG_HEAD_BYTES)
        key = hashlib.sha256(head)
        size = file.seek(0, 2)
        file.seek(max(len(head), size - PNG_TAIL_BYTES) if head.startswith(PNG_SIGNATURE) else len(head))
        key.update(file.read())
    return f"{size} {key.hexdigest()}"
