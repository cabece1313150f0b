"""ScanNet++, both releases: the iPhone's RGB-D recording, and ground truth from the annotated laser scans.

The DSLR's images are not used because they have no depth.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.system.files import opened
from su3d_bench.core.types import Frame, GroundTruth, InstanceMesh, Surface
from su3d_bench.datasets.openlex3d import release as openlex3d
from su3d_bench.datasets.recordings.file_dataset import FileDataset, faults_of, keeps_last, sizes_and_ends
from su3d_bench.datasets.recordings.recorded_frames import reading
from su3d_bench.datasets.scannetpp import frames, truth
from su3d_bench.datasets.scannetpp.frames import IphoneRecording
from su3d_bench.formats.arrays import read_text

SCENE_NAMES = r"[0-9a-f]{10}"
SPLITS_FOLDER = "splits"
IPHONE, SCANS = "iphone", "scans"
MAX_SCENES = 100_000
LARGE_BYTES, END_BYTES = 64 << 20, 1 << 20  # of larger files (videos, packed recordings) only both ends are digested


class ScannetppOptions(BaseModel):
    """``poses``: COLMAP's, as used by the official toolkit, or the phone's own tracking, aligned to the mesh;
    ``auto`` uses COLMAP's if available. ``width``: maximum columns of a frame; the recording has 1920."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    poses: frames.PoseSource = "auto"
    width: int = Field(default=640, ge=16, le=4096)  # ScanNet's depth camera


