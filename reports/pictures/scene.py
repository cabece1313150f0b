"""The picture of a scene: some frames, the trajectory, the observed points in colour, and the ground truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, FramesMissing, GroundTruthMissing, counted, printable
from su3d_bench.core.geometry import back_project, turn_to_z, valid_depth
from su3d_bench.core.interfaces import Dataset, HasSurface, ProvidesUpAxis
from su3d_bench.core.types import (
    BoolArray,
    Float32Array,
    Float64Array,
    Frame,
    GroundTruth,
    Int32Array,
    UInt8Array,
    WorldUp,
)
from su3d_bench.reports.pictures import canvas
from su3d_bench.reports.pictures.maps import thinned_rows, truth_owner

CAMERAS = 48  # enough for the shape of a trajectory
SHOWN_FRAMES = 6
SEEN_POINTS = 250_000  # over all frames: one per 2 cm on the surfaces of a room
PERCENTILES = (1, 99)  # of a frame's depth, against outlier pixels
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SceneView:
    """The data for the picture of a scene.

    ``poses`` (n, 4, 4): camera-to-world of the frames read, of ``n_frames`` in the scene; ``seen`` (m, 3): observed
    points in metres in the world frame, z up, and ``seen_rgb`` (m, 3) their colours, or the vertices of the scan's mesh
    if there are neither frames nor ground truth; ``shown``: some of the frames; ``depth_m``: minimum and maximum depth;
    ``truth``, or the reason why it is missing, as for the frames; ``up``: for datasets without a fixed up axis; if it
    is only estimated, the world of the picture is rotated and that of the frames is not.
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
    no_frames: str = ""
    up: WorldUp | None = None

    @property
    def counts(self) -> dict[str, int]:
        """Points, objects and classes of the ground truth; empty without ground truth."""
        if self.truth is None:
            return {}
        n_objects, n_classes = (len(np.unique(ids[ids > 0])) for ids in (self.truth.instance, self.truth.semantic))
        return {"n_points": len(self.truth.points), "n_objects": n_objects, "n_classes": n_classes}


def look_at(
    dataset: Dataset, scene: str, stride: int | None = None, progress: Progress = lambda n_done, n: None
) -> SceneView:
    """Read every ``stride``-th frame of ``scene`` (None: ``CAMERAS`` evenly spaced ones) and its ground truth.

    A ``DataError`` for corrupted frames or ground truth, or if both and the scan's mesh are missing.
    """
    frames: Sequence[Frame] = ()
    n_frames, no_frames, mesh = 0, "", np.zeros((0, 3), np.float32)
    truth, reason = _truth(dataset, scene)
    try:
        frames, n_frames = dataset.frames(scene, stride or 1), dataset.info(scene, 1).n_frames
        if not len(frames):
            raise DataError(f"{dataset.name}/{scene}: has no frames to show")
    except DataError as error:
        if not isinstance(error, FramesMissing) and not isinstance(error.__cause__, FileNotFoundError):
            raise
        no_frames = str(error)
        if truth is None:
            if not isinstance(dataset, HasSurface):
                raise DataError(f"{no_frames}; {reason}") from error
            mesh = dataset.surface(scene).vertices
    positions = range(len(frames)) if stride else evenly(len(frames), CAMERAS)
    is_shown = set(evenly(len(positions), SHOWN_FRAMES))
    poses, shown, ranges = list[Float64Array](), list[Frame](), list[float]()
    points, colours = [mesh], [np.full((len(mesh), 3), UNSEEN, np.uint8)]
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
    up = dataset.up(scene) if len(frames) and isinstance(dataset, ProvidesUpAxis) else None
    turn = np.eye(3) if up is None or up.axis is None or up.is_turned else turn_to_z(up.axis)
    drawn = np.array(poses).reshape(-1, 4, 4)
    drawn[:, :3] = turn @ drawn[:, :3]
    seen = (np.concatenate(points) @ turn.T).astype(np.float32)
    depth_m = (float(min(ranges, default=0.0)), float(max(ranges, default=0.0)))
    about = (f"{dataset.name}/{scene}", n_frames, drawn, seen, np.concatenate(colours), tuple(shown), depth_m)
    return SceneView(*about, truth, reason, no_frames, up)


