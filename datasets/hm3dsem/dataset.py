"""Walks through HM3DSem as HOV-SG generates and evaluates them: floors, rooms and objects of whole buildings.

The world stays that of Habitat, whose y points up: predictions of HOV-SG lie in it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from su3d_bench.core.errors import DataError, GroundTruthMissing, counted
from su3d_bench.core.types import Frame, GroundTruth, WorldUp
from su3d_bench.datasets.hm3dsem.frames import (
    EVALUATED,
    GROUPS,
    INFO_NAME,
    LABELS_OF,
    OBJECTS,
    PLACES,
    POSE,
    SCENE_NAMES,
    WALKS_URL,
    annotation_file,
    open_walk,
)
from su3d_bench.datasets.hm3dsem.truth import (
    AGAIN,
    LABEL_SPACE,
    VARIANT,
    annotation_problem,
    read_annotation,
    read_info,
    read_truth,
)
from su3d_bench.datasets.openlex3d import release as openlex3d
from su3d_bench.datasets.recordings.file_dataset import FileDataset, NoOptions, faults_of, keeps_last
from su3d_bench.datasets.recordings.recorded_frames import RecordedFrames, Recording, reading


class Hm3dSem(FileDataset[NoOptions]):
    """HOV-SG's walks through HM3DSem, with the truth that its tools create; read below the data root."""

    name = "hm3dsem"
    reader_version = 2
    scene_names = SCENE_NAMES
    places_of_scenes = PLACES
    how_to_get = (
        f"/{PLACES[0]} (a walk is a folder such as {EVALUATED[0]} with pose/, rgb/ and depth/); generate them with "
        f"HOV-SG's tools ({WALKS_URL})"
    )
    label_space = LABEL_SPACE
    variants = (VARIANT,)
    further_truths = openlex3d.FURTHER_TRUTHS
    labels_of = LABELS_OF
    no_mesh = "that of HM3D keeps its objects in a texture, which is not read"
    Options = NoOptions

    def is_scene(self, folder: Path) -> bool:
        is_walk = (folder / POSE).is_dir() or (folder / INFO_NAME).is_file()
        return is_walk and re.fullmatch(SCENE_NAMES, folder.name) is not None

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The scenes that HOV-SG evaluates, and those that it has poses for; whether they are here or not."""
        return GROUPS

    def status(self, scene: str) -> str:
        """A word on the walk from a quick look: frames, and ground truth."""
        folder = self.folder(scene)
        with reading(self.where(scene)):
            n = sum(1 for _ in (folder / POSE).glob("*.txt")) if (folder / POSE).is_dir() else 0
        truth = "ground truth" if (folder / INFO_NAME).is_file() else f"no ground truth ({INFO_NAME} is missing)"
        return f"{counted(n, 'frame')}, {truth}"

    def n_frames(self, scene: str, stride: int) -> int:
        return len(self.frames(scene, stride))

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        return RecordedFrames(self.recording(scene), stride)

    def recording_files(self, scene: str) -> Sequence[Path]:
        return (*self.recording(scene).files, *self.recording(scene).images())

    def recording_key(self, scene: str) -> str:
        return self.recording(scene).digest(())

    def small_files(self, scene: str) -> tuple[Path, ...]:
        folder = self.folder(scene)
        if not (folder / INFO_NAME).is_file():
            return ()
        annotation = annotation_file(self.root, folder)
        clouds = sorted((folder / OBJECTS).glob("*.ply"))
        labels = openlex3d.label_files(self.root, LABELS_OF, scene)
        return (folder / INFO_NAME, *clouds, *(() if annotation is None else (annotation,)), *labels)

    def up(self, scene: str) -> WorldUp:
        """Y, as Habitat has it."""
        self.folder(scene)
        return WorldUp("y", False, "Habitat's worlds are so", "predictions of HOV-SG lie in this world, so it stays")

    def problems(self, scene: str) -> Iterator[str]:
        """What is wrong with poses, truth and annotation, a line each; images are left to the frames."""
        yield from faults_of([lambda: self.recording(scene)])
        faults = list(faults_of([lambda: self.annotated(scene)]))
        yield from faults
        annotation = annotation_file(self.root, self.folder(scene))
        if faults or annotation is None or not (self.folder(scene) / INFO_NAME).is_file():
            return
        yield from faults_of([lambda: self._check_annotation(annotation, scene)])

    def _check_annotation(self, annotation: Path, scene: str) -> None:
        info = read_info(self.folder(scene) / INFO_NAME, self.where(scene))
        line = annotation_problem(info, read_annotation(annotation, self.where(scene)), self.where(scene))
        if line is not None:
            raise DataError(line)

    def own_truth(self, scene: str, variant: str) -> GroundTruth:
        return self.annotated(scene)

    @keeps_last
    def recording(self, scene: str) -> Recording:
        return open_walk(self.folder(scene), self.where(scene))

    @keeps_last
    def annotated(self, scene: str) -> GroundTruth:
        if not (self.folder(scene) / INFO_NAME).is_file():
            raise GroundTruthMissing(
                f"{self.where(scene)}: no ground truth, {INFO_NAME} is missing in {self.folder(scene)}; {AGAIN}"
            )
        return read_truth(self.folder(scene), self.where(scene))
