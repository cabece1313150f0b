"""Frames, masks, maps and truth of a scene of a run as they came one after another, on one timeline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from su3d_bench.analysis.page.maps import Spaces, shown_classes, shown_rules
from su3d_bench.analysis.page.scene import SceneData, SceneReader, fed_frames, frames_of
from su3d_bench.core.errors import StoreError, counted, printable
from su3d_bench.core.geometry import back_project, valid_depth
from su3d_bench.core.interfaces import HasSketches
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Frame, GroundTruth, Int64Array
from su3d_bench.metrics.matching.labelling import class_index_of_ids
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.metric import n_predictions
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.reports.page.maps import Cloud, point_owners, thinned
from su3d_bench.reports.pictures.canvas import (
    CUT_BELOW_TOP_M,
    ROOM_HEIGHT_M,
    Colour,
    class_colours,
    instance_colours,
    room_bounds,
)
from su3d_bench.reports.pictures.scene import evenly
from su3d_bench.reports.timeline import (
    BOXES,
    CLASSES,
    CURVES,
    GROWTH,
    INSTANCES,
    MAP,
    MASKS,
    ROOM,
    TOP,
    TRUE_MASKS,
    TRUTH,
    Name,
    Recording,
    UInt16Array,
)
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.records import read_updates

MOST_FRAMES = 60  # of a scene, unless a stride is given
MOST_WIDTH = 480  # pixels of an image; wider ones are made smaller
MOST_POINTS = 60_000  # of a map, and of the truth
NEAR_SPACINGS = 3.0  # a pixel is the instance's whose point lies within so many spacings of the points
EVERY_PIXEL = 2  # of both axes is asked whose it is
SEEN_M = 0.05  # between a point and what the camera saw there
MOST_IDS = 0xFFFF  # rerun's ids have 16 bits, of which 0 says nobody's
COLUMNS = dict(zip(("n_instances", "n_points", "total_ms"), CURVES, strict=True))  # of updates, and their curves
Tell = Callable[[int, int], None]


@dataclass(frozen=True)
class Owned:
    """Points that are drawn and whose each is: (n,) of ``instance`` and ``label``, -1 for nobody's.

    ``names`` and ``corners`` (k, 2, 3) m are those of the instances, ``labels`` those of the classes.
    """

    cloud: Cloud
    instance: Int64Array
    label: Int64Array
    names: tuple[str, ...]
    corners: Float32Array
    labels: tuple[str, ...]

    @property
    def colours(self) -> list[Colour]:
        return instance_colours(self.names)

    @cached_property
    def near_m(self) -> float:
        return NEAR_SPACINGS * self.cloud.spacing_m

    def named(self) -> list[tuple[str, Sequence[Name], Int64Array]]:
        """Of instances and of classes: the place, what its ids mean, and whose each point is."""
        tints = class_colours(self.labels)
        instances = [(k + 1, f"{name or 'without a name'} #{k}", self.colours[k]) for k, name in enumerate(self.names)]
        classes = [(k + 1, name, tints[name]) for k, name in enumerate(self.labels)]
        return [
            (INSTANCES, instances[: MOST_IDS - 1], self.instance),
            (CLASSES, classes[: MOST_IDS - 1], self.label),
        ]

    def log_names(self, recording: Recording, place: tuple[str, ...], masks: tuple[str, ...]) -> None:
        """What ids mean below ``place`` of the map and at ``masks``."""
        for kind, names, _ in self.named():
            recording.names((*place, kind), names, is_nobody_seen=True)
        recording.names(masks, self.named()[0][1], is_nobody_seen=False)

    def masks(self, frame: Frame) -> UInt16Array:
        """Whose each pixel of ``frame`` is: the instance's whose point is nearest to what the camera saw there."""
        height, width = frame.depth_m.shape
        is_asked = np.zeros((height, width), np.bool_)
        is_asked[::EVERY_PIXEL, ::EVERY_PIXEL] = True
        is_asked &= valid_depth(frame.depth_m, 0.0, np.inf)
        places = back_project(frame.depth_m, frame.intrinsics, frame.camera_to_world, is_asked)
        _, row = nearest(self.cloud.points, places, self.near_m)
        ids = np.zeros((height, width), np.uint16)
        ids[is_asked] = ids_of(np.where(row >= 0, np.append(self.instance, -1)[row], -1))
        few = ids[::EVERY_PIXEL, ::EVERY_PIXEL]
        return few.repeat(EVERY_PIXEL, axis=0).repeat(EVERY_PIXEL, axis=1)[:height, :width]

    def log_all(self, recording: Recording, place: tuple[str, ...]) -> None:
        """All of it at once."""
        everything = np.ones(len(self.instance), np.bool_)
        self.log_points(recording, place, everything, "all")
        self.log_boxes(recording, place, np.ones(len(self.names), np.bool_))

    @cached_property
    def is_top(self) -> BoolArray:
        """Which points are of the ceiling or hang from it, as in the pictures, which look into the room from above."""
        if not len(self.cloud.points):
            return np.zeros(0, np.bool_)
        low, high = room_bounds(self.cloud.points)[:, 2]
        cut = CUT_BELOW_TOP_M if high - low >= ROOM_HEIGHT_M else 0.0
        is_top: BoolArray = self.cloud.points[:, 2] > high - cut
        return is_top

    def log_points(self, recording: Recording, place: tuple[str, ...], shown: BoolArray, own: str) -> None:
        """The points that are ``shown``, in places called ``own``, so that those logged before stay."""
        for kind, _, owner in self.named():
            for part, is_there in ((ROOM, shown & ~self.is_top), (TOP, shown & self.is_top)):
                if is_there.any():
                    where = (*place, kind, part, own)
                    recording.points(
                        where, self.cloud.points[is_there], ids_of(owner[is_there]), self.cloud.spacing_m / 2
                    )

    def log_boxes(self, recording: Recording, place: tuple[str, ...], shown: BoolArray) -> None:
        rows = np.flatnonzero(shown)
        labels, tints = [self.names[k] for k in rows], [self.colours[k] for k in rows]
        recording.boxes((*place, BOXES), self.corners[rows], labels, tints)


