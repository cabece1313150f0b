"""The cost of the updates of one scene and method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.types import Float64Array
from su3d_bench.numerics.statistics import Growth, growth_exponent
from su3d_bench.store.records import MapCost, RealTimeRecord

# Stages that are not mapping: reading the frame, and perception. They give the mapping time of runs by earlier
# versions, whose updates have no ``method_ms``.
NOT_MAP = ("decode", "cache", "segment", "encode", "caption")
MEASURED_AROUND = ("total_ms", "method_ms")  # measured by the runner; all other times are of stages
MAP = "map"
TOTAL = "total"
WARM_UP = 3  # first updates: caches and memory are cold, and the map is small


@dataclass(frozen=True)
class UpdateTimes:
    """The updates of one scene and method, in order.

    ``columns`` has (N,) float64 for every column of ``updates.csv``: ``total_ms``, ``method_ms``, one ``<stage>_ms``
    per stage, sizes. ``maps`` are the intermediate ones and the last; what was not measured is None.
    ``calibration_ms``: the time of a fixed workload, measured between the updates; ``start_ms`` and ``close_ms``: of
    the method before the first frame and after the last map. ``realtime``: the clock of a real-time run. ``frame_ms``
    (N,): perception and method, without reading the frame; None if perception was not timed.
    """

    run: str
    scene: str
    method: str
    columns: Mapping[str, Float64Array]
    maps: tuple[MapCost, ...]
    peak_rss_bytes: int | None
    device_bytes: int | None
    calibration_ms: float | None = None
    start_ms: float | None = None
    close_ms: float | None = None
    realtime: RealTimeRecord | None = None
    frame_ms: Sequence[float] | None = None

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages, in the order of their first nonzero time."""
        return tuple(
            name.removesuffix("_ms") for name in self.columns if name.endswith("_ms") and name not in MEASURED_AROUND
        )

    def ms(self, stage: str) -> Float64Array:
        """Milliseconds (N,) of a stage, of ``total`` or of ``map``; zeros for an unknown stage."""
        if stage == MAP:
            if "method_ms" in self.columns:
                return self.columns["method_ms"]
            mine = [self.ms(name) for name in self.stages if name not in NOT_MAP]
            return np.sum(mine, axis=0) if mine else np.zeros(len(self))
        return self.columns.get(f"{stage}_ms", np.zeros(len(self)))


def pooled(times: Sequence[UpdateTimes], stage: str, warm_up: int) -> Float64Array:
    """Milliseconds of ``stage`` over all scenes, without the first ``warm_up`` updates of each."""
    return np.concatenate([updates.ms(stage)[warm_up:] for updates in times]) if times else np.zeros(0)


@dataclass(frozen=True)
class StageSummary:
    """One stage of a method over its updates, in ms; ``first`` is the mean of the updates before the steady ones.

    ``share`` of the total time; ``against_points``, ``against_instances`` and ``against_frames``: growth with the
    points and instances of the map and with the number of updates so far, None if unknown.
    """

    name: str
    n: int
    first: float
    p50: float
    p95: float
    worst: float
    share: float
    against_points: Growth | None
    against_instances: Growth | None
    against_frames: Growth | None


@dataclass(frozen=True)
class MethodSummary:
    """The cost of a method over the scenes of a run; the last rows of ``stages`` are ``map`` and ``total``.

    ``map`` is the whole time of the method without perception. ``frames_per_s`` counts frames at full rate, of which
    every stride-th is an update. Bytes are the largest over the scenes, None if not measured; ``saved_bytes``: of the
    last map on disk. ``frame_ms``: median of perception and method.
    """

    run: str
    method: str
    scenes: tuple[str, ...]
    n_updates: int
    stages: tuple[StageSummary, ...]
    updates_per_s: float
    frames_per_s: float
    finish_ms: float | None
    n_points: int | None
    map_bytes: int | None
    peak_rss_bytes: int | None
    device_bytes: int | None
    saved_bytes: int | None
    frame_ms: float | None


