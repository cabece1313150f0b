"""The tables of a comparison, from the value of its JSON form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from su3d_bench.core.errors import counted
from su3d_bench.reports.tables.model import NOT_MEASURED, Prose, Table, bracketed, percent, signed, text_table

MANY_CLASSES = "p of single classes are not corrected for the number of classes: a few are small by chance"


def comparison_tables(comparison: Mapping[str, Any]) -> list[Table | Prose]:
    """One table a protocol and pair of methods, and one of its classes; numbers are percentages."""
    parts: list[Table | Prose] = [Prose((f"A: {comparison['left']}", f"B: {comparison['right']}"))]
    for compared in comparison["protocols"]:
        parts += _protocol_parts(compared)
    return [*parts, *([Prose(tuple(comparison["remarks"]), is_list=True)] if comparison["remarks"] else [])]


def _protocol_parts(compared: Mapping[str, Any]) -> list[Table | Prose]:
    left, right, name = compared["left"], compared["right"], compared["protocol"]
    pair = left if left == right else f"{left} (A), {right} (B)"
    title = f"{name} (version {compared['version']}): {pair}, {counted(len(compared['scenes']), 'scene')}"
    header = ["metric", "A", "B", "B - A", "mean over scenes", "p", "smallest p", "better / equal / worse"]
    rows = [[metric, *_cells(value)] for metric, value in compared["metrics"].items()]
    class_rows = [
        [class_name, column, *_cells(value)]
        for class_name, columns in compared["classes"].items()
        for column, value in columns.items()
        if any(value["per_scene"].values())
    ]
    parts: list[Table | Prose] = [text_table(f"{name}-{left}-{right}", [header, *rows], heading=title)]
    if class_rows:
        parts.append(text_table(f"{name}-{left}-{right}-classes", [["class", *header], *class_rows]))
    notes = (*compared["remarks"], *_notes(compared))
    return [*parts, *([Prose(notes, is_list=True)] if notes else [])]


def _cells(value: Mapping[str, Any]) -> list[str]:
    difference = f"{signed(value['difference'])} {bracketed(value['interval'], signed)}".rstrip()
    changes = list(value["per_scene"].values())
    counts = (sum(d > 0 for d in changes), sum(d == 0 for d in changes), sum(d < 0 for d in changes))
    return [
        percent(value["left"]),
        percent(value["right"]),
        difference,
        signed(value["mean_of_scenes"]),
        _probability(value["p"]),
        _probability(value["smallest_p"]),
        " / ".join(map(str, counts)),
    ]


def _probability(value: float | None) -> str:
    return NOT_MEASURED if value is None else f"{value:.3g}"


def _notes(compared: Mapping[str, Any]) -> Sequence[str]:
    tests = [value for value in compared["metrics"].values() if value["p"] is not None]
    notes = []
    if len(compared["scenes"]) < 2:
        notes.append("a single scene says nothing of other scenes: no interval, and p is 1 whatever the difference")
    elif tests:
        how = "all patterns of signs" if all(value["is_exact"] for value in tests) else "100000 drawn patterns of signs"
        notes.append(
            f"[..]: 95 % over resampled scenes, the same on both sides; p: two-sided sign-flip test of the mean over "
            f"scenes, {how}"
        )
    if compared["classes"]:
        n_equal = sum(not any(v["per_scene"].values()) for each in compared["classes"].values() for v in each.values())
        notes.append(f"{n_equal} values of classes that no scene changes are left out")
        notes.append(MANY_CLASSES)
    return notes
