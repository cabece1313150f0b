"""Rooms in the exact layout that the OpenSUN3D challenge downloads, beside them its lists, queries and truths.

A room is searched for one kind of thing in it: the text is the name of a class, the answer all its objects.
"""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import make_folder, write_text
from su3d_bench.core.types import Float64Array, Frame
from su3d_bench.datasets.arkitscenes.challenge import (
    LISTS_FOLDER,
    QUERIES_COLUMNS,
    SCENES_COLUMNS,
    TRACK,
    TRUTH_FOLDER,
)
from su3d_bench.datasets.arkitscenes.folders import DEVELOPMENT, TRAJECTORY_NAME, mesh_name
from su3d_bench.datasets.arkitscenes.frames import (
    CONFIDENCE,
    DEPTH,
    LOWRES,
    MOST_CONFIDENCE,
    UNITS_PER_METRE,
    camera_folder,
)
from su3d_bench.datasets.arkitscenes.trajectory import trajectory_line
from su3d_bench.datasets.scannet.writing.truth import object_of_vertex
from su3d_bench.datasets.scannetpp.writing import categories
from su3d_bench.datasets.writing import FRAMES_PER_SECOND, Layout, Scan, ScannedDataset, ScannedObject, SceneTarget
from su3d_bench.formats.images import depth_in_units, list_column, png_bytes, triangles_of
from su3d_bench.formats.ply import Column, PlyElement, write_ply

LAYOUT_VERSION = 1  # raise it whenever the same scene is written as other bytes
WIDTH = 256  # of lowres_wide and lowres_depth: raw/README.md of apple/ARKitScenes at 7283761
START_S = 1000.0  # so that times have as many digits all along, by which the challenge's loader sorts them
MOST_OBJECTS = 5  # of a query; its five development queries have one, three or four
VISIT = "000000"


class ArkitScenesLayout(Layout):
    """Rooms as scenes ``00000000`` and so on: the last eight digits of their names in ScanNet++'s layout."""

    name = "arkitscenes"
    reader = "arkitscenes"
    settings = (LAYOUT_VERSION, "arkitscenes", UNITS_PER_METRE, WIDTH)

    def scenes_folder(self, out: Path) -> Path:
        return out / DEVELOPMENT

    def scene_name(self, scene: str) -> str:
        return categories.scene_name(scene)[2:]

    def target(self, scene: str, key: str, out: Path) -> SceneTarget:
        name = self.scene_name(scene)
        folder, truth = out / DEVELOPMENT / name, out / TRACK / TRUTH_FOLDER / f"{name}.txt"
        files = (folder / TRAJECTORY_NAME, folder / mesh_name(name), truth)
        return SceneTarget(scene, key, folder, LOWRES, files, ((truth.name, truth),))

    def marker_extras(self, names: Sequence[str]) -> dict[str, Any]:
        return {"rooms": {name: room for name in names if (room := _room_of(name)) is not None}}

    def write_lists(self, dataset: ScannedDataset, names: Sequence[str], out: Path) -> None:
        folder = out / TRACK / LISTS_FOLDER
        make_folder(folder)
        rooms = {name: room for name in names if (room := _room_of(name)) is not None}
        queries = [(name, VISIT, query_of(dataset.objects(room), room)[0]) for name, room in rooms.items()]
        folds = [(name, VISIT, "Training") for name in rooms]
        write_text(folder / "challenge_development_scenes.csv", _csv(SCENES_COLUMNS, folds))
        write_text(folder / "queries_development_scenes.csv", _csv(QUERIES_COLUMNS, queries))

    def frame_names(self, index: int) -> Sequence[str]:
        # The name of the scene stands in that of each file and is known only when the scene is moved to its place.
        images = [f"{folder}/{_time(index)}.png" for folder in (LOWRES, DEPTH, CONFIDENCE)]
        return *images, f"{camera_folder(LOWRES)}/{_time(index)}.pincam"

    def frame_files(self, frame: Frame) -> Sequence[bytes]:
        import cv2

        height, width = frame.depth_m.shape
        columns = min(WIDTH, width)
        size = columns, round(height * columns / width)
        rgb = np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        depth_m = np.asarray(cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
        depth = depth_in_units(depth_m, UNITS_PER_METRE)
        confidence = np.where(depth > 0, MOST_CONFIDENCE, 0).astype(np.uint8)
        scale = np.array(size) / np.array((width, height))
        focal = np.diag(frame.intrinsics)[:2] * scale
        centre = (frame.intrinsics[:2, 2] + 0.5) * scale - 0.5  # the middle of the first pixel is at 0
        camera = " ".join(repr(float(value)) for value in (*focal, *centre))
        return png_bytes(rgb), png_bytes(depth), png_bytes(confidence), f"{size[0]} {size[1]} {camera}\n".encode()

    def join(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        """Put the name of the scene before the time in the name of every image."""
        for name in self.frame_names(0):
            folder, suffix = (target.partial / name).parent, Path(name).suffix
            for path in sorted(folder.glob(f"[0-9]*{suffix}")) if folder.is_dir() else ():
                if "_" not in path.name:
                    path.rename(folder / f"{target.folder.name}_{path.name}")

    def write_truth(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        make_folder(target.partial)
        poses, name = dataset.trajectory(target.scene), target.folder.name
        write_text(target.partial / TRAJECTORY_NAME, "".join(_pose_lines(poses)))
        scan, objects = dataset.scan(target.scene), dataset.objects(target.scene)
        _write_mesh(scan, target.partial / mesh_name(name))
        text, answers = query_of(objects, target.scene)
        owner = object_of_vertex(scan)
        number = np.zeros(len(owner), np.int64)
        for k, object_id in enumerate(answers, start=1):
            number[owner == object_id] = k
        if not number.any():
            raise DataError(f"rooms/{target.scene}: its scan shows no '{text}', for which it would be searched")
        write_text(target.partial / f"{name}.txt", "".join(f"{value}\n" for value in number.tolist()))


def query_of(objects: Sequence[ScannedObject], room: str) -> tuple[str, tuple[int, ...]]:
    """What a room is searched for and the ids of the objects that answer: a class of few objects, drawn by its name."""
    ids_of: dict[str, list[int]] = {}
    for known in objects:
        if categories.words()[known.class_name] not in categories.without_instances():
            ids_of.setdefault(known.class_name, []).append(known.id)
    few = sorted(name for name, ids in ids_of.items() if len(ids) <= MOST_OBJECTS)
    if not few:
        raise DataError(f"rooms/{room}: has nothing that a text could ask for; choose another room")
    drawn = few[int(hashlib.sha256(room.encode()).hexdigest()[:8], 16) % len(few)]
    return drawn.replace("-", " "), tuple(sorted(ids_of[drawn]))


def _room_of(name: str) -> str | None:
    return categories.room_of(f"00{name}")


def _time(index: int) -> str:
    return f"{START_S + index / FRAMES_PER_SECOND:.3f}"


def _pose_lines(poses: Float64Array) -> list[str]:
    return [trajectory_line(_time(index), pose) for index, pose in enumerate(poses)]


def _write_mesh(scan: Scan, path: Path) -> None:
    faces = triangles_of(scan.faces)
    columns: dict[str, Column] = {name: scan.vertices[:, i].astype(np.float32) for i, name in enumerate("xyz")}
    columns |= {name: scan.colours[:, i] for i, name in enumerate(("red", "green", "blue"))}
    face = PlyElement("face", len(faces), {"vertex_indices": list_column(faces)})
    write_ply(path, [PlyElement("vertex", len(scan.vertices), columns), face])


def _csv(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return table.getvalue()
