"""What each kind of error costs, as tables, from the JSON form of an attribution."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from su3d_bench.core.errors import counted
from su3d_bench.formats.tables.table import Prose, Table, percent, signed, text_table

MEANINGS: dict[str, dict[str, str]] = {
    "instance": {
        "merged": "one mask holds several objects",
        "split": "one object lies in several masks",
        "duplicate": "a mask repeats another one's object",
        "mislabelled": "the right mask, another class",
        "background": "a mask that belongs to no object",
        "missed": "an object that no mask is of",
    },
    "semantic": {
        "geometry": "no point of the map within 5 cm",
        "background": "the map is there, but no mask",
        "association": "a mask that belongs to another object",
        "label": "the object's own mask, another class",
    },
}
REST: dict[str, str] = {
    "instance": "masks that fit badly; mask and label wrong at once",
    "semantic": "classes that no correction of points reaches",
}
LEFT = {"overlap": "several together", "rest": "none of these"}  # what the two remainders are called
SUM = (
    "a gain is in percentage points, with this kind of error alone corrected; the value, all gains, 'several together' "
    "and 'none of these' add up to 100"
)
OVERLAP = "correcting all of them, beyond the sum of the gains"
STAGES: dict[str, str] = {
    "labels": "every mask named by the truth",
    "2D masks": "masks and names of each image from the truth",
}


def attribution_tables(attribution: Mapping[str, Any]) -> list[Table | Prose]:
    """One table a protocol; gains are in percentage points, each for one kind of error corrected alone."""
    return [
        Prose((f"{attribution['run']}: {attribution['method']}",)),
        *map(_protocol_table, attribution["protocols"]),
        Prose((SUM, *attribution["remarks"]), is_list=True),
    ]


def _protocol_table(protocol: Mapping[str, Any]) -> Table:
    names, n_scored = list(protocol["values"]), protocol["n_scored"]
    title = f"{protocol['protocol']} (version {protocol['version']}): {counted(len(protocol['scenes']), 'scene')}"
    header = ["", "errors" if n_scored is None else "points", *names, "what it is"]
    rows = [["as it is", "", *(percent(protocol["values"][name]) for name in names), ""]]
    for kind, cause in protocol["causes"].items():
        gains = [signed(cause["gains"][name]) for name in names]
        rows.append([kind, n_text(cause["n"], n_scored), *gains, MEANINGS[protocol["kind"]][kind]])
    rows.append([LEFT["overlap"], "", *(signed(protocol["overlap"][name]) for name in names), OVERLAP])
    rows.append([LEFT["rest"], "", *(signed(protocol["rest"][name]) for name in names), REST[protocol["kind"]]])
    for stage, values in protocol["stages"].items():
        rows.append([f"with true {stage}", "", *(percent(values[name]) for name in names), STAGES[stage]])
    return text_table(protocol["protocol"], [header, *rows], heading=title)


def n_text(n: int, n_scored: int | None) -> str:
    """A number of errors, or a share of the scored points.

    >>> n_text(3, None), n_text(25, 1000)
    ('3', '2.5 %')
    """
    return str(n) if n_scored is None else f"{100 * n / max(n_scored, 1):.1f} %"
