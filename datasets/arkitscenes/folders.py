"""Where scenes of ARKitScenes lie below the data root, which there are, and what each holds.

A scene is a folder named after its video, such as ``42445173``, in the layout of Apple's raw release, which the
OpenSUN3D challenge downloads, or of its 3DOD release, whose frames lie one folder deeper, in ``42445173_frames``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import ScenesMissing
from su3d_bench.datasets.recordings.places import scenes_in

BASES = ("", "arkitscenes", "ARKitScenes", "opensun3d")
DEVELOPMENT = "ChallengeDevelopmentSet"
# What download_data_opensun3d.py (OpenSun3D/cvpr24-challenge at 59db30f) and download_data.py (apple/ARKitScenes at
# 7283761) name the folders of scenes.
SETS = (
    DEVELOPMENT,
    "ChallengeTestSet",
    "FullTrainingSet",
    "FullTrainingSetWithWideAssets",
    *(f"{release}{fold}" for release in ("raw/", "3dod/", "") for fold in ("Training", "Validation")),
)
PLACES = tuple(f"{base}/{name}" if base else name for base in BASES for name in SETS)
SCENE_NAMES = r"[0-9]{8}"
TRAJECTORY_NAME = "lowres_wide.traj"
ARKITSCENES_URL = "https://github.com/apple/ARKitScenes"


def mesh_name(scene: str) -> str:
    return f"{scene}_3dod_mesh.ply"


@dataclass(frozen=True)
class SceneFolders:
    """``folder_of`` each scene; ``made`` are those that `datasets make` rendered; ``places``: the folders of scenes."""

    root: Path
    places: tuple[Path, ...]
    folder_of: Mapping[str, Path]
    made: frozenset[str]

    def frames_folder(self, scene: str) -> Path:
        """The folder with the trajectory and the images."""
        deeper = self.folder_of[scene] / f"{scene}_frames"
        return deeper if deeper.is_dir() else self.folder_of[scene]

    def mesh(self, scene: str) -> Path:
        """The mesh that the phone made, which may be missing."""
        return self.folder_of[scene] / mesh_name(scene)


def find_scenes(root: Path) -> SceneFolders:
    """Every scene in ``PLACES`` below ``root``; none is no error here."""
    return SceneFolders(root, *scenes_in(root, PLACES, _is_scene))


def _is_scene(folder: Path) -> bool:
    if re.fullmatch(SCENE_NAMES, folder.name) is None:
        return False
    names = (TRAJECTORY_NAME, f"{folder.name}_frames", mesh_name(folder.name))
    return any((folder / name).exists() for name in names)


def no_scenes(root: Path) -> ScenesMissing:
    """What to say where no scene was found."""
    return ScenesMissing(
        f"arkitscenes: no scene in {root}/{DEVELOPMENT}, in raw/Training or where else {ARKITSCENES_URL} and the "
        f"OpenSUN3D challenge download them (a scene is a folder such as 42445173 with {TRAJECTORY_NAME}); set "
        f"SU3D_DATA to where they are, or make rooms in this layout: su3d-bench datasets make rooms --layout "
        f"arkitscenes --out {root}"
    )
