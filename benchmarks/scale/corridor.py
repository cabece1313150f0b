r"""An endless corridor as a dataset: the map grows with every frame, for measuring update cost against map size.

    su3d-bench run --scenes benchmarks/scale/corridor.py:Corridor/400m --profile oracle --stride 1 --methods all \
        --out runs/corridor
    su3d-bench report timing runs/corridor --out build/corridor

A corridor of 2.4 x 2.6 m with objects along both walls, traversed at 2 m per frame; at a voxel of 0.02 m, a metre has
about 28,000 points. Its scan has about 5,000 vertices per metre: a method based on the scan has all of them from the
first frame, so it is run on corridors of several lengths, using the first frames (``--limit``).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import (
    Float32Array,
    Float64Array,
    Frame,
    GroundTruth,
    InstanceMesh,
    Int32Array,
    LabelSet,
    SceneInfo,
    Surface,
)

WIDTH_M, HEIGHT_M = 2.4, 2.6
MAX_LENGTH_M = 100_000
LABELS = LabelSet("corridor", (1, 2, 3, 4, 5, 6), ("wall", "floor", "cabinet", "chair", "table", "lamp"))
THINGS = (3, 4, 5, 6)
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]], np.int32)
ENDS = np.array([[0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], np.int32)


class Corridor:
    """Scenes ``<length>m``, such as ``400m``."""

    name = "corridor"
    label_space = "corridor"
    renders_frames = True
    variants: ClassVar[tuple[str, ...]] = ()

    class Options(BaseModel):
        """The camera's image size in pixels; the step per frame and the longest side of a scan cell, in m."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        width: int = Field(default=640, ge=16, le=4096)
        height: int = Field(default=480, ge=16, le=4096)
        step_m: float = Field(default=2.0, gt=0.01)
        surface_edge_m: float = Field(default=0.055, gt=0.001)

    def __init__(self, data_root: Path, options: Options) -> None:
        self._options = options

    def scenes(self) -> Sequence[str]:
        return ("400m",)

    def files(self, scene: str) -> Sequence[Path]:
        return ()

    def digest(self, scene: str) -> str:
        return hashlib.sha256(f"{scene}{self._options.model_dump_json()}".encode()).hexdigest()

    def info(self, scene: str, stride: int) -> SceneInfo:
        return SceneInfo("corridor", scene, len(self.frames(scene, stride)), stride, "rendered-rooms")

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        return Walk(_length_m(scene), self._options, stride)

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        raise GroundTruthMissing(f"corridor/{scene}: for timing only, cannot be scored")

    def instance_mesh(self, scene: str) -> InstanceMesh:
        return corridor_mesh(_length_m(scene))

    def surface(self, scene: str) -> Surface:
        """The scan: the ray-cast surface in cells; no edge connects faces of a box."""
        mesh = self.instance_mesh(scene)
        corners = mesh.vertices[mesh.triangles.reshape(-1, 2, 3)[:, 0]]  # a face is the triangles abc and acd
        return in_squares(corners, self._options.surface_edge_m)


def _length_m(scene: str) -> int:
    found = re.fullmatch(r"([1-9][0-9]{0,5})m", scene)
    if found is None or int(found[1]) > MAX_LENGTH_M:
        raise DataError(f"corridor/{scene}: is not a length such as 400m")
    return int(found[1])


def _box(low: Sequence[float], high: Sequence[float]) -> Float64Array:
    return np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])


def corridor_mesh(length_m: int) -> InstanceMesh:
    """The four surfaces and, on every metre of either side, an object of random size and class."""
    generator = np.random.default_rng(length_m)
    boxes = [_box((-2.0, -WIDTH_M / 2, 0.0), (length_m + 12.0, WIDTH_M / 2, HEIGHT_M))]
    classes = [1]
    for x in range(length_m + 10):
        for side in (-1, 1):
            depth, width, height = generator.uniform((0.15, 0.3, 0.3), (0.5, 0.8, 1.8))
            y = side * (WIDTH_M / 2 - 0.01)
            low, high = min(y, y - side * depth), max(y, y - side * depth)
            boxes.append(_box((x + 0.1, low, 0.01), (x + 0.1 + width, high, height)))
            classes.append(int(generator.choice(THINGS)))
    faces = [FACES] + [np.concatenate([FACES, ENDS])] * (len(boxes) - 1)
    offsets = 8 * np.arange(len(boxes))
    owner = np.repeat(np.arange(1, len(boxes) + 1, dtype=np.int32), [len(each) for each in faces])
    owner[:2] = len(boxes) + 1  # the first two triangles of the shell are its floor
    triangles = np.concatenate([each + offset for each, offset in zip(faces, offsets, strict=True)])
    return InstanceMesh(
        vertices=np.concatenate(boxes).astype(np.float32),
        triangles=triangles.astype(np.int32),
        instance_of_triangle=owner,
        class_of_instance={**{k + 1: each for k, each in enumerate(classes)}, len(boxes) + 1: 2},
        labels=LABELS,
    )


