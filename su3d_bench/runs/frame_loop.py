"""Feed a method frame by frame, write its map, and record the cost of each update and each map."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

import numpy as np

from su3d_bench.core import interfaces, types
from su3d_bench.core.errors import DataError
from su3d_bench.core.geometry import back_project
from su3d_bench.core.maps import Proposals, starts_of
from su3d_bench.core.safe_output import one_line, plain_text
from su3d_bench.core.system.timing import MethodClock, Timer, calibration_ms, memory_bytes
from su3d_bench.perception.profiles import Perception
from su3d_bench.runs.executors import Event, Report
from su3d_bench.runs.plugins import attribute_of
from su3d_bench.store.predictions import features_beside, write_prediction
from su3d_bench.store.records import updates_text


@dataclass(frozen=True)
class ChosenFrames(Sequence[types.Frame]):
    """The ``frames`` at ``places``, read from disk at every access."""

    frames: Sequence[types.Frame]
    places: Sequence[int]

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: Any) -> Any:
        places = self.places[index]
        return self.frames[places] if isinstance(places, int) else [self.frames[place] for place in places]


class TimedRegions:
    """Perception on demand, timed separately from the method that calls it."""

    def __init__(self, regions: interfaces.RegionPerception, clock: MethodClock) -> None:
        self._regions = regions
        self._clock = clock

    @property
    def dim(self) -> int:
        return self._regions.dim

    def mask_at(self, frame: types.Frame, points: types.Int64Array) -> tuple[types.BoolArray, float]:
        with self._clock.perception():
            return self._regions.mask_at(frame, points)

    def encode_regions(self, frame: types.Frame, mask: types.BoolArray, boxes: types.Int64Array) -> types.Float32Array:
        with self._clock.perception():
            return self._regions.encode_regions(frame, mask, boxes)


def no_detections(frame: types.Frame, needs: types.PerceptionNeeds) -> types.Detections:
    """The detections for a method that needs no masks."""
    return _detections(frame, needs, n=0, dim=0)


def detections_of(
    frame: types.Frame, needs: types.PerceptionNeeds, perception: Perception, timer: Timer
) -> types.Detections:
    """The detections that a method with these ``needs`` gets with ``frame``."""
    return no_detections(frame, needs) if needs.masks == "none" else perception.detect(frame, needs, timer)


def _detections(frame: types.Frame, needs: types.PerceptionNeeds, n: int, dim: int) -> types.Detections:
    """``n`` detections without a name, each of the whole image."""
    return types.Detections(
        frame_index=frame.index,
        masks=np.ones((n, *frame.depth_m.shape), np.bool_),
        boxes=np.zeros((n, 4), np.float32),
        scores=np.ones(n, np.float32),
        names=("",) * n,
        captions=("",) * n,
        crop_ratios=needs.crop_ratios,
        crop_features=np.ones((n, len(needs.crop_ratios), dim), np.float32),
        global_feature=np.ones(dim, np.float32),
        name_features=np.ones((n, dim), np.float32) if n and needs.name_features else None,
    )


def warm_up(method: interfaces.Method) -> None:
    """Feed a synthetic frame to the disposable ``method``, so that no timed step waits for a compiler or an import."""
    size = 32
    depth_m = 1 + np.linspace(0, 0.5, size * size, dtype=np.float32).reshape(size, size) ** 2
    intrinsics = np.array([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]])
    frame = types.Frame(0, 0.0, np.zeros((size, size, 3), np.uint8), depth_m, np.eye(4), intrinsics)
    detections = _detections(frame, method.needs, n=1, dim=1)
    points = back_project(depth_m, intrinsics, np.eye(4), depth_m > 0).astype(np.float32)
    surface = types.Surface(points, np.zeros((0, 3), np.int32))
    scene = types.SceneInfo("made-up", "made-up", N_WARM_UP, 1, "camera", read_surface=lambda: surface)
    method.start(scene)
    for _ in range(N_WARM_UP):
        method.update(frame, detections, Timer())
    method.finish()
    if isinstance(method, interfaces.Closable):
        method.close()


def true_proposals(truth: types.GroundTruth) -> Proposals:
    """Every annotated instance of ``truth`` as a class-agnostic mask, in the order of the instance ids."""
    order = np.argsort(truth.instance, kind="stable").astype(np.int32)
    order = order[truth.instance[order] > 0]
    sizes = np.unique(truth.instance[order], return_counts=True)[1]
    ones = np.ones(len(sizes))
    return Proposals(starts_of(sizes), order, points=truth.points, scores=ones, source="ground truth")


Read = TypeVar("Read")
N_THREADS = 2
N_AHEAD = 2  # frames in memory besides the one in use


class ReadAhead(Generic[Read]):
    """The first ``n`` of ``frames`` in order, at most ``n_ahead`` of them read before they are requested.

    An error of reading a frame is raised when that frame is requested, not before. The first frame is read alone, so
    that a dataset initialises only once. Leaving the block, at any frame, ends the threads after waiting for reads in
    progress. ``n_ahead`` 0: each frame is read when it is requested.
    """

    def __init__(self, frames: Sequence[Read], n: int, *, n_threads: int = N_THREADS, n_ahead: int = N_AHEAD) -> None:
        self._frames, self._n = frames, n
        self._n_ahead = n_ahead
        self._n_begun = 0
        self._reading: deque[Future[Read]] = deque()
        self._threads = ThreadPoolExecutor(n_threads, thread_name_prefix="read-ahead")

    def __enter__(self) -> Self:
        self._begin_up_to(min(1, self._n_ahead))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._threads.shutdown(cancel_futures=True)
        self._reading.clear()

    def next_frame(self) -> Read:
        """The next frame."""
        self._begin_up_to(1)
        frame = self._reading.popleft().result()
        self._begin_up_to(self._n_ahead)
        return frame

    def _begin_up_to(self, n_waiting: int) -> None:
        while self._n_begun < self._n and len(self._reading) < n_waiting:
            self._reading.append(self._threads.submit(self._frames.__getitem__, self._n_begun))
            self._n_begun += 1


Row = dict[str, float | int]
N_WARM_UP = 3  # by default an object must be seen this often to be in a map
CALIBRATE_EVERY = 4  # about 5 ms each: one percent of the time of the updates
# Sizes that a method may report after an update.
SIZES = ("n_points", "n_instances", "map_bytes")


class MethodFeed:
    """One method on one scene; ``maps`` has, for each map written, the number of updates before it and its cost.

    ``skips_empty``: a frame without depth is no error but an update without effect, as when a corruption took it all.
    """

    def __init__(
        self, scene: str, method: interfaces.Method, perception: Perception, report: Report, clock: MethodClock,
        *, skips_empty: bool = False,
    ) -> None:  # fmt: skip
        self.maps: list[dict[str, float | int]] = []
        self._clock = clock
        self._scene = scene
        self._method = method
        self._perception = perception
        self._report = report
        self._skips_empty = skips_empty
        self._timer = Timer()
        self._rows: list[Row] = []
        self._processing_ms = 0.0
        self._calibrations: list[float] = []

    @property
    def calibration_ms(self) -> float | None:
        """The median time of the calibration task between updates; None if it was not run."""
        return round(float(np.median(self._calibrations)), 4) if self._calibrations else None

    def feed_until(self, n_fed: int, frames: ReadAhead[types.Frame], n_frames: int) -> None:
        """Feed frames until ``n_fed`` are fed; ``n_frames`` is the total number that will be fed.

        Stage ``decode`` is the time that an update waited for its frame.
        """
        if not self._rows and n_frames:
            self._report(Event(self._scene, self._method.name, 0, n_frames))
        for update in range(len(self._rows), n_fed):
            if update % CALIBRATE_EVERY == 0:
                self._calibrations.append(calibration_ms())
            row = self._feed(update, frames.next_frame)
            self._rows.append(row)
            size = row.get("n_instances")
            self._report(
                Event(self._scene, self._method.name, update + 1, n_frames, None if size is None else int(size))
            )

    def measured_ms(self, frames: Sequence[types.Frame], place: int) -> float:
        """Feed the frame at ``place``; the milliseconds of its perception and update, without those of reading it."""
        self._report(Event(self._scene, self._method.name, place, len(frames)))
        self._rows.append(self._feed(len(self._rows), partial(frames.__getitem__, place)))
        return self._processing_ms

    def _feed(self, update: int, read: Callable[[], types.Frame]) -> Row:
        timer, method = self._timer, self._method
        start = time.perf_counter()
        with timer.stage("decode"):
            frame = read()
        arrival = time.perf_counter()
        if not (frame.depth_m > 0).any():
            if not self._skips_empty:
                raise DataError(f"{self._scene} frame {frame.index}: depth is empty (no pixel is above 0 m)")
            timer.take()
            elapsed_ms, self._processing_ms = (time.perf_counter() - start) * 1e3, 0.0
            empty: Row = {"update": update, "frame": frame.index, "n_detections": 0, "rss_bytes": memory_bytes()}
            return empty | {"method_ms": 0.0, "total_ms": round(elapsed_ms, 3)}
        detections = detections_of(frame, method.needs, self._perception, timer)
        with self._clock.running("update"):
            method.update(frame, detections, timer)
        end = time.perf_counter()
        total_ms, self._processing_ms = (end - start) * 1e3, (end - arrival) * 1e3
        own: Row = {"update": update, "frame": frame.index, "n_detections": len(detections)}
        of_method: Row = {name: int(attribute_of(method, name)) for name in SIZES if hasattr(method, name)}
        of_method |= attribute_of(method, "losses", {})
        of_method |= {"rss_bytes": memory_bytes()}
        of_method |= {f"{name}_ms": round(ms, 3) for name, ms in timer.take().items()}
        # Values measured here take precedence over values of the method with the same name.
        own |= {key: value for key, value in of_method.items() if key not in own}
        return own | {"method_ms": round(self._clock.take("update").method_ms, 3), "total_ms": round(total_ms, 3)}

    def write_map(self, path: Path) -> None:
        """Write the method's map so far."""
        with self._clock.running("finish"):
            prediction = self._method.finish()
        spent = self._clock.take("finish")
        write_prediction(path, prediction)
        costs = attribute_of(self._method, "finish_costs", {})
        own = {"n_updates": len(self._rows), "finish_ms": spent.total_ms, "perception_ms": spent.perception_ms}
        own["n_bytes"] = sum(file.stat().st_size for file in (path, features_beside(path)) if file.is_file())
        self.maps.append({**own, **costs, **{name: round(value, 3) for name, value in own.items()}})

    def updates_text(self) -> str:
        """The table of the updates."""
        return updates_text(self._rows)


class SceneLog(logging.Handler):
    """Collects log messages of a scene: all ``lines`` for its log, ``warnings`` also for the record."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.warnings: list[str] = []

    def text(self, *last: str) -> str:
        return plain_text("\n".join([*self.lines, *last])) + "\n"

    def remarks(self) -> dict[str, list[str]]:
        """The part stored in a completion record, for a run that is resumed from there."""
        return {"log": self.lines, "warnings": list(dict.fromkeys(self.warnings))}

    def recall(self, remarks: Mapping[str, Any]) -> None:
        """Prepend the messages of an earlier process."""
        self.lines[:0] = remarks.get("log", [])
        self.warnings[:0] = remarks.get("warnings", [])

    def emit(self, record: logging.LogRecord) -> None:
        message = one_line(record.getMessage())
        self.lines.append(f"{record.levelname.lower()}: {message}")
        if record.levelno >= logging.WARNING:
            self.warnings.append(message)