def evenly(n: int, most: int) -> Sequence[int]:
    """Return at most ``most`` evenly spaced numbers below ``n``."""
    return sorted({int(place) for place in np.linspace(0, n - 1, min(n, most))})


def spread(n: int, most: int) -> list[int]:
    """Return the numbers of ``evenly``, ordered so that the first few are far apart as well.

    >>> spread(9, 9)
    [0, 8, 4, 2, 6, 1, 3, 5, 7]
    """
    places = list(evenly(n, most))
    taken, step = dict.fromkeys((*places[:1], *places[-1:])), 1 << max(0, len(places) - 1).bit_length()
    while step := step // 2:
        taken |= dict.fromkeys(places[step::step])
    return list(taken)


def chosen_pixels(frame: Frame, n_frames: int, n_points: int = SEEN_POINTS) -> BoolArray:
    """Return a mask (H, W) of pixels with depth, spread over the image: about ``n_points / n_frames`` of them."""
    most = max(1, n_points // n_frames)
    is_valid = valid_depth(frame.depth_m, 0.0, np.inf)
    step = int(np.ceil(np.sqrt(max(1.0, is_valid.sum() / most))))
    chosen = np.zeros_like(is_valid)
    chosen[::step, ::step] = is_valid[::step, ::step]
    return chosen


def seen_points(frames: Sequence[Frame], n_points: int) -> tuple[Float32Array, UInt8Array]:
    """Return about ``n_points`` observed world points (n, 3), in metres, of all ``frames``, and colours (n, 3)."""
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


PANEL_WIDTH, PANEL_HEIGHT = 620, 520  # pixels
PANELS_PER_ROW: dict[canvas.Width, int] = {"8cm": 2, "17cm": 3}
FRAMES_SHOWN: dict[canvas.Width, int] = {"8cm": 3, "17cm": SHOWN_FRAMES}
GAP_IN, SCALE_IN = canvas.GAP_IN, 0.45  # of the depth scale
LEGEND_COLUMNS: dict[canvas.Width, int] = {"8cm": 2, "17cm": 3}  # class legend below the panels
NUMBER_IN, WITH_POINTS_IN = 0.5, 2.0  # a column of numbers; a narrower legend has no numbers of points
MAX_CLASSES = 600  # in the legend; three times the largest label space
REASON_LINES = 4
SEEN_WITHIN_M = 0.12  # a ground-truth point takes the colour of an observed point within this distance
MIN_DRAWN_M = 0.012
UNSEEN = (214, 214, 210)
SCALE_LENGTHS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
WALK, START, END = "#d6246e", "#1a9850", "#111111"
# Trajectories may extend this far beyond the ground truth; longer ones would leave no space for the scene.
MAX_BEYOND_M = 10.0


Panel = tuple[str, UInt8Array, canvas.Camera | None]  # caption, pixels, camera of a top view


@canvas.figure_style()
def draw_scene_picture(look: SceneView, path: Path, width: canvas.Width = "17cm") -> None:
    """Write the picture of ``look`` as PDF, PNG or SVG by the suffix of ``path``."""
    width_in = canvas.WIDTHS_IN[width]
    reason, classes = [], []
    if look.truth is None:
        reason = canvas.fitted(f"no ground truth: {look.no_truth}", width_in).splitlines()[:REASON_LINES]
    else:
        classes = _classes(look.truth)[:MAX_CLASSES]
    n_rows = -(-len(classes) // LEGEND_COLUMNS[width])
    legend_in = canvas.LINE_IN * (len(reason) or 1 + n_rows) + 2 * GAP_IN
    frames = [look.shown[place] for place in evenly(len(look.shown), FRAMES_SHOWN[width])]
    frame_in, frame_height = (width_in - SCALE_IN) / FRAMES_SHOWN[width], 0.0
    if frames:
        rows, wide = frames[0].rgb.shape[:2]
        frame_height = min(2 * frame_in, (frame_in - GAP_IN) * rows / wide)
    below_in = legend_in + (2 * (canvas.LINE_IN + frame_height + GAP_IN) if frames else 0)
    panels = canvas.Panels(width, PANELS_PER_ROW[width], 3, PANEL_HEIGHT / PANEL_WIDTH, below_in)
    page, legend_top = panels.page, panels.bottom
    for k, (title, pixels, camera) in enumerate(_panels(look)):
        axes = panels.draw(k, title, pixels)
        if camera is not None:
            _draw_scale(axes, camera)
            if k == 0 and look.shown:
                _draw_walk(axes, camera, look.poses)
    if look.truth is not None:
        _draw_legend(page, classes, n_rows, (legend_top, width_in / LEGEND_COLUMNS[width]))
    for k, line in enumerate(reason):
        page.text(0, legend_top + canvas.LINE_IN * k, line, colour=canvas.GREY)
    if frames:
        _draw_frames(page, frames, look.depth_m[1], (legend_top + legend_in, frame_in, frame_height))
    page.write(path, f"{look.scene}: {facts_line(look)}")


def facts_line(look: SceneView) -> str:
    """Return the facts about the scene in one line."""
    words = ["no frames", *([f"mesh of {len(look.seen):,} vertices"] if len(look.seen) else [])]
    if look.shown:
        height, width = look.shown[0].rgb.shape[:2]
        words = [
            f"{look.n_frames:,} frames of {width}x{height}",
            f"depth {look.depth_m[0]:.2f} to {look.depth_m[1]:.2f} m",
        ]
    if look.truth is not None:
        counts = look.counts
        words.append(f"{counted(counts['n_objects'], 'object')} of {counted(counts['n_classes'], 'class')}")
        words.append(f"{counts['n_points']:,} ground-truth points ({printable(look.truth.variant, 40)})")
    else:
        words.append("no ground truth")
    if look.up is not None and look.up.axis is not None:
        words.append(f"{look.up.axis} is up" + ("" if look.up.is_turned else " (estimated)"))
    return " \u00b7 ".join(words)


def _panels(look: SceneView) -> tuple[Panel, ...]:
    if look.truth is None:
        points = look.seen if len(look.seen) else look.poses[:, :3, 3].astype(np.float32)
        colours = look.seen_rgb if len(look.seen) else np.full((len(points), 3), UNSEEN, np.uint8)
        corners = canvas.view_cameras(canvas.room_bounds(points), PANEL_WIDTH, PANEL_HEIGHT)[1:]
        cameras = (_camera_above(look, points), *corners)
        size_m = _drawn_size(points)
        pictures = [canvas.colour(canvas.render(points, size_m, camera), colours) for camera in cameras]
        return (
            ("trajectory" if look.shown else "mesh", pictures[0], cameras[0]),
            ("from one corner", pictures[1], None),
            ("from the other corner", pictures[2], None),
        )
    rows = thinned_rows(look.truth.points)
    points, above = look.truth.points[rows], _camera_above(look, look.truth.points)
    view = canvas.render(points, _drawn_size(points), above)
    by_class, by_instance = _class_palette(look.truth)[rows], _instance_palette(look.truth)[rows]
    return (
        ("trajectory" if look.shown else "ground truth", canvas.colour(view, _seen_colours(look, points)), above),
        ("by class", canvas.colour(view, by_class), above),
        ("by instance", canvas.colour(view, by_instance), above),
    )


def _camera_above(look: SceneView, points: Float32Array) -> canvas.Camera:
    """Return the top view of the points and the trajectory, limited to ``MAX_BEYOND_M`` around the points."""
    bounds = canvas.room_bounds(points)
    if not len(look.poses):
        return canvas.view_cameras(bounds, PANEL_WIDTH, PANEL_HEIGHT)[0]
    places = look.poses[:, :2, 3]
    bounds[0, :2] = np.maximum(np.minimum(bounds[0, :2], places.min(axis=0)), bounds[0, :2] - MAX_BEYOND_M)
    bounds[1, :2] = np.minimum(np.maximum(bounds[1, :2], places.max(axis=0)), bounds[1, :2] + MAX_BEYOND_M)
    return canvas.view_cameras(bounds, PANEL_WIDTH, PANEL_HEIGHT)[0]


def _drawn_size(points: Float32Array) -> float:
    """Return the point width at which neighbours touch, also in sparse clouds."""
    from scipy.spatial import KDTree

    if len(points) < 2:
        return MIN_DRAWN_M
    distance, _ = KDTree(points).query(points[:: max(1, len(points) // 1000)], k=2)
    return max(MIN_DRAWN_M, 2.0 * float(np.median(distance[:, 1])))


def _seen_colours(look: SceneView, points: Float32Array) -> UInt8Array:
    """Return the observed colour at each point; pale if none was observed there."""
    from scipy.spatial import KDTree

    palette = np.concatenate([look.seen_rgb, np.array([UNSEEN], np.uint8)])
    if not len(look.seen):
        return np.repeat(palette, len(points), axis=0)
    _, nearest = KDTree(look.seen).query(points, distance_upper_bound=max(SEEN_WITHIN_M, _drawn_size(look.seen)))
    colours: UInt8Array = palette[nearest]
    return colours


def _class_palette(truth: GroundTruth) -> UInt8Array:
    """Return the colour of each point by class."""
    palette = canvas.class_colours([name for name, _, _ in _classes(truth)])
    names = truth.labels.names
    colours = np.array([*(palette.get(name, canvas.NO_INSTANCE) for name in names), canvas.NO_INSTANCE], np.uint8)
    return colours[truth_owner(truth)]


def _instance_palette(truth: GroundTruth) -> UInt8Array:
    """Return the colour of each point by instance, the largest ones most distinct; room surfaces are pale."""
    ids, first, inverse, n_points = np.unique(
        truth.instance, return_index=True, return_inverse=True, return_counts=True
    )
    owner = truth_owner(truth)[first]
    order = [int(row) for row in np.argsort(-n_points, kind="stable") if ids[row] != 0]
    names = [truth.labels.names[owner[row]] if owner[row] >= 0 else "" for row in order]
    colours = np.full((len(ids), 3), canvas.NO_INSTANCE, np.uint8)
    colours[order] = np.array(canvas.instance_colours(names), np.uint8).reshape(-1, 3)
    return colours[inverse.reshape(-1)]


def _classes(truth: GroundTruth) -> list[tuple[str, int, int]]:
    """Return (name, objects, points) of each class with points, largest first."""
    owner = truth_owner(truth)
    n_points = np.bincount(owner[owner >= 0], minlength=len(truth.labels.names))
    pairs: Int32Array = np.unique(np.stack([owner, truth.instance])[:, truth.instance != 0], axis=1)[0]
    n_objects = np.bincount(pairs[pairs >= 0], minlength=len(n_points))
    order = [int(row) for row in np.argsort(-n_points, kind="stable") if n_points[row]]
    return [(truth.labels.names[row], int(n_objects[row]), int(n_points[row])) for row in order]


def _draw_legend(
    page: canvas.Canvas, classes: Sequence[tuple[str, int, int]], n_rows: int, place: tuple[float, float]
) -> None:
    """Draw every class with its numbers of objects and points, column by column, largest first."""
    top, wide = place
    palette: dict[str, canvas.Colour] = canvas.class_colours([name for name, _, _ in classes])
    has_points = wide > WITH_POINTS_IN
    for k, (name, n_objects, n_points) in enumerate(classes):
        column, row = divmod(k, n_rows)
        left, right = column * wide, (column + 1) * wide - 0.15
        objects = right - NUMBER_IN if has_points else right
        if row == 0:
            page.text(left, top, "class", colour=canvas.GREY)
            page.text(objects, top, "objects", colour=canvas.GREY, ha="right")
        y = top + canvas.LINE_IN * (row + 1.5)
        page.text(left, y, "\u25a0", colour=canvas.hex_of(palette[name]), va="center", fontsize=12)
        most = int((objects - left - 0.45) * canvas.LETTERS_PER_INCH)
        page.text(left + 0.15, y, _shortened(name, most), va="center")
        page.text(objects, y, f"{n_objects}", va="center", ha="right")
        if has_points:
            if row == 0:
                page.text(right, top, "points", colour=canvas.GREY, ha="right")
            page.text(right, y, _thousands(n_points), va="center", ha="right")


def _draw_walk(axes: Any, camera: canvas.Camera, poses: Float64Array) -> None:
    """Draw the trajectory with viewing directions, start and end."""
    x, y = canvas.project(camera, poses[:, :3, 3]).T
    ahead_x, ahead_y = canvas.project(camera, poses[:, :3, 3] + 0.25 * poses[:, :3, 2]).T
    axes.plot(x, y, color="white", linewidth=2.4, solid_capstyle="round")
    axes.plot(np.stack([x, ahead_x]), np.stack([y, ahead_y]), color=WALK, linewidth=0.6)
    axes.plot(x, y, color=WALK, linewidth=1.2, solid_capstyle="round")
    for k, name, shade, marker in ((0, "start", START, "o"), (-1, "end", END, "s")):
        axes.plot(x[k], y[k], marker, color=shade, markersize=5, markeredgecolor="white", markeredgewidth=0.8)
        is_right = x[k] > PANEL_WIDTH - 130
        axes.annotate(
            name,
            (float(np.clip(x[k], 0, PANEL_WIDTH)), float(np.clip(y[k], 30, PANEL_HEIGHT - 30))),
            xytext=(-5 if is_right else 5, 5 if k == 0 else -5),
            textcoords="offset points",
            ha="right" if is_right else "left",
            va="center",
            color=shade,
            fontweight="bold",
            bbox=canvas.paper(),
        )


def _draw_scale(axes: Any, camera: canvas.Camera) -> None:
    """Draw a scale bar of a round length in the lower left corner."""
    pixels_a_metre = camera.focal / canvas.OVERSAMPLING
    length_m = max((length for length in SCALE_LENGTHS_M if length * pixels_a_metre < 0.25 * PANEL_WIDTH), default=0.1)
    left, row = 14, PANEL_HEIGHT - 12
    axes.plot([left, left + length_m * pixels_a_metre], [row, row], color="white", linewidth=3, solid_capstyle="butt")
    axes.plot(
        [left, left + length_m * pixels_a_metre], [row, row], color=canvas.DARK, linewidth=1.5, solid_capstyle="butt"
    )
    axes.text(left, row - 12, f"{length_m:g} m", color=canvas.DARK, va="bottom", bbox=canvas.paper())


def _draw_frames(
    page: canvas.Canvas, frames: Sequence[Frame], most_m: float, place: tuple[float, float, float]
) -> None:
    """Draw colour above depth images, with the depth scale on the right."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    top, wide, height = place
    scale = ScalarMappable(Normalize(0.0, max(most_m, 1e-3)), colormaps["viridis"].with_extremes(bad="#b8b8b8"))
    below = top + canvas.LINE_IN + height + GAP_IN
    for column, frame in enumerate(frames):
        left = column * wide
        page.text(left, top, f"frame {frame.index}")
        page.axes(left, top + canvas.LINE_IN, wide - GAP_IN, height).imshow(frame.rgb)
        depth = np.where(frame.depth_m > 0, frame.depth_m, np.nan)
        page.axes(left, below + canvas.LINE_IN, wide - GAP_IN, height).imshow(
            scale.to_rgba(np.ma.masked_invalid(depth)), interpolation="nearest"
        )
    page.text(0, below, "depth in m (grey: none)")
    bar = page.axes(page.width - SCALE_IN, below + canvas.LINE_IN, 0.1, height)
    bar.set_axis_on()
    page.figure.colorbar(scale, cax=bar)


def _thousands(n: int) -> str:
    """Format a count in at most six characters."""
    return f"{n:,}" if n < 10_000 else f"{n / 1e3:.0f} k" if n < 1_000_000 else f"{n / 1e6:.1f} M"


def _shortened(text: str, most: int) -> str:
    text = printable(text)
    return text if len(text) <= most else text[: most - 1] + "\u2026"
