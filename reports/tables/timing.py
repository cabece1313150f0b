"""Timing tables: all methods, the stages of each method, and intermediate maps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from su3d_bench.core.errors import counted, printable
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, csv_lines, percent, text_table
from su3d_bench.metrics.costs import MethodSummary, UpdateTimes
from su3d_bench.metrics.seen import area_under
from su3d_bench.numerics.statistics import Growth
from su3d_bench.store.records import RealTimeRecord

MIB = 2**20
CACHE = "cache"
SIZES = ("points", "instances", "frames")
WHOLE, SEEN, SEEN_CEILING = "whole scene", "seen so far", "seen so far: ceiling"  # what a map is scored against


@dataclass(frozen=True)
class AnytimePoint:
    """The scores of the map after a share of the updates, and the seconds until then, over all scenes together.

    ``truth``: the ground truth that the map is scored against; for ``SEEN_CEILING`` that ground truth is the map.
    """

    run: str
    method: str
    protocol: str
    share: float
    seconds: float
    metrics: Mapping[str, float | None]
    truth: str = WHOLE


def timing_tables(
    summaries: Sequence[MethodSummary],
    anytime: Sequence[AnytimePoint],
    hardware: Mapping[str, str],
    camera_rate: float,
    times: Sequence[UpdateTimes] = (),
) -> list[Table | Prose]:
    """Return all tables. ``hardware``: run -> machine; ``camera_rate``: frames per second; ``times``: of each scene,
    for runs in real time."""
    runs = dict.fromkeys(summary.run for summary in summaries)
    parts: list[Table | Prose] = [Prose((f"{run}: {hardware[run]}",)) for run in runs]
    parts.append(text_table("timing", list(_methods_table(summaries, camera_rate))))
    if any(stage.name == CACHE and stage.share > 0 for summary in summaries for stage in summary.stages):
        line = f"Stage {CACHE}: perception results were read from disk; the speeds do not include perception."
        parts.append(Prose((line,)))
    for summary in summaries:
        updates = f"{counted(summary.n_updates, 'update')} of {counted(len(summary.scenes), 'scene')}"
        caption = f", ms per update ({updates})"
        name = f"timing-{summary.run}-{summary.method}"
        parts.append(text_table(name, list(_stages_table(summary)), heading=summary.method, caption=caption))
    if any(each.realtime is not None for each in times):
        parts.append(text_table("timing-real-time", list(_real_time_table(times)), heading="Real time"))
    if anytime:
        parts.append(text_table("timing-midway", list(_anytime_table(anytime)), heading="Intermediate maps"))
    return parts


def csv_text(summaries: Sequence[MethodSummary], hardware: Mapping[str, str]) -> str:
    """Return one row per run, method and stage, in full precision."""
    growth = [f"{name}_{part}" for name in SIZES for part in ("exponent", "low", "high", "words")]
    head = ["run", "hardware", "method", "n_scenes", "stage", "n", "first_ms", "p50_ms", "p95_ms", "max_ms", "share"]
    rows: list[list[Any]] = [[*head, *growth]]
    for cost in summaries:
        for stage in cost.stages:
            numbers = [stage.n, stage.first, stage.p50, stage.p95, stage.worst, stage.share]
            grown: list[Any] = []
            for each in (stage.against_points, stage.against_instances, stage.against_frames):
                grown += [""] * 4 if each is None else [each.exponent, each.low, each.high, each.words]
            scenes = len(cost.scenes)
            rows.append([cost.run, hardware[cost.run], cost.method, scenes, stage.name, *numbers, *grown])
    return csv_lines(rows)


def methods_csv(summaries: Sequence[MethodSummary], hardware: Mapping[str, str], camera_rate: float) -> str:
    """Return one row per run and method, in full precision: speed, map size, memory."""
    speeds = ("updates_per_s", "frames_per_s", "camera_rate", "real_time_factor")
    sizes = ("finish_ms", "n_points", "map_bytes", "peak_rss_bytes", "device_bytes")
    rows: list[list[Any]] = [["run", "hardware", "method", "n_scenes", "n_updates", *speeds, *sizes]]
    for cost in summaries:
        speed = [cost.updates_per_s, cost.frames_per_s, camera_rate, cost.frames_per_s / camera_rate]
        values = [getattr(cost, name) for name in sizes]
        rows.append([cost.run, hardware[cost.run], cost.method, len(cost.scenes), cost.n_updates, *speed, *values])
    return csv_lines(rows)


def _methods_table(summaries: Sequence[MethodSummary], camera_rate: float) -> Iterator[list[str]]:
    yield [
        *("run", "method", "updates", "update p50", "p95", "max", "first", "map update p50", "updates/s", "frames/s"),
        *(f"real-time factor at {camera_rate:g} fps", "finish", "points", "map MiB", "peak MiB", "GPU MiB"),
    ]
    for cost in summaries:
        total, of_map = (next(stage for stage in cost.stages if stage.name == name) for name in ("total", "map"))
        yield [
            *(cost.run, cost.method, str(cost.n_updates)),
            *(_ms(total.p50), _ms(total.p95), _ms(total.worst), _ms(total.first), _ms(of_map.p50)),
            f"{cost.updates_per_s:.2f}",
            f"{cost.frames_per_s:.2f}",
            f"{cost.frames_per_s / camera_rate:.2f}x",
            NOT_MEASURED if cost.finish_ms is None else _ms(cost.finish_ms),
            NOT_MEASURED if cost.n_points is None else f"{cost.n_points:,}",
            *(_mib(value) for value in (cost.map_bytes, cost.peak_rss_bytes, cost.device_bytes)),
        ]


def _stages_table(summary: MethodSummary) -> Iterator[list[str]]:
    yield [
        *("stage", "p50", "p95", "max", "first", "share"),
        *("exponent by map points", "exponent by instances", "exponent by updates", "growth with map size"),
    ]
    for stage in summary.stages:
        growth = stage.against_points or stage.against_frames
        yield [
            *(stage.name, _ms(stage.p50), _ms(stage.p95), _ms(stage.worst), _ms(stage.first), percent(stage.share)),
            *map(_growth, (stage.against_points, stage.against_instances, stage.against_frames)),
            "too few updates" if growth is None else growth.words,
        ]


def _growth(growth: Growth | None) -> str:
    return NOT_MEASURED if growth is None else f"{growth.exponent:z.2f} [{growth.low:z.2f}, {growth.high:z.2f}]"


def _anytime_table(points: Sequence[AnytimePoint]) -> Iterator[list[str]]:
    names = list(dict.fromkeys(name for point in points for name in point.metrics))
    yield ["run", "method", "protocol", "ground truth", "frames", "seconds", *names]
    curve = list[AnytimePoint]()
    for point in points:
        curve.append(point)
        where = [point.run, point.method, point.protocol, point.truth]
        values = [percent(point.metrics[name]) if name in point.metrics else "" for name in names]
        yield [*where, f"{100 * point.share:.4g} %", f"{point.seconds:.1f}", *values]
        if point.share == 1:
            areas = [area_under([(each.share, each.metrics.get(name)) for each in curve]) for name in names]
            shown = [percent(area) if name in point.metrics else "" for name, area in zip(names, areas, strict=True)]
            yield [*where, "area", "", *shown]
            curve.clear()


def _real_time_table(times: Sequence[UpdateTimes]) -> Iterator[list[str]]:
    """One row per run, method and clock."""
    yield ["run", "method", "Hz", "queue", "frames", "processed", "dropped", "latency (ms)", "processed/s", "durations"]
    clocks: dict[tuple[str, ...], list[RealTimeRecord]] = {}
    for each in times:
        if (clock := each.realtime) is not None:
            source = f"{'simulated' if clock.is_simulated else 'measured'}: {printable(clock.device, 120)}"
            key = each.run, each.method, f"{clock.rate_hz:g}", f"{clock.queue} {clock.queue_size}", source
            clocks.setdefault(key, []).append(clock)
    for (*clock_of, source), scenes in clocks.items():
        n_processed = sum(clock.n_processed for clock in scenes)
        latency_ms = sum(clock.n_processed * (clock.latency_ms or 0.0) for clock in scenes)
        yield [
            *(*clock_of, str(sum(clock.n_frames for clock in scenes)), str(n_processed)),
            *(str(sum(clock.n_dropped for clock in scenes)), _ms(latency_ms / (n_processed or math.nan))),
            *(f"{n_processed / sum(clock.duration_s for clock in scenes):.2f}", source),
        ]


def _ms(value: float) -> str:
    """Return three significant digits, or all digits before the point: 1234, 12.3, 0.123."""
    if value != value:
        return NOT_MEASURED
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _mib(value: int | None) -> str:
    return NOT_MEASURED if value is None else f"{value / MIB:.0f}"
