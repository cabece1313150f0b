"""HM3DSem walks as HOV-SG generates and evaluates them: floors, rooms and objects of whole buildings.

A walk has ``rgb/``, ``depth/`` and ``pose/`` with one file per frame. Depth is 16 bits in mm. A pose is one line of
16 numbers, the camera in Habitat's axes (x right, y up, z back); frames have the camera in OpenCV's axes, as HOV-SG's
loader has them. There is no camera file: the field of view is 90 degrees and the principal point is the centre
(hovsg/dataloader/hm3dsem.py). The world is Habitat's, with y up, as in HOV-SG's predictions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError, GroundTruthMissing, counted
from su3d_bench.core.geometry import are_rigid
from su3d_bench.core.types import Float64Array, GroundTruth, WorldUp
from su3d_bench.datasets.hm3dsem import truth
from su3d_bench.datasets.openlex3d import release as openlex3d
from su3d_bench.datasets.recordings import recorded_frames, source
from su3d_bench.datasets.recordings.file_dataset import NoOptions, RecordedDataset, faults_of, keeps_last
from su3d_bench.datasets.recordings.recorded_frames import RecordedFrame, Recording
from su3d_bench.datasets.recordings.source import by_number, check_complete, list_folder, read_matrix, read_size

WALKS_FOLDER, SPLIT = "hm3dsem_walks", "val"
SPLITS = (SPLIT, "train", "minival")
PLACES = tuple(f"{base}{split}" for base in (f"{WALKS_FOLDER}/", "hm3dsem/", "HM3DSem/", "") for split in SPLITS)
RELEASE_PLACES = tuple(f"{base}/{split}" for base in ("hm3d", "HM3D", "hm3dsem", "HM3DSem") for split in SPLITS)
SCENE_NAMES = r"\d{5}-[A-Za-z0-9]{11}"
COLOUR, DEPTH, POSE = "rgb", "depth", "pose"
LABELS_OF = "hm3d"  # as OpenLex3D calls the dataset
WALKS_URL = "https://github.com/hovsg/HOV-SG#habitat-matterport-3d-semantics"
# The scenes that HOV-SG's README evaluates, and those for which its generator has poses.
EVALUATED = (
    "00824-Dd4bFSTQ8gi", "00829-QaLdnwvtxbs", "00843-DYehNKdT76V", "00861-GLAQ4DNUx5U",
    "00862-LT9Jq6dN3Ea", "00873-bxsVRursffK", "00877-4ok3usBNeis", "00890-6s7QHgap2fW",
)  # fmt: skip
GROUPS: Mapping[str, tuple[str, ...]] = {
    "hovsg": EVALUATED,
    "walks": tuple(sorted((*EVALUATED, "00847-bCPU9suPUw9", "00849-a8BtkwhxdRV"))),
}
UNITS_PER_METRE = 1000.0  # habitat_utils.py: save_obs
FRAMES_PER_SECOND = 30.0  # ours: walks have no time stamps
TO_HABITAT = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV's camera axes to Habitat's, and back
DEPTH_M_OF_VALUE = recorded_frames.depth_m_of_values(UNITS_PER_METRE)
ENDINGS = {COLOUR: "png", DEPTH: "png", POSE: "txt"}


class Hm3dSem(RecordedDataset[NoOptions]):
    """HOV-SG's walks through HM3DSem, with the ground truth created by its tools; read below the data root."""

    name = "hm3dsem"
    headline_protocol = "hm3dsem-objects"  # HOV-SG's semantics of objects
    reader_version = 2
    scene_names = SCENE_NAMES
    places_of_scenes = PLACES
    how_to_get = (
        f"/{PLACES[0]} (a walk is a folder such as {EVALUATED[0]} with pose/, rgb/ and depth/); generate them with "
        f"HOV-SG's tools ({WALKS_URL})"
    )
    label_space = truth.LABEL_SPACE
    variants = (truth.VARIANT,)
    extra_ground_truths = openlex3d.EXTRA_GROUND_TRUTHS
    labels_of = LABELS_OF
    no_mesh = "HM3D stores objects in a texture, which is not read"
    Options = NoOptions

    def is_scene(self, folder: Path) -> bool:
        is_walk = (folder / POSE).is_dir() or (folder / truth.INFO_NAME).is_file()
        return is_walk and re.fullmatch(SCENE_NAMES, folder.name) is not None

    def groups(self) -> Mapping[str, Sequence[str]]:
        """The scenes that HOV-SG evaluates and those for which it has poses, available or not."""
        return GROUPS

    def status(self, scene: str) -> str:
        """One-line summary of the walk from a quick look: frames, ground truth."""
        folder = self.folder(scene)
        with recorded_frames.reading(self.where(scene)):
            n = sum(1 for _ in (folder / POSE).glob("*.txt")) if (folder / POSE).is_dir() else 0
        missing = "" if (folder / truth.INFO_NAME).is_file() else f"no ground truth ({truth.INFO_NAME} is missing)"
        return f"{source.missing_parts(folder, *ENDINGS) or counted(n, 'frame')}, {missing or 'ground truth'}"

    def small_files(self, scene: str) -> tuple[Path, ...]:
        folder = self.folder(scene)
        if not (folder / truth.INFO_NAME).is_file():
            return ()
        annotation = annotation_file(self.root, folder)
        clouds = sorted((folder / truth.OBJECTS).glob("*.ply"))
        labels = openlex3d.label_files(self.root, LABELS_OF, scene)
        return (folder / truth.INFO_NAME, *clouds, *(() if annotation is None else (annotation,)), *labels)

    def up(self, scene: str) -> WorldUp:
        """Y, as in Habitat."""
        self.folder(scene)
        return WorldUp("y", False, "Habitat's worlds have y up", "it is kept for HOV-SG's predictions")

    def problems(self, scene: str) -> Iterator[str]:
        """Faults of poses, ground truth and annotation, one line each; images are checked as frames."""
        yield from faults_of([lambda: self.recording(scene), lambda: self._check_annotation(scene)])

    def _check_annotation(self, scene: str) -> None:
        self.annotated(scene)
        folder, where = self.folder(scene), self.where(scene)
        annotation = annotation_file(self.root, folder)
        if annotation is not None:
            info = truth.read_info(folder / truth.INFO_NAME, where)
            truth.check_annotation(info, truth.read_annotation(annotation, where), where)

    def own_truth(self, scene: str, variant: str) -> GroundTruth:
        return self.annotated(scene)

    @keeps_last
    def recording(self, scene: str) -> Recording:
        return open_walk(self.folder(scene), self.where(scene))

    @keeps_last
    def annotated(self, scene: str) -> GroundTruth:
        if not (self.folder(scene) / truth.INFO_NAME).is_file():
            raise GroundTruthMissing(
                f"{self.where(scene)}: no ground truth, {truth.INFO_NAME} is missing in {self.folder(scene)}; "
                f"{truth.AGAIN}"
            )
        return truth.read_truth(self.folder(scene), self.where(scene))


