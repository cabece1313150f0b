"""Feed a method frame by frame, write down its map, and note what each update and each map cost."""

from __future__ import annotations

import csv
import io
import time
from pathlib import Path

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.interfaces import Method
from su3d_bench.core.timing import Timer, calibration_ms, memory_bytes
from su3d_bench.core.types import Detections, Frame
from su3d_bench.perception.profiles import Perception
from su3d_bench.runs.executors.local import Event, Report
from su3d_bench.runs.read_ahead import ReadAhead
from su3d_bench.runs.scene_tools import no_detections
from su3d_bench.store.run_folder import write_prediction

Row = dict[str, float | int]
CALIBRATE_EVERY = 4  # about 5 ms each: a hundredth of the time of the updates
# What a method may say of its size after an update.
SIZES = ("n_points", "n_instances", "map_bytes")


class Feeding:
    """One method on one scene: ``maps`` holds, for each map written, the updates before it and what it took."""

    def __init__(self, scene: str, method: Method, perception: Perception, report: Report) -> None:
        self.maps: list[dict[str, float | int]] = []
        self._scene = scene
        self._method = method
        self._perception = perception
        self._report = report
        self._timer = Timer()
        self._rows: list[Row] = []
        self._calibrations: list[float] = []

    @property
    def calibration_ms(self) -> float | None:
        """The median time of the calibrating piece of work between the updates; None where there was none."""
        return round(float(np.median(self._calibrations)), 4) if self._calibrations else None

    def up_to(self, n_fed: int, frames: ReadAhead[Frame], n_frames: int) -> None:
        """Feed the frames that are missing to ``n_fed``; ``n_frames`` are all that will come.

        Stage ``decode`` is what an update waited for its frame.
        """
        if not self._rows and n_frames:
            self._report(Event(self._scene, self._method.name, 0, n_frames))
        for update in range(len(self._rows), n_fed):
            if update % CALIBRATE_EVERY == 0:
                self._calibrations.append(calibration_ms())
            row = self._feed(update, frames)
            self._rows.append(row)
            size = row.get("n_instances")
            self._report(
                Event(self._scene, self._method.name, update + 1, n_frames, None if size is None else int(size))
            )

    def _feed(self, update: int, frames: ReadAhead[Frame]) -> Row:
        timer, method = self._timer, self._method
        start = time.perf_counter()
        with timer.stage("decode"):
            frame = frames.next_frame()
        if not (frame.depth_m > 0).any():
            raise DataError(f"{self._scene} frame {frame.index}: depth is empty, no pixel is above 0 m")
        detections = self._detect(frame)
        method.update(frame, detections, timer)
        total_ms = (time.perf_counter() - start) * 1e3
        row: Row = {"update": update, "frame": frame.index, "n_detections": len(detections)}
        row |= {name: int(getattr(method, name)) for name in SIZES if hasattr(method, name)}
        row |= {"rss_bytes": memory_bytes()}
        row |= {f"{name}_ms": round(ms, 3) for name, ms in timer.take().items()}
        return row | {"total_ms": round(total_ms, 3)}

    def _detect(self, frame: Frame) -> Detections:
        needs = self._method.needs
        return (
            no_detections(frame, needs) if needs.masks == "none" else self._perception.detect(frame, needs, self._timer)
        )

    def write_map(self, path: Path) -> None:
        """Write the method's map so far."""
        start = time.perf_counter()
        prediction = self._method.finish()
        elapsed_ms = (time.perf_counter() - start) * 1e3
        write_prediction(path, prediction)
        costs: dict[str, float | int] = dict(getattr(self._method, "finish_costs", {}))
        self.maps.append({"n_updates": len(self._rows), "finish_ms": round(elapsed_ms, 3)} | costs)

    def csv_text(self) -> str:
        """The table of the updates, one row each; a stage that an update lacks is 0."""
        columns = list(dict.fromkeys(name for row in self._rows for name in row if name != "total_ms"))
        text = io.StringIO()
        fields = [*columns, "total_ms"] if self._rows else ["update"]
        writer = csv.DictWriter(text, fields, restval=0, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        return text.getvalue()
