"""Read what the updates of a finished run cost, from the tables that each job left."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.plain_text import printable
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.costs import MapCost, UpdateTimes
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.run_folder import is_file

MAX_UPDATES = 10_000_000


def read_update_times(run: FinishedRun, method: str) -> list[UpdateTimes]:
    """The updates of every scene that ``method`` finished; scenes where it looks at no frame are left out."""
    run.check_method(method)
    found = []
    for scene in run.scenes:
        job = run.folder.job(scene, method)
        if not is_file(job.updates):
            continue
        where = f"{printable(scene, 120)}: {job.updates.name}"
        columns = _columns(job.updates, where)
        if not columns or not len(columns["total_ms"]):
            continue
        costs = _costs(job.remarks("predict").get("costs"), where)
        found.append(UpdateTimes(run.name, scene, method, columns, *costs))
    return found


def _columns(path: Path, where: str) -> dict[str, Float64Array]:
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            reader = csv.reader(stream)
            header = next(reader, [])
            rows = [row for row, _ in zip(reader, range(MAX_UPDATES), strict=False)]
            if "total_ms" not in header:
                return {}
            table = np.array(rows, np.float64).reshape(len(rows), len(header))
    except (ValueError, csv.Error, UnicodeDecodeError) as error:
        raise DataError(f"{where}: is not a table of numbers; run the same command again to mend it") from error
    if not np.isfinite(table).all():
        raise DataError(f"{where}: holds a number that is not finite; run the same command again to mend it")
    return {name: table[:, column] for column, name in enumerate(header)}


def _costs(costs: Any, where: str) -> tuple[tuple[MapCost, ...], int | None, int | None, float | None]:
    if costs is None:
        return (), None, None, None
    try:
        maps = tuple(MapCost(int(one["n_updates"]), float(one["finish_ms"])) for one in costs["maps"])
        peak, device = (None if costs[key] is None else int(costs[key]) for key in ("peak_rss_bytes", "device_bytes"))
        calibration = None if costs["calibration_ms"] is None else float(costs["calibration_ms"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{where}: the costs in done.json are not as a run writes them; run it again") from error
    return maps, peak, device, calibration
