"""Write ``docs/running/performance.md`` (results) and ``benchmarks/measured.md`` (all measured tables).

``python benchmarks write_performance [build/bench.json] [--corridors RUN]``: the JSON file comes from
``make bench``, the runs from ``make bench-methods``. Parts without new input are kept, including
the hand-written list of targets and tables of scripts that left no new file.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from folders import BENCHMARKS, ROOT

from su3d_bench.core.system.timing import hardware_line
from su3d_bench.metrics.costs import (
    MAP,
    NOT_MAP,
    TOTAL,
    WARM_UP,
    MethodSummary,
    StageSummary,
    UpdateTimes,
    pooled,
    summarise,
)
from su3d_bench.numerics.statistics import Growth
from su3d_bench.reports.pictures.plots import draw_update_cost
from su3d_bench.reports.tables.formats import aligned
from su3d_bench.runs.finished import read_run, read_update_times

PAGE, NOTES = ROOT / "docs/running/performance.md", BENCHMARKS / "measured.md"
PICTURE = ROOT / "docs/pictures/update-cost.png"
MACHINE = """Written by `make bench` on one machine: {hardware}.
Times are medians; between machines, compare only ratios within a table. No check fails because a machine is slow.
"""
PAGE_HEAD = f"# Performance\n\n{MACHINE}"
NOTES_HEAD = f"""# What was measured

{MACHINE}Summary: [Performance](../docs/running/performance.md).
"""
TARGETS_TITLE = "## Targets"
MISSED_TITLE = "## Missed targets"
CORRIDORS_TITLE = "## An update against the map"
CORRIDORS_TEXT = """
`make bench-methods`: corridors of the given lengths, perfect masks, one update per frame. OpenMask3D's map is the
complete scan from the first frame on, so it is measured on the first metres of several corridors. Milliseconds are
medians without reading and perception, over the tenth of the updates with the smallest maps and the tenth with the
largest. Exponents, with 95 % intervals, are slopes of log-log fits of time against the number of map points, for the
total and for stages that grow and take at least 1/20 of it.
"""
MIN_SHARE = 0.05  # minimum share of the time (without reading and perception) to list a stage


def benchmark_sections(benchmarks: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """One table per group of ``benchmarks`` in a JSON file of pytest-benchmark, with ratios within it."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for one in benchmarks:
        groups.setdefault(str(one["group"] or one["name"]), []).append(one)
    for name, rows in groups.items():
        yield "\n".join([*_benchmark_table(name, rows), ""])


def _benchmark_table(group: str, rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
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
    """Three digits in a suitable unit: 12.3 ms."""
    for unit, scale in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)):
        if seconds * scale >= 1:
            return f"{seconds * scale:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def measured_sections(folder: Path) -> Iterator[str]:
    """One table per JSON file that ``write_measured`` left in ``folder``, in alphabetical order."""
    for path in sorted(folder.glob("*.json")):
        report = json.loads(path.read_text(encoding="utf-8"))
        notes = [" ".join(report["notes"]), ""] if report["notes"] else []
        lines = [
            f"## {report['title']}",
            "",
            f"`{report['command']}`",
            "",
            *aligned([report["columns"], *report["rows"]]),
            "",
        ]
        yield "\n".join([*lines, *notes])


def program_of(section: str) -> str | None:
    """The program that measured a section's table; None for a group of benchmarks.

    >>> program_of("## A map\\n\\n`python benchmarks big_map --points 5`\\n")
    'big_map'
    """
    found = re.search(r"^`python benchmarks (\w+)", section, re.MULTILINE)
    return found[1] if found else None


def corridors_section(runs: Sequence[Path]) -> str:
    """Growth of each method's update cost with its map, and the plot."""
    every = [times for run in runs for times in _times(run)]
    PICTURE.write_bytes(draw_update_cost(every, WARM_UP, "png"))
    plot = f"![Cost of an update against the points of the map](../{PICTURE.parent.name}/{PICTURE.name})"
    return "\n".join([CORRIDORS_TITLE, CORRIDORS_TEXT, *aligned(growth_table(every)), "", plot, ""])


