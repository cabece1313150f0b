"""What an update and a scene of a method cost, as measured; and what runs will cost at that price."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from su3d_bench.core.config import toml_value
from su3d_bench.core.errors import ConfigError, printable, reading
from su3d_bench.core.files.atomic import write_text
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.system.timing import calibration_ms, hardware_line
from su3d_bench.core.toml import parse_toml
from su3d_bench.runs.executors import SCENE_DONE, Event, Report
from su3d_bench.store.run_folder import JobFolder, RunFolder

FILE = Path(__file__).resolve().parent / "unit_costs.toml"
NAME = "unit_costs.toml"  # of a probe's, in the folder of the reproduction
MOST_BYTES = 1 << 20
N_CALIBRATIONS = 15
LEAST_MS = 1e-3  # where a clock is too coarse for it
COMPILING = "compiling"  # how an event begins that is once a process, see runs.scene
START = ""  # stands for what a run takes before its first scene
Amount = Annotated[float, Field(ge=0, le=1e15, allow_inf_nan=False)]


class UnitCost(BaseModel):
    """The price of one method: seconds an update, seconds a scene beside its updates (reading, finishing, scoring),
    seconds once a process; bytes of a scene's result, of the cache an update, and of memory at most."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    method: Annotated[str, Field(min_length=1)]
    profile: Annotated[str, Field(min_length=1)]
    device: str = "cpu"
    update_s: Amount
    scene_s: Amount
    once_s: Amount
    result_bytes: Amount
    cache_bytes: Amount
    memory_bytes: Amount
    device_bytes: Amount = 0.0


class UnitCosts(BaseModel):
    """Prices with the machine that they were measured on; ``calibration_ms`` is that of ``core.system.timing``."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    where: Annotated[str, Field(min_length=1)]
    calibration_ms: Annotated[float, Field(gt=0, le=1e6)]
    cost: tuple[UnitCost, ...] = ()

    def of(self, method: str, profile: str, device: str) -> UnitCost | None:
        """The price of a method; that of its base where a variant has none of its own; None where neither has one."""
        own = {(one.method, one.profile, one.device): one for one in self.cost}
        kind = device.partition(":")[0]
        return own.get((method, profile, kind)) or own.get((method.partition("@")[0], profile, kind))


def read_costs(path: Path = FILE) -> UnitCosts:
    """The prices in a file as ``write_costs`` leaves it; ``ConfigError`` where it holds none."""
    shown = printable(str(path), 200)
    with reading(shown, ConfigError):
        content = file_bytes(path)
    if len(content) > MOST_BYTES:
        raise ConfigError(f"{shown}: has {len(content)} bytes; expected at most {MOST_BYTES}")
    try:
        table = parse_toml(content.decode("utf-8"))
        return UnitCosts.model_validate({**table, "cost": tuple(table.get("cost", ()))})
    except ValidationError as error:
        first = error.errors()[0]
        key = printable(".".join(map(str, first["loc"])), 100)
        raise ConfigError(f"{shown}: {key}: {printable(first['msg'], 120)}; measure again with --probe") from error
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{shown}: is no table of unit costs; measure again with --probe") from error


def write_costs(path: Path, costs: UnitCosts) -> None:
    lines = ["# Unit costs, measured by su3d-bench reproduce --probe: seconds and bytes.", ""]
    lines += [f"where = {toml_value(costs.where)}", f"calibration_ms = {toml_value(costs.calibration_ms)}"]
    for one in costs.cost:
        lines += ["", "[[cost]]", *(f"{key} = {toml_value(value)}" for key, value in one.model_dump().items())]
    write_text(path, "\n".join(lines) + "\n")


def calibrated_ms() -> float:
    """The fixed piece of work of ``calibration_ms`` on this machine, in milliseconds of processor time: the least of
    several, which what runs beside lengthens least."""
    calibration_ms()
    return min(_calibration() for _ in range(N_CALIBRATIONS))


def _calibration() -> float:
    start = time.process_time()
    calibration_ms()
    return max(1e3 * (time.process_time() - start), LEAST_MS)


def clock_of(device: str) -> Callable[[], float]:
    """Which clock prices are taken by: processor time, which nothing beside moves, where the processor does the work;
    elsewhere the clock on the wall."""
    return time.process_time if device == "cpu" else time.perf_counter


@dataclass
class Stopwatch:
    """Takes the times between the events of each scene: a ``Report`` that passes them on to ``then``.

    ``spent``: (method, what) -> seconds over all scenes, where what is ``feed``, ``once`` or ``scene``.
    """

    clock: Callable[[], float]
    then: Report | None = None
    spent: dict[tuple[str, str], float] = field(default_factory=dict)
    start_s: float = 0.0
    _open: dict[str, tuple[float, str, str]] = field(default_factory=dict)
    _begun: float = 0.0

    def __post_init__(self) -> None:
        self._begun = self.clock()

    def __call__(self, event: Event) -> None:
        now = self.clock()
        if event.unit and not self.spent and not self._open:
            self.start_s = now - self._begun
        before = self._open.pop(event.unit, None)
        if before is not None:
            then, method, what = before
            self.spent[method, what] = self.spent.get((method, what), 0.0) + now - then
        if event.unit and event.label != SCENE_DONE:
            what = "once" if event.doing.startswith(COMPILING) else "scene" if event.doing else "feed"
            self._open[event.unit] = (now, event.label, what)
        if self.then is not None:
            self.then(event)


def measured_costs(
    watch: Stopwatch, folder: RunFolder, jobs: Sequence[tuple[str, str, str]], device: str, cache_bytes: int
) -> tuple[UnitCost, ...]:
    """The price of each method of a run that ``watch`` has seen; ``jobs`` are (scene, method, profile)."""
    n_updates = {(scene, method): _n_updates(folder.job(scene, method)) for scene, method, _ in jobs}
    n_all = sum(n_updates.values())
    costs = []
    for method, profile in dict.fromkeys((method, profile) for _, method, profile in jobs):
        mine = [folder.job(scene, name) for scene, name, _ in jobs if name == method]
        n_mine = sum(n for (_, name), n in n_updates.items() if name == method)
        remarks = [job.remarks("predict").get("costs", {}) for job in mine]
        costs.append(
            UnitCost(
                method=method,
                profile=profile,
                device=device.partition(":")[0],
                update_s=round(watch.spent.get((method, "feed"), 0.0) / max(n_mine, 1), 6),
                scene_s=round(watch.spent.get((method, "scene"), 0.0) / len(mine), 6),
                once_s=round(watch.spent.get((method, "once"), 0.0) / len(mine), 6),
                result_bytes=float(round(sum(map(_bytes_of, mine)) / len(mine))),
                cache_bytes=float(round(cache_bytes / max(n_all, 1))),
                memory_bytes=float(max(remark.get("peak_rss_bytes") or 0 for remark in remarks)),
                device_bytes=float(max(remark.get("device_bytes") or 0 for remark in remarks)),
            )
        )
    return (*costs, *_beside(watch, [method for _, method, _ in jobs], jobs, device))


def _beside(
    watch: Stopwatch, methods: Iterable[str], jobs: Sequence[tuple[str, str, str]], device: str
) -> tuple[UnitCost, ...]:
    """What every run does beside its methods: the truth scored against itself, and the start."""
    truth = sum(seconds for (method, _), seconds in watch.spent.items() if method not in set(methods))
    n_scenes = len({scene for scene, _, _ in jobs})
    profile = jobs[0][2]
    beside = {CEILING_METHOD: (truth / n_scenes, 0.0), START: (0.0, watch.start_s)}
    return tuple(
        UnitCost(
            method=method or "start", profile=profile, device=device.partition(":")[0], update_s=0.0,
            scene_s=round(scene_s, 6), once_s=round(once_s, 6), result_bytes=0.0, cache_bytes=0.0, memory_bytes=0.0,
        )
        for method, (scene_s, once_s) in beside.items()
    )  # fmt: skip


def _n_updates(job: JobFolder) -> int:
    return max(file_bytes(job.updates).count(b"\n") - 1, 0)


def _bytes_of(job: JobFolder) -> int:
    return sum(file.stat().st_size for file in job.path.iterdir() if file.is_file())


def measured_here(costs: Sequence[UnitCost]) -> UnitCosts:
    """Prices with this machine's name."""
    return UnitCosts(where=hardware_line(), calibration_ms=calibrated_ms(), cost=tuple(costs))


