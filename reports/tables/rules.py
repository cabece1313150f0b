"""In which rules two protocols differ, and what each adds to a number, as tables from the JSON form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from su3d_bench.core.config import toml_value
from su3d_bench.core.errors import counted, printable
from su3d_bench.formats.tables.table import Prose, Table, percent, signed, text_table
from su3d_bench.metrics.protocols.mixtures import UNMOVED

MOST_OF_A_RULE = 60  # characters
SUM = "points that a rule adds, the mean over all orders in which rules can be changed; they sum to the difference"
DRAWN = "points that a rule adds, the mean over {n} orders that were drawn, ± its standard error; the sum is exact"


def rules_tables(apart: Mapping[str, Any]) -> list[Table | Prose]:
    """The rules that differ, and beneath them the way from one number to the other where a prediction was given."""
    first, second = apart["first"], apart["second"]
    if not apart["differing"]:
        return [Prose((f"{first} and {second}: no rule differs that moves a number",))]
    rows = [["rule", first, second]]
    rows += [[one["rule"], *_sides(one["rule"], one["first"], one["second"])] for one in apart["differing"]]
    parts: list[Table | Prose] = [text_table("rules", rows, heading=f"{first} and {second}")]
    return parts if apart["walk"] is None else [*parts, _walk_table(apart)]


def _walk_table(apart: Mapping[str, Any]) -> Table:
    walk = apart["walk"]
    names = list(walk["start"])
    rows = [["", *(cell for name in names for cell in (name, "least to most"))]]
    rows.append([apart["first"], *(cell for name in names for cell in (percent(walk["start"][name]), ""))])
    rows += [
        [", ".join(step["rules"]), *(cell for name in names for cell in _cells(step["adds"][name]))]
        for step in walk["steps"]
    ]
    rows.append([apart["second"], *(cell for name in names for cell in (percent(walk["end"][name]), ""))])
    n = walk["n_orders"]
    notes = [
        f"{SUM if n is None else DRAWN.format(n=n)}; beside it the least and the most that it adds anywhere",
        "rules in one line depend on one another and are changed together",
    ]
    if any(one["rule"] in UNMOVED for one in apart["differing"]):
        notes.append("the encoder is the run's own under both")
    title = f"{walk['run']}: {walk['method']}, {counted(len(walk['scenes']), 'scene')}"
    return text_table("walk", rows, heading=title, notes=notes)


def _cells(share: Mapping[str, Any]) -> tuple[str, str]:
    error = share["standard_error"]
    about = f" ± {percent(error)}" if error else ""
    return signed(share["share"]) + about, f"{signed(share['least'])} to {signed(share['most'])}"


def _sides(rule: str, first: Any, second: Any) -> list[str]:
    """Either value; of long lists how many there are and what the other lacks."""
    if rule == "classes":
        names = [[entry["name"] for entry in side] for side in (first, second)]
        return [f"{len(mine)} classes{_alone(mine, other)}" for mine, other in (names, names[::-1])]
    if isinstance(first, list) and isinstance(second, list) and max(len(first), len(second)) > 4:
        return [f"{len(mine)} of them{_alone(mine, other)}" for mine, other in ((first, second), (second, first))]
    return [_shown(value) for value in (first, second)]


def _alone(mine: Sequence[Any], other: Sequence[Any]) -> str:
    own = [str(item) for item in mine if item not in other]
    if not own:
        return ""
    rest = f" and {len(own) - 3} more" if len(own) > 3 else ""
    return f", it alone: {printable(', '.join(own[:3]), MOST_OF_A_RULE)}{rest}"


def _shown(value: Any) -> str:
    if value is None or value in ([], {}):
        return "none"
    if isinstance(value, Mapping):
        return printable(", ".join(f"{key} = {_shown(item)}" for key, item in value.items()), MOST_OF_A_RULE)
    return printable(toml_value(value), MOST_OF_A_RULE)