def growth_table(every: Sequence[Sequence[UpdateTimes]]) -> list[list[str]]:
    """One row per method: the size of its map, and the cost of updates of the smallest and largest maps."""
    head = ["method", "m", "updates", "points, from", "to", "ms, smallest tenth", "largest", "worst", "exponent", ""]
    rows = [[*head, "stages that grow"]]
    for times in every:
        summary = summarise(times)
        cost = pooled(times, MAP, WARM_UP)
        points = np.concatenate([one.columns["n_points"][WARM_UP:] for one in times])
        by_size = np.argsort(points, kind="stable")
        tenth = max(1, len(cost) // 10)
        rows.append(
            [
                *(summary.method, ", ".join(_length(one.scene) for one in times), str(summary.n_updates)),
                *(f"{points.min():,.0f}", f"{points.max():,.0f}"),
                *(f"{np.median(cost[part]):.1f}" for part in (by_size[:tenth], by_size[-tenth:])),
                f"{cost.max():.0f}",
                *_growth(_stage(summary, MAP).against_points),
                _growing_stages(summary),
            ]
        )
    return rows


def _length(scene: str) -> str:
    return scene.rpartition("/")[2].removesuffix("m")


def _growth(growth: Growth | None) -> tuple[str, str]:
    if growth is None:
        return "-", ""
    return f"{growth.exponent:.2f} [{growth.low:.2f}, {growth.high:.2f}]", growth.words


def _growing_stages(summary: MethodSummary) -> str:
    least = MIN_SHARE * _stage(summary, MAP).share
    mine = [one for one in summary.stages if one.name not in (*NOT_MAP, MAP, TOTAL) and one.share >= least]
    grown = [(one.name, one.against_points) for one in mine if one.against_points is not None]
    return ", ".join(f"{name} {growth.exponent:.2f}" for name, growth in grown if growth.words == "grows")


def _times(run: Path) -> list[list[UpdateTimes]]:
    finished = read_run(run)
    return [found for method in finished.methods if (found := read_update_times(finished, method))]


def _stage(summary: MethodSummary, name: str) -> StageSummary:
    return next(one for one in summary.stages if one.name == name)


def section_of(page: str, title: str) -> str:
    """The section of ``page`` with the heading ``title``; empty if there is none."""
    return next((one for one in sections_of(page) if one.startswith(f"{title}\n")), "")


def sections_of(page: str) -> list[str]:
    """The second-level sections, with their headings; text before the first is omitted."""
    return [f"## {one.rstrip()}\n" for one in f"\n{page}".split("\n## ")[1:]]


def head_of(page: str) -> str:
    """The text before the first second-level heading."""
    return f"{page.partition(chr(10) + '## ')[0].rstrip()}\n"


def results_page(before: str, hardware: str | None, corridors: Sequence[Path] | None) -> str:
    """The page of results; None keeps the text of ``before``."""
    sections = [
        head_of(before) if hardware is None else PAGE_HEAD.format(hardware=hardware),
        section_of(before, TARGETS_TITLE),
        section_of(before, MISSED_TITLE),
        section_of(before, CORRIDORS_TITLE) if corridors is None else corridors_section(corridors),
    ]
    return "\n".join(filter(None, sections))


def notes_page(before: str, hardware: str | None, groups: Sequence[str] | None, measured: Sequence[str]) -> str:
    """All tables: the ``groups`` of benchmarks, then those ``measured`` by scripts, one table per script.

    A script's table replaces its previous one in ``before``; groups are replaced as a whole or kept.
    """
    known = sections_of(before)
    if groups is None:
        groups = [one for one in known if program_of(one) is None]
    tables = {program_of(one): one for one in (*known, *measured) if program_of(one) is not None}
    head = head_of(before) if hardware is None else NOTES_HEAD.format(hardware=hardware)
    return "\n".join([head, *groups, *(tables[name] for name in sorted(filter(None, tables)))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benchmarks", type=Path, nargs="?", help="JSON file of pytest-benchmark")
    parser.add_argument("--measured", type=Path, default=Path("build/measured"), help="folder of scripts' JSON files")
    parser.add_argument("--corridors", type=Path, nargs="+", metavar="RUN")
    asked = parser.parse_args()
    hardware, groups = None, None
    if asked.benchmarks is not None:
        hardware = hardware_line()
        groups = list(benchmark_sections(json.loads(asked.benchmarks.read_text(encoding="utf-8"))["benchmarks"]))
    page, notes = (file.read_text(encoding="utf-8") for file in (PAGE, NOTES))
    measured = list(measured_sections(asked.measured))
    NOTES.write_text(notes_page(notes, hardware, groups, measured), encoding="utf-8")
    PAGE.write_text(results_page(page, hardware, asked.corridors), encoding="utf-8")


if __name__ == "__main__":
    main()
