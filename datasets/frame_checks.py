"""Checks of a scene's frames and of their alignment with its ground truth, as findings.

The checks know no dataset: they use the measurements of each frame, and the points of the ground truth.
"""

from __future__ import annotations

import itertools
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from su3d_bench.core.geometry import RIGID_TOLERANCE
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, ObjectBoxes

Severity = Literal["error", "warning", "note"]
DEPTH_STEP = 4  # statistics use every 4th row and column
SEEN_POINTS = 300  # points kept per frame, to compare with the ground truth
PLAUSIBLE_MEDIAN_DEPTH_M = (0.2, 20.0)  # indoors; depth sensors begin at about 0.2 m
PLAUSIBLE_FAR_DEPTH_M = 20.0  # 99th percentile; rooms are smaller, except halls
LITTLE_DEPTH, LITTLE_DEPTH_OF_SCENE = 0.05, 0.3  # shares of pixels with a depth, of a frame and of a scene
BLACK_BELOW = 8  # of 255; sensor noise under a covered lens stays below
PLAUSIBLE_WALK_M = 100.0
CAMERA_SLACK_M = 1.0  # scans end below the ceiling, and the operator may stand in a doorway
CAMERAS_OUTSIDE = (0.05, 0.5)  # shares at which to warn and to fail
MEETING_DISTANCE_M = 0.05
# Shares of seen points near the ground truth. A correct scene has at least 0.8 (ground truth may lack windows and what
# is behind a door), a wrong unit or frame of reference 0.0 to 0.2, because a room is crowded.
POINTS_MEETING = (0.6, 0.3)
SEARCHED_TRUTH_POINTS, SEARCHED_SEEN_POINTS = 1_000_000, 20_000
# Ratios between common depth units: 1000, 5000, 4000, 6553.5 and 256 per metre.
UNITS_PER_METRE = (1000.0, 5000.0, 4000.0, 6553.5, 256.0)


@dataclass(frozen=True)
class Finding:
    """A finding of a check: ``check`` is its kind, ``where`` the frame or file (empty: the scene)."""

    severity: Severity
    check: str
    where: str
    text: str


@dataclass(frozen=True)
class FrameFacts:
    """Statistics of a frame: depth at its 1st, 50th and 99th percentile (0 if it has none), ``seen`` (n, 3) m in
    camera coordinates, and a key that repeated images share."""

    index: int
    width: int
    height: int
    camera_to_world: Float64Array
    intrinsics: Float64Array
    valid_share: float
    near_m: float
    median_m: float
    far_m: float
    has_odd_depth: bool
    is_black: bool
    image_key: int
    seen: Float32Array


@dataclass(frozen=True)
class Meeting:
    """Number of seen points within ``distance_m`` of the ground truth, and a hint on what would align them."""

    share: float
    distance_m: float
    hint: str


def facts_of(frame: Frame) -> FrameFacts:
    """Measurements of ``frame`` for the checks, small enough to keep for every frame of a scene."""
    depth = frame.depth_m
    is_valid = np.isfinite(depth) & (depth > 0)
    sample = depth[::DEPTH_STEP, ::DEPTH_STEP]
    sample = sample[is_valid[::DEPTH_STEP, ::DEPTH_STEP]]
    sample = sample if len(sample) else depth[is_valid]
    near, median, far = np.percentile(sample, [1, 50, 99]) if len(sample) else (0.0, 0.0, 0.0)
    height, width = depth.shape
    image_key = zlib.crc32(depth[::8, ::8].tobytes(), zlib.crc32(frame.rgb[::8, ::8].tobytes()))
    return FrameFacts(
        index=frame.index,
        width=width,
        height=height,
        camera_to_world=frame.camera_to_world,
        intrinsics=frame.intrinsics,
        valid_share=float(is_valid.mean()),
        near_m=float(near),
        median_m=float(median),
        far_m=float(far),
        has_odd_depth=not bool(np.isfinite(depth).all()) or bool((depth < 0).any()),
        is_black=int(frame.rgb.max()) < BLACK_BELOW,
        image_key=image_key,
        seen=_seen_points(frame, is_valid),
    )


