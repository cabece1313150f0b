"""The tables of an evaluation of predictions made elsewhere, from the value of its JSON file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from su3d_bench.core.errors import counted, printable
from su3d_bench.reports.tables.model import NOT_MEASURED, Prose, Table, percent, text_table, with_interval

NAMES = {"ap": "AP", "ap50": "AP50", "ap25": "AP25", "macc": "mAcc", "miou": "mIoU", "fmiou": "F-mIoU"}
MOST_NOTES = 12  # warnings that are printed; the file has all


def evaluation_tables(document: Mapping[str, Any], *, per_class: bool = False) -> list[Table | Prose]:
    """A table a protocol: its numbers in per cent, what stands beside them, warnings; classes where asked for."""
    parts: list[Table | Prose] = []
    for name, one in document["protocols"].items():
        caption = f" (version {one['version']}), {_scenes(one)}"
        parts.append(text_table(name, _numbers(one), heading=name, caption=caption, notes=_context(one)))
        parts += _classes(name, one) if per_class else []
    return parts


def _scenes(one: Mapping[str, Any]) -> str:
    text = counted(int(one["n_scenes"]), "scene")
    n_missed, n_skipped = len(one["missed_scenes"]), len(one["skipped_scenes"])
    text += f", {n_missed} of them without a prediction" if n_missed else ""
    return text + (f"; {n_skipped} LEFT OUT" if n_skipped else "")


def _numbers(one: Mapping[str, Any]) -> list[list[str]]:
    metrics, intervals = one["metrics"], one["intervals"]
    names = list(metrics)
    is_pooled = metrics == {name: one["pooled"].get(name) for name in names}
    rows = [["", *(NAMES.get(name, name) for name in names)]]
    rows.append(["result", *(with_interval(metrics[name], intervals.get(name)) for name in names)])
    other = ("mean of scenes", one["scene_mean"]) if is_pooled else ("scenes pooled", one["pooled"])
    others = [other, ("ceiling", one["ceiling"]), ("every mask under every class", one["every_mask_every_class"])]
    others.insert(1, ("with every confidence 1", one["every_confidence_1"]))
    others += list(one["groups"].items())
    for title, values in others:
        if values is not None:
            rows.append([title, *(percent(values.get(name)) for name in names)])
    return rows


def _context(one: Mapping[str, Any]) -> Iterable[str]:
    counts = list(one["n_predictions"].values())
    if counts and one["confidences"] is not None:
        spread = f" ({min(counts)} to {max(counts)})" if min(counts) < max(counts) else ""
        twice = one["duplicates"]
        yield (
            f"predictions a scene: {sum(counts) / len(counts):.1f}{spread}; near-duplicate pairs {twice['near']}, "
            f"identical ones {twice['identical']}; confidences {_confidences(one)}"
        )
    if one["contested_points"] is not None:
        yield f"points that several masks claim: {percent(one['contested_points'])} % of those in masks"
    if one["coverage"] is None:
        yield "coverage: unknown, the ground truth has no coordinates"
    else:
        shares = " / ".join(percent(share) for share in one["coverage"].values())
        yield f"scored points with a predicted one within 2.5 / 5 / 10 cm: {shares} %"
    warnings = one["warnings"]
    yield from (f"WARNING: {printable(line)}" for line in warnings[:MOST_NOTES])
    if len(warnings) > MOST_NOTES:
        yield f"and {len(warnings) - MOST_NOTES} more warnings, all in the --json file"


def _confidences(one: Mapping[str, Any]) -> str:
    found = one["confidences"]
    return f"all {found['min']:g}" if found["constant"] else f"{found['min']:g} to {found['max']:g}"


def _classes(protocol: str, one: Mapping[str, Any]) -> list[Table | Prose]:
    """A row a class; those without a value in any column are named beneath."""
    classes = {name: values for name, values in one["per_class"].items() if any(v is not None for v in values.values())}
    if not classes:
        return [Prose(("no class has a value",))]
    columns = list(next(iter(classes.values())))
    rows = [["class", *(NAMES.get(column, column) for column in columns)]]
    rows += [[name, *(percent(values[column]) for column in columns)] for name, values in classes.items()]
    without = [name for name in one["per_class"] if name not in classes]
    note = [Prose((f"no value ({NOT_MEASURED}): {', '.join(without)}",))] if without else []
    return [text_table(f"{protocol}-classes", rows), *note]
