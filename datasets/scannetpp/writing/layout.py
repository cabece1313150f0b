"""Scenes in the exact layout of ScanNet++: ``data/<scene>/`` with ``iphone/`` and ``scans/``, beside it the lists.

Colour images are those that the official toolkit extracts of the video; depth is packed as in the release, in its size
of 256x192. Every frame has a pose in both files. The vertices of television screens are masked.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.files.atomic import make_folder, replacing, write_text
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Float32Array, Float64Array, Frame, Int64Array
from su3d_bench.datasets.openlex3d import writing as openlex3d
from su3d_bench.datasets.openlex3d.labels import CATEGORIES_NAME
from su3d_bench.datasets.openlex3d.points import SAMPLED_FOLDER
from su3d_bench.datasets.scannet.writing.truth import object_of_vertex, segment_of_vertex
from su3d_bench.datasets.scannetpp.annotations import MASK_NAME, MESH_NAME, OBJECTS_NAME, SEGMENTS_NAME
from su3d_bench.datasets.scannetpp.folders import IPHONE, SCANS
from su3d_bench.datasets.scannetpp.iphone.depth_file import DEPTH_NAME, DEPTH_SIZE, UNITS_PER_METRE, packed_metres
from su3d_bench.datasets.scannetpp.iphone.frames import COLOUR_FOLDER
from su3d_bench.datasets.scannetpp.iphone.poses import CAMERAS_NAME, COLMAP, IMAGES_NAME, TRACKING_NAME
from su3d_bench.datasets.scannetpp.labels import BENCHMARK_FOLDER
from su3d_bench.datasets.scannetpp.truth import TRUTH_NAMES
from su3d_bench.datasets.scannetpp.writing.categories import list_texts, room_of, scene_name, without_instances, words
from su3d_bench.datasets.writing import (
    FRAMES_PER_SECOND,
    Layout,
    Scan,
    ScannedDataset,
    ScannedObject,
    SceneTarget,
    write_shared_text,
)
from su3d_bench.formats.images import JPEG_QUALITY, depth_in_units, jpeg_bytes, list_column, triangles_of
from su3d_bench.formats.ply import Column, PlyElement, write_ply

LAYOUT_VERSION = 1  # raise it whenever the same scene is written as other bytes
SCENES_FOLDER = "data"
PIECES = ".depth"
MASKED = ("tv-screen",)  # laser scanners see little of what is dark and bright at once
LABELS_OF = "scannetpp"  # as OpenLex3D calls the dataset
NO_OBJECT = -100  # in what the official toolbox samples
CORNER = 0.5  # of the first pixel, from its middle


class ScannetppLayout(Layout):
    """Rooms as scenes ``0000000000`` and so on (see ``categories``)."""

    name = "scannetpp"
    reader = "scannetpp"
    settings = (LAYOUT_VERSION, "scannetpp", UNITS_PER_METRE, JPEG_QUALITY)

    def scenes_folder(self, out: Path) -> Path:
        return out / SCENES_FOLDER

    def scene_name(self, scene: str) -> str:
        return scene_name(scene)

    def target(self, scene: str, key: str, out: Path) -> SceneTarget:
        folder = out / SCENES_FOLDER / scene_name(scene)
        poses = (f"{COLMAP}/{CAMERAS_NAME}", f"{COLMAP}/{IMAGES_NAME}", TRACKING_NAME)
        truth = (*(folder / IPHONE / name for name in poses), *(folder / SCANS / name for name in TRUTH_NAMES))
        labels = openlex3d.labels_folder(out, LABELS_OF, folder.name)
        sampled = out / SAMPLED_FOLDER / f"{folder.name}.pth"
        apart = ((openlex3d.STAGED, labels), (sampled.name, sampled))
        return SceneTarget(
            scene, key, folder, f"{IPHONE}/{DEPTH_NAME}", (*truth, labels / CATEGORIES_NAME, sampled), apart
        )

    def marker_extras(self, names: Sequence[str]) -> dict[str, Any]:
        return {"rooms": {scene: room for scene in names if (room := room_of(scene)) is not None}}

    def write_shared(self, dataset: ScannedDataset, scene: str, out: Path) -> None:
        make_folder(out / BENCHMARK_FOLDER)
        for name, text in list_texts().items():
            write_shared_text(out / BENCHMARK_FOLDER / name, text, "is another list than that of the rooms")
        openlex3d.write_prompts(out, LABELS_OF)

    def frame_names(self, index: int) -> Sequence[str]:
        return f"{IPHONE}/{COLOUR_FOLDER}/{_image_name(index)}", f"{PIECES}/{index:06d}"

    def frame_files(self, frame: Frame) -> Sequence[bytes]:
        return jpeg_bytes(frame.rgb), packed_metres(depth_in_units(_at_depth_size(frame.depth_m), UNITS_PER_METRE))

    def join(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        if not target.has_frames:
            n_frames = len(dataset.frames(target.scene, 1))
            pieces = (file_bytes(target.partial / self.frame_names(index)[1]) for index in range(n_frames))
            with replacing(target.partial / target.frames) as stream:
                stream.writelines(pieces)
        if (target.partial / PIECES).exists():
            shutil.rmtree(target.partial / PIECES)

    def write_truth(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        colmap, scans = target.partial / IPHONE / COLMAP, target.partial / SCANS
        make_folder(colmap)
        make_folder(scans)
        height, width = dataset.frames(target.scene, 1)[0].depth_m.shape
        poses, k = dataset.trajectory(target.scene), dataset.intrinsics.copy()
        k[:2, 2] += CORNER
        camera = " ".join(repr(float(v)) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0, 0, 0))
        write_text(colmap / CAMERAS_NAME, f"# Number of cameras: 1\n1 OPENCV {width} {height} {camera}\n")
        write_text(colmap / IMAGES_NAME, _images_text(poses))
        tracked = {
            _image_name(index).partition(".")[0]: {
                "timestamp": index / FRAMES_PER_SECOND,
                "pose": pose.tolist(),
                "aligned_pose": pose.tolist(),
                "intrinsic": k.tolist(),
            }
            for index, pose in enumerate(poses)
        }
        write_text(target.partial / IPHONE / TRACKING_NAME, json.dumps(tracked, indent=1) + "\n")
        scan = dataset.scan(target.scene)
        numbers = _write_scan(scan, dataset.objects(target.scene), target.folder.name, scans)
        self._write_labels(scan, dataset.objects(target.scene), numbers, target)

    def _write_labels(
        self, scan: Scan, objects: Sequence[ScannedObject], numbers: Mapping[int, int], target: SceneTarget
    ) -> None:
        """OpenLex3D's labels, and the sampled points with the objects of the nearest vertices that they are for.

        Of what is sampled the official toolbox keeps classes with instances alone; points are the vertices themselves.
        """
        kept = {known.id for known in objects if words()[known.class_name] not in without_instances()}
        numbers = {key: number for key, number in numbers.items() if key in kept}
        owner = object_of_vertex(scan)
        number_of = np.full(int(max(owner.max(initial=0), *numbers, 0)) + 1, NO_OBJECT, np.int64)
        number_of[list(numbers)] = list(numbers.values())
        openlex3d.write_labels(target.partial / openlex3d.STAGED, target.folder.name, objects, numbers)
        path = target.partial / f"{target.folder.name}.pth"
        openlex3d.write_sampled_points(path, target.folder.name, scan.vertices.astype(np.float64), number_of[owner])


def _image_name(index: int) -> str:
    return f"frame_{index:06d}.jpg"


def _images_text(poses: Float64Array) -> str:
    """World-to-camera poses as COLMAP lists them, each above a line for points, of which there are none."""
    from scipy.spatial.transform import Rotation

    lines = [f"# Number of images: {len(poses)}, mean observations per image: 0"]
    for index, pose in enumerate(poses):
        to_camera = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(to_camera[:3, :3]).as_quat()
        values = " ".join(repr(float(value)) for value in (w, x, y, z, *to_camera[:3, 3]))
        lines += [f"{index + 1} {values} 1 {_image_name(index)}", ""]
    return "\n".join(lines) + "\n"


def _at_depth_size(depth_m: Float32Array) -> Float32Array:
    """The depth nearest to each pixel of an image of the iPhone's size."""
    import cv2

    return np.asarray(cv2.resize(depth_m, DEPTH_SIZE, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)


def _write_scan(scan: Scan, objects: Sequence[ScannedObject], scene: str, folder: Path) -> dict[int, int]:
    """Write the annotated mesh; the object ids of the annotation by those of the scan."""
    owner, segments = object_of_vertex(scan), segment_of_vertex(scan)
    faces = triangles_of(scan.faces)
    columns: dict[str, Column] = {name: scan.vertices[:, i].astype(np.float32) for i, name in enumerate("xyz")}
    columns |= {name: scan.colours[:, i] for i, name in enumerate(("red", "green", "blue"))}
    face = PlyElement("face", len(faces), {"vertex_indices": list_column(faces)})
    write_ply(folder / MESH_NAME, [PlyElement("vertex", len(scan.vertices), columns), face])
    masked = np.flatnonzero(np.isin(owner, [known.id for known in objects if known.class_name in MASKED]))
    write_text(folder / MASK_NAME, "".join(f"{vertex}\n" for vertex in masked.tolist()))
    _write_json(folder / SEGMENTS_NAME, {"sceneId": scene, "segIndices": segments.tolist()})
    # The first object of a file is never an instance of the benchmark: here it is one that would be none anyhow.
    seen = [known for known in objects if (owner == known.id).any()]
    seen.sort(key=lambda known: words()[known.class_name] not in without_instances())
    groups = [_group(number, known, segments[owner == known.id]) for number, known in enumerate(seen)]
    _write_json(folder / OBJECTS_NAME, {"sceneId": scene, "appId": "su3d-bench", "segGroups": groups})
    return {known.id: int(group["objectId"]) for known, group in zip(seen, groups, strict=True)}


def _group(number: int, known: ScannedObject, segments: Int64Array) -> dict[str, Any]:
    low, high = np.array(known.box_min, np.float64), np.array(known.box_max, np.float64)
    box = {"centroid": ((low + high) / 2).tolist(), "axesLengths": (high - low).tolist()}
    return {
        "id": number,
        "objectId": number + 1,
        "index": number,
        "label": words()[known.class_name],
        "segments": np.unique(segments).tolist(),
        "obb": box | {"normalizedAxes": np.eye(3).reshape(-1).tolist()},
    }


def _write_json(path: Path, value: Any) -> None:
    """JSON on one line: a mesh has a number a vertex."""
    write_text(path, json.dumps(value, separators=(",", ":")) + "\n")
