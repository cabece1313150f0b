"""Where the two trees of Replica are below the data root, and the names of scenes and classes.

The *render tree* is the RGB-D render of NICE-SLAM (``Replica/room0/...``), the *original tree* the release with the
annotated meshes (``replica_v1/room_0/habitat/...``).
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from su3d_bench.core.errors import ScenesMissing, no_scene
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import LabelSet

LABEL_SPACE = "replica"
OFFICIAL_SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
RENDER_FOLDERS, RENDER_PARTS = ("Replica", "replica", "."), ("traj.txt", "results")
DATASET_FOLDERS = ("Replica-Dataset", "Replica_Dataset", "replica_dataset", "Replica", "replica", ".")
ORIGINAL_FOLDERS = ("replica_v1", "Replica_v1", "Replica-Dataset/replica_v1", *DATASET_FOLDERS)
ORIGINAL_FILES = ("info_semantic.json", "mesh_semantic.ply")  # in the folder habitat of a scene
# Common names of the folder with ConceptGraphs' ground truth, whose scenes are room_0/Sequence_1/...
SEMANTIC_FOLDERS = (
    *(f"{name}{mark}semantic" for mark in "-_" for name in ("Replica", "replica")),
    "Replica_Semantic",
    *DATASET_FOLDERS,
)
FUSED_CLOUD = "saved-maps-gt/pointclouds"  # in Sequence_1
REFERENCE_CLOUD = "rgb_cloud/pointclouds/pc_points.h5"  # in the scene of the render tree
# Folders of text files with one label per vertex, below the data root or a render tree.
LABEL_PLACES = (*RENDER_FOLDERS, "opennerf/datasets", "datasets")
INSTANCE_FOLDERS = ("ground_truth", "instance_gt", "instance_gt/validation", "replica_gt_instances")
SEMANTIC_LABEL_FOLDERS = ("semantic_gt", "replica_gt_semantics")
FETCH_FRAMES, FETCH_MESHES = "su3d-bench datasets fetch replica frames", "su3d-bench datasets fetch replica meshes"
CLOUDS_URL = "https://github.com/concept-graphs/concept-graphs"  # its README has the link
HOW_TO_GET_LABELS = {
    "openmask3d": "ask its authors (https://github.com/OpenMask3D/openmask3d/issues/1) or use the archive that "
    "scripts/get_replica_dataset.sh of Open-YOLO 3D downloads; replica-openmask3d scores without them",
    "ovo-51": "get them from https://github.com/opennerf/opennerf, datasets/replica_gt_semantics",
}


@dataclass(frozen=True)
class RenderTree:
    """The folder with ``cam_params.json`` and the names of its scenes, the official ones first."""

    folder: Path
    scenes: tuple[str, ...]


def find_render_tree(root: Path) -> RenderTree | None:
    """The first of ``RENDER_FOLDERS`` below ``root`` that holds a scene; None if none does."""
    for name in RENDER_FOLDERS:
        folder = root / name
        # The data root also contains other datasets, whose folders are not scenes of this one.
        is_scene = all if name == "." else any
        scenes = [one.name for one in _folders(folder) if is_scene((one / part).exists() for part in RENDER_PARTS)]
        if scenes:
            official = [scene for scene in OFFICIAL_SCENES if scene in scenes]
            others = sorted(set(scenes) - set(official), key=_natural_order)
            return RenderTree(folder, (*official, *others))
    return None


def _folders(folder: Path) -> list[Path]:
    try:
        return [child for child in folder.iterdir() if child.is_dir() and not child.name.startswith(".")]
    except OSError:
        return []


def _natural_order(scene: str) -> tuple[str, int, str]:
    match = re.fullmatch(r"(.*?)(\d{1,18})", scene)
    return (match[1], int(match[2]), scene) if match else (scene, -1, scene)


def original_name(scene: str) -> str:
    """The scene as the original release calls it: ``room_0`` for ``room0``, ``frl_apartment_0`` for itself."""
    return re.sub(r"(?<=[^\d_])(\d+)$", r"_\1", scene)


def find_original_scene(root: Path, scene: str) -> Path | None:
    """The folder of the original release with ``habitat/`` in it; None if no tree below ``root`` has it."""
    return _scene_with("habitat", root, ORIGINAL_FOLDERS, scene)


def unrendered_scenes(root: Path) -> tuple[str, ...]:
    """The scenes of the original release that have a ``habitat/`` below ``root``, official ones first."""
    found = {
        child.name
        for name in ORIGINAL_FOLDERS
        for child in _folders(root / name)
        if any((child / "habitat" / file).is_file() for file in ORIGINAL_FILES)
    }
    official = [scene for scene in OFFICIAL_SCENES if {scene, original_name(scene)} & found]
    named = {name for scene in official for name in (scene, original_name(scene))}
    return (*official, *sorted(found - named, key=_natural_order))


def find_semantic_sequence(root: Path, scene: str) -> Path | None:
    """The folder ``Sequence_1`` with ConceptGraphs' fused clouds of the scene; None if there is none."""
    folder = _scene_with(f"Sequence_1/{FUSED_CLOUD}", root, SEMANTIC_FOLDERS, scene)
    return None if folder is None else folder / "Sequence_1"


def _scene_with(part: str, root: Path, folders: tuple[str, ...], scene: str) -> Path | None:
    """The first folder of the scene, in one of ``folders``, that contains a folder ``part``."""
    for name in folders:
        for scene_name in dict.fromkeys((original_name(scene), scene)):
            if (root / name / scene_name / part).is_dir():
                return root / name / scene_name
    return None


def find_label_file(root: Path, scene: str, folders: tuple[str, ...], prefix: str) -> Path | None:
    """The labels of one scene, one per vertex: ``office0.txt``, ``office_0.txt`` or ``<prefix>office0.txt``."""
    for place in LABEL_PLACES:
        for folder in folders:
            for name in dict.fromkeys((scene, original_name(scene), f"{prefix}{scene}")):
                path = root / place / folder / f"{name}.txt"
                if path.is_file():
                    return path
    return None


def no_render_tree(root: Path) -> ScenesMissing:
    """Message if no scene was found: where they are expected and how to get data."""
    return no_scene(
        "replica",
        root,
        " or in its folder Replica (a scene is a folder such as room0 with traj.txt and results/); download "
        f"them with {FETCH_FRAMES}, set SU3D_DATA to their folder, "
        "or create a room in this layout: su3d-bench datasets make rooms --layout replica --scenes bathroom0 "
        f"--set n_frames=120 --out {root}",
    )


@cache
def replica_label_set() -> LabelSet:
    """The 101 classes, ids 1 to 101; 0 is void, not a class."""
    rows = json.loads(file_text(Path(__file__).with_name("labels.json")))
    return LabelSet(LABEL_SPACE, tuple(int(row["id"]) for row in rows), tuple(str(row["name"]) for row in rows))
