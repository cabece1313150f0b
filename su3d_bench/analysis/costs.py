"""The scores of finished runs beside their costs: time per frame, memory, size of the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from su3d_bench.analysis.tables import results_of
from su3d_bench.core.digests import digest_json
from su3d_bench.core.errors import printable
from su3d_bench.metrics.costs import MAP, WARM_UP, UpdateTimes, summarise
from su3d_bench.reports.tables.costs import CostRow
from su3d_bench.runs.finished import FinishedRun

SIZES = ("peak_rss_bytes", "device_bytes", "saved_bytes", "n_points")


def rate_of(run: FinishedRun) -> float | None:
    """Frames that arrive per second in a real-time run; None if every frame waits for the method."""
    return run.settings.get(("realtime",)) or None


def machine_of(run: FinishedRun, times: Sequence[UpdateTimes]) -> str:
    """The machine whose times count: that of the run, or of a schedule that was measured elsewhere or simulated."""
    here = run.record.hardware
    clocks = [updates.realtime for updates in times if updates.realtime is not None]
    of_clocks = {f"{one.device}{' (simulated)' if one.is_simulated else ''}" for one in clocks}
    others = sorted(of_clocks - {here})
    return f"{', '.join(others)}; memory of {here}" if others else here


def costs_of(times: Sequence[UpdateTimes], warm_up: int = WARM_UP) -> dict[str, float | None]:
    """The costs of a method in seconds, bytes and points; None if unknown, as without any processed frame."""
    summary = summarise(times, warm_up) if times else None
    map_ms = next((stage.p50 for stage in summary.stages if stage.name == MAP), None) if summary else None
    ms = {"frame_s": summary and summary.frame_ms, "map_s": map_ms}
    return {
        **{name: value / 1e3 if value is not None and value == value else None for name, value in ms.items()},
        **{name: getattr(summary, name, None) for name in SIZES},
    }


def cost_rows(
    runs: Sequence[FinishedRun], timed: Mapping[tuple[str, str], Sequence[UpdateTimes]], warm_up: int
) -> list[CostRow]:
    """The scores and costs of each method whose frames were timed; ``timed``: by names of run and method.

    A method that finished no frame in real time has a score and no costs.
    """
    rows = []
    for run in runs:
        for score in results_of(run.name, run):
            times = timed.get((run.name, score.method), ())
            if not score.per_scene or score.is_ceiling or not (times or rate_of(run)):
                continue
            record = run.results[score.method, score.protocol].result
            n_instances = None if record is None else max(record.n_predictions.values(), default=None)
            data = {scene: run.record.data_digests.get(scene) for scene in score.scenes}
            rules = run.protocols[score.protocol].digest
            rows.append(
                CostRow(
                    score=score,
                    machine=printable(machine_of(run, times), 300),
                    data=digest_json([score.protocol, rules, score.limit, data]),
                    rate_hz=rate_of(run),
                    costs=costs_of(times, warm_up) | {"n_instances": n_instances},
                )
            )
    return rows
