"""The real-time clock of a run: its settings, its part of the keys, and the schedule of each job."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from su3d_bench.core.config import RunConfig
from su3d_bench.core.digests import digest_bytes, digest_file
from su3d_bench.core.errors import ConfigError, DataError, counted, printable, shown
from su3d_bench.core.system.timing import hardware_line
from su3d_bench.runs.clock import QUEUE_SIZE, Schedule, Stream, frame_times, read_costs, read_schedule
from su3d_bench.store.run_folder import RunFolder

# Perception of these profiles reads results, so that its time is not that of any perception.
NOT_TIMED = ("oracle", "stored")


def with_clock(config: RunConfig) -> RunConfig:
    """``config`` with all values of the clock, those of ``--schedule`` read from it; ``ConfigError`` if they conflict.

    A schedule determines the rate, the queue and the stride.
    """
    if config.anytime_every and (config.realtime or config.schedule is not None):
        raise ConfigError("--anytime-every: in real time updates have no fixed distance; use --anytime SHARE")
    fixed: dict[str, Any] = {"queue": "newest", "queue_size": 0, "cost": None}
    why = "has no effect without --realtime HZ"
    if config.schedule is not None:
        stream = read_schedule(_any_schedule(config.schedule)).stream
        settings = stream.model_dump(include={"queue", "queue_size", "stride"})
        fixed, why = {"realtime": stream.rate_hz, **settings, "cost": None}, "differs from the schedule; omit it"
    elif config.realtime:
        size = 1 if config.queue == "newest" else config.queue_size or QUEUE_SIZE
        fixed, why = {"queue_size": size}, "'newest' has one place; choose another --queue"
    for name, value in fixed.items():
        if (given := getattr(config, name)) not in (RunConfig.model_fields[name].default, value):
            raise ConfigError(f"--{name.replace('_', '-')} {given}: {why}")
    return config.model_copy(update=fixed)


def _any_schedule(place: Path) -> Path:
    """The file itself, or one of the schedules of a run."""
    if not place.is_dir():
        return place
    found = [job.schedule for job in RunFolder(place).jobs() if job.schedule.is_file()]
    if not found:
        raise ConfigError(f"--schedule {shown(place)}: has no schedules; name a run with --realtime, or a schedule.csv")
    return found[0]


def is_measured(config: RunConfig) -> bool:
    """Whether the durations of updates are measured by the run itself."""
    return config.realtime > 0 and config.schedule is None and config.cost is None


def check_is_timed(config: RunConfig, profile: str, *, uses_captions: bool) -> None:
    """A ``ConfigError`` if perception would be read from files or replies instead of being timed."""
    if is_measured(config) and (profile in NOT_TIMED or uses_captions):
        what = "captions of a language model" if uses_captions else f"profile '{profile}'"
        raise ConfigError(f"--realtime: {what}: perception is stored, so it cannot be timed; add --cost FILE")


def _schedule_file(place: Path, scene: str, method: str) -> Path:
    return RunFolder(place).job(scene, method).schedule if place.is_dir() else place


def clock_key(config: RunConfig, scene: str, method: str) -> dict[str, str]:
    """The part of a prediction's key that describes the clock; a ``DataError`` if the schedule is of another scene."""
    if not config.realtime:
        return {}
    source = "measured"
    if config.schedule is not None:
        file = _schedule_file(config.schedule, scene, method)
        stream = read_schedule(file).stream
        if (stream.scene, stream.rate_hz, stream.stride) != (scene, config.realtime, config.stride):
            own = f"{stream.scene} at {stream.rate_hz:g} Hz, stride {stream.stride}"
            wanted = f"{printable(scene, 200)} at {config.realtime:g} Hz, stride {config.stride}"
            raise DataError(f"{shown(file)}: is the schedule of {own}, not of {wanted}")
        source = digest_file(file)
    elif config.cost is not None:
        read_costs(config.cost, method, [])  # raises if it is unreadable
        source = f"simulated {digest_file(config.cost)}"
    return {"realtime": f"{config.realtime} Hz, {config.queue} {config.queue_size}", "schedule": source}


def schedule_of(
    config: RunConfig, scene: str, method: str, n_frames: int, stride: int, cost_ms: Callable[[int], float] | None
) -> Schedule:
    """The schedule of one job: replayed, drawn from the cost file, or with the durations that ``cost_ms`` measures."""
    if config.schedule is not None:
        file = _schedule_file(config.schedule, scene, method)
        schedule = read_schedule(file)
        if len(schedule.times) != n_frames:
            has = f"has {counted(len(schedule.times), 'frame')}, but {n_frames} arrive"
            raise DataError(f"{scene}: {shown(file)} {has}; use the same --limit")
        return schedule
    device = hardware_line()
    if config.cost is not None:
        seed = [config.seed, int(digest_bytes(scene.encode())[:15], 16)]
        device, cost_ms = read_costs(config.cost, method, seed)
    assert cost_ms is not None
    stream = Stream(
        scene=printable(scene, 300), method=printable(method, 300), rate_hz=config.realtime, stride=stride,
        queue=config.queue, queue_size=config.queue_size, device=device, is_simulated=config.cost is not None,
    )  # fmt: skip
    return Schedule(stream, frame_times(n_frames, config.realtime, config.queue, config.queue_size, cost_ms))
