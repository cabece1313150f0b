"""Shared base of file-based datasets: scenes below the data root, the files that are read, digests, missing data."""

from __future__ import annotations

import hashlib
import json
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError, FramesMissing, GroundTruthMissing, no_scene, suggest
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import Frame, GroundTruth, ImageDomain, InstanceMesh, SceneInfo
from su3d_bench.datasets.openlex3d import release as openlex3d
from su3d_bench.datasets.recordings.recorded_frames import RecordedFrames, Recording, reading

logger = logging.getLogger(__name__)
MARKER = "rooms.json"  # lists the scenes of a folder that `datasets make` rendered
MAX_LINES = 20  # per kind of fault
DatasetT = TypeVar("DatasetT")
OptionsT = TypeVar("OptionsT", bound=BaseModel)
Answer = TypeVar("Answer")


class NoOptions(BaseModel):
    """A dataset without options: its files define everything."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def read_marker(folder: Path) -> dict[str, str]:
    """Scene -> content key of the scenes in a folder that ``datasets make`` rendered; empty without a marker."""
    path = folder / MARKER
    if not path.is_file():
        return {}
    try:
        scenes = json.loads(file_text(path))["scenes"]
        return {str(scene): str(key) for scene, key in scenes.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{path}: not a marker of `su3d-bench datasets make` ({error}); delete it if the scenes were "
            "created otherwise, or create them again"
        ) from error


def folders_in(root: Path, names: Iterable[str]) -> Iterator[tuple[Path, list[Path]]]:
    """Each readable folder of these names below ``root``, and its sub-folders in alphabetical order.

    A folder reached by two names counts once (links, or a case-insensitive file system with scannet and ScanNet).
    """
    seen = set[tuple[int, int]]()
    for place in (root / name for name in names):
        try:
            identity = place.stat().st_dev, place.stat().st_ino
            children = sorted(child for child in place.iterdir() if child.is_dir())
        except OSError:
            continue
        if identity not in seen:
            seen.add(identity)
            yield place, children


@dataclass(frozen=True)
class SceneTree:
    """``places``: the folders with scenes; ``folders`` of each scene, first place first; ``made``: those that
    ``datasets make`` rendered."""

    root: Path
    places: tuple[Path, ...]
    folders: Mapping[str, tuple[Path, ...]]
    made: frozenset[str] = frozenset()


def find_scenes(
    root: Path, names: Iterable[str], is_scene: Callable[[Path], bool], first: Sequence[str] = ()
) -> SceneTree:
    """The scenes in folders of these names below ``root``, those of ``first`` before all others; may be empty."""
    folders: dict[str, tuple[Path, ...]] = {}
    places, made = [], set[str]()
    for place, children in folders_in(root, names):
        scenes = [child for child in children if is_scene(child)]
        if scenes:
            rooms = read_marker(place)
            places.append(place)
            made |= {scene.name for scene in scenes if scene.name in rooms}
        for scene in scenes:
            folders[scene.name] = (*folders.get(scene.name, ()), scene)
    order = dict.fromkeys([scene for scene in first if scene in folders] + sorted(folders))
    return SceneTree(root, tuple(places), {scene: folders[scene] for scene in order}, frozenset(made))


def keeps_last(method: Callable[[DatasetT, str], Answer]) -> Callable[[DatasetT, str], Answer]:
    """A per-scene method that caches its last answer, because each step asks for it again."""
    name = f"_last{method.__name__}"

    @wraps(method)
    def asked(self: DatasetT, scene: str) -> Answer:
        last: tuple[str, Answer] | None = self.__dict__.get(name)
        if last is None or last[0] != scene:
            last = self.__dict__[name] = scene, method(self, scene)
        return last[1]

    return asked


def faults_of(questions: Iterable[Callable[[], object]]) -> Iterator[str]:
    """The messages of the checks that fail, without repeats; missing ground truth is not a fault."""
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


def shortened(lines: Iterable[str], where: str) -> Iterator[str]:
    """The first lines on faults of one kind, and the number of further ones."""
    found = list(lines)
    yield from found[:MAX_LINES]
    if len(found) > MAX_LINES:
        yield f"{where}: {len(found) - MAX_LINES} more faults of this kind"


class FileDataset(ABC, Generic[OptionsT]):
    """A dataset that is read from files below a data root.

    ``reader_version`` is raised whenever the same files yield different frames or ground truth.
    ``places_of_scenes``: folders below the data root that may contain scenes, the usual first. ``how_to_get`` states,
    after "no scene in ROOT", where scenes are expected and come from. ``labels_of``: OpenLex3D's name of the dataset,
    if labelled. ``no_mesh``: why there is no annotated mesh.
    """

    name: str
    reader_version: int
    places_of_scenes: Sequence[str]
    how_to_get: str
    variants: tuple[str, ...] = ()
    labels_of: str | None = None
    no_mesh = ""
    Options: type[OptionsT]

    def __init__(self, root: Path, options: OptionsT | None = None) -> None:
        self.root = root
        self.options = options if options is not None else self.Options()
        self._warned_of: set[str] = set()

    def warn_once(self, scene: str, line: str | None) -> None:
        """Log a line on the scene, if any, only once."""
        if line and scene not in self._warned_of:
            self._warned_of.add(scene)
            logger.warning("%s", line)

    def is_scene(self, folder: Path) -> bool:
        """Whether a folder in one of the places is a scene; used by ``find_tree`` only."""
        raise AssertionError(f"{type(self).__name__} defines neither is_scene nor find_tree")

    def find_tree(self) -> SceneTree:
        """Locate the scenes; there may be none."""
        return find_scenes(self.root, self.places_of_scenes, self.is_scene)

    @cached_property
    def tree(self) -> SceneTree:
        """The location of the scenes; a ``ScenesMissing`` that states how to get data if there are none."""
        tree = self.find_tree()
        if not tree.folders:
            raise no_scene(self.name, self.root, self.how_to_get)
        return tree

    def scenes(self) -> Sequence[str]:
        return tuple(self.tree.folders)

    def places(self) -> Sequence[Path]:
        """Where scenes are, or where they are looked for first."""
        return self.find_tree().places or [self.root / name for name in self.places_of_scenes[:2]]

    def info(self, scene: str, stride: int) -> SceneInfo:
        return SceneInfo(self.name, scene, self.n_frames(scene, stride), stride, self.image_domain(scene))

    @abstractmethod
    def n_frames(self, scene: str, stride: int) -> int:
        """The number of frames that ``frames`` would return, from a cheap look."""

    def image_domain(self, scene: str) -> ImageDomain:
        return "rendered-rooms" if scene in self.tree.made else "camera"

    @abstractmethod
    def recording_files(self, scene: str) -> Sequence[Path]:
        """The files that the frames are read from."""

    @abstractmethod
    def recording_key(self, scene: str) -> str:
        """A key of the recording: poses, cameras, sizes of all files, the first and last images."""

    def small_files(self, scene: str) -> tuple[Path, ...]:
        """The files read besides the recording, if available."""
        return ()

    def files(self, scene: str) -> Sequence[Path]:
        return (*self.recording_files(scene), *self.small_files(scene))

    def digest(self, scene: str) -> str:
        """A key of ``recording_key`` and of the content of the other files; a changed image in the middle of the
        recording is not detected if its size is unchanged."""
        words = self.name, self.reader_version, scene, self.image_domain(scene), self.options.model_dump_json()
        total = hashlib.sha256(" ".join(str(word) for word in words).encode())
        with suppress(FramesMissing):  # enough to score predictions of other programs
            total.update(self.recording_key(scene).encode())
        with reading(self.where(scene)):
            for path in self.small_files(scene):
                total.update(f"{path.name} {digest_file(path)}\n".encode())
        return total.hexdigest()

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        self.folder(scene)
        if self.labels_of is not None and variant in openlex3d.EXTRA_GROUND_TRUTHS.values():
            labelled: GroundTruth = openlex3d.truth_below(self.root, self.labels_of, scene, variant)
            return labelled
        if variant not in self.variants:
            hint = suggest(variant, self.variants) or f"; {self.no_mesh}"
            raise GroundTruthMissing(f"{self.where(scene)}: no ground truth '{variant}'{hint}")
        return self.own_truth(scene, variant)

    def own_truth(self, scene: str, variant: str) -> GroundTruth:
        """The ground truth under one of ``variants``."""
        raise AssertionError(f"{type(self).__name__} has variants and no own_truth")

    def instance_mesh(self, scene: str) -> InstanceMesh:
        self.folder(scene)
        raise GroundTruthMissing(f"{self.where(scene)}: no annotated mesh; {self.no_mesh}")

    def where(self, scene: str) -> str:
        """Prefix of messages."""
        return f"{self.name}/{scene}"

    def folder(self, scene: str) -> Path:
        """The folder of a scene; a ``DataError`` if there is none."""
        if scene not in self.tree.folders:
            hint = suggest(scene, list(self.tree.folders), f"{self.tree.places[0]} has")
            raise DataError(f"{self.name}: no scene '{scene}'{hint}")
        return self.tree.folders[scene][0]


class RecordedDataset(FileDataset[OptionsT]):
    """A dataset whose frames have one size and are each read from one colour and one depth file."""

    @abstractmethod
    def recording(self, scene: str) -> Recording: ...

    def n_frames(self, scene: str, stride: int) -> int:
        return len(self.frames(scene, stride))

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        return RecordedFrames(self.recording(scene), stride)

    def recording_files(self, scene: str) -> Sequence[Path]:
        return (*self.recording(scene).files, *self.recording(scene).images())

    def recording_key(self, scene: str) -> str:
        return self.recording(scene).digest()

    def problems(self, scene: str) -> Iterator[str]:
        """What the recording lacks, one line per kind; frames are usable without it."""
        yield from self.recording(scene).missing


def sizes_and_ends(files: Sequence[Path], n_ends: int, digest: Callable[[Path], Any] = digest_file) -> str:
    """A key of the names and sizes of files, and the content of the first and last ``n_ends``."""
    lines = [f"{path.parent.name}/{path.name} {path.stat().st_size}" for path in files]
    ends = dict.fromkeys((*files[:n_ends], *files[-n_ends:]))
    return "\n".join([*lines, *(f"{path.name} {digest(path)}" for path in ends)])
