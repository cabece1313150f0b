"""What the frames of a generated scene show: instances per view, views per instance, motion between updates."""

from __future__ import annotations

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.procedural.dataset import GeneratedScenes
from su3d_bench.datasets.procedural.rendering.render import Renderer

WIDTH = 160  # of the images in which instances are counted
MIN_PIXEL_SHARE = 100 / (640 * 480)  # 100 pixels of a 640x480 image: an object that a detector can find


def view_statistics(dataset: GeneratedScenes, scene: str, stride: int) -> dict[str, float]:
    """Medians over the frames at a stride: visible instances, motion; and updates that show the median instance.

    Instances are all objects but walls, floors and other parts of the room itself.
    """
    built = dataset.built(scene)
    poses = built.trajectory[::stride]
    width = min(WIDTH, dataset.options.width)
    renderer = Renderer(built.unlit, width, round(width * dataset.options.height / dataset.options.width))
    pixels = np.arange(renderer.width * renderer.height)
    instances = [placed.id for placed in built.placed if built.mount[placed.id] != "room"]
    shown = (renderer.depth_and_instance(pose, pixels)[1] for pose in poses)
    counts = np.stack([np.bincount(ids, minlength=len(built.placed) + 1) for ids in shown])
    visible = counts[:, instances] >= MIN_PIXEL_SHARE * len(pixels)
    translation_m, rotation_deg = motion(poses)
    return {
        "frames": len(built.trajectory),
        "updates": len(poses),
        "instances": len(instances),
        "instances_never_visible": int((~visible.any(axis=0)).sum()),
        "instances_per_view": float(np.median(visible.sum(axis=1))),
        "updates_per_instance": float(np.median(visible.sum(axis=0))),
        "translation_cm": 100 * float(np.median(translation_m)),
        "rotation_deg": float(np.median(rotation_deg)),
    }


def motion(poses: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Metres and degrees (N - 1,) between consecutive poses (N, 4, 4); one zero each for a single pose."""
    poses = np.repeat(poses, 2, axis=0) if len(poses) == 1 else poses
    turn = np.einsum("nji,njk->nik", poses[:-1, :3, :3], poses[1:, :3, :3])
    cosine = (np.trace(turn, axis1=1, axis2=2) - 1) / 2
    translation = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return translation, np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
