"""The tables of a comparison, from the value of its JSON form: Markdown that reads well as plain text too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from su3d_bench.reports.tables.run import NOT_MEASURED, aligned, percent

MANY_CLASSES = "p of single classes are not corrected for the number of classes: a few are small by chance"


def comparison_tables(comparison: Mapping[str, Any]) -> str:
    """One table a protocol and pair of methods, with remarks beneath; numbers are percentages."""
    blocks = [f"A: {comparison['left']}\nB: {comparison['right']}"]
    blocks += [_protocol_block(one) for one in comparison["protocols"]]
    if comparison["remarks"]:
        blocks.append("\n".join(f"- {line}" for line in comparison["remarks"]))
    return "\n\n".join(blocks) + "\n"


def _protocol_block(one: Mapping[str, Any]) -> str:
    pair = one["left"] if one["left"] == one["right"] else f"{one['left']} (A), {one['right']} (B)"
    n = len(one["scenes"])
    title = f"**{one['protocol']} (version {one['version']}): {pair}, {n} scene{'s' if n != 1 else ''}**"
    header = ["metric", "A", "B", "B - A", "mean over scenes", "p", "smallest p", "better / equal / worse"]
    body = [[name, *_cells(value)] for name, value in one["metrics"].items()]
    lines = [title, "", *aligned([header, *body])]
    if one["classes"]:
        rows = [
            [name, column, *_cells(value)]
            for name, columns in one["classes"].items()
            for column, value in columns.items()
            if any(value["per_scene"].values())
        ]
        lines += ["", *aligned([["class", *header], *rows])] if rows else []
    notes = [*one["remarks"], *_notes(one)]
    return "\n".join([*lines, *([""] if notes else []), *(f"- {line}" for line in notes)])


def _cells(value: Mapping[str, Any]) -> list[str]:
    difference = signed(value["difference"])
    if value["interval"] is not None:
        low, high = value["interval"]
        difference += f" [{signed(low)}, {signed(high)}]"
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


def signed(value: float | None) -> str:
    """A difference of fractions in percentage points, with its sign; ``-`` where there is none.

    >>> signed(0.0123), signed(-0.00001), signed(None)
    ('+1.2', '0.0', '-')
    """
    if value is None:
        return NOT_MEASURED
    text = f"{100 * value:+.1f}"
    return "0.0" if float(text) == 0 else text


def _probability(value: float | None) -> str:
    return NOT_MEASURED if value is None else f"{value:.3g}"


def _notes(one: Mapping[str, Any]) -> Sequence[str]:
    tests = [value for value in one["metrics"].values() if value["p"] is not None]
    notes = []
    if len(one["scenes"]) < 2:
        notes.append("a single scene says nothing of other scenes: no interval, and p is 1 whatever the difference")
    elif tests:
        how = "all patterns of signs" if all(value["is_exact"] for value in tests) else "100000 drawn patterns of signs"
        notes.append(
            f"[..]: 95 % over resampled scenes, the same on both sides; p: two-sided sign-flip test of the mean over "
            f"scenes, {how}"
        )
    if one["classes"]:
        n_equal = sum(not any(v["per_scene"].values()) for each in one["classes"].values() for v in each.values())
        notes.append(f"{n_equal} values of classes that no scene changes are left out")
        notes.append(MANY_CLASSES)
    return notes
