"""What a picture of a scene shows: some frames, where the cameras are, what they see in colour, and the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import DataError, FramesMissing, GroundTruthMissing
from su3d_bench.core.geometry import back_project, turn_to_z, valid_depth
from su3d_bench.core.interfaces import Dataset, SaysUp
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, GroundTruth, UInt8Array, WorldUp

CAMERAS = 48  # enough for the shape of a walk
SHOWN_FRAMES = 6
SEEN_POINTS = 250_000  # of all frames together: one each 2 cm on the surfaces of a room
PERCENTILES = (1, 99)  # of a frame's depth: a stray pixel is no range
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SceneLook:
    """A scene as a picture needs it.

    ``poses`` (n, 4, 4) camera-to-world of the cameras that were read, of ``n_frames`` in the scene; ``seen`` (m, 3) m
    in the world, z up, and ``seen_rgb`` (m, 3) what they see; ``shown`` are some of the frames; ``depth_m`` the least
    and the greatest depth; ``truth`` or the reason why there is none; ``up`` where the dataset's files may have any
    world: where it is only guessed, the world of the picture is turned and that of the frames is not.
    """

    scene: str
    n_frames: int
    poses: Float64Array
    seen: Float32Array
    seen_rgb: UInt8Array
    shown: tuple[Frame, ...]
    depth_m: tuple[float, float]
    truth: GroundTruth | None
    no_truth: str
    up: WorldUp | None = None

    @property
    def counts(self) -> dict[str, int]:
        """Points, objects and classes of the truth; nothing where there is none."""
        if self.truth is None:
            return {}
        n_objects, n_classes = (len(np.unique(ids[ids > 0])) for ids in (self.truth.instance, self.truth.semantic))
        return {"n_points": len(self.truth.points), "n_objects": n_objects, "n_classes": n_classes}


def look_at(
    dataset: Dataset, scene: str, stride: int | None = None, progress: Progress = lambda n_done, n: None
) -> SceneLook:
    """Read every ``stride``-th frame of ``scene`` (None: ``CAMERAS`` evenly spaced ones) and its fullest truth.

    A frame or a truth that is damaged is a ``DataError``; a truth that is not there is no fault, nor are frames.
    """
    try:
        frames = dataset.frames(scene, stride or 1)
        n_frames = dataset.info(scene, 1).n_frames
    except FramesMissing:
        return _without_frames(dataset, scene)
    if not len(frames):
        raise DataError(f"{dataset.name}/{scene}: has no frames to show")
    positions = range(len(frames)) if stride else evenly(len(frames), CAMERAS)
    is_shown = set(evenly(len(positions), SHOWN_FRAMES))
    poses, shown, points, colours, ranges = [], [], [], [], []
    for k, position in enumerate(positions):
        progress(k, len(positions))
        frame = frames[position]
        poses.append(frame.camera_to_world)
        if k in is_shown:
            shown.append(frame)
        pixels = chosen_pixels(frame, len(positions))
        points.append(back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels).astype(np.float32))
        colours.append(frame.rgb[pixels])
        depth = frame.depth_m[pixels]
        ranges += list(np.percentile(depth, PERCENTILES)) if len(depth) else []
    progress(len(positions), len(positions))
    truth, reason = _truth(dataset, scene)
    up = dataset.up(scene) if isinstance(dataset, SaysUp) else None
    turn = np.eye(3) if up is None or up.axis is None or up.is_turned else turn_to_z(up.axis)
    drawn = np.array(poses)
    drawn[:, :3] = turn @ drawn[:, :3]
    return SceneLook(
        scene=f"{dataset.name}/{scene}",
        n_frames=n_frames,
        poses=drawn,
        seen=(np.concatenate(points) @ turn.T).astype(np.float32),
        seen_rgb=np.concatenate(colours),
        shown=tuple(shown),
        depth_m=(float(min(ranges, default=0.0)), float(max(ranges, default=0.0))),
        truth=truth,
        no_truth=reason,
        up=up,
    )


def _without_frames(dataset: Dataset, scene: str) -> SceneLook:
    """A look at the truth alone; where there is none either, ``DataError``."""
    truth, reason = _truth(dataset, scene)
    if truth is None:
        raise DataError(reason)
    none = np.zeros((0, 3))
    return SceneLook(
        scene=f"{dataset.name}/{scene}",
        n_frames=0,
        poses=np.zeros((0, 4, 4)),
        seen=none.astype(np.float32),
        seen_rgb=none.astype(np.uint8),
        shown=(),
        depth_m=(0.0, 0.0),
        truth=truth,
        no_truth="",
    )


def evenly(n: int, most: int) -> Sequence[int]:
    """At most ``most`` of the numbers below ``n``, as far from one another as can be."""
    return sorted({int(place) for place in np.linspace(0, n - 1, min(n, most))})


def spread(n: int, most: int) -> list[int]:
    """The places of ``evenly``, so ordered that the first few lie far apart as well.

    >>> spread(9, 9)
    [0, 8, 4, 2, 6, 1, 3, 5, 7]
    """
    places = list(evenly(n, most))
    taken, step = dict.fromkeys((*places[:1], *places[-1:])), 1 << max(0, len(places) - 1).bit_length()
    while step := step // 2:
        taken |= dict.fromkeys(places[step::step])
    return list(taken)


def chosen_pixels(frame: Frame, n_frames: int, n_points: int = SEEN_POINTS) -> BoolArray:
    """Pixels (H, W) with a depth, spread over the image: about one frame's share of ``n_points``."""
    most = max(1, n_points // n_frames)
    is_valid = valid_depth(frame.depth_m, 0.0, np.inf)
    step = int(np.ceil(np.sqrt(max(1.0, is_valid.sum() / most))))
    chosen = np.zeros_like(is_valid)
    chosen[::step, ::step] = is_valid[::step, ::step]
    return chosen


def seen_points(frames: Sequence[Frame], n_points: int) -> tuple[Float32Array, UInt8Array]:
    """Points (n, 3) m in the world and their colours (n, 3): about ``n_points`` of what all ``frames`` see."""
    points, colours = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
    for frame in frames:
        pixels = chosen_pixels(frame, len(frames), n_points)
        points.append(back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, pixels).astype(np.float32))
        colours.append(frame.rgb[pixels])
    return np.concatenate(points), np.concatenate(colours)


def _truth(dataset: Dataset, scene: str) -> tuple[GroundTruth | None, str]:
    reason = ""
    for variant in getattr(dataset, "variants", ()):
        try:
            truth = dataset.ground_truth(scene, variant)
        except GroundTruthMissing as error:
            reason = reason or str(error)
            continue
        if len(truth.points):
            return truth, ""
    return None, reason or f"{dataset.name} has no ground truth"
