"""The frames of a walk as HOV-SG's generator writes them: ``rgb/``, ``depth/`` and ``pose/``, a file a frame each.

Depth is 16 bits in mm. A pose is one line of 16 numbers, the camera in Habitat's axes (x right, y up, z back) in a
world whose y points up; frames have the camera in OpenCV's axes in that same world, as HOV-SG's loader has them. There
is no camera file: images are 90 degrees wide, and the principal point is half the size
(hovsg/dataloader/hm3dsem.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.recordings.recorded_frames import (
    Folder,
    RecordedFrame,
    Recording,
    depth_m_of_values,
    pinhole,
)
from su3d_bench.datasets.recordings.source import (
    by_number,
    check_complete,
    list_folder,
    read_matrix,
    read_size,
)
from su3d_bench.formats.images import Size

WALKS_FOLDER, SPLIT = "hm3dsem_walks", "val"
SPLITS = (SPLIT, "train", "minival")
PLACES = tuple(f"{base}{split}" for base in (f"{WALKS_FOLDER}/", "hm3dsem/", "HM3DSem/", "") for split in SPLITS)
RELEASE_PLACES = tuple(f"{base}/{split}" for base in ("hm3d", "HM3D", "hm3dsem", "HM3DSem") for split in SPLITS)
SCENE_NAMES = r"\d{5}-[A-Za-z0-9]{11}"
COLOUR, DEPTH, POSE, INFO_NAME, OBJECTS = "rgb", "depth", "pose", "scene_info.json", "objects"
LABELS_OF = "hm3d"  # as OpenLex3D calls the dataset
WALKS_URL = "https://github.com/hovsg/HOV-SG#habitat-matterport-3d-semantics"
# The scenes that HOV-SG evaluates by its README, and those that its generator has poses for.
EVALUATED = (
    "00824-Dd4bFSTQ8gi", "00829-QaLdnwvtxbs", "00843-DYehNKdT76V", "00861-GLAQ4DNUx5U",
    "00862-LT9Jq6dN3Ea", "00873-bxsVRursffK", "00877-4ok3usBNeis", "00890-6s7QHgap2fW",
)  # fmt: skip
GROUPS: Mapping[str, tuple[str, ...]] = {
    "hovsg": EVALUATED,
    "walks": tuple(sorted((*EVALUATED, "00847-bCPU9suPUw9", "00849-a8BtkwhxdRV"))),
}


def annotation_file(root: Path, walk: Path) -> Path | None:
    """The ``.semantic.txt`` of a walk's scene, beside the walk or in the release; None where it is not there."""
    name = f"{walk.name.partition('-')[2]}.semantic.txt"
    folders = [walk, *(root / place / walk.name for place in RELEASE_PLACES)]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


UNITS_PER_METRE = 1000.0  # habitat_utils.py: save_obs
FRAMES_PER_SECOND = 30.0  # ours: walks have no times
TO_HABITAT = np.diag([1.0, -1.0, -1.0, 1.0])  # from a camera in OpenCV's axes to one in Habitat's, and back
DEPTH_M_OF_VALUE = depth_m_of_values(UNITS_PER_METRE)
ENDINGS = {COLOUR: "png", DEPTH: "png", POSE: "txt"}


def intrinsics_of(size: Size, where: str) -> Float64Array:
    """The camera of images of this size: 90 degrees wide, square pixels."""
    width, height = size
    return pinhole(width / 2, width / 2, width / 2, height / 2, where)


def open_walk(path: Path, where: str) -> Recording:
    """The frames of the walk in ``path``; a fault in what is read of it is a ``DataError``."""
    names: dict[str, list[str]] = {kind: list_folder(path, kind, where) for kind in ENDINGS}
    files = {
        kind: by_number(names[kind], rf"[\w-]{{1,80}}[_-](\d{{6,9}})\.{ending}", f"{where}: {kind}/")
        for kind, ending in ENDINGS.items()
    }
    numbers = sorted(set().union(*files.values()))
    if not numbers:
        raise DataError(f"{where}: {POSE}/, {COLOUR}/ and {DEPTH}/ hold no frame; generate the walk again")
    check_complete(
        {f"{kind}/..._{{:06d}}.{ending}": files[kind] for kind, ending in ENDINGS.items()},
        range(numbers[0], numbers[-1] + 1),
        where,
    )
    poses = read_poses(path, [f"{POSE}/{files[POSE][number]}" for number in numbers], where)
    frames = tuple(
        RecordedFrame(
            number,
            number / FRAMES_PER_SECOND,
            f"{COLOUR}/{files[COLOUR][number]}",
            f"{DEPTH}/{files[DEPTH][number]}",
            pose,
        )
        for number, pose in zip(numbers, poses, strict=True)
    )
    size = read_size(path, frames[0].colour, where)
    return Recording(
        where,
        Folder(path),
        frames,
        intrinsics_of(size, where),
        DEPTH_M_OF_VALUE,
        tuple(path / POSE / files[POSE][number] for number in numbers),
        image_size=size,
    )


def read_poses(path: Path, names: Sequence[str], where: str) -> Float64Array:
    """Camera-to-world poses (n, 4, 4) of cameras in OpenCV's axes, in the world of the files."""
    poses = np.array([read_matrix(path, name, where) for name in names]).reshape(-1, 4, 4)
    is_sound = np.isfinite(poses).all(axis=(1, 2))
    is_sound[is_sound] = are_rigid(poses[is_sound])
    if not is_sound.all():
        raise DataError(f"{where}: {names[int(np.argmin(is_sound))]}: is no rigid pose; generate the walk again")
    return poses @ TO_HABITAT
