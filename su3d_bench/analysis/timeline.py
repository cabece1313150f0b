"""Frames, masks, maps and ground truth of a scene of a run on one timeline.

The result is a recording for the rerun viewer (``.rrd``), written without a viewer, a display or a network.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.analysis.page.maps import Spaces, shown_classes, shown_rules
from su3d_bench.analysis.page.scene import SceneData, SceneReader, fed_frames, frames_of
from su3d_bench.core.errors import ModelMissing, StoreError, counted, printable
from su3d_bench.core.geometry import back_project, valid_depth
from su3d_bench.core.interfaces import HasPreviews
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, GroundTruth, Int64Array
from su3d_bench.formats.images import depth_in_units, jpeg_bytes, png_bytes
from su3d_bench.metrics.matching.labelling import class_index_of_ids
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.metric import n_predictions
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.numerics.visibility import visible
from su3d_bench.reports.page.maps import Cloud, point_owners, thinned
from su3d_bench.reports.pictures import canvas
from su3d_bench.reports.pictures.maps import names_of
from su3d_bench.reports.pictures.scene import evenly
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.records import read_updates

MAX_FRAMES = 60  # per scene, unless a stride is given
MAX_WIDTH = 480  # pixels of an image; wider ones are downscaled
MAX_POINTS = 60_000  # of a map, and of the ground truth
NEAR_SPACINGS = 3.0  # maximum distance of a pixel to its instance's nearest point, in point spacings
EVERY_PIXEL = 2  # pixel step on both axes at which instances are looked up
MAX_IDS = 0xFFFF  # rerun's ids have 16 bits; 0 means no instance
UInt16Array = NDArray[np.uint16]
# Entity paths; names of methods are only appended below them, so that they cannot collide.
CAMERA = ("world", "camera")
MASKS, TRUE_MASKS = (*CAMERA, "masks"), (*CAMERA, "truth")
MAP, TRUTH, GROWTH, ABOUT = ("world", "map"), ("world", "truth"), ("growth",), ("about",)
INSTANCES, CLASSES, BOXES = "instances", "classes", "boxes"
ROOM, TOP = "room", "ceiling"  # parts of a cloud: below the ceiling, and the rest
CURVES = ("instances", "points", "milliseconds per update")
APPLICATION = "su3d-bench"
MIN_VERSION = (0, 41)  # the first version that the project was tested with
UNITS_PER_METRE = 1000.0  # of depth: 16 bits reach 65 m
JPEG_QUALITY = 80
CAMERA_M = 0.4  # distance of the image plane from the camera in the 3D view
INSTALL = "pip install 'su3d-bench[rerun]'"
COLUMNS = dict(zip(("n_instances", "n_points", "total_ms"), CURVES, strict=True))  # column of updates -> curve
Progress = Callable[[int, int], None]


def rerun_sdk() -> Any:
    """The module of rerun; ``ModelMissing`` if it is not installed, too old, or disabled."""
    try:
        import rerun
    except ImportError as error:
        raise ModelMissing(f"report rerun needs the rerun extra: {INSTALL}") from error
    version = str(getattr(rerun, "__version__", ""))
    numbers = re.match(r"(\d+)\.(\d+)", version)
    if numbers is None or (int(numbers[1]), int(numbers[2])) < MIN_VERSION:
        least = ".".join(map(str, MIN_VERSION))
        raise ModelMissing(f"report rerun needs rerun-sdk {least} or later, found {version or 'another'}: {INSTALL}")
    if not rerun.RecordingStream(APPLICATION, send_properties=False).is_enabled():
        raise ModelMissing("the environment variable RERUN disables rerun, so nothing would be written; unset RERUN")
    return rerun


class Recording:
    """The recording of one scene, written to ``stream`` piece by piece; ``sdk`` is ``rerun_sdk()``.

    A place is an entity path, as a sequence of names. Content is logged at the frame of the last call of ``at``, or
    without time before the first call.
    """

    def __init__(self, sdk: Any, scene: str, methods: Sequence[str], stream: IO[bytes]) -> None:
        self.sdk, self._stream, self._is_static = sdk, stream, True
        self._recording = sdk.RecordingStream(APPLICATION, recording_id=printable(scene, 200), send_properties=False)
        self._recording.set_log_time_enabled(False)
        self._recording.set_log_tick_enabled(False)
        self._sink = self._recording.binary_stream()
        self._recording.send_recording_name(printable(scene, 200))
        self._recording.send_blueprint(_panels(sdk, methods), make_active=True, make_default=True)
        self.log(CAMERA[:1], sdk.ViewCoordinates.RIGHT_HAND_Z_UP)

    def at(self, frame: int, seconds: float) -> None:
        """Set the time: a frame's index at full rate, and seconds since the first frame shown."""
        self._recording.set_time("frame", sequence=frame)
        self._recording.set_time("seconds", duration=seconds)
        self._is_static = False

    def photo(self, frame: Frame) -> None:
        """Log the camera pose, the image and the depth."""
        height, width = frame.depth_m.shape
        pose = frame.camera_to_world
        pinhole = self.sdk.Pinhole(
            image_from_camera=frame.intrinsics,
            width=width,
            height=height,
            camera_xyz=self.sdk.ViewCoordinates.RDF,
            image_plane_distance=CAMERA_M,
        )
        self.log(CAMERA, self.sdk.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), pinhole)
        colour = self.sdk.EncodedImage(contents=jpeg_bytes(frame.rgb, JPEG_QUALITY), media_type="image/jpeg")
        self.log((*CAMERA, "colour"), colour)
        packed = png_bytes(depth_in_units(frame.depth_m, UNITS_PER_METRE))
        depth = self.sdk.EncodedDepthImage(packed, media_type="image/png", meter=UNITS_PER_METRE)
        self.log((*CAMERA, "depth"), depth)

    def close(self, about: str) -> None:
        """End the recording with the text ``about``."""
        made_with = f"Made with rerun {self.sdk.__version__}; other versions may not read this file."
        self._is_static = True
        self.log(ABOUT, self.sdk.TextDocument(f"{about}\n\n{made_with}", media_type="text/plain"))
        self._recording.disconnect()
        self._stream.write(self._sink.read(flush=True) or b"")

    def log(self, place: Sequence[str], *contents: Any) -> None:
        """Log ``contents``, objects of ``sdk``, at a place."""
        for content in contents:
            self._recording.log(_path(place), content, static=self._is_static)
        self._stream.write(self._sink.read(flush=True) or b"")


