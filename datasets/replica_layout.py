"""Scenes of a scanned dataset, written in the exact layout of Replica: the render tree and the original release.

A scene is built in a hidden folder beside its place and moved there when it is whole; a killed process leaves frames
that the next one takes over, and no scene that looks finished. ``rooms.json`` beside ``cam_params.json`` names the
scenes that were made here, each with the key of what it was made from.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from su3d_bench.datasets.ply import Column, ListColumn, PlyElement, write_ply
from su3d_bench.datasets.replica_folders import MARKER, original_name, read_marker
from su3d_bench.datasets.replica_frames import colour_name, depth_name
from su3d_bench.datasets.replica_labels import replica_label_set
from su3d_bench.datasets.replica_truth import INFO_NAME, MESH_NAME
from su3d_bench.digests import digest_json
from su3d_bench.errors import DataError, StoreError
from su3d_bench.store import json_text, make_folder, write_bytes, write_json, write_text
from su3d_bench.types import Float32Array, Float64Array, Frame, Int32Array, UInt8Array

LAYOUT_VERSION = 1  # raise it whenever the same scene is written as other bytes
DEPTH_SCALE = 6553.5  # of NICE-SLAM's render: 65535 is 10 m
JPEG_QUALITY = 95
PNG_COMPRESSION = 3
RENDER_FOLDER, ORIGINAL_FOLDER = "Replica", "replica_v1"
STAGED_ORIGINAL, STAGED_MESH = ".original", ".mesh.ply"


class ScannedObject(Protocol):
    """An object with its id in the scan, its class, and its axis-aligned box in the world, metres."""

    @property
    def id(self) -> int: ...
    @property
    def class_id(self) -> int: ...
    @property
    def class_name(self) -> str: ...
    @property
    def box_min(self) -> Sequence[float]: ...
    @property
    def box_max(self) -> Sequence[float]: ...


class Scan(Protocol):
    """``vertices`` and ``normals`` (V, 3), ``colours`` (V, 3), ``faces`` (F, 4) quads, ``object_id`` (F,)."""

    @property
    def vertices(self) -> Float32Array: ...
    @property
    def normals(self) -> Float32Array: ...
    @property
    def colours(self) -> UInt8Array: ...
    @property
    def faces(self) -> Int32Array: ...
    @property
    def object_id(self) -> Int32Array: ...


class ScannedDataset(Protocol):
    """What can be written in this layout: Replica's classes, one camera, frames at full rate and a scan."""

    name: str

    @property
    def intrinsics(self) -> Float64Array: ...
    def digest(self, scene: str) -> str: ...
    def objects(self, scene: str) -> Sequence[ScannedObject]: ...
    def trajectory(self, scene: str) -> Float64Array: ...
    def frames(self, scene: str, stride: int) -> Sequence[Frame]: ...
    def scan(self, scene: str) -> Scan: ...


@dataclass(frozen=True)
class SceneTarget:
    """One scene to be made below ``out``, under the ``key`` of what it is made from."""

    out: Path
    scene: str
    key: str

    @property
    def render(self) -> Path:
        return self.out / RENDER_FOLDER / self.scene

    @property
    def mesh(self) -> Path:
        return self.out / RENDER_FOLDER / f"{self.scene}_mesh.ply"

    @property
    def original(self) -> Path:
        return self.out / ORIGINAL_FOLDER / original_name(self.scene)

    @property
    def partial(self) -> Path:
        """Where the scene is built; it bears the key, so that frames of another making are never taken over."""
        return self.render.with_name(f".{self.scene}.{self.key[:12]}.partial")

    @property
    def is_whole(self) -> bool:
        parts = (self.render, self.mesh, self.original / MESH_NAME, self.original / INFO_NAME)
        return all(part.exists() for part in parts)


