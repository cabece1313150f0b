"""The scores of finished runs beside their costs: time per frame, memory, size of the map.

Times are those of perception and method; reading a frame takes none, as in real time. A real-time run has the times of
its schedule, because its maps are made by a second pass. Sizes are the largest over the scenes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from su3d_bench.analysis.tables import results_of
from su3d_bench.core.digests import digest_json
from su3d_bench.core.errors import printable
from su3d_bench.metrics.costs import MAP, UpdateTimes, summarise
from su3d_bench.reports.tables.costs import COSTS, RATE, TIME, CostRow
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.records import NumbersRecord


def machine_of(run: FinishedRun, times: Sequence[UpdateTimes]) -> str:
    """The machine of the run, and those on which its schedules were measured elsewhere or simulated."""
    devices = [f"{one.device}{' (simulated)' if one.is_simulated else ''}" for each in times if (one := each.realtime)]
    return printable(", ".join(dict.fromkeys([run.record.hardware, *devices])), 300)


def costs_of(run: FinishedRun, times: Sequence[UpdateTimes], score: NumbersRecord) -> dict[str, float | None]:
    """The costs of a method by the keys of ``COSTS``: Hz, seconds, MiB, points and instances; None if unknown.

    ``times``: its updates in each scene, none if it finished no frame in real time; ``score``: its result under any
    protocol, for the number of instances.
    """
    costs: dict[str, float | None] = dict.fromkeys(COSTS) | {RATE: run.settings.get(("realtime",)) or None}
    if times:
        one = summarise(times)
        ms = {TIME: one.frame_ms, "map_s": next(stage.p50 for stage in one.stages if stage.name == MAP)}
        n_bytes = {"peak_mib": one.peak_rss_bytes, "gpu_mib": one.device_bytes, "saved_mib": one.saved_bytes}
        costs |= {name: value / 1e3 for name, value in ms.items() if value is not None and value == value}
        costs |= {name: value / 2**20 for name, value in n_bytes.items() if value is not None}
        costs["n_points"] = one.n_points
        if "n_instances" in times[0].columns:  # otherwise the predictions are points
            costs["n_instances"] = max(score.n_predictions.values(), default=None)
    return costs


def cost_rows(runs: Sequence[FinishedRun], timed: Mapping[tuple[str, str], Sequence[UpdateTimes]]) -> list[CostRow]:
    """The scores and costs of the methods whose frames were timed; ``timed``: by names of run and method.

    A method that finished no frame in real time has a score and no costs.
    """
    rows = []
    for run, score in [(each, score) for each in runs for score in results_of(each.name, each)]:
        times, result = timed.get((run.name, score.method)), run.results[score.method, score.protocol].result
        if times is None or result is None or score.is_ceiling:
            continue
        costs = costs_of(run, times, result)
        if times or costs[RATE]:
            data = {scene: run.record.data_digests.get(scene) for scene in result.scenes}
            key = digest_json([score.protocol, run.protocols[score.protocol].digest, score.limit, data])
            rows.append(CostRow(score, machine_of(run, times), key, costs))
    return rows
