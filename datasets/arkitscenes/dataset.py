"""ARKitScenes as used by the OpenSUN3D challenge: phone recordings, their meshes, and one text query per scene.

The raw and the 3DOD release are read; the query and the ground truth come from a clone of the challenge's repository.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import Frame, GroundTruth, Surface
from su3d_bench.datasets.arkitscenes import challenge as challenge_files
from su3d_bench.datasets.arkitscenes import frames
from su3d_bench.datasets.arkitscenes.frames import PhoneRecording
from su3d_bench.datasets.recordings import meshes
from su3d_bench.datasets.recordings.file_dataset import FileDataset, faults_of, keeps_last, sizes_and_ends
from su3d_bench.datasets.recordings.recorded_frames import reading
from su3d_bench.datasets.recordings.source import missing_parts

DEVELOPMENT = "ChallengeDevelopmentSet"
# What download_data_opensun3d.py (OpenSun3D/cvpr24-challenge at 59db30f) and download_data.py (apple/ARKitScenes at
# 7283761) call the scene folders.
SETS = (
    DEVELOPMENT,
    "ChallengeTestSet",
    "FullTrainingSet",
    "FullTrainingSetWithWideAssets",
    *(f"{release}{fold}" for release in ("raw/", "3dod/", "") for fold in ("Training", "Validation")),
)


def mesh_name(scene: str) -> str:
    return f"{scene}_3dod_mesh.ply"


class ArkitScenesOptions(BaseModel):
    """``images``: those of 256x192 at up to 60 per second, as in the challenge's loader, or the ``wide`` camera's
    with the laser scanner's depth if available. ``width``: maximum columns of a frame. ``min_confidence``:
    depth of lower confidence (0 to 2) is dropped. ``challenge``: a clone of the challenge's repository,
    if it is not next to the scenes."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    images: frames.Images = "lowres"
    width: int = Field(default=640, ge=16, le=4096)  # ScanNet's depth camera; images of low resolution have 256
    min_confidence: int = Field(default=0, ge=0, le=frames.MAX_CONFIDENCE)  # the challenge's loader reads no confidence
    challenge: Path | None = None


class ArkitScenes(FileDataset[ArkitScenesOptions]):
    """ARKitScenes and the OpenSUN3D challenge's queries over it; read below the data root.

    A scene is a folder named after its video, such as ``42445173``, in the layout of Apple's raw release, which the
    OpenSUN3D challenge downloads, or of its 3DOD release, whose frames lie one folder deeper, in ``42445173_frames``.
    """

    name = "arkitscenes"
    headline_protocol = "opensun3d-queries"  # the challenge's
    reader_version = 2
    scene_names = challenge_files.SCENE_NAMES
    places_of_scenes = tuple(f"{base}/{name}" if base else name for base in challenge_files.BASES for name in SETS)
    how_to_get = (
        f"/{DEVELOPMENT}, in raw/Training or wherever https://github.com/apple/ARKitScenes and the OpenSUN3D "
        f"challenge download them (a scene is a folder such as 42445173 with {frames.TRAJECTORY_NAME}); set SU3D_DATA "
        "to that folder"
    )
    label_space = challenge_files.LABEL_SPACE
    variants = (challenge_files.VARIANT,)
    no_mesh = "the challenge annotates only the objects that answer its query"
    Options = ArkitScenesOptions

    def is_scene(self, folder: Path) -> bool:
        names = (frames.TRAJECTORY_NAME, f"{folder.name}_frames", mesh_name(folder.name))
        return re.fullmatch(challenge_files.SCENE_NAMES, folder.name) is not None and any(
            (folder / one).exists() for one in names
        )

    @cached_property
    def challenge(self) -> challenge_files.Challenge:
        """The challenge's lists and ground truth, as far as available."""
        return challenge_files.find_challenge(self.root, self.options.challenge)

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The challenge's development scenes, and its test scenes if their list is available."""
        return self.challenge.groups

    def status(self, scene: str) -> str:
        """One-line summary of the scene from a quick look: images, query, ground truth."""
        try:
            words = f"{len(self.recording(scene).images)} images"
        except DataError as error:
            words = str(error).partition(": ")[2]
        try:
            text = self.challenge.query(scene)
        except GroundTruthMissing:
            return f"{words}, no query"
        missing = missing_parts(self.folder(scene), mesh_name(scene))
        has_truth = any(path.suffix == ".txt" for path in self.challenge.files(scene)) and not missing
        truth = "ground truth" if has_truth else f"no ground truth{missing and f' ({missing})'}"
        return f"{words}, query '{text}', {truth}"

    def n_frames(self, scene: str, stride: int) -> int:
        return len(self.frames(scene, stride))

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """Every ``stride``-th frame that has all its files and a pose, in temporal order."""
        return frames.PhoneFrames(self.recording(scene), stride, self.options.width, self.options.min_confidence)

    def recording_files(self, scene: str) -> Sequence[Path]:
        return self.recording(scene).files()

    def recording_key(self, scene: str) -> str:
        files = self.recording_files(scene)
        cameras = [path for path in files if path.suffix == ".pincam"]
        with reading(self.where(scene)):
            return sizes_and_ends(files, 4) + sizes_and_ends(cameras, len(cameras))

    def small_files(self, scene: str) -> tuple[Path, ...]:
        mesh = self.mesh_file(scene)
        return (*((mesh,) if mesh.is_file() else ()), *self.challenge.files(scene))

    def own_truth(self, scene: str, variant: str) -> GroundTruth:
        """The vertices that answer the scene's query, each with the number of its object."""
        if missing := missing_parts(self.folder(scene), mesh_name(scene)):
            raise GroundTruthMissing(f"{self.where(scene)}: no ground truth, {missing} in {self.folder(scene)}")
        return self.challenge.ground_truth(scene, self.surface(scene).vertices)

    def asked_text(self, scene: str) -> str:
        """The query of the scene; ``GroundTruthMissing`` if no list has it."""
        return self.challenge.query(scene)

    def queries(self, scene: str) -> Sequence[challenge_files.ChallengeQuery]:
        """The scene's query with the numbers of the objects that answer it, or ``GroundTruthMissing``."""
        return (
            challenge_files.answered(self.ground_truth(scene, challenge_files.VARIANT), self.challenge.query(scene)),
        )

    def mesh_file(self, scene: str) -> Path:
        """The phone's mesh, which may be missing."""
        return self.folder(scene) / mesh_name(scene)

    @keeps_last
    def surface(self, scene: str) -> Surface:
        """The phone's mesh, without labels."""
        path = self.mesh_file(scene)
        return meshes.read_surface(path, f"{self.where(scene)}: {path.name}")

    def problems(self, scene: str) -> Iterator[str]:
        """What was excluded from the recording, and faults of query and ground truth; images are checked as frames."""
        yield from self.recording(scene).missing
        yield from faults_of(
            [
                lambda: self.surface(scene),
                lambda: self.ground_truth(scene, challenge_files.VARIANT),
                lambda: self.challenge.query(scene),
            ]
        )

    @keeps_last
    def recording(self, scene: str) -> PhoneRecording:
        deeper = self.folder(scene) / f"{scene}_frames"
        folder = deeper if deeper.is_dir() else self.folder(scene)
        options = self.options
        return frames.open_recording(folder, scene, options.images, options.min_confidence, self.where(scene))