def annotation_file(root: Path, walk: Path) -> Path | None:
    """The ``.semantic.txt`` of a walk's scene, next to the walk or in the release; None if missing."""
    name = f"{walk.name.partition('-')[2]}.semantic.txt"
    folders = [walk, *(root / place / walk.name for place in RELEASE_PLACES)]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def open_walk(path: Path, where: str) -> Recording:
    """The frames of the walk in ``path``; a fault in its files is a ``DataError``."""
    files = {
        kind: by_number(list_folder(path, kind, where), rf"[\w-]{{1,80}}[_-](\d{{6,9}})\.{ending}", f"{where}: {kind}/")
        for kind, ending in ENDINGS.items()
    }
    numbers = sorted(set().union(*files.values()))
    if not numbers:
        raise DataError(f"{where}: {POSE}/, {COLOUR}/ and {DEPTH}/ have no frames; generate the walk again")
    check_complete(
        {f"{kind}/..._{{:06d}}.{ending}": files[kind] for kind, ending in ENDINGS.items()},
        range(numbers[0], numbers[-1] + 1),
        where,
    )
    poses = read_poses(path, [f"{POSE}/{files[POSE][number]}" for number in numbers], where)
    frames = tuple(
        RecordedFrame(n, n / FRAMES_PER_SECOND, f"{COLOUR}/{files[COLOUR][n]}", f"{DEPTH}/{files[DEPTH][n]}", pose)
        for n, pose in zip(numbers, poses, strict=True)
    )
    width, height = read_size(path, frames[0].colour, where)
    return Recording(
        where,
        recorded_frames.Folder(path),
        frames,
        recorded_frames.pinhole(width / 2, width / 2, width / 2, height / 2, where),
        DEPTH_M_OF_VALUE,
        tuple(path / POSE / files[POSE][number] for number in numbers),
        image_size=(width, height),
    )


def read_poses(path: Path, names: Sequence[str], where: str) -> Float64Array:
    """Camera-to-world poses (n, 4, 4), OpenCV camera axes, in the world of the files."""
    poses = np.array([read_matrix(path, name, where) for name in names]).reshape(-1, 4, 4)
    is_sound = np.isfinite(poses).all(axis=(1, 2))
    is_sound[is_sound] = are_rigid(poses[is_sound])
    if not is_sound.all():
        raise DataError(f"{where}: {names[int(np.argmin(is_sound))]}: not a rigid transform; generate the walk again")
    return poses @ TO_HABITAT