def _seen_points(frame: Frame, is_valid: Any) -> Float32Array:
    rows, columns = np.nonzero(is_valid)
    if len(rows) == 0 or not np.linalg.det(frame.intrinsics):
        return np.zeros((0, 3), np.float32)
    chosen = np.linspace(0, len(rows) - 1, min(SEEN_POINTS, len(rows))).astype(np.int64)
    rows, columns = rows[chosen], columns[chosen]
    pixels = np.stack([columns, rows, np.ones(len(rows))]).astype(np.float64)
    rays = np.einsum("ij,jk->ki", np.linalg.inv(frame.intrinsics), pixels)
    seen: Float32Array = (rays * frame.depth_m[rows, columns][:, None]).astype(np.float32)
    return seen


def check_frames(frames: Sequence[FrameFacts]) -> Iterator[Finding]:
    """Findings on the frames alone: poses, sizes, intrinsics, depth, colour, motion."""
    if not frames:
        return
    size = Counter((frame.width, frame.height) for frame in frames).most_common(1)[0][0]
    for check in (_pose, partial(_size, common=size), _intrinsics):
        for frame in frames:
            yield from (Finding("error", kind, f"frame {frame.index}", text) for kind, text in check(frame))
    n_odd = sum(not np.allclose(frame.intrinsics, frames[0].intrinsics) for frame in frames)
    if n_odd:
        yield Finding("note", "intrinsics", "", f"{n_odd} of {len(frames)} frames have different intrinsics")
    yield from _depth(frames)
    for frame in frames:
        if frame.is_black:
            yield Finding("warning", "colour", f"frame {frame.index}", "the colour image is black")
    yield from _motion(frames)


def _pose(frame: FrameFacts) -> Iterator[tuple[str, str]]:
    if not np.isfinite(frame.camera_to_world).all():
        yield "pose", "the pose is not finite; fix the trajectory"
    elif (reason := _not_rigid_reason(frame.camera_to_world)) is not None:
        yield "pose", f"the pose is not a rigid motion: {reason}; expected camera-to-world with last row 0 0 0 1"


def _not_rigid_reason(pose: Float64Array) -> str | None:
    rotation = pose[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.abs(np.einsum("ij,kj->ik", rotation, rotation) - np.eye(3)).max())
        if not off < RIGID_TOLERANCE:
            return f"its rows deviate from orthonormal by {off:.2g}"
        if np.linalg.det(rotation) < 0:
            return "it mirrors"
        if not np.abs(pose[3] - (0, 0, 0, 1)).max() < RIGID_TOLERANCE:
            return f"its last row is {' '.join(f'{value:.3g}' for value in pose[3])}"
    return None


def _size(frame: FrameFacts, common: tuple[int, int]) -> Iterator[tuple[str, str]]:
    if (frame.width, frame.height) != common:
        sizes = f"{frame.width}x{frame.height}, most frames are {common[0]}x{common[1]}"
        yield "size", f"is {sizes}; all frames must have one size"


def _intrinsics(frame: FrameFacts) -> Iterator[tuple[str, str]]:
    fx, fy, cx, cy = frame.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    if not (fx > 0 and fy > 0):
        yield "intrinsics", f"the focal lengths are {fx:g} and {fy:g} pixels; they must be above 0"
    elif not (0 <= cx <= frame.width and 0 <= cy <= frame.height):
        outside = f"({cx:g}, {cy:g}) lies outside the image of {frame.width}x{frame.height}"
        yield "intrinsics", f"the principal point {outside}"


def _depth(frames: Sequence[FrameFacts]) -> Iterator[Finding]:
    for frame in frames:
        where = f"frame {frame.index}"
        if frame.has_odd_depth:
            yield Finding("error", "depth", where, "depth has negative or non-finite values; use 0 for invalid depth")
        if frame.valid_share == 0:
            yield Finding("error", "depth", where, "depth is empty, no pixel is above 0 m; drop the frame")
        elif frame.valid_share < LITTLE_DEPTH:
            yield Finding("warning", "depth", where, f"only {frame.valid_share:.1%} of the pixels have depth")
    with_depth = [frame for frame in frames if frame.valid_share > 0]
    if not with_depth:
        return
    share = float(np.median([frame.valid_share for frame in with_depth]))
    if share < LITTLE_DEPTH_OF_SCENE:
        yield Finding("warning", "depth", "", f"in most frames less than {share:.0%} of the pixels have depth")
    median, (low, high) = float(np.median([frame.median_m for frame in with_depth])), PLAUSIBLE_MEDIAN_DEPTH_M
    if not low <= median <= high:
        text = f"the median depth is {median:.3g} m, expected {low:g} to {high:g} m indoors; check the depth scale"
        yield Finding("error", "depth-scale", "", text)
        return
    far = [frame for frame in with_depth if frame.far_m > PLAUSIBLE_FAR_DEPTH_M]
    if far:
        text = (
            f"in {len(far)} of {len(frames)} frames depth reaches {max(frame.far_m for frame in far):.3g} m, first "
            f"frame {far[0].index}; indoors such a value usually means no depth (set depth_invalid in rgbd.toml)"
        )
        yield Finding("warning", "depth", "", text)


