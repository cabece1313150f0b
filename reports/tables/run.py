"""Tables of a run, from what ``metrics.json`` holds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from su3d_bench.core.errors import counted, some
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, percent, text_table, with_interval
from su3d_bench.reports.tables.formats import markdown
from su3d_bench.reports.tables.found import Found, found_table
from su3d_bench.reports.tables.model import confidence_notes, few_scenes, is_ceiling, label_count_notes, label_notes
from su3d_bench.reports.tables.warnings import summed

# What stands below the methods: the prefix of a metric's name, and what the row is called.
MOST_SCENES = 20  # that a line names
CHEAP = {"chance": "by chance", "names-alone": "by names alone"}


def markdown_table(metrics: Mapping[str, Any]) -> str:
    """The tables of a run as Markdown that reads well as plain text too."""
    return markdown(run_tables(metrics))


def run_tables(metrics: Mapping[str, Any], found: Sequence[Found] = ()) -> list[Table | Prose]:
    """One table a protocol that scored a scene or should have, a row a method, what must be known beneath.

    ``metrics`` is the value of ``metrics.json``, ``found`` are the maps that nothing scored. Numbers are percentages
    with their 95 % interval over scenes.
    """
    rows_of: dict[str, list[Mapping[str, Any]]] = {}
    for result in metrics["results"]:
        rows_of.setdefault(str(result["protocol"]), []).append(result)
    told = [rows for rows in rows_of.values() if any(row["result"] is not None or row["failed"] for row in rows)]
    parts: list[Table | Prose] = [_protocol_table(rows, metrics) for rows in told]
    if not parts:
        parts = [Prose(("no protocol scores these scenes",))]
    return [*parts, *([found_table(found)] if found else [])]


def headline(result: Mapping[str, Any]) -> str:
    """One line a method and protocol: ``F-mIoU 31.2 [28.9, 33.4] (8 scenes, truth's score 97.1)``, by commas."""
    parts = []
    for name in result["headline"]:
        remarks = [_scenes_text(result) + " scenes"]
        if result["ceiling"] is not None:
            remarks.append(f"truth's score {percent(result['ceiling'].get(name))}")
        parts.append(f"{name} {_value_text(result, name)} ({', '.join(remarks)})")
    return ", ".join(parts)


def _protocol_table(rows: Sequence[Mapping[str, Any]], metrics: Mapping[str, Any]) -> Table:
    first = rows[0]
    names = list(first["headline"])
    title = f"{first['protocol']} (version {first['version']})"
    if metrics["is_partial"]:
        title += f": PARTIAL, only the first {counted(int(metrics['limit']), 'frame')} of each scene"
    header = ["method", *names, f"truth's score ({' / '.join(names)})", "scenes", "covered at 2.5 / 5 / 10 cm"]
    body = [[row["method"], *(_value_text(row, name) for name in names), *_context(row, names)] for row in rows]
    body += _cheap_rows(rows, names, len(header))
    notes = [line for row in rows for line in _notes(row)]
    notes += confidence_notes({str(row["method"]): row.get("confidences") for row in rows})
    notes += label_count_notes({str(row["method"]): row.get("labels") for row in rows if not _is_ceiling(row)})
    n_scenes = [row["result"]["n_scenes"] for row in rows if row["result"] and any(row["result"]["intervals"].values())]
    notes += label_notes(names)
    notes += [line for line in (few_scenes(min(n_scenes, default=0)),) if line]
    return text_table(str(first["protocol"]), [header, *body], heading=title, notes=notes)


def _is_ceiling(row: Mapping[str, Any]) -> bool:
    return is_ceiling(str(row["method"]), row["caveat"])


def _cheap_rows(rows: Sequence[Mapping[str, Any]], names: Sequence[str], n_columns: int) -> list[list[str]]:
    """What a guess scores, and who knows names alone, and the number of questions; nothing where nobody guesses."""
    results = [row["result"] for row in rows if row["result"] is not None]
    metrics: Mapping[str, Any] = results[0]["metrics"] if results else {}
    if not any(f"chance_{name}" in metrics for name in names):
        return []
    shares = [[label, *(percent(metrics.get(f"{prefix}_{name}")) for name in names)] for prefix, label in CHEAP.items()]
    counts = ["questions", *(str(metrics.get(f"n_{name}", NOT_MEASURED)) for name in names)]
    return [[*row, *[NOT_MEASURED] * (n_columns - len(row))] for row in (*shares, counts)]


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
    return with_interval(row["result"]["metrics"].get(name), row["result"]["intervals"].get(name))


def _notes(row: Mapping[str, Any]) -> Iterable[str]:
    """What stands beneath a table: incomplete scenes, the caveat of the profile, warnings with their scenes."""
    method = row["method"]
    if row["failed"]:
        yield f"INCOMPLETE: {method} failed on {', '.join(row['failed'])}"
    if row["unscored"]:
        yield f"{method} is unscored on {some(row['unscored'], MOST_SCENES)}"
    if row["caveat"]:
        yield f"{method}: {row['caveat']}"
    warnings = [] if row["result"] is None else [str(line) for line in row["result"]["warnings"]]
    for said, scenes in summed(warnings, {line.partition(": ")[0] for line in warnings if ": " in line}):
        yield f"{method}: {said}" + (f" ({some(scenes, 3)})" if scenes else "")
