"""What ``make bench`` measured, as ``docs/performance.md``: a table a group, with ratios within it, then whole runs.

``python benchmarks/write_performance.py build/bench.json docs/performance.md [ROOMS_RUN CORRIDOR_RUN...]``: the runs of
``make bench-methods``, all methods on the four demo rooms and along a corridor in which every map grows.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.finished_run import read_run
from su3d_bench.finished_updates import read_update_times
from su3d_bench.reports.tables import aligned
from su3d_bench.reports.timing_plots import draw_update_cost
from su3d_bench.timing import hardware_line
from su3d_bench.update_times import MAP, TOTAL, MethodSummary, UpdateTimes, summarise

HEAD = """# Performance

Written by `make bench` on one machine: {hardware}.
Times are medians; only the ratios within a table travel to another machine. No check fails because a machine was slow.
"""


def performance_page(benchmarks: Sequence[Mapping[str, Any]], hardware: str) -> str:
    """The page from the ``benchmarks`` of a JSON file of pytest-benchmark."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for one in benchmarks:
        groups.setdefault(str(one["group"] or one["name"]), []).append(one)
    return HEAD.format(hardware=hardware) + "".join(
        "\n" + "\n".join(_table(name, rows)) + "\n" for name, rows in groups.items()
    )


def _table(group: str, rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    yield f"## {group[:1].upper()}{group[1:]}\n"
    extras = list(dict.fromkeys(key for row in rows for key in row["extra_info"]))
    columns = ["benchmark", "median", "times the fastest", "rounds", *(key.replace("_", " ") for key in extras)]
    yield f"| {' | '.join(columns)} |"
    yield f"|{'---|' * len(columns)}"
    fastest = min(row["stats"]["median"] for row in rows)
    for row in rows:
        median = row["stats"]["median"]
        cells = [_words(row["name"]), _time(median), f"{median / fastest:.3g}", str(row["stats"]["rounds"])]
        yield f"| {' | '.join([*cells, *(str(row['extra_info'].get(key, '')) for key in extras)])} |"


def _words(name: str) -> str:
    """``test_a_b[c]`` as ``a b, c``."""
    base, _, parameter = name.removeprefix("test_").removesuffix("]").partition("[")
    words = base.replace("_", " ")
    return f"{words}, {parameter}" if parameter else words


def _time(seconds: float) -> str:
    """Three digits in the unit that fits: 12.3 ms."""
    for unit, scale in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)):
        if seconds * scale >= 1:
            return f"{seconds * scale:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def rooms_section(run: Path) -> str:
    """Run time and memory of every method on the scenes of a run."""
    rows = [["method", "updates", "ms an update", "of it the map", "finish, s", "whole scene, s", "peak memory, MiB"]]
    for times in _times(run):
        summary = summarise(times)
        total_s = [one.ms(TOTAL).sum() / 1e3 + one.maps[-1].finish_ms / 1e3 for one in times]
        rows.append(
            [
                summary.method,
                str(summary.n_updates),
                *(f"{_stage(summary, name).p50:.0f}" for name in (TOTAL, MAP)),
                f"{(summary.finish_ms or 0) / 1e3:.1f}",
                f"{sum(total_s) / len(total_s):.0f}",
                f"{(summary.peak_rss_bytes or 0) / 2**20:.0f}",
            ]
        )
    finished = read_run(run)
    scenes = ", ".join(finished.scenes)
    head = (
        f"## Every method on rooms\n\n`make bench-methods`: {scenes}, embedded profile, each method's own stride, two "
    )
    head += "scenes side by side. Medians over updates; the slowest `finish`; memory is that of the process.\n"
    return "\n".join([head, *aligned(rows), ""])


def corridor_section(runs: Sequence[Path], picture: Path) -> str:
    """How the cost of an update grows with each method's map, and its plot."""
    rows = [["method", "updates", "points at the end", "map ms at a tenth", "at the end", "exponent", "", "worst, ms"]]
    every = [times for run in runs for times in _times(run)]
    for times in every:
        summary = summarise(times)
        cost = times[0].ms(MAP)
        tenth = max(1, len(cost) // 10)
        growth = _stage(summary, MAP).against_points
        fitted = "-" if growth is None else f"{growth.exponent:.2f} [{growth.low:.2f}, {growth.high:.2f}]"
        early, late = np.median(cost[tenth : 2 * tenth]), np.median(cost[-tenth:])
        words = "" if growth is None else growth.words
        points = f"{summary.n_points or 0:,}"
        rows.append(
            [summary.method, str(len(cost)), points, f"{early:.1f}", f"{late:.1f}", fitted, words, f"{cost.max():.0f}"]
        )
    picture.write_bytes(draw_update_cost(every, 3, "png"))
    head = (
        "## An update against the map\n\n`make bench-methods`: corridors of 400 m (`conceptgraphs-detector`: 100 m), "
        "2 m a frame, perfect masks, every frame an update. Milliseconds without reading and perception; the exponent "
        "is that of a log-log fit against the points of the method's own map, with its 95 % interval. An update that "
        "tidies the map, every 20th of ConceptGraphs', stands in the last column.\n"
    )
    return "\n".join(
        [head, *aligned(rows), "", f"![Cost of an update against the points of the map]({picture.name})", ""]
    )


def _times(run: Path) -> list[list[UpdateTimes]]:
    finished = read_run(run)
    return [found for method in finished.methods if (found := read_update_times(finished, method))]


def _stage(summary: MethodSummary, name: str) -> Any:
    return next(one for one in summary.stages if one.name == name)


def main(arguments: Sequence[str]) -> None:
    source, target, *runs = map(Path, arguments)
    measured = json.loads(source.read_text(encoding="utf-8"))
    page = performance_page(measured["benchmarks"], hardware_line())
    if runs:
        rooms, *corridors = runs
        page += "\n" + rooms_section(rooms) + "\n" + corridor_section(corridors, target.with_name("update-cost.png"))
    target.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
