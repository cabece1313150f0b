"""Generated rooms, written as files in another dataset's layout; a scene appears when it is complete.

A scene is built in a temporary folder next to its destination, which is renamed at the end. ``rooms.json`` in the
folder of the scenes lists those that were generated here, each with the key of its inputs.
"""

from __future__ import annotations

import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.core.digests import digest_json
from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import make_folder, write_error, write_json, write_text
from su3d_bench.core.files.locks import publish, unfinished_folder
from su3d_bench.core.system.files import file_text
from su3d_bench.core.types import Frame
from su3d_bench.datasets.recordings.file_dataset import MARKER, read_marker

if TYPE_CHECKING:
    from su3d_bench.datasets.procedural.dataset import GeneratedScenes


@dataclass(frozen=True)
class SceneTarget:
    """A scene to generate, under the ``key`` of its inputs.

    ``folder`` is named after the scene. ``files``: what a complete scene has. ``apart``: files and folders with a
    destination outside ``folder``, each with its name while the scene is built.
    """

    scene: str
    key: str
    folder: Path
    files: tuple[Path, ...]
    apart: tuple[tuple[str, Path], ...] = ()

    @property
    def is_whole(self) -> bool:
        return all(path.exists() for path in self.files)


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
    def write_frames(
        self, frames: Iterator[Frame], dataset: GeneratedScenes, target: SceneTarget, folder: Path
    ) -> None:
        """Write the files of all frames into ``folder``."""

    @abstractmethod
    def write_truth(self, dataset: GeneratedScenes, target: SceneTarget, folder: Path) -> None:
        """Write all files except those of the frames into ``folder``."""


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
    return pending


def write_shared_text(path: Path, text: str, complaint: str) -> None:
    """Write a file shared by all scenes; a ``StoreError`` if it exists with other content."""
    if path.exists() and file_text(path, errors="replace") != text:
        raise StoreError(f"{path}: {complaint}, but all scenes of a folder share it; choose another folder with --out")
    write_text(path, text)


def write_scene(
    layout: Layout,
    dataset: GeneratedScenes,
    target: SceneTarget,
    report: Callable[[int], None] = lambda n_done: None,
) -> None:
    """Write a scene and move it to its destination, its folder last, so that only complete scenes appear."""

    def frames() -> Iterator[Frame]:
        for n_done, frame in enumerate(dataset.frames(target.scene, 1), 1):
            yield frame
            report(n_done)

    try:
        with unfinished_folder(target.folder) as folder:
            layout.write_frames(frames(), dataset, target, folder)
            layout.write_truth(dataset, target, folder)
            for name, place in target.apart:
                if place.is_dir():
                    shutil.rmtree(place)
                place.parent.mkdir(parents=True, exist_ok=True)
                os.replace(folder / name, place)
            if target.folder.exists():  # with files missing
                shutil.copytree(folder, target.folder, dirs_exist_ok=True)
            else:
                publish(folder, target.folder)
    except OSError as error:
        raise write_error(target.folder, error) from error
