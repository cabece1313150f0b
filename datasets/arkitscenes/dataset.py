"""ARKitScenes as the OpenSUN3D challenge uses it: a phone's recording, its mesh, and a text to be found in each scene.

The raw and the 3DOD release are read; the query and the truth come from a clone of the challenge's repository.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, FramesMissing, GroundTruthMissing, suggest
from su3d_bench.core.types import Frame, GroundTruth, ImageDomain, InstanceMesh, SceneInfo, Surface
from su3d_bench.datasets.arkitscenes.challenge import (
    LABEL_SPACE,
    VARIANT,
    Challenge,
    ChallengeQuery,
    answered,
    find_challenge,
)
from su3d_bench.datasets.arkitscenes.folders import (
    DEVELOPMENT,
    SCENE_NAMES,
    SceneFolders,
    find_scenes,
    no_scenes,
)
from su3d_bench.datasets.arkitscenes.frames import (
    MOST_CONFIDENCE,
    Images,
    PhoneFrames,
    PhoneRecording,
    open_recording,
)
from su3d_bench.datasets.recordings import meshes
from su3d_bench.datasets.recordings.recorded_frames import reading

READER_VERSION = 1  # raise it whenever the same files come out as other frames or another truth


class ArkitScenesOptions(BaseModel):
    """``images``: those of 256x192 at up to 60 a second, as the challenge's loader takes them, or the ``wide`` camera's
    with the laser scanner's depth where it is there. ``width``: columns of the frames, at most. ``least_confidence``:
    depth that the phone was less sure of (0 to 2) is left out. ``challenge``: a clone of the challenge's repository,
    where it does not lie beside the scenes."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    images: Images = "lowres"
    width: int = Field(default=640, ge=16, le=4096)  # ScanNet's depth camera; images of low resolution have 256
    least_confidence: int = Field(default=0, ge=0, le=MOST_CONFIDENCE)  # the challenge's loader reads no confidence
    challenge: Path | None = None