def _path(place: Sequence[str]) -> list[str]:
    """A place in rerun's form; rerun escapes each part itself."""
    return [printable(part, 100) for part in place]


def _panels(sdk: Any, methods: Sequence[str]) -> Any:
    """The view layout: photo with masks above the curves; maps by instance and by class; ground truth."""
    rrb = sdk.blueprint

    def at(*parts: str) -> str:
        return str(sdk.new_entity_path(_path(parts)))

    def room(name: str, *shown: str) -> Any:
        camera = [at(*CAMERA), at(*CAMERA, "colour")]
        return rrb.Spatial3DView(origin=at("world"), contents=[*camera, *shown], name=printable(name, 100))

    def photo(name: str, *shown: str) -> Any:
        return rrb.Spatial2DView(origin=at(*CAMERA), contents=[at(*CAMERA, "colour"), *shown], name=name)

    photos = [photo(f"masks of {printable(method, 80)}", at(*MASKS, method)) for method in methods]
    depth = rrb.Spatial2DView(origin=at(*CAMERA), contents=[at(*CAMERA, "depth")], name="depth")
    rooms = []
    for method in methods:
        boxes = at(*MAP, method, BOXES)
        rooms.append(room(f"{method}: instances", f"{at(*MAP, method, INSTANCES, ROOM)}/**", boxes))
        rooms.append(room(f"{method}: classes", f"{at(*MAP, method, CLASSES, ROOM)}/**"))
    truths = [room(f"ground truth: {kind}", f"{at(*TRUTH, kind, ROOM)}/**") for kind in (CLASSES, INSTANCES)]
    left = rrb.Vertical(
        rrb.Tabs(*photos, photo("ground-truth masks", at(*TRUE_MASKS)), depth),
        rrb.Tabs(
            *(rrb.TimeSeriesView(origin=at(*GROWTH, curve), name=curve) for curve in CURVES),
            rrb.TextDocumentView(origin=at(*ABOUT), name="about"),
        ),
    )
    right = rrb.Vertical(rrb.Tabs(*rooms), rrb.Tabs(*truths))
    panels = rrb.Horizontal(left, right, column_shares=[2, 3])
    time = rrb.TimePanel(state="collapsed", timeline="frame")
    return rrb.Blueprint(panels, time, rrb.SelectionPanel(state="collapsed"))


