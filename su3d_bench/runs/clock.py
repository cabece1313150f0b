"""The clock of a real-time run: frames arrive at a fixed rate, and the method processes one frame at a time.

The rule is that of streaming perception (Li, Wang and Ramanan, ECCV 2020; ``det/srt_det.py`` of mtli/sAP, commit
0a45939): an update that starts at s and takes d finishes at s + d; a recording of n frames at R Hz ends at n / R, and
an update that is not finished before the end does not count. Nothing waits: times are computed from durations, in whole
nanoseconds, so that the same durations give the same schedule on every machine.
"""

from __future__ import annotations

import csv
import io
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from su3d_bench.core.errors import DataError, printable, reading, shown
from su3d_bench.core.registry import base_name
from su3d_bench.core.system.files import file_text, regular

Queue = Literal["newest", "drop-new", "drop-old"]
QUEUE_SIZE = 10  # of the queues that are not ``newest``, unless requested otherwise
MAX_RATE_HZ = 1e6
MAX_TIME_S = 1e7  # four months
MAX_FRAMES = 10_000_000
MAX_BYTES = 1 << 28  # about five million frames
MAX_COST_MS = 1e9
NS = 1_000_000_000
COLUMNS = ["frame", "arrived_s", "started_s", "finished_s", "dropped"]


@dataclass(frozen=True)
class FrameTimes:
    """When a frame arrived and when its update started and finished, in ns; None if it was dropped."""

    arrived_ns: int
    started_ns: int | None = None
    finished_ns: int | None = None


def frame_times(
    n_frames: int, rate_hz: float, queue: Queue, queue_size: int, cost_ms: Callable[[int], float]
) -> tuple[FrameTimes, ...]:
    """The times of every frame; ``cost_ms`` is called for each frame whose update starts, in order.

    While the method is busy, at most ``queue_size`` frames wait. If the queue is full, ``drop-new`` drops the frame
    that arrives and ``drop-old`` the one that has waited longest, as a subscriber in ROS does; ``newest`` is
    ``drop-old`` with one place. A frame that arrives when an update finishes arrives first. Frames that still wait at
    the end are dropped.

    >>> [times.finished_ns for times in frame_times(4, 10.0, "newest", 1, lambda frame: 150.0)]
    [150000000, 300000000, None, 450000000]
    """
    times = [FrameTimes(round(k * NS / rate_hz)) for k in range(n_frames)]
    end_ns = round(n_frames * NS / rate_hz)
    waiting: deque[int] = deque()
    n_arrived = now_ns = 0
    while now_ns < end_ns:
        while n_arrived < n_frames and times[n_arrived].arrived_ns <= now_ns:
            if len(waiting) < queue_size or queue != "drop-new":
                waiting.append(n_arrived)
            if len(waiting) > queue_size:
                waiting.popleft()
            n_arrived += 1
        if not waiting:
            now_ns = times[n_arrived].arrived_ns if n_arrived < n_frames else end_ns
            continue
        frame = waiting.popleft()
        finished_ns = now_ns + round(cost_ms(frame) * 1e6)
        times[frame] = FrameTimes(times[frame].arrived_ns, now_ns, finished_ns)
        now_ns = finished_ns
    return tuple(times)


Text = Annotated[str, Field(max_length=300)]