def _motion(frames: Sequence[FrameFacts]) -> Iterator[Finding]:
    """Cameras that do not move, repeated images, trajectories too long for a room."""
    poses = np.array([frame.camera_to_world for frame in frames if np.isfinite(frame.camera_to_world).all()])
    if len(poses) > 1 and (poses == poses[0]).all():
        yield Finding("warning", "motion", "", f"all {len(poses)} frames have the same pose; the camera does not move")
    repeats = [b.index for a, b in itertools.pairwise(frames) if a.image_key == b.image_key]
    if repeats:
        text = f"{len(repeats)} frames repeat the images of the previous frame, first frame {repeats[0]}"
        yield Finding("warning", "motion", "", text)
    extent = float(np.ptp(poses[:, :3, 3], axis=0).max()) if len(poses) else 0.0
    if extent > PLAUSIBLE_WALK_M:
        yield Finding("warning", "motion", "", f"the cameras are spread over {extent:.3g} m; are the poses in metres?")


def check_truth(
    frames: Sequence[FrameFacts], truth_points: Float32Array, boxes: ObjectBoxes | None = None
) -> tuple[Meeting | None, list[Finding]]:
    """How well frames and ground truth align, and the findings; ground truth without points is only reported.

    For objects known only by their ``boxes``, points inside a box count as near, not points near a point.
    """
    usable = [frame for frame in frames if np.isfinite(frame.camera_to_world).all()]
    if not len(truth_points):
        return None, [Finding("error", "truth", "", "the ground truth has no points")]
    if not np.isfinite(truth_points).all():
        return None, [Finding("error", "truth", "", "the ground truth has non-finite points")]
    seeing = [frame for frame in usable if len(frame.seen)]
    meeting = _meeting(seeing, _nearness_to_points(truth_points) if boxes is None else _nearness_to_boxes(boxes))
    do_meet = meeting is not None and meeting.share >= POINTS_MEETING[0]
    findings = list(_cameras(usable, truth_points, do_meet))
    if meeting is not None and not do_meet:
        severity: Severity = "error" if meeting.share < POINTS_MEETING[1] else "warning"
        text = (
            f"only {meeting.share:.1%} of what the frames see lies within {meeting.distance_m * 100:.3g} cm of the "
            f"ground truth{_apart(usable, truth_points)}{meeting.hint}; check depth scale and frames of reference"
        )
        findings.append(Finding(severity, "frame-of-reference", "", text))
    return meeting, findings


def _cameras(frames: Sequence[FrameFacts], truth_points: Float32Array, do_meet: bool) -> Iterator[Finding]:
    """Cameras outside the ground truth's box; not an error if what they see still matches the ground truth."""
    if not frames:
        return
    low = truth_points.min(axis=0).astype(np.float64) - CAMERA_SLACK_M
    high = truth_points.max(axis=0).astype(np.float64) + CAMERA_SLACK_M
    places = np.array([frame.camera_to_world[:3, 3] for frame in frames])
    is_outside = ((places < low) | (places > high)).any(axis=1)
    share = float(is_outside.mean())
    if share < CAMERAS_OUTSIDE[0]:
        return
    first = int(np.argmax(is_outside))
    text = (
        f"{int(is_outside.sum())} of {len(frames)} cameras lie outside the ground truth's box by more than "
        f"{CAMERA_SLACK_M:g} m, first frame {frames[first].index} at ({', '.join(f'{v:.3g}' for v in places[first])}); "
        f"the box is {_box_text(low + CAMERA_SLACK_M, high - CAMERA_SLACK_M)}"
    )
    is_error = share > CAMERAS_OUTSIDE[1] and not do_meet
    yield Finding("error" if is_error else "warning", "frame-of-reference", "", text)


