"""What ``make bench`` measured, as ``docs/performance.md``: a table a group, with ratios within it.

``python benchmarks/write_performance.py build/bench.json docs/performance.md``
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from su3d_bench.timing import hardware_line

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


def main(arguments: Sequence[str]) -> None:
    source, target = map(Path, arguments)
    measured = json.loads(source.read_text(encoding="utf-8"))
    target.write_text(performance_page(measured["benchmarks"], hardware_line()), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