@dataclass(frozen=True)
class Work:
    """What one run will do: ``n_updates`` by (scene, method), None for a method that looks at no frame."""

    name: str
    profile: str
    device: str
    n_updates: Mapping[tuple[str, str], int]
    n_workers: int


@dataclass(frozen=True)
class Estimate:
    """Of one run: seconds and bytes; None where ``unknown`` names methods without a price."""

    name: str
    seconds: float | None
    disk_bytes: float | None
    memory_bytes: float | None
    device_bytes: float | None
    unknown: tuple[str, ...]
    where: str


def estimated(work: Work, costs: UnitCosts, scale: float) -> Estimate:
    """The price of ``work``; ``scale``: how much slower this machine is than that of ``costs``."""
    prices = {method: costs.of(method, work.profile, work.device) for _, method in work.n_updates}
    unknown = tuple(method for method, price in prices.items() if price is None)
    if unknown or not prices:
        return Estimate(work.name, None, None, None, None, unknown, costs.where)
    known = {method: price for method, price in prices.items() if price is not None}
    extra = [costs.of(name, work.profile, work.device) for name in (CEILING_METHOD, "start")]
    scenes = {scene for scene, _ in work.n_updates}
    seconds = sum(known[method].scene_s + n * known[method].update_s for (_, method), n in work.n_updates.items())
    once = sum(price.once_s for price in known.values())
    for price in filter(None, extra):
        seconds += price.scene_s * len(scenes)
        once += price.once_s
    return Estimate(
        work.name,
        scale * (once + seconds / work.n_workers),
        sum(known[method].result_bytes + n * known[method].cache_bytes for (_, method), n in work.n_updates.items()),
        max(price.memory_bytes for price in known.values()) * work.n_workers,
        max(price.device_bytes for price in known.values()) * work.n_workers,
        (),
        costs.where,
    )