def _box_text(low: Float64Array, high: Float64Array) -> str:
    return ", ".join(f"{axis} {a:.3g}..{b:.3g}" for axis, a, b in zip("xyz", low, high, strict=True)) + " m"


def _apart(frames: Sequence[FrameFacts], truth_points: Float32Array) -> str:
    """A clause if the boxes of both clouds do not overlap."""
    seen = _placed(frames, lambda facts: facts.camera_to_world, np.ones(3))
    if (seen.min(axis=0) <= truth_points.max(axis=0)).all() and (seen.max(axis=0) >= truth_points.min(axis=0)).all():
        return ""
    return f" (the clouds do not overlap: the frames see {_box_text(seen.min(axis=0), seen.max(axis=0))})"


Nearness = tuple[float, Callable[[Float64Array], BoolArray]]  # a distance (m), and which points are within it


def _nearness_to_points(truth_points: Float32Array) -> Nearness:
    from scipy.spatial import KDTree

    step = -(-len(truth_points) // SEARCHED_TRUTH_POINTS)
    tree = KDTree(truth_points[::step])
    distance_m = max(MEETING_DISTANCE_M, _spacing(tree))
    return distance_m, lambda points: np.isfinite(tree.query(points, distance_upper_bound=distance_m)[0])


def _nearness_to_boxes(boxes: ObjectBoxes) -> Nearness:
    return MEETING_DISTANCE_M, lambda points: boxes.instance_at(points, MEETING_DISTANCE_M) > 0


def _meeting(frames: Sequence[FrameFacts], truth: Nearness) -> Meeting | None:
    if not frames:
        return None
    distance_m, is_near = truth

    def share(pose_of: Any, factors: Float64Array) -> float:
        return float(is_near(_placed(frames, pose_of, factors)).mean())

    as_given = share(lambda facts: facts.camera_to_world, np.ones(3))
    hint = "" if as_given >= POINTS_MEETING[0] else _hint(share, as_given)
    return Meeting(as_given, distance_m, hint)


def _spacing(tree: Any) -> float:
    """Typical distance from a vertex to the next: points seen between those of a coarse mesh are near its surface
    but not near a vertex. Vertices at the same position (faces that share none) count once."""
    distance, _ = tree.query(tree.data[:: max(1, tree.n // 500)], k=min(9, tree.n))
    distance = np.reshape(distance, (-1, min(9, tree.n)))
    nearest = np.where(distance > 1e-6, distance, np.inf).min(axis=1)
    return float(np.median(nearest[np.isfinite(nearest)])) if np.isfinite(nearest).any() else 0.0


def _hint(share: Any, as_given: float) -> str:
    """Try to undo common mistakes: a clause on the one that aligns the points with the ground truth, or nothing."""
    tries = {
        "with the poses inverted": share(lambda facts: _inverse(facts.camera_to_world), np.ones(3)),
        "with camera axes of OpenGL": share(lambda facts: facts.camera_to_world, np.array([1.0, -1.0, -1.0])),
    }
    factors = {a / b for a in UNITS_PER_METRE for b in UNITS_PER_METRE if a != b}
    for factor in sorted(factors):
        tries[f"with depth times {factor:.4g}"] = share(lambda facts: facts.camera_to_world, np.full(3, factor))
    best = max(tries, key=lambda name: tries[name])
    is_better = tries[best] >= max(POINTS_MEETING[0], 2 * as_given)
    return f"; {best} it is {tries[best]:.0%}" if is_better else ""


def _inverse(pose: Float64Array) -> Float64Array:
    turned = np.eye(4)
    turned[:3, :3] = pose[:3, :3].T
    turned[:3, 3] = -np.einsum("ij,j->i", pose[:3, :3].T, pose[:3, 3])
    return turned


def _placed(frames: Sequence[FrameFacts], pose_of: Any, factors: Float64Array) -> Float64Array:
    """World points (n, 3) that the frames see, with camera coordinates multiplied by ``factors``."""
    frames = [frame for frame in frames if len(frame.seen)]
    if not frames:
        return np.zeros((1, 3))
    step = max(1, sum(len(frame.seen) for frame in frames) // SEARCHED_SEEN_POINTS)
    parts = []
    for frame in frames:
        pose = pose_of(frame)
        parts.append(np.einsum("ij,kj->ki", pose[:3, :3], frame.seen[::step] * factors) + pose[:3, 3])
    return np.concatenate(parts)