@dataclass(frozen=True)
class Owned:
    """Drawn points with the ``instance`` and ``label`` (n,) of each, -1 for none.

    ``names`` and ``corners`` (k, 2, 3) m describe the instances, ``labels`` are the names of the classes.
    """

    cloud: Cloud
    instance: Int64Array
    label: Int64Array
    names: tuple[str, ...]
    corners: Float32Array
    labels: tuple[str, ...]

    @property
    def colours(self) -> list[canvas.Colour]:
        return canvas.instance_colours(self.names)

    def named(self) -> list[tuple[str, Sequence[tuple[int, str, canvas.Colour]], Int64Array]]:
        """For instances and for classes: the place, ids with names and colours, and the owner of each point."""
        tints = canvas.class_colours(self.labels)
        instances = [(k + 1, f"{name or 'unnamed'} #{k}", self.colours[k]) for k, name in enumerate(self.names)]
        classes = [(k + 1, name, tints[name]) for k, name in enumerate(self.labels)]
        return [
            (INSTANCES, instances[: MAX_IDS - 1], self.instance),
            (CLASSES, classes[: MAX_IDS - 1], self.label),
        ]

    def log_names(self, recording: Recording, place: tuple[str, ...], masks: tuple[str, ...]) -> None:
        """Log names and colours of ids below ``place`` (id 0 is grey) and at ``masks`` (id 0 is transparent)."""
        places = [((*place, kind), entries, canvas.NO_INSTANCE) for kind, entries, _ in self.named()]
        for where, entries, nobody in (*places, (masks, places[0][1], (0, 0, 0, 0))):
            infos = [
                recording.sdk.AnnotationInfo(number, printable(name, 80), tint)
                for number, name, tint in ((0, "", nobody), *entries)
            ]
            recording.log(where, recording.sdk.AnnotationContext(infos))

    def log_masks(self, recording: Recording, place: tuple[str, ...], frame: Frame) -> None:
        """Log the instance id of each pixel of ``frame``."""
        recording.log(place, recording.sdk.SegmentationImage(self.masks(frame), opacity=0.6))

    def masks(self, frame: Frame) -> UInt16Array:
        """The instance id of each pixel of ``frame``: that of the map point nearest to the measured surface."""
        height, width = frame.depth_m.shape
        is_asked = np.zeros((height, width), np.bool_)
        is_asked[::EVERY_PIXEL, ::EVERY_PIXEL] = True
        is_asked &= valid_depth(frame.depth_m, 0.0, np.inf)
        places = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, is_asked)
        _, row = nearest(self.cloud.points, places, NEAR_SPACINGS * self.cloud.spacing_m)
        ids = np.zeros((height, width), np.uint16)
        ids[is_asked] = ids_of(np.where(row >= 0, np.append(self.instance, -1)[row], -1))
        few = ids[::EVERY_PIXEL, ::EVERY_PIXEL]
        return few.repeat(EVERY_PIXEL, axis=0).repeat(EVERY_PIXEL, axis=1)[:height, :width]

    @cached_property
    def is_top(self) -> BoolArray:
        """Which points belong to the ceiling or hang from it; the pictures from above omit them as well."""
        if not len(self.cloud.points):
            return np.zeros(0, np.bool_)
        low, high = canvas.room_bounds(self.cloud.points)[:, 2]
        cut = canvas.CUT_BELOW_TOP_M if high - low >= canvas.ROOM_HEIGHT_M else 0.0
        is_top: BoolArray = self.cloud.points[:, 2] > high - cut
        return is_top

    def log_points(self, recording: Recording, place: tuple[str, ...], shown: BoolArray, own: str) -> None:
        """Log the points that are ``shown`` at places called ``own``, so that points logged before are kept."""
        for kind, _, owner in self.named():
            for part, is_there in ((ROOM, shown & ~self.is_top), (TOP, shown & self.is_top)):
                if is_there.any():
                    points, ids = self.cloud.points[is_there], ids_of(owner[is_there])
                    cloud = recording.sdk.Points3D(points, class_ids=ids, radii=self.cloud.spacing_m / 2)
                    recording.log((*place, kind, part, own), cloud)

    def log_boxes(self, recording: Recording, place: tuple[str, ...], shown: BoolArray) -> None:
        rows = np.flatnonzero(shown)
        low, high = self.corners[rows].swapaxes(0, 1)
        labels = [printable(self.names[k], 80) for k in rows]
        shades = np.array([self.colours[k] for k in rows], np.uint8).reshape(-1, 3)
        boxes = recording.sdk.Boxes3D(mins=low, sizes=high - low, labels=labels, colors=shades)
        recording.log((*place, BOXES), boxes)