class ArkitScenes:
    """ARKitScenes and the OpenSUN3D challenge's queries over it; read below the data root."""

    name = "arkitscenes"
    reads_made_rooms = True
    scene_names = SCENE_NAMES
    label_space = LABEL_SPACE
    variants: tuple[str, ...] = (VARIANT,)
    Options = ArkitScenesOptions

    def __init__(self, root: Path, options: ArkitScenesOptions | None = None) -> None:
        self.root = root
        self.options = options or ArkitScenesOptions()
        self._tree: SceneFolders | None = None
        self._challenge: Challenge | None = None
        self._last: tuple[str, PhoneRecording] | None = None
        self._mesh: tuple[str, Surface] | None = None

    @property
    def tree(self) -> SceneFolders:
        """Where the scenes are; a ``ScenesMissing`` that says how to get data where there are none."""
        if self._tree is None:
            tree = find_scenes(self.root)
            if not tree.folder_of:
                raise no_scenes(self.root)
            self._tree = tree
        return self._tree

    @property
    def challenge(self) -> Challenge:
        """The challenge's lists and truths, as far as they are here."""
        if self._challenge is None:
            self._challenge = find_challenge(self.root, self.options.challenge)
        return self._challenge

    def scenes(self) -> Sequence[str]:
        return tuple(self.tree.folder_of)

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The challenge's development scenes, and its test scenes where their list is here."""
        return self.challenge.groups

    def places(self) -> Sequence[Path]:
        """Where scenes are, or else would be looked for first."""
        return find_scenes(self.root).places or [self.root / DEVELOPMENT]

    def status(self, scene: str) -> str:
        """A word on the scene from a quick look: images, and query and truth."""
        try:
            words = f"{len(self._recording(scene).images)} images"
        except FramesMissing:
            words = "no images"
        try:
            text = self.challenge.query(scene)
        except GroundTruthMissing:
            return f"{words}, no query"
        has_truth = any(path.suffix == ".txt" for path in self.challenge.files(scene))
        return f"{words}, query '{text}', {'ground truth' if has_truth else 'no ground truth'}"

    def info(self, scene: str, stride: int) -> SceneInfo:
        domain: ImageDomain = "rendered-rooms" if scene in self.tree.made else "camera"
        return SceneInfo(self.name, scene, len(self.frames(scene, stride)), stride, domain)

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """Every ``stride``-th of the frames that have all of their files and a pose, in the order of their times."""
        return PhoneFrames(self._recording(scene), stride, self.options.width, self.options.least_confidence)

    def files(self, scene: str) -> Sequence[Path]:
        return (*self._recording(scene).files(), *self._small_files(scene))

    def digest(self, scene: str) -> str:
        """A key of the content of the truth, the lists, the mesh, the poses, all cameras and the first and last images,
        and of the sizes of all files: what is changed in the middle and keeps its size goes unseen."""
        words = self.name, READER_VERSION, scene, scene in self.tree.made, self.options.model_dump_json()
        total = hashlib.sha256(" ".join(str(word) for word in words).encode())
        files = self._recording(scene).files()
        cameras = [path for path in files if path.suffix == ".pincam"]
        with reading(self._where(scene)):
            for path in files:
                total.update(f"{path.parent.name}/{path.name} {path.stat().st_size}\n".encode())
            for path in (*files[:4], *files[-4:], *cameras, *self._small_files(scene)):
                total.update(f"{path.name} {digest_file(path)}\n".encode())
        return total.hexdigest()

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        """The vertices that answer the scene's query, each with the number of its object."""
        if variant not in self.variants:
            hint = suggest(variant, self.variants)
            raise GroundTruthMissing(f"{self._where(scene)}: no ground truth '{variant}'{hint}")
        return self.challenge.ground_truth(scene, self.surface(scene).vertices)

    def asked_text(self, scene: str) -> str:
        """What the scene is searched for; ``GroundTruthMissing`` where no list has its query."""
        return self.challenge.query(scene)

    def queries(self, scene: str) -> Sequence[ChallengeQuery]:
        """The scene's query with the numbers of the objects that answer it; ``GroundTruthMissing`` without either."""
        return (answered(self.ground_truth(scene, VARIANT), self.challenge.query(scene)),)

    def instance_mesh(self, scene: str) -> InstanceMesh:
        raise GroundTruthMissing(
            f"{self._where(scene)}: no annotated mesh; the challenge annotates what answers its query and nothing else"
        )

    def surface(self, scene: str) -> Surface:
        """The mesh that the phone made, without labels; the last one is kept, because every protocol asks for it."""
        if self._mesh is None or self._mesh[0] != scene:
            self._folder(scene)
            path = self.tree.mesh(scene)
            self._mesh = scene, meshes.read_surface(path, f"{self._where(scene)}: {path.name}")
        return self._mesh[1]

    def problems(self, scene: str) -> Iterator[str]:
        """What of the recording was left out, and what is wrong with query and truth; images are left to the frames."""
        yield from self._recording(scene).missing
        questions: list[Callable[[], object]] = [
            lambda: self.surface(scene),
            lambda: self.ground_truth(scene, VARIANT),
            lambda: self.challenge.query(scene),
        ]
        seen = set[str]()
        for ask in questions:
            try:
                ask()
            except GroundTruthMissing:
                pass
            except DataError as error:
                if str(error) not in seen:
                    yield str(error)
                seen.add(str(error))

    def _where(self, scene: str) -> str:
        return f"{self.name}/{scene}"

    def _folder(self, scene: str) -> Path:
        if scene not in self.tree.folder_of:
            hint = suggest(scene, list(self.tree.folder_of), f"{self.tree.places[0]} has")
            raise DataError(f"arkitscenes: no scene '{scene}'{hint}")
        return self.tree.frames_folder(scene)

    def _small_files(self, scene: str) -> tuple[Path, ...]:
        """What is read of the scene beside its recording, as far as it is there."""
        mesh = self.tree.mesh(scene)
        return (*((mesh,) if mesh.is_file() else ()), *self.challenge.files(scene))

    def _recording(self, scene: str) -> PhoneRecording:
        """The recording of ``scene``; the last one is kept, because each step asks for it anew."""
        if self._last is None or self._last[0] != scene:
            options, where = self.options, self._where(scene)
            folder = self._folder(scene)
            self._last = scene, open_recording(folder, scene, options.images, options.least_confidence, where)
        return self._last[1]
