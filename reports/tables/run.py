"""Tables of a run, from what ``metrics.json`` holds: Markdown that reads well as plain text too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

NOT_MEASURED = "-"


def markdown_table(metrics: Mapping[str, Any]) -> str:
    """All tables of a run: one a protocol, a row a method, what must be known beneath.

    ``metrics`` is the value of ``metrics.json``. Numbers are percentages with their 95 % interval over scenes.
    """
    results: list[Mapping[str, Any]] = metrics["results"]
    blocks = []
    for protocol in dict.fromkeys(str(one["protocol"]) for one in results):
        rows = [one for one in results if one["protocol"] == protocol]
        blocks.append(_protocol_block(rows, metrics))
    return "\n\n".join(blocks) + "\n" if blocks else "no protocol scores these scenes\n"


def headline(result: Mapping[str, Any]) -> str:
    """One line a method and protocol: ``F-mIoU 31.2 [28.9, 33.4] (8 scenes, ceiling 97.1)``, metrics by commas."""
    parts = []
    for name in result["headline"]:
        remarks = [_scenes_text(result) + " scenes"]
        if result["ceiling"] is not None:
            remarks.append(f"ceiling {percent(result['ceiling'].get(name))}")
        parts.append(f"{name} {_value_text(result, name)} ({', '.join(remarks)})")
    return ", ".join(parts)


def _protocol_block(rows: Sequence[Mapping[str, Any]], metrics: Mapping[str, Any]) -> str:
    first = rows[0]
    names = list(first["headline"])
    title = f"{first['protocol']} (version {first['version']})"
    if metrics["is_partial"]:
        title += f": PARTIAL, only the first {metrics['limit']} frames of each scene"
    header = ["method", *names, f"ceiling ({' / '.join(names)})", "scenes", "covered at 2.5 / 5 / 10 cm"]
    body = [[one["method"], *(_value_text(one, name) for name in names), *_context(one, names)] for one in rows]
    notes = [line for one in rows for line in _notes(one)]
    return "\n".join([f"**{title}**", "", *aligned([header, *body]), *([""] if notes else []), *notes])


def _context(row: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    ceiling = row["ceiling"]
    ceilings = NOT_MEASURED if ceiling is None else " / ".join(percent(ceiling.get(name)) for name in names)
    coverage = {} if row["result"] is None else row["result"]["coverage"]
    covered = [percent(None if share is None else 1.0 - share) for share in coverage.values()]
    return [ceilings, _scenes_text(row), " / ".join(covered) or NOT_MEASURED]


def _scenes_text(row: Mapping[str, Any]) -> str:
    n_scored = 0 if row["result"] is None else int(row["result"]["n_scenes"])
    n_planned = int(row["n_planned"])
    return str(n_scored) if n_scored == n_planned else f"{n_scored}/{n_planned}"


def _value_text(row: Mapping[str, Any], name: str) -> str:
    if row["result"] is None:
        return NOT_MEASURED
    text = percent(row["result"]["metrics"].get(name))
    interval = row["result"]["intervals"].get(name)
    return text if interval is None else f"{text} [{percent(interval[0])}, {percent(interval[1])}]"


def percent(value: float | None) -> str:
    """A fraction in per cent with one decimal; ``-`` where there is none."""
    return NOT_MEASURED if value is None else f"{100.0 * value:.1f}"


def _notes(row: Mapping[str, Any]) -> Iterable[str]:
    """What stands beneath a table: incomplete scenes, the caveat of the profile, warnings with their scenes."""
    method = row["method"]
    if row["failed"]:
        yield f"- INCOMPLETE: {method} failed on {', '.join(row['failed'])}"
    if row["unscored"]:
        yield f"- {method} is unscored on {', '.join(row['unscored'])}"
    if row["caveat"]:
        yield f"- {method}: {row['caveat']}"
    scenes_of: dict[str, list[str]] = {}
    for warning in [] if row["result"] is None else row["result"]["warnings"]:
        scene, _, sentence = str(warning).partition(": ")
        scenes_of.setdefault(sentence or scene, []).append(scene)
    for sentence, scenes in scenes_of.items():
        yield f"- {method}: {sentence} ({_some(scenes)})"


def _some(scenes: Sequence[str]) -> str:
    return ", ".join(scenes[:3]) + (f" and {len(scenes) - 3} more" if len(scenes) > 3 else "")


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table, the first row its header, with columns of one width."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return [lines[0], rule, *lines[1:]]