def plan_scenes(dataset: ScannedDataset, scenes: Sequence[str], out: Path) -> list[SceneTarget]:
    """The scenes that are not yet whole below ``out``, which is made ready for them; one caller at a time.

    Raises ``StoreError`` where ``out`` cannot be written or holds one of the scenes, or a camera, from elsewhere.
    """
    folder = out / RENDER_FOLDER
    make_folder(folder)
    make_folder(out / ORIGINAL_FOLDER)
    targets = [SceneTarget(out, scene, _key(dataset, scene)) for scene in scenes]
    marked = read_marker(folder)
    for target in targets:
        if target.render.exists() and marked.get(target.scene) != target.key:
            raise StoreError(
                f"{target.render}: holds another '{target.scene}', made elsewhere or with other options; delete it or "
                "choose another folder with --out"
            )
    pending = [target for target in targets if not target.is_whole]
    if not pending:
        return []
    _write_camera(folder / "cam_params.json", dataset, pending[0].scene)
    marked |= {target.scene: target.key for target in targets}
    marker = {"generator": f"su3d-bench {dataset.name}", "version": LAYOUT_VERSION}
    write_json(folder / MARKER, marker | {"scenes": dict(sorted(marked.items()))})
    for target in pending:
        for leftover in target.partial.rglob(".*.tmp"):
            leftover.unlink(missing_ok=True)
    return pending


def _key(dataset: ScannedDataset, scene: str) -> str:
    return digest_json([dataset.digest(scene), LAYOUT_VERSION, DEPTH_SCALE, JPEG_QUALITY])


def _write_camera(path: Path, dataset: ScannedDataset, scene: str) -> None:
    height, width = dataset.frames(scene, 1)[0].depth_m.shape
    k = dataset.intrinsics
    camera = {"w": width, "h": height, "fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "scale": DEPTH_SCALE}
    text = json_text({"camera": camera})
    if path.exists() and path.read_text(encoding="utf-8") != text:
        raise StoreError(
            f"{path}: is another camera than that of {dataset.name} ({width}x{height}), and all scenes of a folder "
            "share one; choose another folder with --out"
        )
    write_text(path, text)


def write_frames(
    dataset: ScannedDataset, target: SceneTarget, indices: range, report: Callable[[int], None] = lambda n_done: None
) -> None:
    """Colour and depth of the frames at ``indices``; those that an earlier process has written are kept."""
    if target.render.exists():
        return
    make_folder(target.partial / "results")
    frames = dataset.frames(target.scene, 1)
    for n_done, index in enumerate(indices, 1):
        colour, depth = target.partial / colour_name(index), target.partial / depth_name(index)
        if not (colour.exists() and depth.exists()):
            frame = frames[index]
            write_bytes(colour, _jpeg(frame.rgb))
            write_bytes(depth, _depth_png(frame.depth_m))
        report(n_done)


def _jpeg(rgb: UInt8Array) -> bytes:
    import cv2

    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def _depth_png(depth_m: Float32Array) -> bytes:
    """Depth in units of 1 / 6553.5 m, rounded; what 16 bits cannot hold, beyond 10 m, becomes 0, no reading."""
    import cv2

    values = np.rint(depth_m.astype(np.float64) * DEPTH_SCALE)
    values = np.where(values > np.iinfo(np.uint16).max, 0, values).astype(np.uint16)
    return bytes(cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])[1])


def write_truth(dataset: ScannedDataset, target: SceneTarget) -> None:
    """Trajectory, annotated mesh, table of objects and plain mesh, beside the frames until the scene is finished."""
    scan = dataset.scan(target.scene)
    staged = target.partial / STAGED_ORIGINAL
    make_folder((staged / MESH_NAME).parent)
    write_ply(staged / MESH_NAME, _annotated_mesh(scan))
    write_json(staged / INFO_NAME, _info(dataset.objects(target.scene)))
    write_ply(target.partial / STAGED_MESH, _plain_mesh(scan))
    lines = [" ".join(repr(float(value)) for value in pose.reshape(-1)) for pose in dataset.trajectory(target.scene)]
    write_text(target.partial / "traj.txt", "\n".join(lines) + "\n")


