"""Built-in procedural rooms, frozen: generated on demand from a name, rendered by ray casting, fully annotated."""

from __future__ import annotations

import re
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
from su3d_bench.datasets.procedural.items import Placed
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh, build_mesh
from su3d_bench.datasets.procedural.rendering.render import LEVELS, add_noise
from su3d_bench.datasets.procedural.trajectory import walk
from su3d_bench.datasets.rooms.classes import CLASS_BY_NAME, CLASS_ID
from su3d_bench.datasets.rooms.plan import Plan
from su3d_bench.datasets.rooms.recipes import KINDS, furnish

DEFAULT_SCENES = ("living0", "bedroom0", "kitchen0", "office0", "bathroom0", "studio0", "living1", "office1")
TRAINING_FROM = 10_000  # numbers from here on are reserved for training; no benchmark uses them
N_STRUCTURE = 6  # floor, ceiling and four walls have the ids 1..6


class RoomOptions(SceneOptions):
    """Image size, length of the trajectory, density of the scan, sensor noise (0 none, 1 mild, 2 strong)."""

    noise: int = Field(default=0, ge=0, lt=len(LEVELS))


@cache
def label_set() -> LabelSet:
    """The classes of the rooms, which are Replica's."""
    return LabelSet("replica", tuple(CLASS_ID.values()), tuple(CLASS_ID))


def scene_name_parts(scene: str) -> tuple[str, int]:
    """Kind and number of a scene name; raises ``DataError`` if it is not a scene."""
    match = re.fullmatch(r"([a-z]+)(0|[1-9]\d{0,5})", scene)
    if match is None or match[1] not in KINDS:
        hint = nearest(scene, DEFAULT_SCENES) or f"; kinds: {', '.join(KINDS)}"
        raise DataError(f"rooms: no scene '{scene}'; a scene is a kind and a number such as office3{hint}")
    return match[1], int(match[2])


class BuiltRoom(BuiltScene):
    """A furnished room."""

    classes = CLASS_BY_NAME

    def __init__(self, scene: str, options: RoomOptions, folder: Path | None) -> None:
        super().__init__(scene, options, folder)
        self.kind = scene_name_parts(scene)[0]

    @cached_property
    def plan(self) -> Plan:
        return furnish(self.kind, self._random("room"))

    @property
    def placed(self) -> list[Placed]:
        return self.plan.placed

    @property
    def mount(self) -> dict[int, str]:
        return self.plan.mount

    def make_mesh(self) -> SceneMesh:
        return build_mesh(self.patches, self.plan.lights, float(self._random("exposure").uniform(0.58, 0.72)))

    def make_trajectory(self) -> Float64Array:
        plan = self.plan
        size = plan.width, plan.depth, plan.height
        return walk(
            self.mesh, list(plan.boxes.values()), size, N_STRUCTURE, self.options.n_frames, self._random("walk")
        )

    def _random(self, what: str) -> np.random.Generator:
        return generator(what, self.scene, self.options.seed_offset)


class Rooms(GeneratedScenes):
    """Furnished rooms, generated from their names."""

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
        scene_name_parts(scene)

    def is_for_training(self, scene: str) -> bool:
        return scene_name_parts(scene)[1] >= TRAINING_FROM

    def build(self, scene: str, folder: Path | None) -> BuiltRoom:
        return BuiltRoom(scene, self.options, folder)

    def frame(self, scene: str, index: int) -> Frame:
        image = self.render(scene, index)
        rng = generator("noise", scene, self.options.seed_offset, index)
        rgb, depth_m = add_noise(image.rgb, image.depth_m, self.options.noise, rng)
        return Frame(index, index / FRAMES_PER_SECOND, rgb, depth_m, self.trajectory(scene)[index], self.intrinsics)
