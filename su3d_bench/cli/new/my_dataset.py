"""A first dataset: two scenes of a painted chair and table before a wall. Read your own files in its place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pydantic

from su3d_bench import Frame, GroundTruth, InstanceMesh, LabelSet, SceneInfo

LABELS = LabelSet("replica", (20, 80, 93), ("chair", "table", "wall"))  # ids and names of Replica's classes
COLOURS = np.array([[180, 60, 40], [60, 90, 180], [200, 196, 188]], np.uint8)
THINGS_M = ((-0.3, 0.9), (0.3, 1.1))  # of chair and table: where their middle is in x, and how far they are
WALL_M = {"near": 1.8, "far": 2.4}
INTRINSICS = np.array([[200.0, 0, 159.5], [0, 200.0, 119.5], [0, 0, 1]])  # pixels; the principal point is a centre


class MyDataset:
    name = "my-dataset"
    label_space = "replica"  # whose class ids the truth uses
    variants = ("mesh-vertices",)  # the forms of ground truth it can give, the fullest first

    class Options(pydantic.BaseModel):
        model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

        n_frames: int = 80

    def __init__(self, root: Path, options: Options) -> None:
        self._folder, self._options = root / self.name, options  # root is $SU3D_DATA

    def scenes(self) -> Sequence[str]:
        return ("near", "far")

    def files(self, scene: str) -> Sequence[Path]:
        """What the scene is read from; none here, where it is painted."""
        return ()

    def digest(self, scene: str) -> str:
        """Equal only where frames and truth are equal: of files their digests, here what they are made from."""
        return f"{self.name} 1 {scene} {self._options.n_frames}"

    def info(self, scene: str, stride: int) -> SceneInfo:
        return SceneInfo(self.name, scene, len(range(0, self._options.n_frames, stride)), stride, "camera")

    def frames(self, scene: str, stride: int) -> Sequence[Frame]:
        """Every ``stride``-th frame. Read them when they are asked for, where there are many."""
        return [self._frame(scene, index) for index in range(0, self._options.n_frames, stride)]

    def ground_truth(self, scene: str, variant: str) -> GroundTruth:
        """Points (N, 3) m with class ids of ``LABELS`` and instance ids from 1; 0 is neither."""
        points, instance = self._surface(scene)
        return GroundTruth(points, np.array([0, *LABELS.ids], np.int32)[instance], instance, LABELS, variant, "painted")

    def instance_mesh(self, scene: str) -> InstanceMesh:
        """The annotated surface, for perfect masks: here a small triangle at each point."""
        points, instance = self._surface(scene)
        corners = points[:, None] + np.array([[0, 0, 0], [0.02, 0, 0], [0, 0, 0.02]], np.float32)
        triangles = np.arange(3 * len(points), dtype=np.int32).reshape(-1, 3)
        classes = {k + 1: class_id for k, class_id in enumerate(LABELS.ids)}
        return InstanceMesh(corners.reshape(-1, 3), triangles, instance, classes, LABELS)

    def _frame(self, scene: str, index: int) -> Frame:
        """Depth in metres along the optical axis, 0 where there is none. Cameras have x right, y down, z forward; the
        world has z up, and these look along its y.
        """
        camera_to_world = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        camera_to_world[0, 3] = 0.006 * index - 0.24
        x, y = np.meshgrid((np.arange(320) - 159.5) / 200.0, (np.arange(240) - 119.5) / 200.0)
        which, depth_m = np.full((240, 320), 2), np.full((240, 320), WALL_M[scene], np.float32)
        for k, (centre_m, far_m) in enumerate(THINGS_M):
            is_seen = np.maximum(np.abs(x * far_m + camera_to_world[0, 3] - centre_m), np.abs(y * far_m)) < 0.2
            which[is_seen], depth_m[is_seen] = k, far_m
        stripe = np.floor((x * depth_m + camera_to_world[0, 3]) * 10) % 2 * 20  # painted on everything, each 10 cm
        rgb = COLOURS[which] + stripe[..., None].astype(np.uint8)
        return Frame(index, index / 30, rgb, depth_m, camera_to_world, INTRINSICS)

    def _surface(self, scene: str) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) every centimetre of the two things and the wall, and whose each is (N,), from 1."""
        squares = [(centre_m, far_m, 0.2) for centre_m, far_m in THINGS_M] + [(0.0, WALL_M[scene], 2.2)]
        clouds = []
        for centre_m, far_m, half_m in squares:
            steps = np.arange(-half_m, half_m, 0.01)
            x, z = (grid.ravel() for grid in np.meshgrid(steps + centre_m, steps))
            clouds.append(np.stack([x, np.full(len(x), far_m), z], axis=1))
        instance = np.repeat([1, 2, 3], [len(cloud) for cloud in clouds])
        return np.concatenate(clouds).astype(np.float32), instance.astype(np.int32)
