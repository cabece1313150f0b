"""Generated rooms, written as files in another dataset's layout: atomic, and resumable after a kill.

A scene is built in a hidden folder next to its destination and moved there when complete; a killed process leaves
frames that the next one reuses, and no incomplete scene. ``rooms.json`` in the folder of the scenes lists those
that were generated here, each with the key of its inputs.
"""

from __future__ import annotations

import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.core.digests import digest_json
from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import make_folder, write_bytes, write_json, write_text
from su3d_bench.core.files.locks import clear_unfinished
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import Frame
from su3d_bench.datasets.recordings.file_dataset import MARKER, read_marker

if TYPE_CHECKING:
    from su3d_bench.datasets.procedural.dataset import GeneratedScenes


@dataclass(frozen=True)
class SceneTarget:
    """A scene to generate, under the ``key`` of its inputs.

    ``folder`` is named after the scene. ``frames`` is the path in it that contains the frames; if that
    is a single file, it is written atomically. ``truth``: other files required for completeness. ``apart``:
    files and folders with a destination outside ``folder``, each with its name while the scene is built.
    """

    scene: str
    key: str
    folder: Path
    frames: str
    truth: tuple[Path, ...] = ()
    apart: tuple[tuple[str, Path], ...] = ()

    @property
    def partial(self) -> Path:
        """Where the scene is built; named by the key, so that frames from other inputs are never reused."""
        return self.folder.with_name(f".{self.folder.name}.{self.key[:12]}.partial")

    @property
    def has_frames(self) -> bool:
        return (self.folder / self.frames).exists() or (self.partial / self.frames).is_file()

    @property
    def is_whole(self) -> bool:
        return all(path.exists() for path in (self.folder / self.frames, *self.truth))


class Layout(ABC):
    """How the scenes of one dataset are named, and how their frames and ground truth are written.

    ``name`` is the value of ``--layout``, ``reader`` the dataset that reads it. ``settings`` affect the bytes written
    for a scene; the layout's version comes first.
    """

    name: str
    reader: str
    settings: Sequence[Any]

    @abstractmethod
    def scenes_folder(self, out: Path) -> Path: ...

    def scene_name(self, scene: str) -> str:
        """The scene's name in the layout; a ``DataError`` if it has none."""
        return scene

    @abstractmethod
    def target(self, scene: str, key: str, out: Path) -> SceneTarget: ...

    @abstractmethod
    def write_shared(self, dataset: GeneratedScenes, scene: str, out: Path) -> None:
        """Write the files shared by all scenes; a ``StoreError`` if they exist with other content."""

    @abstractmethod
    def frame_names(self, index: int) -> Sequence[str]:
        """The files of a frame, relative to the folder in which the scene is built."""

    @abstractmethod
    def frame_files(self, frame: Frame) -> Sequence[bytes]:
        """The content of each of ``frame_names``."""

    @abstractmethod
    def write_truth(self, dataset: GeneratedScenes, target: SceneTarget) -> None:
        """Write all files except those of the frames into ``target.partial``."""

    def join(self, dataset: GeneratedScenes, target: SceneTarget) -> None:  # noqa: B027 - most have one file per frame
        """Create in ``target.partial`` the file for all frames; called after everything else is written."""


def plan_scenes(layout: Layout, dataset: GeneratedScenes, scenes: Sequence[str], out: Path) -> list[SceneTarget]:
    """The incomplete scenes below ``out``, which is prepared for them; one caller at a time.

    Raises ``StoreError`` if ``out`` is not writable or contains one of the scenes, or a shared file, from
    another source.
    """
    folder = layout.scenes_folder(out)
    make_folder(folder)
    targets = [layout.target(scene, digest_json([dataset.digest(scene), *layout.settings]), out) for scene in scenes]
    marked = read_marker(folder)
    for target in targets:
        if target.folder.exists() and marked.get(target.folder.name) != target.key:
            raise StoreError(
                f"{target.folder}: is another '{target.folder.name}', created elsewhere or with other options; delete "
                "it or choose another folder with --out"
            )
        strange = next(
            (place for _, place in target.apart if place.exists() and target.folder.name not in marked), None
        )
        if strange is not None:
            raise StoreError(f"{strange}: exists already and was created elsewhere; choose another folder with --out")
    pending = [target for target in targets if not target.is_whole]
    if not pending:
        return []
    layout.write_shared(dataset, pending[0].scene, out)
    marked = marked | {target.folder.name: target.key for target in targets}
    marker = {"generator": f"su3d-bench {dataset.name}", "version": layout.settings[0]}
    write_json(folder / MARKER, marker | {"scenes": dict(sorted(marked.items()))})
    for target in pending:
        for folder in (target.partial, *(path for path in target.partial.rglob("*") if path.is_dir())):
            clear_unfinished(folder)
    return pending


def write_shared_text(path: Path, text: str, complaint: str) -> None:
    """Write a file shared by all scenes; a ``StoreError`` if it exists with other content."""
    if path.exists() and file_text(path, errors="replace") != text:
        raise StoreError(f"{path}: {complaint}, but all scenes of a folder share it; choose another folder with --out")
    write_text(path, text)


def write_frames(
    layout: Layout,
    dataset: GeneratedScenes,
    target: SceneTarget,
    indices: range,
    report: Callable[[int], None] = lambda n_done: None,
) -> None:
    """The files of the frames at ``indices``; those written by an earlier process are kept."""
    if target.has_frames:
        return
    for folder in {(target.partial / name).parent: None for name in layout.frame_names(0)}:
        make_folder(folder)
    frames = dataset.frames(target.scene, 1)
    for n_done, index in enumerate(indices, 1):
        paths = [target.partial / name for name in layout.frame_names(index)]
        if not all(path.exists() for path in paths):
            for path, content in zip(paths, layout.frame_files(frames[index]), strict=True):
                write_bytes(path, content)
        report(n_done)


def finish_scene(layout: Layout, dataset: GeneratedScenes, target: SceneTarget) -> None:
    """Move everything to its destination, the scene's folder last, so that only complete scenes appear."""
    try:
        layout.join(dataset, target)
        for name, place in target.apart:
            if place.is_dir():
                shutil.rmtree(place)
            place.parent.mkdir(parents=True, exist_ok=True)
            os.replace(target.partial / name, place)
        if target.folder.exists():
            _add_files(target.partial, target.folder)
        else:
            os.replace(target.partial, target.folder)
        for leftover in target.folder.parent.glob(f".{target.folder.name}.*.partial"):
            shutil.rmtree(leftover)
    except OSError as error:
        raise StoreError(f"cannot write {target.folder}: {error.strerror or error}") from error


def _add_files(source: Path, folder: Path) -> None:
    """Move every file below ``source`` to the same place below ``folder``."""
    for path in sorted(path for path in source.rglob("*") if path.is_file()):
        place = folder / path.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, place)
