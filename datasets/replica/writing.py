"""Write scenes in the exact layout of Replica: the render tree and the original release."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import json_text, make_folder, write_json, write_text
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float64Array, Frame
from su3d_bench.datasets.replica.folders import original_name, replica_label_set
from su3d_bench.datasets.replica.frames import colour_name, depth_name
from su3d_bench.datasets.replica.truth import INFO_NAME, MESH_NAME
from su3d_bench.datasets.writing import Layout, SceneTarget, write_shared_text
from su3d_bench.formats import images
from su3d_bench.formats.ply import Column, PlyElement, write_ply

if TYPE_CHECKING:
    from su3d_bench.datasets.procedural.dataset import GeneratedScenes
    from su3d_bench.datasets.procedural.scan import SceneScan
    from su3d_bench.datasets.procedural.truth import SceneObject

LAYOUT_VERSION = 1  # increase it when the written bytes of a scene change
DEPTH_SCALE = 6553.5  # NICE-SLAM's render: 65535 is 10 m
RENDER_FOLDER, ORIGINAL_FOLDER = "Replica", "replica_v1"
NO_CLASS = -1  # as in the release
STAGED_ORIGINAL, STAGED_MESH = ".original", ".mesh.ply"


class ReplicaLayout(Layout):
    """``Replica/<scene>/`` with the frames, the annotated mesh in ``replica_v1``; one camera for all scenes."""

    name = "replica"
    reader = "replica"
    settings = (LAYOUT_VERSION, DEPTH_SCALE, images.JPEG_QUALITY)

    def scenes_folder(self, out: Path) -> Path:
        return out / RENDER_FOLDER

    def target(self, scene: str, key: str, out: Path) -> SceneTarget:
        folder, mesh = out / RENDER_FOLDER / scene, out / RENDER_FOLDER / f"{scene}_mesh.ply"
        original = out / ORIGINAL_FOLDER / original_name(scene)
        files = (folder / "results", folder / "traj.txt", mesh, original / MESH_NAME, original / INFO_NAME)
        return SceneTarget(scene, key, folder, files, ((STAGED_ORIGINAL, original), (STAGED_MESH, mesh)))

    def write_shared(self, dataset: GeneratedScenes, scene: str, out: Path) -> None:
        make_folder(out / ORIGINAL_FOLDER)
        height, width = dataset.frames(scene, 1)[0].depth_m.shape
        k = dataset.intrinsics
        sizes = {"w": width, "h": height, "fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
        text = json_text({"camera": sizes | {"scale": DEPTH_SCALE}})
        complaint = f"differs from the camera of {dataset.name} ({width}x{height})"
        write_shared_text(out / RENDER_FOLDER / "cam_params.json", text, complaint)

    def write_frames(
        self, frames: Iterator[Frame], dataset: GeneratedScenes, target: SceneTarget, folder: Path
    ) -> None:
        make_folder(folder / "results")
        for frame in frames:
            depth = images.depth_in_units(frame.depth_m, DEPTH_SCALE)
            (folder / colour_name(frame.index)).write_bytes(images.jpeg_bytes(frame.rgb))
            (folder / depth_name(frame.index)).write_bytes(images.png_bytes(depth))

    def write_truth(self, dataset: GeneratedScenes, target: SceneTarget, folder: Path) -> None:
        """Trajectory, annotated mesh, table of objects and plain mesh."""
        scan = dataset.scan(target.scene)
        staged = folder / STAGED_ORIGINAL
        make_folder((staged / MESH_NAME).parent)
        write_ply(staged / MESH_NAME, _annotated_mesh(scan))
        write_json(staged / INFO_NAME, _info(dataset.objects(target.scene)))
        write_ply(folder / STAGED_MESH, _plain_mesh(scan))
        poses = dataset.trajectory(target.scene)
        lines = [" ".join(repr(float(value)) for value in pose.reshape(-1)) for pose in poses]
        write_text(folder / "traj.txt", "\n".join(lines) + "\n")


def _vertex_element(scan: SceneScan) -> PlyElement:
    columns: dict[str, Column] = {}
    for names, array in ((("x", "y", "z"), scan.vertices), (("nx", "ny", "nz"), scan.normals)):
        columns |= {name: array[:, i].astype(np.float32) for i, name in enumerate(names)}
    columns |= {name: scan.colours[:, i].astype(np.uint8) for i, name in enumerate(("red", "green", "blue"))}
    return PlyElement("vertex", len(scan.vertices), columns)


def _annotated_mesh(scan: SceneScan) -> list[PlyElement]:
    """Quads with a 16-bit ``object_id``, as in the release."""
    if scan.object_id.max(initial=0) > np.iinfo(np.uint16).max or scan.object_id.min(initial=0) < 0:
        raise DataError(f"object ids go up to {scan.object_id.max()}; the layout's 16 bits allow 0 to 65535")
    faces: dict[str, Column] = {
        "vertex_indices": images.list_column(scan.faces),
        "object_id": scan.object_id.astype(np.uint16),
    }
    return [_vertex_element(scan), PlyElement("face", len(scan.faces), faces)]


def _plain_mesh(scan: SceneScan) -> list[PlyElement]:
    """The same surface as triangles, without labels."""
    triangles = images.triangles_of(scan.faces)
    return [
        _vertex_element(scan),
        PlyElement("face", len(triangles), {"vertex_indices": images.list_column(triangles)}),
    ]


def _info(objects: Sequence[SceneObject]) -> dict[str, Any]:
    """The content of ``info_semantic.json``."""
    labels = replica_label_set()
    ids = dict(zip(labels.names, labels.ids, strict=True))
    names = {known.id: _class_name(known.class_name) for known in objects}
    class_of_id = {object_id: ids.get(name, NO_CLASS) for object_id, name in names.items()}
    return {
        "classes": [{"id": i, "name": name} for i, name in zip(labels.ids, labels.names, strict=True)],
        "gravity_center": [0.0, 0.0, 0.0],
        "gravity_dir": [0.0, 0.0, -1.0],
        "id_to_label": [class_of_id.get(object_id, -1) for object_id in range(max(class_of_id, default=-1) + 1)],
        "objects": [
            {
                "class_id": class_of_id[known.id],
                "class_name": names[known.id],
                "id": known.id,
                "oriented_bbox": _oriented_box(
                    np.array(known.box_min, np.float64), np.array(known.box_max, np.float64)
                ),
            }
            for known in objects
        ],
    }


@cache
def _class_names() -> Mapping[str, str]:
    return dict(parse_toml(file_text(Path(__file__).with_name("made_classes.toml")))["classes"])


def _class_name(name: str) -> str:
    """Replica's class for a class of generated scenes; the name itself if it is one, or if there is none."""
    return _class_names().get(name, name)


def _oriented_box(low: Float64Array, high: Float64Array) -> dict[str, Any]:
    return {
        "abb": {"center": ((low + high) / 2).tolist(), "sizes": (high - low).tolist()},
        "orientation": {"rotation": [0.0, 0.0, 0.0, 1.0], "translation": [0.0, 0.0, 0.0]},
    }