class Growth:
    """A finished map, revealed over time: the points seen so far of the instances known so far."""

    def __init__(self, recording: Recording, place: tuple[str, ...], owned: Owned, first_frame: Sequence[int]) -> None:
        self._recording, self._place, self._owned = recording, place, owned
        self._first_frame = np.append(np.array(first_frame, np.int64), 0)  # the last entry: no instance
        self._is_seen = np.zeros(len(owned.cloud.points), np.bool_)
        self._is_out = self._is_seen.copy()
        self._own = "all"

    def step(self, frame: Frame) -> None:
        """Log what ``frame`` adds to the map."""
        self._own = f"from frame {frame.index:06}"
        self._is_seen |= visible(self._owned.cloud.points, frame)
        is_known = self._first_frame[self._owned.instance] <= frame.index
        self._show(self._is_seen & is_known)

    def end(self) -> None:
        """Log the points that no frame showed, so that the map is complete at the end."""
        self._own = "all" if self._own == "all" else "in no frame"
        self._show(np.ones_like(self._is_out))

    def _show(self, wanted: BoolArray) -> None:
        new = wanted & ~self._is_out
        if not new.any():
            return
        self._is_out |= new
        self._owned.log_points(self._recording, self._place, new, self._own)
        if len(self._owned.names):
            is_there = np.zeros(len(self._owned.names) + 1, np.bool_)
            is_there[self._owned.instance[self._is_out]] = True
            self._owned.log_boxes(self._recording, self._place, is_there[:-1])