class Stream(BaseModel):
    """The frames that a schedule belongs to, and where its durations come from.

    ``stride``: frames of the recording per arriving frame; ``device``: the machine on which durations were measured;
    ``is_simulated``: they were drawn from a cost file.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    scene: Text
    method: Text
    rate_hz: float = Field(gt=0, le=MAX_RATE_HZ)
    stride: int = Field(ge=1)
    queue: Queue
    queue_size: int = Field(ge=1, le=MAX_FRAMES)
    device: Text
    is_simulated: bool

    def note(self, method: str) -> str:
        """The note shown with every number of ``method`` under this clock."""
        waiting = "the newest frame waits" if self.queue == "newest" else f"{self.queue}, queue of {self.queue_size}"
        source = f"{'simulated costs of' if self.is_simulated else 'measured on'} {self.device}"
        other = "" if method == self.method else f" with {self.method}"
        return f"real time at {self.rate_hz:g} Hz ({waiting}; {source}{other})"


@dataclass(frozen=True)
class Schedule:
    """The times of all frames that arrive; frames are numbered from 0 in the order of their arrival."""

    stream: Stream
    times: tuple[FrameTimes, ...]

    @property
    def end_ns(self) -> int:
        """The end of the recording."""
        return round(len(self.times) * NS / self.stream.rate_hz)

    @property
    def fed(self) -> tuple[int, ...]:
        """The frames whose updates count: those that are finished before the end."""
        return tuple(frame for frame, _ in self._finished())

    @property
    def fed_ms(self) -> list[float]:
        """The duration of each update that counts."""
        return [(ns - (self.times[frame].started_ns or 0)) / 1e6 for frame, ns in self._finished()]

    def n_fed_by(self, share: float) -> int:
        """The number of updates that are finished when a fraction ``share`` of the recording has been shown."""
        return sum(finished_ns <= round(share * self.end_ns) for _, finished_ns in self._finished())

    def _finished(self) -> list[tuple[int, int]]:
        done = [(frame, times.finished_ns) for frame, times in enumerate(self.times)]
        return [(frame, ns) for frame, ns in done if ns is not None and ns < self.end_ns]

    def numbers(self) -> dict[str, Any]:
        """The fields of ``RealTimeRecord``."""
        finished = self._finished()
        latencies = [finished_ns - self.times[frame].arrived_ns for frame, finished_ns in finished]
        return {
            **self.stream.model_dump(include={"rate_hz", "queue", "queue_size", "device", "is_simulated"}),
            "n_frames": len(self.times),
            "n_processed": len(finished),
            "n_dropped": sum(times.started_ns is None for times in self.times),
            "latency_ms": round(sum(latencies) / len(latencies) / 1e6, 3) if latencies else None,
        }

    def text(self) -> str:
        """The schedule as CSV, after a line with the stream; ``read_schedule`` reads it."""
        text = io.StringIO()
        text.write(f"# {self.stream.model_dump_json()}\n")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        for frame, times in enumerate(self.times):
            ends = [times.arrived_ns, times.started_ns, times.finished_ns]
            seconds = ["" if ns is None else f"{ns // NS}.{ns % NS:09d}" for ns in ends]
            writer.writerow([frame, *seconds, int(times.started_ns is None)])
        return text.getvalue()


def read_schedule(file: Path) -> Schedule:
    """The schedule in ``file``; a ``DataError`` that names the line if it is not one."""
    lines = [*_lines(file), "", ""]
    number, free_ns = 1, 0
    times: list[FrameTimes] = []
    try:
        stream = Stream.model_validate_json(lines[0].removeprefix("# "))
        number = 2
        if lines[1] != ",".join(COLUMNS) or not lines[2]:
            raise ValueError(f"expected the columns {','.join(COLUMNS)} and one row per frame")
        for line in lines[2:-2]:
            number += 1
            times.append(_frame_times(line, len(times), times[-1].arrived_ns if times else 0, free_ns))
            free_ns = times[-1].finished_ns or free_ns
    except ValueError as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else None
        what = f"is not a schedule: {'.'.join(map(str, first['loc']))}: {first['msg']}" if first else str(error)
        raise DataError(f"{shown(file)}:{number}: {printable(what, 200)}") from error
    return Schedule(stream, tuple(times))


def _frame_times(line: str, frame: int, arrived_before_ns: int, free_ns: int) -> FrameTimes:
    """The times in a row; ``free_ns``: the end of the previous update. A ``ValueError`` if it is invalid."""
    values = line.split(",")
    if len(values) != len(COLUMNS) or values[0] != str(frame):
        raise ValueError(f"expected frame {frame}: every frame that arrives has one row of {len(COLUMNS)} values")
    arrived, started, finished = (round(_limited(one, MAX_TIME_S) * NS) if one else None for one in values[1:4])
    if values[4] not in ("0", "1") or not (started is None) == (finished is None) == (values[4] == "1"):
        raise ValueError("expected started_s, finished_s and 0, or neither and 1 if the frame was dropped")
    known = [ns for ns in (arrived, started, finished) if ns is not None]
    is_overlapping = started is not None and started < free_ns
    if arrived is None or arrived < arrived_before_ns or is_overlapping or known != sorted(known):
        raise ValueError("times are not in order: an update starts after its frame arrived and the previous one ended")
    return FrameTimes(arrived, started, finished)


def _limited(text: str, most: float) -> float:
    value = float(text)
    if not 0 <= value <= most:
        raise ValueError(f"'{text}' is not a number from 0 to {most:g}")
    return value


def _lines(file: Path) -> list[str]:
    """The lines of a text file; a ``DataError`` if it cannot be read or is larger than any file of this kind."""
    with reading(shown(file), DataError):
        if regular(file).stat().st_size > MAX_BYTES:
            raise DataError(f"{shown(file)}: has more than {MAX_BYTES} bytes")
        try:
            return file_text(file).splitlines()
        except UnicodeDecodeError as error:
            raise DataError(f"{shown(file)}: is not a UTF-8 text file") from error


def read_costs(file: Path, method: str, seed: list[int]) -> tuple[str, Callable[[int], float]]:
    """The device of a cost file, and a function that draws the duration in ms of an update with its perception.

    A cost file is a CSV file with the columns ``device`` and ``duration_ms``, of which rows are drawn with replacement,
    or ``device``, ``mean_ms`` and ``sd_ms`` with one row, of which a gamma distribution has the mean and the standard
    deviation. A column ``method`` restricts a row to that method. Other columns are ignored.
    """
    import numpy as np

    generator = np.random.default_rng(seed)
    names = method, base_name(method)
    try:
        rows = [row for row in csv.DictReader(_lines(file)) if row.get("method", method) in names]
        (device,) = {printable(row["device"] or "", 300) for row in rows}
        if not device:
            raise ValueError("device is empty")
        if "duration_ms" in rows[0]:
            samples = [_limited(row["duration_ms"], MAX_COST_MS) for row in rows]
            return device, lambda frame: samples[int(generator.integers(len(samples)))]
        ((mean, sd),) = [[_limited(row[name], MAX_COST_MS) for name in ("mean_ms", "sd_ms")] for row in rows]
    except (csv.Error, KeyError, TypeError, ValueError) as error:
        what = f"rows of one device for {printable(method, 80)}, with duration_ms, or one row with mean_ms and sd_ms"
        raise DataError(f"{shown(file)}: expected {what} ({printable(str(error), 120)})") from error
    return device, lambda frame: float(generator.gamma((mean / sd) ** 2, sd**2 / mean)) if mean and sd else mean
