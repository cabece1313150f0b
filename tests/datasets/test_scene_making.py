"""Scenes written as files: a kill at any time leaves no partial scene, and the next process finishes the work."""

from __future__ import annotations

import errno
import os
from collections import namedtuple
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from written_scenes import write_scene

from su3d_bench.core import registry
from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.core.types import Frame
from su3d_bench.datasets import writing
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.writing import plan_scenes

CHAIR, WALL = 20, 93
WIDTH, HEIGHT, N_FRAMES = 16, 12, 5


Thing = namedtuple("Thing", "id class_id class_name material box_min box_max")
# A wall of two quads and a chair of one, which touch.
SURFACE = SimpleNamespace(
    vertices=np.array([(x, y, 0.1) for y in (0, 1 / 3) for x in range(4)], np.float32),
    normals=np.tile(np.array([0, 0, 1], np.float32), (8, 1)),
    colours=np.arange(24, dtype=np.uint8).reshape(8, 3),
    faces=np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6]], np.int32),
    object_id=np.array([1, 1, 4], np.int32),
)


class Stage:
    """A dataset of one scene; it counts the frames that it renders and can die at one of them."""

    name = "stage"

    def __init__(self, *, dies_at: int | None = None, kind: str = "plain", width: int = WIDTH) -> None:
        self.dies_at, self.kind, self.width = dies_at, kind, width
        self.rendered: list[int] = []

    @property
    def intrinsics(self) -> np.ndarray:
        return np.array([[10.5, 0, 7.5], [0, 10.5, 5.5], [0, 0, 1]])

    def digest(self, scene: str) -> str:
        return f"{self.kind} {scene}"

    def objects(self, scene: str) -> Sequence[Thing]:
        return (
            Thing(1, WALL, "wall", "stone", (0, 0, 0.1), (2, 1 / 3, 0.1)),
            Thing(4, CHAIR, "chair", "wooden", (2, 0, 0.1), (3, 1 / 3, 0.1)),
        )

    def trajectory(self, scene: str) -> np.ndarray:
        poses = np.tile(np.eye(4), (N_FRAMES, 1, 1))
        poses[:, :3, 3] = np.random.default_rng(7).normal(size=(N_FRAMES, 3))
        return poses

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        return StageFrames(self, scene)

    def scan(self, scene: str) -> Any:
        return SURFACE


class StageFrames(Sequence[Frame]):
    def __init__(self, stage: Stage, scene: str) -> None:
        self.stage, self.poses = stage, stage.trajectory(scene)

    def __len__(self) -> int:
        return N_FRAMES

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]
        if index == self.stage.dies_at:
            raise KeyboardInterrupt
        self.stage.rendered.append(index)
        across = np.linspace(0, 1, self.stage.width)
        depth_m = np.tile(0.5 + 9 * across + index / 7, (HEIGHT, 1)).astype(np.float32)
        depth_m[0, 0], depth_m[0, 1] = 0.0, 10.5
        rgb = np.repeat((40 + 150 * np.tile(across, (HEIGHT, 1)))[..., None], 3, 2).astype(np.uint8)
        rgb[..., 2] = 10 * index
        return Frame(index, index / 30, rgb, depth_m, self.poses[index], self.stage.intrinsics)


def files_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


ROOM = "living0"
ADDRESS = {"replica": ROOM, "scannet": "scene9000_00"}
TRUTH = {"replica": "mesh-vertices", "scannet": "nyu40-vertices"}


def reader(name: str, root: Path) -> Any:
    dataset_class = registry.load("dataset", LAYOUTS[name].reader)
    return dataset_class(root, dataset_class.Options())


def scenes(name: str, root: Path) -> list[str]:
    """The scenes with frames that the dataset finds; empty if it reports none."""
    try:
        dataset = reader(name, root)
        return [scene for scene in dataset.scenes() if dataset.info(scene, 1).n_frames]
    except DataError as error:
        if ": no s" not in str(error):  # no scene, no scan
            raise
        return []


def check_is_whole(name: str, root: Path) -> None:
    dataset = reader(name, root)
    assert scenes(name, root) == [ADDRESS[name]]
    assert len([frame.depth_m for frame in dataset.frames(ADDRESS[name], 1)]) == N_FRAMES
    assert len(dataset.ground_truth(ADDRESS[name], TRUTH[name]).points) == 8