class Growth:
    """A finished map as it came into the camera's view: what was seen by then of the instances that were known."""

    def __init__(self, recording: Recording, place: tuple[str, ...], owned: Owned, first_frame: Sequence[int]) -> None:
        self._recording, self._place, self._owned = recording, place, owned
        self._first_frame = np.append(np.array(first_frame, np.int64), 0)  # the last one: nobody's
        self._is_seen = np.zeros(len(owned.cloud.points), np.bool_)
        self._is_out = self._is_seen.copy()
        self._own = "all"

    def step(self, frame: Frame) -> None:
        """What ``frame`` adds to the map."""
        self._own = f"from frame {frame.index:06}"
        self._is_seen |= in_view(self._owned.cloud.points, frame)
        is_known = self._first_frame[self._owned.instance] <= frame.index
        self._show(self._is_seen & is_known)

    def end(self) -> None:
        """What no frame showed, so that the whole map stands at the end."""
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
    """What is shown of a scene of a run; ``remarks``: what is not, known once it was written."""

    def __init__(self, run: FinishedRun, scene: str, methods: Sequence[str], stride: int, spaces: Spaces) -> None:
        self._run, self.scene, self._methods, self._stride = run, scene, methods, stride
        self._spaces = spaces
        self._reader = SceneReader(run, scene, SceneData(scene))
        self.remarks = self._reader.remarks
        self.n_frames = self.n_maps = 0

    def write(self, recording: Recording, tell: Tell = lambda n_done, n: None) -> None:
        """All of it into ``recording`` in the order of time; ``tell`` hears how many frames are done."""
        frames = self._frames()
        rules = shown_rules(self._run)
        truth = None if rules is None else self._reader.truth(rules)
        shown_truth = None if truth is None or rules is None else owned_of_truth(rules, truth)
        maps = self._maps(rules, truth)
        self.n_maps = len(maps)
        if shown_truth is not None:
            shown_truth.log_names(recording, TRUTH, TRUE_MASKS)
            shown_truth.log_all(recording, TRUTH)
        for method, (owned, _) in maps.items():
            owned.log_names(recording, (*MAP, method), (*MASKS, method))
        growing = {method: Growth(recording, (*MAP, method), owned, first) for method, (owned, first) in maps.items()}
        curves = {method: self._curves(method) for method in maps}
        first_s = None
        for done, index in enumerate(frames):
            tell(done, len(frames))
            frame = self._frame(index)
            if frame is None:
                continue
            first_s = frame.timestamp_s if first_s is None else first_s
            self.n_frames += 1
            recording.at(frame.index, frame.timestamp_s - first_s)
            recording.photo(frame)
            if shown_truth is not None:
                recording.masks(TRUE_MASKS, shown_truth.masks(frame))
            for method, growth in growing.items():
                if maps[method][0].names:
                    recording.masks((*MASKS, method), maps[method][0].masks(frame))
                growth.step(frame)
                for curve, value in curves[method].get(index, {}).items():
                    recording.number((*GROWTH, curve, method), value)
        for growth in growing.values():
            growth.end()
        recording.close(self._about())

    def _frames(self) -> list[int]:
        """The frames that are shown: of those that the methods were given, else of all."""
        fed = {index for method in self._methods for index in fed_frames(self._run, self.scene, method)}
        n_frames = len(self._reader.sequence)
        there = sorted(index for index in fed if 0 <= index < n_frames) or range(n_frames)
        if self._stride:
            return list(there[:: self._stride])
        return [there[place] for place in evenly(len(there), MOST_FRAMES)] if len(there) else []

    def _frame(self, index: int) -> Frame | None:
        name = self.scene.partition("/")[2]

        def read() -> Frame:
            if isinstance(self._reader.dataset, HasSketches):
                return self._reader.dataset.sketch(name, index, MOST_WIDTH)
            return smaller(self._reader.sequence[index], MOST_WIDTH)

        frame: Frame | None = self._reader.had("a frame is left out", read)
        return frame

    def _maps(self, rules: ProtocolRules | None, truth: GroundTruth | None) -> dict[str, tuple[Owned, Sequence[int]]]:
        """Each method's map, and the first frame in which each of its instances was seen, 0 where nobody knows."""
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
        cloud = thinned(prediction.points, MOST_POINTS)
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
        return Owned(cloud, instance, label, _names_of(prediction), _corners_of(prediction), labels)

    def _curves(self, method: str) -> dict[int, dict[str, float]]:
        """Frame -> curve -> value, of what the updates of a method say."""
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
            f"{counted(self.n_frames, 'frame')} shown, images at most {MOST_WIDTH} pixels wide, colour as JPEG, depth "
            f"in millimetres; of each map and of the truth at most {MOST_POINTS:,} points.",
            "The maps are the finished ones. A point stands from the frame on in which the camera saw it, and not "
            "before its instance was seen first; what no frame shows comes with the last. The curves are what the "
            "method's map held after each update.",
            f"The ceiling and what hangs from it stand in places of their own, called '{TOP}', which are not shown at "
            "first.",
            "Masks are the map's instances seen from the camera: a pixel is that of the nearest point.",
            *self.remarks,
        ]
        return "\n\n".join(lines)


