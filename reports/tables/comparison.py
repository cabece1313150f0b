"""The tables of a comparison, from the value of its JSON form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from su3d_bench.core.errors import counted
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, bracketed, percent, signed, text_table
from su3d_bench.reports.tables.model import few_scenes

HEADER = ["p", "p of all", "smallest p", "better / equal / worse", "A", "B", "B - A", "mean over scenes"]
SEEDS = "SD of seeds, A / B"


def comparison_tables(comparison: Mapping[str, Any]) -> list[Table | Prose]:
    """One table a protocol and pair of methods, and one of its classes; numbers are percentages."""
    parts: list[Table | Prose] = [Prose((f"A: {comparison['left']}", f"B: {comparison['right']}"))]
    for compared in comparison["protocols"]:
        parts += _protocol_parts(compared, comparison["seeds"])
    return [*parts, *([Prose(tuple(comparison["remarks"]), is_list=True)] if comparison["remarks"] else [])]


def _protocol_parts(compared: Mapping[str, Any], seeds: Sequence[Sequence[int]]) -> list[Table | Prose]:
    left, right, name = compared["left"], compared["right"], compared["protocol"]
    pair = left if left == right else f"{left} (A), {right} (B)"
    title = f"{name} (version {compared['version']}): {pair}, {counted(len(compared['scenes']), 'scene')}"
    has_seeds = max(map(len, seeds)) > 1
    header = ["metric", *HEADER, *([SEEDS] if has_seeds else [])]
    rows = [[metric, *_cells(value, has_seeds)] for metric, value in compared["metrics"].items()]
    class_rows = [
        [class_name, column, *_cells(value, has_seeds)]
        for class_name, columns in compared["classes"].items()
        for column, value in columns.items()
        if any(value["per_scene"].values())
    ]
    parts: list[Table | Prose] = [text_table(f"{name}-{left}-{right}", [header, *rows], heading=title)]
    if class_rows:
        parts.append(text_table(f"{name}-{left}-{right}-classes", [["class", *header], *class_rows]))
    notes = (*compared["remarks"], *_notes(compared), *([_of_seeds(seeds)] if has_seeds else []))
    return [*parts, *([Prose(notes, is_list=True)] if notes else [])]


def _of_seeds(seeds: Sequence[Sequence[int]]) -> str:
    told = [f"{side} over {counted(len(of_side), 'seed')}" for side, of_side in zip("AB", seeds, strict=True)]
    return (
        f"each scene's value is the mean of {' and of '.join(told)}; {SEEDS}: the standard deviation of one run's "
        "value, in points, from the seed alone. Test and interval are over scenes, and do not allow for what a seed "
        "moves in all scenes alike; su3d-bench report power does"
    )


def _cells(value: Mapping[str, Any], has_seeds: bool) -> list[str]:
    difference = f"{signed(value['difference'])} {bracketed(value['interval'], signed)}".rstrip()
    changes = list(value["per_scene"].values())
    counts = (sum(d > 0 for d in changes), sum(d == 0 for d in changes), sum(d < 0 for d in changes))
    return [
        _probability(value["p"]),
        _probability(value["p_of_all"]),
        _probability(value["smallest_p"]),
        " / ".join(map(str, counts)),
        percent(value["left"]),
        percent(value["right"]),
        difference,
        signed(value["mean_of_scenes"]),
        *([" / ".join(map(percent, value["deviations_of_seeds"]))] if has_seeds else []),
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
            f"p: two-sided sign-flip test of the mean over scenes, {how}; p of all: corrected by Holm for all metrics "
            "that are compared here, or all classes; [..]: 95 % t interval from the differences without each scene"
        )
        notes += [line for line in (few_scenes(len(compared["scenes"])),) if line]
        notes += [f"{name}: {d['disagreement']}" for name, d in compared["metrics"].items() if d["disagreement"]]
    if compared["classes"]:
        values = [(name, v) for name, columns in compared["classes"].items() for v in columns.values()]
        n_equal = sum(not any(v["per_scene"].values()) for _, v in values)
        notes.append(f"{n_equal} values of classes that no scene changes are left out")
        odd = dict.fromkeys(name for name, v in values if v["disagreement"])
        if odd:
            notes.append(f"interval and test disagree, and the test decides, for {', '.join(odd)}")
    return notes