def _vertex_element(scan: Scan) -> PlyElement:
    columns: dict[str, Column] = {}
    for names, array in ((("x", "y", "z"), scan.vertices), (("nx", "ny", "nz"), scan.normals)):
        columns |= {name: array[:, i].astype(np.float32) for i, name in enumerate(names)}
    columns |= {name: scan.colours[:, i].astype(np.uint8) for i, name in enumerate(("red", "green", "blue"))}
    return PlyElement("vertex", len(scan.vertices), columns)


def _list_of(rows: Int32Array) -> ListColumn:
    return ListColumn(np.arange(len(rows) + 1) * rows.shape[1], rows.reshape(-1).astype(np.int32))


def _annotated_mesh(scan: Scan) -> list[PlyElement]:
    """Quads with ``object_id`` of 16 bits, as in the release."""
    if scan.object_id.max(initial=0) > np.iinfo(np.uint16).max or scan.object_id.min(initial=0) < 0:
        raise DataError(f"object ids go to {scan.object_id.max()}; the layout has 16 bits, 0 to 65535")
    faces: dict[str, Column] = {
        "vertex_indices": _list_of(scan.faces),
        "object_id": scan.object_id.astype(np.uint16),
    }
    return [_vertex_element(scan), PlyElement("face", len(scan.faces), faces)]


def _plain_mesh(scan: Scan) -> list[PlyElement]:
    """The same surface as triangles, without labels."""
    triangles = scan.faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return [_vertex_element(scan), PlyElement("face", len(triangles), {"vertex_indices": _list_of(triangles)})]


def _info(objects: Sequence[ScannedObject]) -> dict[str, Any]:
    """The content of ``info_semantic.json``."""
    labels = replica_label_set()
    class_of_id = {one.id: one.class_id for one in objects}
    return {
        "classes": [{"id": i, "name": name} for i, name in zip(labels.ids, labels.names, strict=True)],
        "gravity_center": [0.0, 0.0, 0.0],
        "gravity_dir": [0.0, 0.0, -1.0],
        "id_to_label": [class_of_id.get(one, -1) for one in range(max(class_of_id, default=-1) + 1)],
        "objects": [
            {
                "class_id": one.class_id,
                "class_name": one.class_name,
                "id": one.id,
                "oriented_bbox": _oriented_box(np.array(one.box_min, np.float64), np.array(one.box_max, np.float64)),
            }
            for one in objects
        ],
    }


def _oriented_box(low: Float64Array, high: Float64Array) -> dict[str, Any]:
    return {
        "abb": {"center": ((low + high) / 2).tolist(), "sizes": (high - low).tolist()},
        "orientation": {"rotation": [0.0, 0.0, 0.0, 1.0], "translation": [0.0, 0.0, 0.0]},
    }


def finish_scene(target: SceneTarget) -> None:
    """Move everything to its place, the frames last: only then is there a scene."""
    try:
        if target.original.exists():
            shutil.rmtree(target.original)
        os.replace(target.partial / STAGED_ORIGINAL, target.original)
        os.replace(target.partial / STAGED_MESH, target.mesh)
        if target.render.exists():
            shutil.rmtree(target.partial)
        else:
            os.replace(target.partial, target.render)
        for leftover in target.render.parent.glob(f".{target.scene}.*.partial"):
            shutil.rmtree(leftover)
    except OSError as error:
        raise StoreError(f"cannot write {target.render}: {error.strerror or error}") from error


def write_scene(
    dataset: ScannedDataset, scene: str, out: Path, report: Callable[[int], None] = lambda n_done: None
) -> None:
    """Write one scene whole; nothing is done where it is there already."""
    for target in plan_scenes(dataset, [scene], out):
        write_frames(dataset, target, range(len(dataset.frames(scene, 1))), report)
        write_truth(dataset, target)
        finish_scene(target)
