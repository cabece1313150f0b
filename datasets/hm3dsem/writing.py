"""Rooms in the layout of HOV-SG's walks: ``hm3dsem_walks/val/<scene>/``, and the annotation in ``hm3d/val/<scene>/``.

The world is turned until its y points up. Images are as wide as 90 degrees take; where the room's camera saw less, they
are black and without depth. A room is one floor with one region. Object clouds are of the surface that the walk sees,
reduced to a point each 2 cm; voxels that two objects share are left out, as the colours of the original mix there. The
generator's ``semantic/``, from which it makes those clouds, is not written.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.files.atomic import make_folder, write_json, write_text
from su3d_bench.core.types import UP, Float64Array, Frame, Int64Array, UInt8Array
from su3d_bench.datasets.hm3dsem.categories import category_of, room_category, scene_name
from su3d_bench.datasets.hm3dsem.folders import COLOUR, DEPTH, INFO_NAME, LABELS_OF, OBJECTS, POSE, SPLIT, WALKS_FOLDER
from su3d_bench.datasets.hm3dsem.frames import TO_HABITAT, UNITS_PER_METRE
from su3d_bench.datasets.hm3dsem.truth import HEADER
from su3d_bench.datasets.openlex3d import writing as openlex3d
from su3d_bench.datasets.openlex3d.labels import CATEGORIES_NAME
from su3d_bench.datasets.writing import Layout, ScannedDataset, ScannedObject, SceneTarget
from su3d_bench.formats.images import depth_in_units, png_bytes
from su3d_bench.formats.ply import Column, PlyElement, write_ply
from su3d_bench.metrics.graphs.objects import voxel_ids, voxel_means

LAYOUT_VERSION = 1  # raise it whenever the same scene is written as other bytes
CLOUD_VOXEL_M, ROOM_VOXEL_M = 0.02, 0.05  # create_hm3dsem_walks_gt.py
REGION = FLOOR = 0
STAGED_ANNOTATION = ".annotation"
CLOUDS = "scene_rgb.ply", "scene_panoptic.ply"
# From a world whose z points up to Habitat's: x stays, y is up, z comes towards the viewer.
TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


class HovSgWalkLayout(Layout):
    """Rooms as walks ``00000-living00000`` and so on."""

    name = "hm3dsem"
    reader = "hm3dsem"
    settings = (LAYOUT_VERSION, "hm3dsem", UNITS_PER_METRE, CLOUD_VOXEL_M, ROOM_VOXEL_M)

    def scenes_folder(self, out: Path) -> Path:
        return out / WALKS_FOLDER / SPLIT

    def scene_name(self, scene: str) -> str:
        return scene_name(scene)

    def target(self, scene: str, key: str, out: Path) -> SceneTarget:
        name = scene_name(scene)
        folder, release = self.scenes_folder(out) / name, out / "hm3d" / SPLIT / name
        annotation, labels = release / f"{_short(name)}.semantic.txt", openlex3d.labels_folder(out, LABELS_OF, name)
        truth = (folder / INFO_NAME, *(folder / cloud for cloud in CLOUDS), annotation, labels / CATEGORIES_NAME)
        apart = ((STAGED_ANNOTATION, annotation), (openlex3d.STAGED, labels))
        return SceneTarget(scene, key, folder, POSE, truth, apart)

    def write_shared(self, dataset: ScannedDataset, scene: str, out: Path) -> None:
        openlex3d.write_prompts(out, LABELS_OF)

    def frame_names(self, index: int) -> Sequence[str]:
        return tuple(f"{kind}/walk_{index:06d}.{end}" for kind, end in ((COLOUR, "png"), (DEPTH, "png"), (POSE, "txt")))

    def frame_files(self, frame: Frame) -> Sequence[bytes]:
        pose = TO_Y_UP @ frame.camera_to_world @ TO_HABITAT
        line = "\t".join(repr(float(value)) for value in pose.reshape(-1)) + "\n"
        depth = depth_in_units(frame.depth_m, UNITS_PER_METRE)
        return png_bytes(_widened(frame.rgb, frame)), png_bytes(_widened(depth, frame)), line.encode()

    def write_truth(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        """The clouds, what stands above them, and the annotation of the release."""
        folder = target.partial
        make_folder(folder / OBJECTS)
        make_folder(folder / "regions")
        points, colours, owner = _cloud(dataset, target.scene)
        seen = [known for known in dataset.objects(target.scene) if (owner == known.id).any()]
        write_ply(folder / CLOUDS[0], [_element(points, colours)])
        painted = np.array([list(bytes.fromhex(_hex(key))) for key in owner.tolist()], np.uint8).reshape(-1, 3)
        write_ply(folder / CLOUDS[1], [_element(points, painted)])
        write_ply(folder / "regions" / f"{REGION}.ply", [_element(points, colours)])
        for known in seen:
            mine = owner == known.id
            write_ply(folder / OBJECTS / f"{known.id}.ply", [_element(points[mine], colours[mine])])
        write_json(folder / INFO_NAME, _info(target.scene, points, seen))
        lines = [f'{known.id},{_hex(known.id)},"{category_of(known.class_name)}",{REGION}' for known in seen]
        write_text(folder / STAGED_ANNOTATION, "\n".join([HEADER, *lines]) + "\n")
        numbers = {known.id: known.id for known in seen}
        openlex3d.write_labels(folder / openlex3d.STAGED, target.folder.name, seen, numbers)


def _short(scene: str) -> str:
    return scene.partition("-")[2]


def _hex(object_id: int) -> str:
    """A colour of its own for each object: an odd factor takes no two of 16 million to one."""
    return f"{object_id * 0x9E3779B1 % (1 << 24):06X}"


def _widened(image: Any, frame: Frame) -> Any:
    """The image in the middle of one that is 90 degrees wide, twice the focal length."""
    width = image.shape[1]
    focal = frame.intrinsics[0, 0]
    wide = max(width, round(2 * float(focal)))
    left = (wide - width) // 2
    return np.pad(image, ((0, 0), (left, wide - width - left), *[(0, 0)] * (image.ndim - 2)))


def _cloud(dataset: ScannedDataset, scene: str) -> tuple[Float64Array, UInt8Array, Int64Array]:
    """Points (N, 3) in Habitat's world, their colours and the object of each."""
    scan = dataset.scan(scene)
    owner = np.zeros(len(scan.vertices), np.int64)
    owner[scan.faces] = scan.object_id[:, None]
    points = scan.vertices.astype(np.float64) @ TO_Y_UP[:3, :3].T
    voxel = voxel_ids(points, CLOUD_VOXEL_M)
    means = voxel_means(np.column_stack([points, scan.colours, owner, owner.astype(np.float64) ** 2]), voxel)
    is_of_one = (means[:, 6] == np.rint(means[:, 6])) & (means[:, 7] == means[:, 6] ** 2) & (means[:, 6] > 0)
    means = means[is_of_one]
    return means[:, :3], np.rint(means[:, 3:6]).astype(np.uint8), means[:, 6].astype(np.int64)


