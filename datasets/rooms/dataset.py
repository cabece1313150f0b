"""Nine built-in rooms, stored as they were generated once; rendered by ray casting, fully annotated."""

from __future__ import annotations

from functools import cache, cached_property
from pathlib import Path

import numpy as np
from pydantic import Field

from su3d_bench.core.errors import DataError, nearest
from su3d_bench.core.types import Float64Array, Frame, LabelSet
from su3d_bench.datasets.procedural.dataset import (
    FRAMES_PER_SECOND,
    BuiltScene,
    GeneratedScenes,
    SceneOptions,
    generator,
)
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh, build_mesh
from su3d_bench.datasets.procedural.rendering.render import LEVELS, add_noise
from su3d_bench.datasets.procedural.trajectory import walk
from su3d_bench.datasets.rooms.classes import CLASS_BY_NAME, CLASS_ID
from su3d_bench.datasets.rooms.frozen import FrozenRoom, read_room

DEFAULT_SCENES = ("living0", "bedroom0", "kitchen0", "office0", "bathroom0", "studio0", "living1", "office1")
SCENES = (*DEFAULT_SCENES, "bathroom7")
N_STRUCTURE = 6  # floor, ceiling and four walls have the ids 1..6
FORMER_OFFSET = 0  # of the seeds; a word in the names of the random streams


class RoomOptions(SceneOptions):
    """Image size, length of the trajectory, density of the scan, sensor noise (0 none, 1 mild, 2 strong)."""

    noise: int = Field(default=0, ge=0, lt=len(LEVELS))


@cache
def label_set() -> LabelSet:
    """The classes of the rooms, which are Replica's."""
    return LabelSet("replica", tuple(CLASS_ID.values()), tuple(CLASS_ID))


class BuiltRoom(BuiltScene):
    """A furnished room."""

    classes = CLASS_BY_NAME

    @cached_property
    def plan(self) -> FrozenRoom:
        return read_room(self.scene)

    def make_mesh(self) -> SceneMesh:
        return build_mesh(self.patches, self.plan.lights, float(self._random("exposure").uniform(0.58, 0.72)))

    def make_trajectory(self) -> Float64Array:
        plan = self.plan
        return walk(self.mesh, plan.boxes, plan.size, N_STRUCTURE, self.options.n_frames, self._random("walk"))

    def _random(self, what: str) -> np.random.Generator:
        return generator(what, self.scene, FORMER_OFFSET)


class Rooms(GeneratedScenes):
    """Nine furnished rooms."""

    name = cached_as = "rooms"
    headline_protocol = "rooms-semantic"  # the paper's mAcc and F-mIoU on Replica, whose classes the rooms have
    label_space = "replica"
    Options = RoomOptions
    version = 3
    options: RoomOptions
    sources = ("datasets/rooms", "datasets/procedural", "numerics")
    default_scenes = DEFAULT_SCENES
    label_set = staticmethod(label_set)

    def check_name(self, scene: str) -> None:
        if scene not in SCENES:
            hint = f"{nearest(scene, SCENES)}; the rooms are {', '.join(SCENES)}"
            raise DataError(f"rooms: no scene '{scene}'{hint}; homes are generated from any seed, such as homes/seed0")

    def build(self, scene: str, folder: Path | None) -> BuiltRoom:
        return BuiltRoom(scene, self.options, folder)

    def frame(self, scene: str, index: int) -> Frame:
        image = self.render(scene, index)
        rng = generator("noise", scene, FORMER_OFFSET, index)
        rgb, depth_m = add_noise(image.rgb, image.depth_m, self.options.noise, rng)
        return Frame(index, index / FRAMES_PER_SECOND, rgb, depth_m, self.trajectory(scene)[index], self.intrinsics)
