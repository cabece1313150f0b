"""Walks through HM3DSem as HOV-SG generates and evaluates them: floors, rooms and objects of whole buildings.

The world stays that of Habitat, whose y points up: predictions of HOV-SG lie in it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, GroundTruthMissing, counted, suggest
from su3d_bench.core.types import Frame, GroundTruth, ImageDomain, InstanceMesh, SceneInfo, WorldUp
from su3d_bench.datasets.hm3dsem.folders import (
    GROUPS,
    INFO_NAME,
    LABELS_OF,
    OBJECTS,
    PLACES,
    POSE,
    SCENE_NAMES,
    Walks,
    annotation_file,
    find_walks,
    no_walks,
)
from su3d_bench.datasets.hm3dsem.frames import open_walk
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
from su3d_bench.datasets.recordings.recorded_frames import RecordedFrames, Recording, reading

READER_VERSION = 1  # raise it whenever the same files come out as other frames or another truth


class Hm3dSemOptions(BaseModel):
    """Walks have no settings: their files say everything."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Hm3dSem:
    """HOV-SG's walks through HM3DSem, with the truth that its tools create; read below the data root."""

    name = "hm3dsem"
    reads_made_rooms = True
    scene_names = SCENE_NAMES
    label_space = LABEL_SPACE
    variants: tuple[str, ...] = (VARIANT,)
    further_truths = openlex3d.FURTHER_TRUTHS
    Options = Hm3dSemOptions

    def __init__(self, root: Path, options: Hm3dSemOptions | None = None) -> None:
        self.root = root
        self.options = options or Hm3dSemOptions()
        self._truth: tuple[str, GroundTruth] | None = None
        self._last: tuple[str, Recording] | None = None

    @cached_property
    def walks(self) -> Walks:
        """Where the walks are; a ``ScenesMissing`` that says how to get some where there are none."""
        walks = find_walks(self.root)
        if not walks.folder_of:
            raise no_walks(self.root)
        return walks

    def scenes(self) -> Sequence[str]:
        return tuple(self.walks.folder_of)

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The scenes that HOV-SG evaluates, and those that it has poses for; whether they are here or not."""
        return GROUPS

    def places(self) -> Sequence[Path]:
        """Where walks are, or else would be looked for first."""
        return find_walks(self.root).places or [self.root / PLACES[0]]

    def status(self, scene: str) -> str:
        """A word on the walk from a quick look: frames, and ground truth."""
        folder = self._folder(scene)
        with reading(self._where(scene)):
            n = sum(1 for _ in (folder / POSE).glob("*.txt")) if (folder / POSE).is_dir() else 0
        truth = "ground truth" if (folder / INFO_NAME).is_file() else f"no ground truth ({INFO_NAME} is missing)"
        return f"{counted(n, 'frame')}, {truth}"

    def info(self, scene: str, stride: int) -> SceneInfo:
        domain: ImageDomain = "rendered-rooms" if scene in self.walks.made else "camera"
        return SceneInfo(self.name, scene, len(self._recording(scene).frames[::stride]), stride, domain)

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        return RecordedFrames(self._recording(scene), stride)

    def files(self, scene: str) -> Sequence[Path]:
        recording = self._recording(scene)
        return (*recording.files, *recording.images(), *self._truth_files(scene))

    def digest(self, scene: str) -> str:
        """A key of the frames, as ``Recording.digest`` has it, and of the content of the truth."""
        words = self.name, READER_VERSION, scene, scene in self.walks.made
        total = hashlib.sha256(self._recording(scene).digest(words).encode())
        with reading(self._where(scene)):
            for path in self._truth_files(scene):
                total.update(f"{path.name} {digest_file(path)}\n".encode())
        return total.hexdigest()

    def up(self, scene: str) -> WorldUp:
        """Y, as Habitat has it."""
        self._folder(scene)
        return WorldUp("y", False, "Habitat's worlds are so", "predictions of HOV-SG lie in this world, so it stays")

    def problems(self, scene: str) -> Iterator[str]:
        """What is wrong with poses, truth and annotation, a line each; images are left to the frames."""
        try:
            self._recording(scene)
        except DataError as error:
            yield str(error)
        if not (self._folder(scene) / INFO_NAME).is_file():
            return
        try:
            self._annotated(scene)
            annotation = annotation_file(self.root, self._folder(scene))
            if annotation is not None:
                info = read_info(self._folder(scene) / INFO_NAME, self._where(scene))
                known = read_annotation(annotation, self._where(scene))
                if (line := annotation_problem(info, known, self._where(scene))) is not None:
                    yield line
        except DataError as error:
            yield str(error)

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        if variant in self.further_truths.values():
            self._folder(scene)
            labelled: GroundTruth = openlex3d.truth_below(self.root, LABELS_OF, scene, variant)
            return labelled
        if variant not in self.variants:
            hint = suggest(variant, self.variants)
            raise GroundTruthMissing(f"{self._where(scene)}: no ground truth '{variant}'{hint}")
        return self._annotated(scene)

    def instance_mesh(self, scene: str) -> InstanceMesh:
        self._folder(scene)
        raise GroundTruthMissing(
            f"{self._where(scene)}: no annotated mesh; that of HM3D keeps its objects in a texture, which is not read"
        )

    def _where(self, scene: str) -> str:
        return f"{self.name}/{scene}"

    def _folder(self, scene: str) -> Path:
        if scene not in self.walks.folder_of:
            hint = suggest(scene, list(self.walks.folder_of), f"{self.walks.places[0]} has")
            raise DataError(f"{self.name}: no scene '{scene}'{hint}")
        return self.walks.folder_of[scene]

    def _recording(self, scene: str) -> Recording:
        """The recording of ``scene``; the last one is kept, because each step asks for it anew."""
        if self._last is None or self._last[0] != scene:
            self._last = scene, open_walk(self._folder(scene), self._where(scene))
        return self._last[1]

    def _annotated(self, scene: str) -> GroundTruth:
        """The truth of ``scene``; the last one is kept, because every protocol asks for it anew."""
        if self._truth is None or self._truth[0] != scene:
            if not (self._folder(scene) / INFO_NAME).is_file():
                raise GroundTruthMissing(
                    f"{self._where(scene)}: no ground truth, {INFO_NAME} is missing in {self._folder(scene)}; {AGAIN}"
                )
            self._truth = scene, read_truth(self._folder(scene), self._where(scene))
        return self._truth[1]

    def _truth_files(self, scene: str) -> tuple[Path, ...]:
        folder = self._folder(scene)
        if not (folder / INFO_NAME).is_file():
            return ()
        annotation = annotation_file(self.root, folder)
        clouds = sorted((folder / OBJECTS).glob("*.ply"))
        labels = openlex3d.label_files(self.root, LABELS_OF, scene)
        return (folder / INFO_NAME, *clouds, *(() if annotation is None else (annotation,)), *labels)