def in_squares(corners: Float32Array, edge_m: float) -> Surface:
    """Rectangles as grids whose cells are at most ``edge_m`` long and wide."""
    vertices, triangles, n = [], [], 0
    for a, b, c in corners.astype(np.float64):
        n_along, n_across = (max(1, int(np.ceil(np.linalg.norm(side) / edge_m))) for side in (b - a, c - b))
        along, across = np.linspace(0, 1, n_along + 1), np.linspace(0, 1, n_across + 1)
        grid = a + along[:, None, None] * (b - a) + across[None, :, None] * (c - b)
        row = n + np.arange(grid[..., 0].size, dtype=np.int32).reshape(grid.shape[:2])
        first, second = row[:-1, :-1], row[1:, :-1]
        third, fourth = row[1:, 1:], row[:-1, 1:]
        triangles.append(np.stack([first, second, third, first, third, fourth], axis=-1).reshape(-1, 3))
        vertices.append(grid.reshape(-1, 3))
        n += row.size
    return Surface(np.concatenate(vertices).astype(np.float32), np.concatenate(triangles).astype(np.int32))


class Walk(Sequence[Frame]):
    """The frames of a trajectory along the corridor, ray cast on access."""

    def __init__(self, length_m: int, options: Corridor.Options, stride: int) -> None:
        self._length_m = length_m
        self._options = options
        self._stride = stride

    def __len__(self) -> int:
        return -(-int(self._length_m / self._options.step_m) // self._stride)

    @cached_property
    def _mesh(self) -> InstanceMesh:
        return corridor_mesh(self._length_m)

    @cached_property
    def _scene(self) -> Any:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            o3d.core.Tensor(self._mesh.vertices), o3d.core.Tensor(self._mesh.triangles.astype(np.uint32))
        )
        return scene

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        number = range(len(self))[index] * self._stride
        depth_m, owner, points = self._cast(number)
        return Frame(number, number / 30.0, _paint(owner, points), depth_m, self._pose(number), self._intrinsics)

    @property
    def _intrinsics(self) -> Float64Array:
        width, height = self._options.width, self._options.height
        focal = 0.6 * width
        return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])

    def _pose(self, number: int) -> Float64Array:
        """The camera looks along x: its z is the world's x, its x the world's -y, its y the world's -z."""
        pose = np.eye(4)
        pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        pose[:3, 3] = number * self._options.step_m, 0.0, 1.5
        return pose

    def _cast(self, number: int) -> tuple[Float32Array, Int32Array, Float32Array]:
        import open3d as o3d

        width, height = self._options.width, self._options.height
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        pose = self._pose(number)
        directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self._intrinsics).T @ pose[:3, :3].T
        rays = np.concatenate([np.broadcast_to(pose[:3, 3], directions.shape), directions], axis=-1).astype(np.float32)
        answer = self._scene.cast_rays(o3d.core.Tensor(np.ascontiguousarray(rays)), nthreads=1)
        depth_m = answer["t_hit"].numpy()
        triangle = np.where(np.isfinite(depth_m), answer["primitive_ids"].numpy(), 0).astype(np.int64)
        depth_m = np.where(depth_m < 10.0, depth_m, 0.0).astype(np.float32)
        return depth_m, self._mesh.instance_of_triangle[triangle], rays[..., :3] + depth_m[..., None] * rays[..., 3:]


def _paint(owner: Int32Array, points: Float32Array) -> Any:
    """One colour per instance, in squares of 0.1 m that distinguish places."""
    hues = (owner[..., None].astype(np.int64) * np.array([7919, 104729, 1299709])) % 160 + 60
    squares = np.floor(points / 0.1).astype(np.int64).sum(axis=-1) % 2
    return (hues - 25 * squares[..., None]).astype(np.uint8)