def ids_of(rows: Int64Array) -> UInt16Array:
    """Ids of rows: row 0 is 1; 0 for no row, and for rows beyond what 16 bits can tell.

    >>> ids_of(np.array([0, 2, -1, 65535])).tolist()
    [1, 3, 0, 0]
    """
    return np.where((rows >= 0) & (rows < MOST_IDS - 1), rows + 1, 0).astype(np.uint16)


def in_view(points: Float32Array, frame: Frame) -> BoolArray:
    """Which of ``points`` (n,) the camera sees: in its image, and no farther than what it measured there."""
    height, width = frame.depth_m.shape
    relative = (points.astype(np.float64) - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, :3]
    rows = np.flatnonzero(relative[:, 2] > 0)
    pixels = relative[rows] @ frame.intrinsics.T
    places = np.rint(pixels[:, :2] / pixels[:, 2:])
    is_inside = ((places >= 0) & (places < (width, height))).all(axis=1)
    rows, column_row = rows[is_inside], places[is_inside].astype(np.int64)
    measured = frame.depth_m[column_row[:, 1], column_row[:, 0]]
    seen = np.zeros(len(points), np.bool_)
    seen[rows] = np.abs(relative[rows, 2] - measured) < SEEN_M
    return seen


def smaller(frame: Frame, width: int) -> Frame:
    """A frame at most ``width`` pixels wide; one that is wider is made smaller, depth by the nearest pixel."""
    import cv2

    height, full = frame.depth_m.shape
    if full <= width:
        return frame
    size = width, max(1, round(width * height / full))
    scale = np.diag([size[0] / full, size[1] / height, 1.0])
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # whole numbers are the middles of pixels
    intrinsics: Float64Array = np.linalg.inv(half) @ scale @ half @ frame.intrinsics
    return replace(
        frame,
        rgb=np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA), np.uint8),
        depth_m=np.asarray(cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST), np.float32),
        intrinsics=intrinsics,
    )


def owned_of_truth(rules: ProtocolRules, truth: GroundTruth) -> Owned:
    """The truth as a map: its instances, named by their classes, and the classes of ``rules``."""
    cloud = thinned(truth.points, MOST_POINTS)
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
    """Lowest and highest corner (n, 2, 3) of the points of each of ``n`` owners, who all have some."""
    low, high = np.full((n + 1, 3), np.inf, np.float32), np.full((n + 1, 3), -np.inf, np.float32)
    np.minimum.at(low, owner, points)
    np.maximum.at(high, owner, points)
    return np.stack([low, high], axis=1)[:-1]


def _names_of(prediction: Prediction) -> tuple[str, ...]:
    if isinstance(prediction, DenseFeatures):
        return ()
    if not isinstance(prediction, Instances):
        return ("",) * n_predictions(prediction)
    labels = prediction.labels or prediction.names
    return tuple(label or name for label, name in zip(labels, prediction.names, strict=True))


def _corners_of(prediction: Prediction) -> Float32Array:
    if isinstance(prediction, DenseFeatures):
        return np.zeros((0, 2, 3), np.float32)
    if isinstance(prediction, Instances):
        return prediction.boxes
    n = n_predictions(prediction)
    return np.nan_to_num(_corners(prediction.points, prediction.instance.astype(np.int64), n), posinf=0, neginf=0)


def refuse_nothing(timelines: Sequence[SceneTimeline], where: str) -> None:
    """A ``StoreError`` where no frame and no map could be shown."""
    if not any(one.n_frames or one.n_maps for one in timelines):
        why = next((line for one in timelines for line in one.remarks), "it has neither frames nor maps")
        raise StoreError(f"{where}: there is nothing to show: {why}")
