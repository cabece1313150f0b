"""A tiny dataset, method and perception for tests of the runner.

Each object of a scene has its own colour, perception finds regions by colour, the method collects their
points.
"""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.geometry import back_project
from su3d_bench.core.interfaces import StageTimer
from su3d_bench.core.maps import Instances, Prediction
from su3d_bench.core.types import (
    Detections,
    Float32Array,
    Frame,
    GroundTruth,
    InstanceMesh,
    LabelSet,
    PerceptionNeeds,
    SceneInfo,
    UInt8Array,
)

HEIGHT, WIDTH = 24, 32
INTRINSICS = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
LABELS = LabelSet("replica", (20, 76, 80, 93), ("chair", "sofa", "table", "wall"))
COLOURS = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [120, 120, 120]], np.uint8)


class Painted:
    """Four scenes of three painted boxes in front of a wall, seen by a camera that moves sideways.

    ``painted_as``: the scene whose objects another name shows.
    """

    name = "painted"
    painted_as: ClassVar[dict[str, str]] = {scene: scene for scene in "abcd"}
    label_space = "replica"
    variants: ClassVar[tuple[str, ...]] = ("mesh-vertices",)
    image_domain = "rendered-rooms"

    class Options(BaseModel):
        """``fault`` applies to ``fault_scene``; ``frame_ms`` makes frames slow."""

        model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

        n_frames: int = 6
        frame_ms: float = 0.0
        fault: str = ""
        fault_scene: str = "b"

    def __init__(self, root: Path, options: Options) -> None:
        self.options = options

    def scenes(self) -> Sequence[str]:
        return tuple(self.painted_as)

    def files(self, scene: str) -> Sequence[Path]:
        return ()

    def digest(self, scene: str) -> str:
        return hashlib.sha256(f"painted {self.painted_as[scene]} {self.options.n_frames}".encode()).hexdigest()

    def info(self, scene: str, stride: int) -> SceneInfo:
        if scene not in self.scenes():
            raise DataError(f"painted/{scene}: no such scene")
        return SceneInfo(self.name, scene, -(-self.options.n_frames // stride), stride, "rendered-rooms")

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        return _Frames(self, self.painted_as[scene], range(0, self.options.n_frames, stride))

    def frame(self, scene: str, index: int) -> Frame:
        fault = self.options.fault if scene == self.options.fault_scene and index == 2 else ""
        time.sleep(self.options.frame_ms / 1e3)
        pose = np.eye(4)
        pose[0, 3] = 0.05 * index
        objects, depth_m = _painting(scene, index)
        if fault == "missing-frame":
            raise DataError(f"painted/{scene}: frame 2 is missing; copy it again")
        if fault == "nan-pose":
            pose[0, 0] = np.nan
        if fault == "crash":
            raise ZeroDivisionError("a mistake in a plug-in")
        if fault == "memory":
            np.zeros(1 << 56)
        if fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        return Frame(index, index / 30, COLOURS[objects], depth_m, pose, INTRINSICS)

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        fault = self.options.fault if scene == self.options.fault_scene else ""
        if fault == "no-truth":
            raise GroundTruthMissing(f"painted/{scene}: has no ground truth")
        if fault == "unknown-class":
            raise DataError(f"painted/{scene}: class id 777 is unknown; the label set ends at 101")
        points, instance = _surface(self.painted_as[scene], self.options.n_frames)
        semantic = np.array(LABELS.ids, np.int32)[instance - 1]
        return GroundTruth(points, semantic, instance, LABELS, variant, "painted")

    def instance_mesh(self, scene: str) -> InstanceMesh:
        points, instance = _surface(self.painted_as[scene], self.options.n_frames)
        corners = points[:, None] + np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]], np.float32)
        triangles = np.arange(3 * len(points), dtype=np.int32).reshape(-1, 3)
        classes = {k + 1: class_id for k, class_id in enumerate(LABELS.ids)}
        return InstanceMesh(corners.reshape(-1, 3), triangles, instance, classes, LABELS)


class _Frames(Sequence[Frame]):
    def __init__(self, dataset: Painted, scene: str, indices: range) -> None:
        self._dataset, self._scene, self._indices = dataset, scene, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, k: Any) -> Any:
        return self._dataset.frame(self._scene, self._indices[k])