class ScanNetPP(FileDataset[ScannetppOptions]):
    """ScanNet++ (v1 and v2): the iPhone's frames and the annotated laser scans; read below the data root.

    A scene is a folder such as ``data/036bce3393`` with ``iphone/`` and ``scans/``; ``metadata/`` and ``splits/`` are
    next to ``data/``. Both releases have this layout.
    """

    name = "scannetpp"
    headline_protocol = "scannetpp-instance"  # the benchmark's own
    reader_version = 2
    scene_names = SCENE_NAMES
    places_of_scenes = tuple(f"{base}/data" if base else "data" for base in truth.BASES)
    how_to_get = (
        "/data or in scannetpp/data (a scene is a folder such as 036bce3393 with iphone/ and scans/); request the data "
        "at https://kaldir.vc.in.tum.de/scannetpp/ and set SU3D_DATA to its folder"
    )
    label_space = truth.LABEL_SPACE
    variants = (truth.VARIANT,)
    extra_ground_truths = openlex3d.EXTRA_GROUND_TRUTHS
    labels_of = "scannetpp"
    Options = ScannetppOptions

    def is_scene(self, folder: Path) -> bool:
        is_named = re.fullmatch(SCENE_NAMES, folder.name) is not None
        return is_named and ((folder / IPHONE).exists() or (folder / SCANS).exists())

    @property
    def releases(self) -> list[Path]:
        """The folders with ``data/``, ``metadata/`` and ``splits/``; there are two if ``data/`` is a link."""
        return list(dict.fromkeys(path.parent for place in self.tree.places for path in (place, place.resolve())))

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The official splits whose lists are in ``splits/``, whether their scenes are available or not."""
        return self._splits

    @cached_property
    def _splits(self) -> dict[str, tuple[str, ...]]:
        found: dict[str, tuple[str, ...]] = {}
        for release in self.releases:
            for path in sorted((release / SPLITS_FOLDER).glob("*.txt")):
                if re.fullmatch(r"[a-z0-9_]{1,40}", path.stem) and path.stem not in found:
                    found[path.stem] = read_split(path)
        return found

    def status(self, scene: str) -> str:
        """One-line summary of the scene from a quick look: frames, ground truth."""
        with reading(self.where(scene)):
            words = frames.describe_recording(self.folder(scene) / IPHONE, self.options.poses)
        try:
            self._truth_files(scene)
            self._benchmark_folder(scene)
        except GroundTruthMissing as error:
            return f"{words}, {str(error).partition(': ')[2]}"
        return f"{words}, ground truth"

    def n_frames(self, scene: str, stride: int) -> int:
        return len(self.recording(scene).every(stride))

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """Every ``stride``-th frame with a pose entry, in the order of the video; the number of
        frames without a pose is logged once."""
        recording = self.recording(scene)
        self.warn_once(scene, recording.missing_frames_remark())
        return frames.IphoneFrames(recording, recording.every(stride), self.options.width)

    def recording_files(self, scene: str) -> Sequence[Path]:
        return self.recording(scene).files()

    def files(self, scene: str) -> Sequence[Path]:
        # A list of masked vertices may be empty: it is listed only if not, because an empty file is otherwise a fault.
        return [path for path in super().files(scene) if path.name != truth.MASK_NAME or path.stat().st_size]

    def recording_key(self, scene: str) -> str:
        recording = self.recording(scene)
        posed = recording.posed
        arrays = posed.numbers, posed.poses, posed.intrinsics, posed.distortion
        poses = hashlib.sha256(str(posed.size).encode() + b"".join(array.tobytes() for array in arrays)).hexdigest()
        with reading(self.where(scene)):
            return poses + sizes_and_ends(recording.files()[len(posed.files) :], 1, _digest_of)

    def small_files(self, scene: str) -> tuple[Path, ...]:
        paths = [self.folder(scene) / SCANS / name for name in truth.TRUTH_NAMES]
        lists = self._find_benchmark_folder(scene)
        paths += [] if lists is None else [lists / name for name in truth.LIST_NAMES]
        paths += openlex3d.label_files(self.root, self.name, scene)
        return tuple(path for path in paths if path.is_file())

    def own_truth(self, scene: str, variant: str) -> GroundTruth:
        return truth.vertex_truth(self.annotated_scan(scene))

    def instance_mesh(self, scene: str) -> InstanceMesh:
        return truth.instance_mesh(self.annotated_scan(scene))

    def surface(self, scene: str) -> Surface:
        """The mesh, with the published segments if available; scenes without ground truth have both."""
        folder = self.folder(scene) / SCANS
        segments = folder / truth.SEGMENTS_NAME
        return truth.read_surface(folder / truth.MESH_NAME, segments if segments.is_file() else None, self.where(scene))

    def problems(self, scene: str) -> Iterator[str]:
        """Faults of the recording's poses and the ground truth, one line each; images are checked as frames."""
        yield from faults_of([lambda: self.recording(scene)])
        if (self.folder(scene) / SCANS).is_dir():
            yield from faults_of([lambda: self.annotated_scan(scene)])

    @keeps_last
    def recording(self, scene: str) -> IphoneRecording:
        with reading(self.where(scene)):
            return frames.open_recording(self.folder(scene) / IPHONE, self.where(scene), self.options.poses)

    def _truth_files(self, scene: str) -> dict[str, Path]:
        """The path of each file of the ground truth."""
        folder = self.folder(scene) / SCANS
        missing = [name for name in truth.TRUTH_NAMES if not (folder / name).is_file()]
        if missing:
            reason = f"expected in {folder}"
            if missing[0] == truth.MASK_NAME:
                reason += "; without it, vertices excluded by the benchmark would be scored"
            elif missing[0] != truth.MESH_NAME:
                reason += "; it is not published for test scenes"
            raise GroundTruthMissing(f"{self.where(scene)}: no ground truth, {missing[0]} is missing; {reason}")
        return {name: folder / name for name in truth.TRUTH_NAMES}

    def _find_benchmark_folder(self, scene: str) -> Path | None:
        """The folder of the benchmark's lists, nearest to the scene first; None if no folder has all of them."""
        near = self.folder(scene).parent.parent
        places = [release / truth.BENCHMARK_FOLDER for release in (near, *self.releases)]
        return next((place for place in places if all((place / name).is_file() for name in truth.LIST_NAMES)), None)

    def _benchmark_folder(self, scene: str) -> Path:
        lists = self._find_benchmark_folder(scene)
        if lists is None:
            place = self.folder(scene).parent.parent / truth.BENCHMARK_FOLDER
            raise GroundTruthMissing(
                f"{self.where(scene)}: no ground truth, the benchmark's lists {', '.join(truth.LIST_NAMES)} are "
                f"missing; they come with the data, put them into {place}"
            )
        return lists

    @keeps_last
    def annotated_scan(self, scene: str) -> truth.AnnotatedScan:
        files, where = self._truth_files(scene), self.where(scene)
        return truth.read_annotated_scan(
            files, truth.read_benchmark_classes(self._benchmark_folder(scene), where), where
        )


def read_split(path: Path) -> tuple[str, ...]:
    """The scenes of a split in order, each once."""
    where = f"scannetpp: {SPLITS_FOLDER}/{path.name}"
    scenes = read_text(path, where).split()
    wrong = next((scene for scene in scenes if not re.fullmatch(SCENE_NAMES, scene)), None)
    if wrong is not None or len(scenes) > MAX_SCENES:
        raise DataError(f"{where}: {(wrong or '')[:40]!a} is not a scene; expected one per line, such as 036bce3393")
    return tuple(dict.fromkeys(scenes))


def _digest_of(path: Path) -> str:
    """A digest of the whole content, or of both ends of a large file."""
    if path.stat().st_size <= LARGE_BYTES:
        return digest_file(path)
    with opened(path) as stream:
        first = stream.read(END_BYTES)
        stream.seek(-END_BYTES, 2)
        return hashlib.sha256(first + stream.read(END_BYTES)).hexdigest()