def _element(points: Float64Array, colours: UInt8Array) -> PlyElement:
    columns: dict[str, Column] = {name: points[:, i] for i, name in enumerate("xyz")}
    columns |= {name: colours[:, i] for i, name in enumerate(("red", "green", "blue"))}
    return PlyElement("vertex", len(points), columns)


def _info(scene: str, points: Float64Array, objects: Sequence[ScannedObject]) -> dict[str, Any]:
    """The content of ``scene_info.json``."""
    category = room_category(scene)
    heights = points[:, UP]
    low, high = float(heights.min()), float(heights.max())
    flat = points.copy()
    flat[:, UP] = low
    ids = [known.id for known in objects]
    region = {
        "id": REGION,
        "floor_id": FLOOR,
        "voted_category": category,
        "category": category,
        "min_height": low,
        "max_height": high,
        "mean_height": float(heights.mean()),
        "bev_region_points": voxel_means(flat, voxel_ids(flat, ROOM_VOXEL_M)).tolist(),
        "objects": ids,
    }
    return {
        "levels": [{"id": FLOOR, "lower": low, "upper": high, "regions": [REGION], "objects": ids}],
        "regions": [region],
        "objects": [_object(known) for known in objects],
    }


def _object(known: ScannedObject) -> dict[str, Any]:
    corners = np.array([known.box_min, known.box_max], np.float64) @ TO_Y_UP[:3, :3].T
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, sides = ((low + high) / 2).tolist(), (high - low).tolist()
    to_world = np.eye(4)
    to_world[:3, 3] = centre
    return {
        "id": known.id,
        "category": category_of(known.class_name),
        "hex": _hex(known.id),
        "region_id": REGION,
        "floor_id": FLOOR,
        "aabb_center": centre,
        "aabb_dims": sides,
        "obb_center": centre,
        "obb_dims": sides,
        "obb_rotation": [0.0, 0.0, 0.0, 1.0],
        "obb_local_to_world": to_world.tolist(),
        "obb_world_to_local": np.linalg.inv(to_world).tolist(),
        "obb_volume": float(np.prod(sides)),
        "obb_half_extents": [side / 2 for side in sides],
    }