def _painting(scene: str, index: int) -> tuple[Any, Float32Array]:
    """Object (row of COLOURS) and depth of each pixel."""
    objects = np.full((HEIGHT, WIDTH), 3)
    depth_m = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    shift = "abcd".index(scene)
    for k in range(3):
        rows, columns = slice(4 + 2 * k + shift, 14 + 2 * k), slice(2 + 10 * k - index // 3, 9 + 10 * k)
        objects[rows, columns] = k
        depth_m[rows, columns] = 1.5 + 0.3 * k
    return objects, depth_m


@cache
def _surface(scene: str, n_frames: int) -> tuple[Float32Array, Any]:
    points, instance = [], []
    for index in range(n_frames):
        objects, depth_m = _painting(scene, index)
        pose = np.eye(4)
        pose[0, 3] = 0.05 * index
        points.append(back_project(depth_m, INTRINSICS, pose, np.ones((HEIGHT, WIDTH), bool)))
        instance.append(objects.reshape(-1) + 1)
    surface = np.concatenate(points).astype(np.float32), np.concatenate(instance).astype(np.int32)
    for array in surface:
        array.flags.writeable = False
    return surface


class Collector:
    """Collects the points of each colour; one instance per colour."""

    name = "collector"

    class Config(BaseModel):
        model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

        stride: int = 1
        drop: int = 0
        noise_m: float = 0.0

    def __init__(self, config: Config) -> None:
        self.config = config
        self._points: dict[str, list[Any]] = {}
        self._views: dict[str, list[tuple[int, int]]] = {}
        self._features: dict[str, Float32Array] = {}

    @property
    def needs(self) -> PerceptionNeeds:
        return PerceptionNeeds(masks="grounded")

    @property
    def n_points(self) -> int:
        return sum(len(part) for parts in self._points.values() for part in parts)

    @property
    def n_instances(self) -> int:
        return len(self._points)

    def start(self, scene: SceneInfo) -> None:
        self._rng = np.random.default_rng(scene.seed)

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        with timer.stage("collect"):
            for k, name in enumerate(detections.names[self.config.drop :], start=self.config.drop):
                pixels = detections.masks[k]
                points = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels)
                points += self.config.noise_m * self._rng.standard_normal(points.shape)
                self._points.setdefault(name, []).append(points)
                self._views.setdefault(name, []).append((frame.index, k))
                self._features[name] = detections.crop_features[k, 0]

    def finish(self) -> Prediction:
        names = sorted(self._points)
        clouds = [np.concatenate(self._points[name]).astype(np.float32) for name in names]
        owners = np.repeat(np.arange(len(names)), [len(cloud) for cloud in clouds])
        return Instances.of(
            np.concatenate([np.zeros((0, 3), np.float32), *clouds]),
            owners,
            features=np.array([self._features[name] for name in names], np.float32).reshape(len(names), 8),
            names=names,
            captions=names,
            views=[self._views[name] for name in names],
            ids=np.arange(1, len(names) + 1, dtype=np.int32),
        )


class Twins(Painted):
    """Scenes whose names differ in one character not allowed in folder names, all painted differently."""

    name = "twins"
    painted_as: ClassVar[dict[str, str]] = {"a/b": "a", "a_b": "b", "a%2Fb": "c"}


class Noisy(Painted):
    """Scenes whose depth has 2 cm of noise and holes, black in the image: the left half of the first frames, and single
    pixels. Scene b has half as many frames."""

    name = "noisy"

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        return _Frames(self, scene, range(0, self.options.n_frames // (2 if scene == "b" else 1), stride))

    def frame(self, scene: str, index: int) -> Frame:
        frame, rng = super().frame(scene, index), np.random.default_rng(index)
        noisy = frame.depth_m + 0.02 * rng.standard_normal(frame.depth_m.shape)
        has_depth = rng.random(frame.depth_m.shape) > 0.1
        has_depth[:, : WIDTH // 2 if index < 2 else 0] = False
        depth_m = np.where(has_depth, noisy, 0).astype(np.float32)
        return replace(frame, depth_m=depth_m, rgb=np.where(has_depth[..., None], frame.rgb, 0).astype(np.uint8))


class Renamer(Collector):
    """Declares that ids persist, but changes them all after four updates."""

    name = "renamer"
    keeps_ids = True

    def __init__(self, config: Collector.Config) -> None:
        super().__init__(config)
        self._n_updates = 0

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        super().update(frame, detections, timer)
        self._n_updates += 1

    def finish(self) -> Instances:
        found = super().finish()
        assert isinstance(found, Instances)
        return replace(found, ids=np.arange(len(found), dtype=np.int64) + (1000 if self._n_updates > 4 else 0))


class SlashCollector(Collector):
    """A method whose name is a path to another folder."""

    name = "../elsewhere"


class WordEncoder:
    """Maps texts to pseudo-random features by their last word; images to the feature of their colour's class."""

    name = "words"
    digest = "words-1"
    dim = 8

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        nearest = [int(np.abs(COLOURS.astype(int) - image.mean((0, 1))).sum(1).argmin()) for image in images]
        return self.encode_texts([LABELS.names[k] for k in nearest])

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        seeds = [next((name for name in LABELS.names if name in text), text) for text in texts]
        rows = [np.random.default_rng(list(seed.encode())).normal(size=8) for seed in seeds]
        features = np.array(rows, np.float32).reshape(-1, 8)
        return np.asarray(features / np.linalg.norm(features, axis=1, keepdims=True), np.float32)


class ColourPerception:
    """Regions of one colour, named after the colour's class."""

    profile = "embedded"
    caveat: str | None = None
    digest = "colours-1"

    def __init__(self) -> None:
        self.encoder = WordEncoder()

    def detect(self, frame: Frame, needs: PerceptionNeeds, timer: StageTimer) -> Detections:
        with timer.stage("segment"):
            found = [k for k in range(4) if (frame.rgb == COLOURS[k]).all(-1).any()]
            masks = np.array([(frame.rgb == COLOURS[k]).all(-1) for k in found])
        names = tuple(LABELS.names[k] for k in found)
        features, ones = self.encoder.encode_texts(names), np.ones(len(found), np.float32)
        boxes = np.tile(np.array([0, 0, WIDTH, HEIGHT], np.float32), (len(found), 1))
        return Detections(
            frame.index, masks, boxes, ones, names, names, (1.0,), features[:, None], features[0]
        )  # fmt: skip


def colour_perception(*_: Any, **__: Any) -> ColourPerception:
    """Stands in for ``build_perception``."""
    return ColourPerception()