class SceneTimeline:
    """The timeline of one scene of a run; ``remarks``: what could not be shown, complete after ``write``."""

    def __init__(self, run: FinishedRun, scene: str, methods: Sequence[str], stride: int, spaces: Spaces) -> None:
        self._run, self.scene, self._methods, self._stride = run, scene, methods, stride
        self._spaces = spaces
        self._reader = SceneReader(run, scene, SceneData(scene))
        self.remarks = self._reader.remarks
        self.n_frames = self.n_maps = 0

    def write(self, recording: Recording, progress: Progress = lambda n_done, n: None) -> None:
        """Write everything to ``recording`` in order of time; ``progress`` is called with the number of frames done."""
        frames = self._frames()
        rules = shown_rules(self._run)
        truth = None if rules is None else self._reader.truth(rules)
        shown_truth = None if truth is None or rules is None else owned_of_truth(rules, truth)
        maps = self._maps(rules, truth)
        self.n_maps = len(maps)
        if shown_truth is not None:
            shown_truth.log_names(recording, TRUTH, TRUE_MASKS)
            shown_truth.log_points(recording, TRUTH, np.ones(len(shown_truth.instance), np.bool_), "all")
            shown_truth.log_boxes(recording, TRUTH, np.ones(len(shown_truth.names), np.bool_))
        for method, (owned, _) in maps.items():
            owned.log_names(recording, (*MAP, method), (*MASKS, method))
        growing = {method: Growth(recording, (*MAP, method), owned, first) for method, (owned, first) in maps.items()}
        curves = {method: self._curves(method) for method in maps}
        first_s = None
        for done, index in enumerate(frames):
            progress(done, len(frames))
            frame = self._frame(index)
            if frame is None:
                continue
            first_s = frame.timestamp_s if first_s is None else first_s
            self.n_frames += 1
            recording.at(frame.index, frame.timestamp_s - first_s)
            recording.photo(frame)
            if shown_truth is not None:
                shown_truth.log_masks(recording, TRUE_MASKS, frame)
            for method, growth in growing.items():
                if maps[method][0].names:
                    maps[method][0].log_masks(recording, (*MASKS, method), frame)
                growth.step(frame)
                for curve, value in curves[method].get(index, {}).items():
                    recording.log((*GROWTH, curve, method), recording.sdk.Scalars(value))
        for growth in growing.values():
            growth.end()
        recording.close(self._about())

    def _frames(self) -> list[int]:
        """The frames to show: a selection of those that the methods were given, otherwise of all."""
        fed = {index for method in self._methods for index in fed_frames(self._run, self.scene, method)}
        n_frames = len(self._reader.sequence)
        there = sorted(index for index in fed if 0 <= index < n_frames) or range(n_frames)
        if self._stride:
            return list(there[:: self._stride])
        return [there[place] for place in evenly(len(there), MAX_FRAMES)] if len(there) else []

    def _frame(self, index: int) -> Frame | None:
        name = self.scene.partition("/")[2]

        def read() -> Frame:
            if isinstance(self._reader.dataset, HasPreviews):
                return self._reader.dataset.sketch(name, index, MAX_WIDTH)
            return smaller(self._reader.sequence[index], MAX_WIDTH)

        frame: Frame | None = self._reader.had("a frame is omitted", read)
        return frame

    def _maps(self, rules: ProtocolRules | None, truth: GroundTruth | None) -> dict[str, tuple[Owned, Sequence[int]]]:
        """Each method's map, and the first frame in which each of its instances was seen (0 if unknown)."""
        maps: dict[str, tuple[Owned, Sequence[int]]] = {}
        for method in self._methods:
            file = self._run.folder.job(self.scene, method).prediction
            prediction = self._reader.had(f"no map of {printable(method, 80)}", partial(read_prediction, file))
            if prediction is not None:
                n = 0 if isinstance(prediction, DenseFeatures) else n_predictions(prediction)
                first = [0] * n
                if isinstance(prediction, Instances):
                    first = [min(frames_of(prediction, k), default=0) for k in range(n)]
                maps[method] = self._owned(prediction, rules, truth), first
        return maps

    def _owned(self, prediction: Prediction, rules: ProtocolRules | None, truth: GroundTruth | None) -> Owned:
        cloud = thinned(prediction.points, MAX_POINTS)
        instance = point_owners(prediction, cloud.rows).astype(np.int64)
        is_dense = isinstance(prediction, DenseFeatures)
        label: Int64Array = np.full(len(cloud.rows), -1, np.int64)
        labels: tuple[str, ...] = ()
        if rules is not None:
            of_truth = None if truth is None else class_index_of_ids(rules, truth.semantic)
            classes = self._reader.had(
                "no classes", lambda: shown_classes(self._run, rules, prediction, of_truth, cloud, self._spaces)
            )
            if classes is not None:
                labels = tuple(entry.name for entry in rules.classes)
                label = classes if is_dense else np.append(classes, -1)[instance]
        return Owned(cloud, instance, label, names_of(prediction), _corners_of(prediction), labels)

    def _curves(self, method: str) -> dict[int, dict[str, float]]:
        """Frame -> curve -> value, from the update records of a method."""
        file = self._run.folder.job(self.scene, method).updates
        columns = self._reader.had(f"no growth of {printable(method, 80)}", lambda: read_updates(file, file.name)) or {}
        known = {column: curve for column, curve in COLUMNS.items() if column in columns}
        frames = columns.get("frame", ())
        return {
            int(frame): {curve: float(columns[column][row]) for column, curve in known.items()}
            for row, frame in enumerate(frames)
        }

    def _about(self) -> str:
        lines = [
            f"{printable(self.scene, 200)}, {self._run.name}: {', '.join(printable(m, 80) for m in self._methods)}",
            f"{counted(self.n_frames, 'frame')} shown, images at most {MAX_WIDTH} pixels wide, colour as JPEG, depth "
            f"in millimetres; at most {MAX_POINTS:,} points per map and of the ground truth.",
            "The maps are the final maps. A point appears when the camera first saw it, but not before its instance "
            "was first seen; points that no frame shows appear with the last frame. The curves show the size of the "
            "method's map after each update.",
            f"The ceiling and what hangs from it are separate entities, called '{TOP}', which are hidden initially.",
            "Masks are the map's instances seen from the camera: each pixel has the instance of the nearest map point.",
            *self.remarks,
        ]
        return "\n\n".join(lines)


