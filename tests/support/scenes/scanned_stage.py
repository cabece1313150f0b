"""A scanned dataset of one scene, small and made of nothing, for what writes scenes as files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.types import Frame
from su3d_bench.datasets.writing import Layout, finish_scene, plan_scenes, write_frames

CHAIR, WALL = 20, 93
WIDTH, HEIGHT, N_FRAMES = 16, 12, 5


@dataclass(frozen=True)
class Thing:
    id: int
    class_id: int
    class_name: str
    material: str
    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]


@dataclass(frozen=True)
class Surface:
    """A wall of two quads and a chair of one, which touch."""

    vertices: np.ndarray = field(
        default_factory=lambda: np.array([(x, y, 0.1) for y in (0, 1 / 3) for x in range(4)], np.float32)
    )
    normals: np.ndarray = field(default_factory=lambda: np.tile(np.array([0, 0, 1], np.float32), (8, 1)))
    colours: np.ndarray = field(default_factory=lambda: np.arange(24, dtype=np.uint8).reshape(8, 3))
    faces: np.ndarray = field(default_factory=lambda: np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6]], np.int32))
    object_id: np.ndarray = field(default_factory=lambda: np.array([1, 1, 4], np.int32))


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

    def scan(self, scene: str) -> Surface:
        return Surface()


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


def write_scene(
    layout: Layout,
    dataset: Any,  # rooms, or a stage in their place
    scene: str,
    out: Path,
    report: Callable[[int], None] = lambda n_done: None,
) -> None:
    """Write one scene whole; nothing is done where it is there already."""
    for target in plan_scenes(layout, dataset, [scene], out):
        write_frames(layout, dataset, target, range(len(dataset.frames(scene, 1))), report)
        layout.write_truth(dataset, target)
        finish_scene(layout, dataset, target)