def content(root: Path) -> dict[str, bytes]:
    return {name: (root / name).read_bytes() for name in files_below(root)}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    folder = tmp_path_factory.mktemp("undisturbed")
    for name, layout in LAYOUTS.items():
        write_scene(layout, Stage(), ROOM, folder / name)
        check_is_whole(name, folder / name)
    return {name: content(folder / name) for name in LAYOUTS}


def dies_at(n: int, replace: Callable[..., None]) -> Callable[..., None]:
    """``os.replace`` for ``n`` calls, then the end."""
    left = [n]

    def dying(source: Path, target: Path) -> None:
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        replace(source, target)

    return dying


@pytest.mark.parametrize("name", LAYOUTS)
def test_kill_leaves_no_partial_scene_and_resuming_gives_the_same_bytes(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    for n in range(100):
        root = tmp_path / str(n)
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", dies_at(n, os.replace))
            try:
                write_scene(LAYOUTS[name], Stage(), ROOM, root)
                break
            except KeyboardInterrupt:
                pass
        if scenes(name, root):
            check_is_whole(name, root)
        write_scene(LAYOUTS[name], Stage(), ROOM, root)
        assert content(root) == undisturbed[name], n
        assert not list(root.rglob(".*")), n
    assert n > 3


@pytest.mark.parametrize("name", LAYOUTS)
def test_scene_of_a_killed_process_is_written_again(
    name: str, tmp_path: Path, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_scene(LAYOUTS[name], Stage(dies_at=3), ROOM, tmp_path)
    assert scenes(name, tmp_path) == []
    write_scene(LAYOUTS[name], Stage(), ROOM, tmp_path)
    assert content(tmp_path) == undisturbed[name]


@pytest.mark.parametrize("name", LAYOUTS)
def test_complete_scene_is_kept_and_lost_files_are_restored(
    name: str, tmp_path: Path, undisturbed: dict[str, dict[str, bytes]]
) -> None:
    layout = LAYOUTS[name]
    write_scene(layout, Stage(), ROOM, tmp_path)
    before = {path: (tmp_path / path).stat().st_mtime_ns for path in files_below(tmp_path)}
    write_scene(layout, Stage(dies_at=0), ROOM, tmp_path)
    assert {path: (tmp_path / path).stat().st_mtime_ns for path in files_below(tmp_path)} == before
    for path in (path for path in layout.target(ROOM, "", tmp_path).files if path.is_file()):
        path.unlink()
        write_scene(layout, Stage(), ROOM, tmp_path)
        assert content(tmp_path) == undisturbed[name]


@pytest.mark.parametrize("name", LAYOUTS)
def test_scene_from_elsewhere_is_never_overwritten(name: str, tmp_path: Path) -> None:
    layout = LAYOUTS[name]
    write_scene(layout, Stage(), ROOM, tmp_path)
    with pytest.raises(StoreError, match=ADDRESS[name]):
        write_scene(layout, Stage(kind="other"), ROOM, tmp_path)
    (layout.scenes_folder(tmp_path) / "rooms.json").unlink()
    with pytest.raises(StoreError, match=ADDRESS[name]):
        write_scene(layout, Stage(), ROOM, tmp_path)


def test_conflicting_shared_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "scannetv2-labels.combined.tsv").write_text("id\traw_category\n1\twall\n")
    with pytest.raises(StoreError, match=r"combined\.tsv: differs from the label table"):
        write_scene(LAYOUTS["scannet"], Stage(), ROOM, tmp_path)
    write_scene(LAYOUTS["replica"], Stage(), ROOM, tmp_path)
    with pytest.raises(StoreError, match=r"cam_params\.json: differs from the camera .*20x12"):
        write_scene(LAYOUTS["replica"], Stage(width=20), "living1", tmp_path)


@pytest.mark.parametrize("name", LAYOUTS)
def test_full_disk_is_one_line_and_leaves_nothing_partial(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    layout = LAYOUTS[name]
    stage: Any = Stage()
    (target,) = plan_scenes(layout, stage, [ROOM], tmp_path)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match="disk is full"):
        writing.write_scene(layout, stage, target)
    assert not list(tmp_path.rglob(".*")) and scenes(name, tmp_path) == []
