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

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from su3d_bench.core.errors import DataError, counted, printable, reading, shown
from su3d_bench.core.system.files import opened_text

Queue = Literal["newest", "drop-new", "drop-old"]
QUEUE_SIZE = 10  # of the queues that are not ``newest``, unless requested otherwise
MAX_RATE_HZ = 1e6
MAX_TIME_S = 1e7  # four months
MAX_FRAMES = 10_000_000
MAX_LINE = 4000  # characters
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


def _is_printable(text: str) -> str:
    if text != printable(text, 300):
        raise ValueError("must be printable text of at most 300 characters")
    return text


Text = Annotated[str, AfterValidator(_is_printable)]


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
    lines = _lines(file)
    first = lines[0] if lines else ""
    try:
        stream = Stream.model_validate_json(first.removeprefix("# "))
    except ValidationError as error:
        problem = error.errors()[0]
        what = ": ".join([*map(str, problem["loc"]), problem["msg"]])
        raise DataError(f"{shown(file)}:1: is not a schedule of su3d-bench ({printable(what, 200)})") from error
    if lines[1:2] != [",".join(COLUMNS)]:
        raise DataError(f"{shown(file)}:2: expected the columns {','.join(COLUMNS)}")
    times: list[FrameTimes] = []
    last_ns = 0
    for number, line in enumerate(lines[2:], 3):
        try:
            times.append(_frame_times(line, len(times), times[-1].arrived_ns if times else 0, last_ns))
        except ValueError as error:
            raise DataError(f"{shown(file)}:{number}: {printable(str(error), 200)}") from error
        last_ns = times[-1].finished_ns or last_ns
    if not times:
        raise DataError(f"{shown(file)}: has no frames")
    return Schedule(stream, tuple(times))


def _frame_times(line: str, frame: int, arrived_last_ns: int, finished_last_ns: int) -> FrameTimes:
    values = line.split(",")
    if len(values) != len(COLUMNS):
        raise ValueError(f"has {counted(len(values), 'value')}, expected {len(COLUMNS)}")
    if values[0] != str(frame):
        raise ValueError(f"is frame '{values[0]}', expected {frame}: every frame that arrives has one row, in order")
    arrived, started, finished = (_ns(value) for value in values[1:4])
    if arrived is None or arrived < arrived_last_ns:
        raise ValueError(f"arrived_s is '{values[1]}', expected a time not before the previous frame's")
    if values[4] != str(int(started is None)) or (started is None) != (finished is None):
        raise ValueError("a frame is either dropped (1, without times) or has started_s, finished_s and 0")
    if started is not None and finished is not None and not max(arrived, finished_last_ns) <= started <= finished:
        raise ValueError("an update starts after its frame arrived and the previous one finished, and then finishes")
    return FrameTimes(arrived, started, finished)


def _ns(value: str) -> int | None:
    if not value:
        return None
    seconds = float(value)
    if not 0 <= seconds <= MAX_TIME_S:
        raise ValueError(f"'{value}' is not a time in seconds")
    return round(seconds * NS)


def _lines(file: Path) -> list[str]:
    """The lines of a text file; a ``DataError`` if it cannot be read or is longer than any file of this kind."""
    lines: list[str] = []
    with reading(shown(file), DataError), opened_text(file) as stream:
        try:
            while line := stream.readline(MAX_LINE):
                if len(lines) > MAX_FRAMES or (not line.endswith("\n") and len(line) == MAX_LINE):
                    raise DataError(f"{shown(file)}:{len(lines) + 1}: is too long")
                lines.append(line.rstrip("\n"))
        except UnicodeDecodeError as error:
            raise DataError(f"{shown(file)}: is not a UTF-8 text file") from error
    return lines


@dataclass(frozen=True)
class Costs:
    """Durations of an update with its perception, in ms: ``samples``, or a mean and a standard deviation."""

    device: str
    samples: tuple[float, ...] = ()
    mean_sd: tuple[float, float] | None = None

    def draws(self, seed: list[int]) -> Callable[[int], float]:
        """A function that returns the next duration: of ``samples`` with replacement, otherwise from a gamma
        distribution, which has no negative values, with that mean and standard deviation."""
        import numpy as np

        generator = np.random.default_rng(seed)
        if self.mean_sd is None:
            return lambda frame: self.samples[int(generator.integers(len(self.samples)))]
        mean, sd = self.mean_sd
        return lambda frame: float(generator.gamma((mean / sd) ** 2, sd**2 / mean)) if mean and sd else mean


def read_costs(file: Path, method: str) -> Costs:
    """The durations of ``method`` in a cost file: a CSV file with the columns ``device`` and ``duration_ms``, or
    ``device``, ``mean_ms`` and ``sd_ms`` with one row, and optionally ``method``; other columns are ignored."""
    rows = list(csv.DictReader(_lines(file)))
    names = set(rows[0]) if rows else set()
    is_sampled = "duration_ms" in names
    if "device" not in names or not (is_sampled or {"mean_ms", "sd_ms"} <= names):
        raise DataError(f"{shown(file)}: expected the columns device and duration_ms, or device, mean_ms and sd_ms")
    own = [row for row in rows if row.get("method", method) in (method, method.partition("@")[0].partition("~")[0])]
    devices = {row["device"] for row in own}
    if len(devices) != 1 or not (is_sampled or len(own) == 1):
        what = "rows of one device" if is_sampled else "one row"
        raise DataError(f"{shown(file)}: expected {what} for {printable(method, 80)}, found {counted(len(own), 'row')}")
    try:
        device = _is_printable(devices.pop() or "")
        wanted = ["duration_ms"] if is_sampled else ["mean_ms", "sd_ms"]
        values = [_cost_ms(row[name]) for row in own for name in wanted]
    except (TypeError, ValueError) as error:
        raise DataError(f"{shown(file)}: {printable(str(error), 200)}") from error
    if not device:
        raise DataError(f"{shown(file)}: device is empty; name the machine or GPU on which the costs were measured")
    return Costs(device, tuple(values)) if is_sampled else Costs(device, mean_sd=(values[0], values[1]))


def _cost_ms(value: str) -> float:
    cost = float(value)
    if not 0 <= cost <= MAX_TIME_S * 1e3:
        raise ValueError(f"'{value}' is not a duration in ms")
    return cost