def ids_of(rows: Int64Array) -> UInt16Array:
    """Ids of rows: row 0 is 1; 0 for no row, and for rows that do not fit into 16 bits.

    >>> ids_of(np.array([0, 2, -1, 65535])).tolist()
    [1, 3, 0, 0]
    """
    return np.where((rows >= 0) & (rows < MAX_IDS - 1), rows + 1, 0).astype(np.uint16)


def smaller(frame: Frame, width: int) -> Frame:
    """A frame at most ``width`` pixels wide; wider ones are downscaled, depth by nearest pixel."""
    import cv2

    height, full = frame.depth_m.shape
    if full <= width:
        return frame
    size = width, max(1, round(width * height / full))
    scale = np.diag([size[0] / full, size[1] / height, 1.0])
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # integer coordinates are pixel centres
    intrinsics: Float64Array = np.linalg.inv(half) @ scale @ half @ frame.intrinsics
    return replace(
        frame,
        rgb=np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA), np.uint8),
        depth_m=np.asarray(cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST), np.float32),
        intrinsics=intrinsics,
    )


def owned_of_truth(rules: ProtocolRules, truth: GroundTruth) -> Owned:
    """The ground truth as a map: its instances, named by their classes, and the classes of ``rules``."""
    cloud = thinned(truth.points, MAX_POINTS)
    own, first, instance = np.unique(truth.instance, return_index=True, return_inverse=True)
    place = np.cumsum(own > 0) - 1
    place[own <= 0] = -1
    name_of = dict(zip(truth.labels.ids, truth.labels.names, strict=True))
    names = tuple(name_of.get(int(truth.semantic[row]), "") for row in first[own > 0])
    instance = place[instance.reshape(-1)]
    return Owned(
        cloud,
        instance[cloud.rows],
        class_index_of_ids(rules, truth.semantic[cloud.rows]),
        names,
        _corners(truth.points, instance, len(names)),
        tuple(entry.name for entry in rules.classes),
    )


def _corners(points: Float32Array, owner: Int64Array, n: int) -> Float32Array:
    """Lowest and highest corner (n, 2, 3) of the points of each of ``n`` owners; each must have points."""
    low, high = np.full((n + 1, 3), np.inf, np.float32), np.full((n + 1, 3), -np.inf, np.float32)
    np.minimum.at(low, owner, points)
    np.maximum.at(high, owner, points)
    return np.stack([low, high], axis=1)[:-1]


def _corners_of(prediction: Prediction) -> Float32Array:
    if isinstance(prediction, DenseFeatures):
        return np.zeros((0, 2, 3), np.float32)
    if isinstance(prediction, Instances):
        return prediction.boxes
    n = n_predictions(prediction)
    return np.nan_to_num(_corners(prediction.points, prediction.instance.astype(np.int64), n), posinf=0, neginf=0)


def check_not_empty(timelines: Sequence[SceneTimeline], where: str) -> None:
    """Raise a ``StoreError`` if no frame and no map could be shown."""
    if not any(one.n_frames or one.n_maps for one in timelines):
        why = next((line for one in timelines for line in one.remarks), "it has neither frames nor maps")
        raise StoreError(f"{where}: nothing to show: {why}")
