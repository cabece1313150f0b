"""ScanNet++, both releases: the iPhone's RGB-D recording, and truth from the annotated laser scans.

The DSLR's images, which have no depth, are left out.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, GroundTruthMissing, suggest
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Frame, GroundTruth, ImageDomain, InstanceMesh, SceneInfo, Surface
from su3d_bench.datasets.openlex3d import release as openlex3d
from su3d_bench.datasets.recordings.recorded_frames import reading
from su3d_bench.datasets.scannetpp.annotations import MASK_NAME, MESH_NAME, SEGMENTS_NAME
from su3d_bench.datasets.scannetpp.folders import (
    IPHONE,
    PLACES,
    SCANS,
    SCENE_NAMES,
    SceneFolders,
    find_scenes,
    no_scenes,
)
from su3d_bench.datasets.scannetpp.iphone.frames import (
    IphoneFrames,
    IphoneRecording,
    PoseSource,
    describe_recording,
    open_recording,
)
from su3d_bench.datasets.scannetpp.labels import (
    BENCHMARK_FOLDER,
    LABEL_SPACE,
    LIST_NAMES,
    BenchmarkClasses,
    read_benchmark_classes,
)
from su3d_bench.datasets.scannetpp.truth import (
    TRUTH_NAMES,
    VARIANT,
    AnnotatedScan,
    instance_mesh,
    read_annotated_scan,
    read_surface,
    vertex_truth,
)

READER_VERSION = 1  # raise it whenever the same files come out as other frames or another truth
LARGE_BYTES, END_BYTES = 64 << 20, 1 << 20  # of a larger file, a video or a packed recording, the two ends are digested
logger = logging.getLogger(__name__)


class ScannetppOptions(BaseModel):
    """``poses``: COLMAP's, as the official toolkit takes them, or the phone's own tracking, aligned to the mesh;
    ``auto`` takes COLMAP's where they are there. ``width``: columns of the frames, at most; the recording has 1920."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    poses: PoseSource = "auto"
    width: int = Field(default=640, ge=16, le=4096)  # ScanNet's depth camera