def summarise(times: Sequence[UpdateTimes], warm_up: int = WARM_UP) -> MethodSummary:
    """The costs of one method over ``times``, at least one scene; ``warm_up`` updates per scene are kept separate."""
    pool = _Pool(times, warm_up)
    stages = tuple(dict.fromkeys(stage for updates in times for stage in updates.stages))
    seconds = float(pool.total_ms.sum()) / 1e3
    n_updates = len(pool.total_ms)
    n_frames = sum(_frames_covered(updates) for updates in times)
    last = [updates.maps[-1] for updates in times if updates.maps]
    frame_ms = [updates.frame_ms for updates in times if updates.frame_ms is not None]
    return MethodSummary(
        run=times[0].run,
        method=times[0].method,
        scenes=tuple(updates.scene for updates in times),
        n_updates=n_updates,
        stages=tuple(pool.stage(name) for name in (*stages, MAP, TOTAL)),
        updates_per_s=n_updates / seconds if seconds else float("nan"),
        frames_per_s=n_frames / seconds if seconds else float("nan"),
        finish_ms=max((one.finish_ms for one in last), default=None),
        n_points=_largest([updates.columns["n_points"].max() for updates in times if "n_points" in updates.columns]),
        map_bytes=_largest([updates.columns["map_bytes"].max() for updates in times if "map_bytes" in updates.columns]),
        peak_rss_bytes=_largest([updates.peak_rss_bytes for updates in times if updates.peak_rss_bytes is not None]),
        device_bytes=_largest([updates.device_bytes for updates in times if updates.device_bytes is not None]),
        saved_bytes=_largest([one.n_bytes for one in last if one.n_bytes is not None]),
        frame_ms=float(np.median(np.concatenate(frame_ms))) if len(frame_ms) == len(times) else None,
    )


class _Pool:
    """The updates of several scenes one after another; ``number`` counts those of each scene from 1."""

    def __init__(self, times: Sequence[UpdateTimes], warm_up: int) -> None:
        self._times = times
        self.total_ms = pooled(times, TOTAL, 0)
        self._number = np.concatenate([np.arange(1.0, len(updates) + 1) for updates in times])
        self._points, self._instances = (
            np.concatenate([updates.columns.get(column, np.zeros(len(updates))) for updates in times])
            for column in ("n_points", "n_instances")
        )
        self._is_steady = self._number > warm_up

    def stage(self, name: str) -> StageSummary:
        ms = pooled(self._times, name, 0)
        first, steady = ms[~self._is_steady], ms[self._is_steady]
        total = float(self.total_ms.sum())
        middle, high, worst = np.percentile(steady, [50, 95, 100]) if len(steady) else (float("nan"),) * 3
        return StageSummary(
            name=name,
            n=len(steady),
            first=float(first.mean()) if len(first) else float("nan"),
            p50=float(middle),
            p95=float(high),
            worst=float(worst),
            share=float(ms.sum()) / total if total else float("nan"),
            against_points=growth_exponent(self._points[self._is_steady], steady),
            against_instances=growth_exponent(self._instances[self._is_steady], steady),
            against_frames=growth_exponent(self._number[self._is_steady], steady),
        )


def pareto_front(costs: Sequence[float], scores: Sequence[float]) -> list[int]:
    """The points, by rising cost, for which no other has a higher score at the same cost or less.

    >>> pareto_front([3.0, 1.0, 2.0, 2.0], [0.3, 0.1, 0.3, 0.2])
    [1, 2]
    """
    front: list[int] = []
    for k in sorted(range(len(costs)), key=lambda k: (costs[k], -scores[k])):
        if not front or scores[k] > scores[front[-1]]:
            front.append(k)
    return front


def _largest(values: Sequence[float]) -> int | None:
    return int(max(values)) if values else None


def _frames_covered(times: UpdateTimes) -> float:
    """Frames at full rate that the updates represent: the spacing of their indices, including the last one's."""
    frames = times.columns.get("frame", np.arange(len(times), dtype=np.float64))
    spacing = float(np.median(np.diff(frames))) if len(frames) > 1 else 1.0
    return float(frames[-1] - frames[0]) + spacing
