"""Procedural homes: generated on demand from a name, rendered by ray casting, fully annotated; with a sensor track."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from su3d_bench.core.errors import DataError, nearest
from su3d_bench.core.types import Float64Array, Frame, LabelSet, UInt8Array
from su3d_bench.corruptions.sensors.colour import mean_luminance
from su3d_bench.corruptions.sensors.poses import shutter
from su3d_bench.datasets.homes.catalogue import HomeClass, catalogue, read_classes
from su3d_bench.datasets.homes.furnish import furnish
from su3d_bench.datasets.homes.plan import PERSON_M, HomePlan
from su3d_bench.datasets.homes.sensor import CameraContext, Materials, SensorSettings, drifted, metered, record
from su3d_bench.datasets.homes.walk import walk_home
from su3d_bench.datasets.procedural.dataset import (
    FRAMES_PER_SECOND,
    BuiltScene,
    GeneratedScenes,
    SceneOptions,
    generator,
)
from su3d_bench.datasets.procedural.rendering.light import lit_mesh
from su3d_bench.datasets.procedural.rendering.mesh import SceneMesh
from su3d_bench.datasets.procedural.rendering.render import Renderer
from su3d_bench.datasets.procedural.rendering.sampled import SampledRenderer

LIGHT_M, TRAINING_LIGHT_M = 0.1, 0.15  # between points at which light is computed; coarser where speed counts more
METERED_WIDTH = 80  # of the images from which the exposure follows: a mean needs no more
N_NAMED = 24  # homes for tuning, and as many for testing
SERIES = ("tuning", "test", "seed", "training")
DEFAULT_SCENES = tuple(f"{series}{k}" for series in ("test", "tuning") for k in range(N_NAMED))


class HomeOptions(SceneOptions):
    """Image size, length of the trajectory, density of the scan; who carries the camera.

    ``seed_offset``: other homes under the same names. ``carrier``: ``person``, ``robot``, or ``either``: a robot in
    every third home.
    """

    seed_offset: int = Field(default=0, ge=0)
    carrier: Literal["either", "person", "robot"] = "either"

    def of_trajectory(self) -> tuple[object, ...]:
        return self.n_frames, self.seed_offset, self.carrier


@cache
def label_set() -> LabelSet:
    """The classes of the homes."""
    rows = sorted(read_classes().items(), key=lambda item: item[1].id)
    return LabelSet("homes", tuple(row.id for _, row in rows), tuple(name for name, _ in rows))


def scene_name_parts(scene: str) -> tuple[str, int]:
    """Series and number of a scene name; raises ``DataError`` if it is not a scene."""
    match = re.fullmatch(rf"({'|'.join(SERIES)})(0|[1-9]\d{{0,5}})", scene)
    if match is None or (match[1] in SERIES[:2] and int(match[2]) >= N_NAMED):
        hint = nearest(scene, DEFAULT_SCENES) or ""
        named = " or ".join(f"{series}0 to {series}{N_NAMED - 1}" for series in SERIES[:2])
        raise DataError(f"homes: no scene '{scene}'; expected {named}, or a seed such as seed7{hint}")
    return match[1], int(match[2])


class BuiltHome(BuiltScene):
    """A furnished home."""

    def __init__(self, scene: str, options: HomeOptions, folder: Path | None) -> None:
        super().__init__(scene, options, folder)
        self.series, self.number = scene_name_parts(scene)
        # Of 1600 frames every eighth: between these the camera moves by centimetres.
        self.scan_stride = max(1, min(8, options.n_frames // 200))
        self.merged_m = 0.8 * options.mesh_spacing_m  # a grid of that spacing keeps its vertices, finer parts do not

    @property
    def classes(self) -> Mapping[str, HomeClass]:  # type: ignore[override]
        return catalogue().classes

    @cached_property
    def plan(self) -> HomePlan:
        return self.furnished()

    def furnished(self) -> HomePlan:
        """The furnished home of this name, drawn again at each call."""
        return furnish(self._random("home"), catalogue(), training=self.series == "training")

    def make_mesh(self) -> SceneMesh:
        plan = self.plan
        exposure = float(self._random("exposure").uniform(0.58, 0.72))
        spacing_m = TRAINING_LIGHT_M if self.series == "training" else LIGHT_M
        return lit_mesh(self.patches, plan.lights, plan.sun, plan.windows, exposure, spacing_m)

    def make_renderer(self, width: int, height: int, like: Renderer | None = None) -> Renderer:
        return SampledRenderer(self.mesh, width, height, like)

    def make_trajectory(self) -> Float64Array:
        return self.walk("walk", self.options.n_frames)

    def walk(self, name: str, n_frames: int) -> Float64Array:
        """The poses (n_frames, 4, 4) of a walk through the home; walks of other names differ in speed and views."""
        plan, cell_m = self.plan, 0.05
        free, origin = plan.free(cell_m, PERSON_M)  # where people fit; all of it is connected
        carrier = self.options.carrier
        if carrier == "either":
            carrier = "robot" if self.number % 3 == 2 else "person"
        return walk_home(
            self.unlit, free, cell_m, origin, plan.n_structure, n_frames,
            self._random(name), carrier,
        )  # fmt: skip

    def _random(self, what: str) -> np.random.Generator:
        return generator(what, "homes", self.scene, self.options.seed_offset)


class Homes(GeneratedScenes):
    """Furnished homes, generated from their names."""

    name = "homes"
    cached_as = "homes"
    headline_protocol = "homes-semantic"
    label_space = "homes"
    Options = HomeOptions
    version = 1
    options: HomeOptions
    sources = ("datasets/homes", "datasets/procedural", "numerics")
    default_scenes = DEFAULT_SCENES
    label_set = staticmethod(label_set)

    @staticmethod
    def model_sheet(names: Sequence[str]) -> tuple[UInt8Array, int, int]:
        """A picture of the models with these names or classes, by default all; the numbers of models and of classes."""
        from su3d_bench.datasets.homes.model_sheet import model_sheet

        return model_sheet(names)

    def check_name(self, scene: str) -> None:
        scene_name_parts(scene)

    def is_for_training(self, scene: str) -> bool:
        return scene_name_parts(scene)[0] == "training"

    def build(self, scene: str, folder: Path | None) -> BuiltHome:
        return BuiltHome(scene, self.options, folder)

    def frame(self, scene: str, index: int) -> Frame:
        image = self.render(scene, index)
        pose = self.trajectory(scene)[index]
        return Frame(index, index / FRAMES_PER_SECOND, image.rgb, image.depth_m, pose, self.intrinsics)


class HomesSensor(Homes):
    """The same homes as a hand-held RGB-D camera records them: noise, missing depth, blur, exposure, drifting poses.

    Ground truth is that of the clean homes.
    """

    name = "homes-sensor"
    settings = SensorSettings()

    def __init__(self, root: Path, options: HomeOptions | None = None) -> None:
        super().__init__(root, options)
        self._drifted: dict[str, Float64Array] = {}

    def poses(self, scene: str) -> Float64Array:
        found = self._drifted.get(scene)
        if found is None:
            found = drifted(self.trajectory(scene), self.settings, self._random("drift", scene))
            self._drifted = {scene: found}  # other threads may read another scene
        return found

    def frame(self, scene: str, index: int) -> Frame:
        built, poses, as_estimated = self.built(scene), self.trajectory(scene), self.poses(scene)
        small = built.coarser(METERED_WIDTH)
        context = CameraContext(
            self.intrinsics, poses[index], *shutter(poses, index, self.settings.exposure_s, FRAMES_PER_SECOND),
            tuple(mean_luminance(small.render(poses[k]).rgb) for k in metered(index, self.settings)),
            _materials(built.renderer, poses[index]),
        )  # fmt: skip
        rng = self._random("sensor", scene, index)
        rgb, depth_m = record(built.renderer.render(poses[index]), context, self.settings, rng)
        return Frame(index, index / FRAMES_PER_SECOND, rgb, depth_m, as_estimated[index], self.intrinsics)

    def _random(self, *words: object) -> np.random.Generator:
        return generator(self.name, self.options.seed_offset, *words)


def _materials(renderer: Renderer, pose: Float64Array) -> Materials:
    rows = renderer.material_rows(pose)
    # Red is nearest to the projector's 830 nm, where most dyes are bright.
    albedo = np.float32(0.5) * (rows[..., 1] + rows[..., 4])
    return Materials(albedo, rows[..., 8], clear=rows[..., 17], mirror=rows[..., 16])