class ScanNetPP:
    """ScanNet++ (v1 and v2): the iPhone's frames and the annotated laser scans; read below the data root."""

    name = "scannetpp"
    reads_made_rooms = True
    scene_names = SCENE_NAMES
    label_space = LABEL_SPACE
    variants: tuple[str, ...] = (VARIANT,)
    further_truths = openlex3d.FURTHER_TRUTHS
    Options = ScannetppOptions

    def __init__(self, root: Path, options: ScannetppOptions | None = None) -> None:
        self.root = root
        self.options = options or ScannetppOptions()
        self._scan: tuple[str, AnnotatedScan] | None = None
        self._last: tuple[str, IphoneRecording] | None = None
        self._tree: SceneFolders | None = None
        self._warned_of: set[str] = set()

    @property
    def tree(self) -> SceneFolders:
        """Where the scenes are; a ``ScenesMissing`` that says how to get data where there are none."""
        if self._tree is None:
            tree = find_scenes(self.root)
            if not tree.folder_of:
                raise no_scenes(self.root)
            self._tree = tree
        return self._tree

    def scenes(self) -> Sequence[str]:
        return tuple(self.tree.folder_of)

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The official splits as far as their lists lie in ``splits/``; whether their scenes are here or not."""
        return self.tree.splits

    def places(self) -> Sequence[Path]:
        """Where scenes are, or else would be looked for first."""
        return find_scenes(self.root).places or [self.root / name for name in PLACES[:2]]

    def status(self, scene: str) -> str:
        """A word on the scene from a quick look: frames, and ground truth."""
        with reading(self._where(scene)):
            words = describe_recording(self._folder(scene) / IPHONE, self.options.poses)
        try:
            self._truth_files(scene)
            self._benchmark_folder(scene)
        except GroundTruthMissing as error:
            return f"{words}, {str(error).partition(': ')[2]}"
        return f"{words}, ground truth"

    def info(self, scene: str, stride: int) -> SceneInfo:
        domain: ImageDomain = "rendered-rooms" if scene in self.tree.made else "camera"
        return SceneInfo(self.name, scene, len(self._recording(scene).every(stride)), stride, domain)

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """Every ``stride``-th of the frames that the poses name, in the order of the video; a line of the log counts
        those that have none once."""
        recording = self._recording(scene)
        if (line := recording.say_what_is_lost()) and scene not in self._warned_of:
            self._warned_of.add(scene)
            logger.warning("%s", line)
        return IphoneFrames(recording, recording.every(stride), self.options.width)

    def files(self, scene: str) -> Sequence[Path]:
        # A list of masked vertices may be empty: it is listed where it is not, because an empty file is else a fault.
        small = [path for path in self._small_files(scene) if path.name != MASK_NAME or path.stat().st_size]
        return (*self._recording(scene).files(), *small)

    def digest(self, scene: str) -> str:
        """A key of the content of the truth, the benchmark's lists, the poses and the first and last images, and of the
        sizes of all files: what is changed in the middle of a recording and keeps its size goes unseen."""
        words = "scannetpp", READER_VERSION, scene, scene in self.tree.made, self.options.model_dump_json()
        total = hashlib.sha256(" ".join(str(word) for word in words).encode())
        recording = self._recording(scene)
        posed = recording.posed
        arrays = posed.numbers, posed.poses, posed.intrinsics, posed.distortion
        total.update(str(posed.size).encode() + b"".join(array.tobytes() for array in arrays))
        images = recording.files()[len(posed.files) :]
        with reading(self._where(scene)):
            for path in images:
                total.update(f"{path.parent.name}/{path.name} {path.stat().st_size}\n".encode())
            for path in (*dict.fromkeys((*images[:1], *images[-1:])), *self._small_files(scene)):
                total.update(f"{path.name} {_digest_of(path)}\n".encode())
        return total.hexdigest()

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        if variant in self.further_truths.values():
            self._folder(scene)
            labelled: GroundTruth = openlex3d.truth_below(self.root, self.name, scene, variant)
            return labelled
        if variant not in self.variants:
            hint = suggest(variant, self.variants)
            raise GroundTruthMissing(f"{self._where(scene)}: no ground truth '{variant}'{hint}")
        return vertex_truth(self._annotated_scan(scene))

    def instance_mesh(self, scene: str) -> InstanceMesh:
        return instance_mesh(self._annotated_scan(scene))

    def surface(self, scene: str) -> Surface:
        """The mesh, with the published segments where they are here; scenes without truth have both."""
        folder = self._folder(scene) / SCANS
        segments = folder / SEGMENTS_NAME
        return read_surface(folder / MESH_NAME, segments if segments.is_file() else None, self._where(scene))

    def problems(self, scene: str) -> Iterator[str]:
        """What is wrong with the recording's poses and with the truth, a line each; images are left to the frames."""
        questions: list[Callable[[], object]] = [lambda: self._open(scene)]
        if (self._folder(scene) / SCANS).is_dir():
            questions.append(lambda: self._annotated_scan(scene))
        for ask in questions:
            try:
                ask()
            except GroundTruthMissing:
                pass
            except DataError as error:
                yield str(error)

    def _where(self, scene: str) -> str:
        return f"{self.name}/{scene}"

    def _folder(self, scene: str) -> Path:
        if scene not in self.tree.folder_of:
            hint = suggest(scene, list(self.tree.folder_of), f"{self.tree.places[0]} has")
            raise DataError(f"scannetpp: no scene '{scene}'{hint}")
        return self.tree.folder_of[scene]

    def _recording(self, scene: str) -> IphoneRecording:
        """The recording of ``scene`` and its poses; the last one is kept, because each step asks for it anew."""
        if self._last is None or self._last[0] != scene:
            self._last = scene, self._open(scene)
        return self._last[1]

    def _open(self, scene: str) -> IphoneRecording:
        with reading(self._where(scene)):
            return open_recording(self._folder(scene) / IPHONE, self._where(scene), self.options.poses)

    def _small_files(self, scene: str) -> tuple[Path, ...]:
        """What is read of the scene beside its recording, as far as it is there."""
        paths = [self._folder(scene) / SCANS / name for name in TRUTH_NAMES]
        lists = self.tree.benchmark_folder(scene)
        paths += [] if lists is None else [lists / name for name in LIST_NAMES]
        paths += openlex3d.label_files(self.root, self.name, scene)
        return tuple(path for path in paths if path.is_file())

    def _truth_files(self, scene: str) -> dict[str, Path]:
        """The path of each file of the truth."""
        folder = self._folder(scene) / SCANS
        missing = [name for name in TRUTH_NAMES if not (folder / name).is_file()]
        if missing:
            reason = f"expected in {folder}"
            if missing[0] == MASK_NAME:
                reason += "; without it, vertices would be scored that the benchmark leaves out"
            elif missing[0] != MESH_NAME:
                reason += "; the benchmark keeps the annotation of its test scenes to itself"
            raise GroundTruthMissing(f"{self._where(scene)}: no ground truth, {missing[0]} is missing; {reason}")
        return {name: folder / name for name in TRUTH_NAMES}

    def _benchmark_folder(self, scene: str) -> Path:
        self._folder(scene)
        lists = self.tree.benchmark_folder(scene)
        if lists is None:
            place = self._folder(scene).parent.parent / BENCHMARK_FOLDER
            raise GroundTruthMissing(
                f"{self._where(scene)}: no ground truth, the benchmark's lists {', '.join(LIST_NAMES)} are missing; "
                f"they come with the data, put them into {place}"
            )
        return lists

    def _classes(self, scene: str) -> BenchmarkClasses:
        return read_benchmark_classes(self._benchmark_folder(scene), self._where(scene))

    def _annotated_scan(self, scene: str) -> AnnotatedScan:
        """The annotated mesh of ``scene``; the last one is kept, because every protocol asks for it anew."""
        if self._scan is None or self._scan[0] != scene:
            files = self._truth_files(scene)
            self._scan = scene, read_annotated_scan(files, self._classes(scene), self._where(scene))
        return self._scan[1]


def _digest_of(path: Path) -> str:
    """Of the whole content, or of the two ends of a large file."""
    if path.stat().st_size <= LARGE_BYTES:
        return digest_file(path)
    with opened(path) as stream:
        first = stream.read(END_BYTES)
        stream.seek(-END_BYTES, 2)
        return hashlib.sha256(first + stream.read(END_BYTES)).hexdigest()
