"""The tables of an evaluation of predictions made elsewhere, from the value of its JSON file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from su3d_bench.core.errors import counted, printable, some
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, percent, text_table, with_interval
from su3d_bench.reports.tables.model import few_scenes
from su3d_bench.reports.tables.run import run_tables, summed

NAMES = {"ap": "AP", "ap50": "AP50", "ap25": "AP25", "macc": "mAcc", "miou": "mIoU", "fmiou": "F-mIoU"}
NAMES |= {f"top_{k}_{key}": f"top-{k} {name}" for k in range(1, 10) for key, name in NAMES.items()}
MOST_NOTES = 12  # warnings that are printed; the file has all


def evaluation_tables(document: Mapping[str, Any], *, per_class: bool = False) -> list[Table | Prose]:
    """A table a protocol: its numbers in per cent, what stands beside them, warnings; classes where asked for."""
    parts: list[Table | Prose] = []
    for name, scored in document["protocols"].items():
        caption = f" (version {scored['version']}), {_scenes(scored)}"
        parts.append(text_table(name, _numbers(scored), heading=name, caption=caption, notes=_context(scored)))
        parts += _classes(name, scored) if per_class else []
    return parts


def side_by_side_tables(
    metrics: Mapping[str, Any], documents: Mapping[str, Mapping[str, Any]], *, per_class: bool = False
) -> list[Table | Prose]:
    """The tables of a run of several methods; classes of each where asked for."""
    parts = run_tables(metrics)
    for method, document in documents.items() if per_class else ():
        for name, scored in document["protocols"].items():
            parts.append(Prose((f"{printable(method, 80)}, {name}",)))
            parts += _classes(name, scored)
    return parts


def _scenes(scored: Mapping[str, Any]) -> str:
    text = counted(int(scored["n_scenes"]), "scene")
    n_missed, n_skipped = len(scored["missed_scenes"]), len(scored["skipped_scenes"])
    text += f", {n_missed} of them without a prediction" if n_missed else ""
    return text + (f"; {n_skipped} LEFT OUT" if n_skipped else "")


def _numbers(scored: Mapping[str, Any]) -> list[list[str]]:
    metrics, intervals = scored["metrics"], scored["intervals"]
    names = list(metrics)
    is_pooled = metrics == {name: scored["pooled"].get(name) for name in names}
    rows = [["", *(NAMES.get(name, name) for name in names)]]
    rows.append(["result", *(with_interval(metrics[name], intervals.get(name)) for name in names)])
    other = ("mean of scenes", scored["scene_mean"]) if is_pooled else ("scenes pooled", scored["pooled"])
    others = [other, ("the truth's score", scored["ceiling"])]
    others.append(("every mask under every class", scored["every_mask_every_class"]))
    others.insert(1, ("with every confidence 1", scored["every_confidence_1"]))
    others += list(scored["groups"].items())
    for title, values in others:
        if values is not None:
            rows.append([title, *(percent(values.get(name)) for name in names)])
    return rows


def _context(scored: Mapping[str, Any]) -> Iterable[str]:
    counts = list(scored["n_predictions"].values())
    if counts and scored["confidences"] is not None:
        spread = f" ({min(counts)} to {max(counts)})" if min(counts) < max(counts) else ""
        twice = scored["duplicates"]
        yield (
            f"predictions a scene: {sum(counts) / len(counts):.1f}{spread}; near-duplicate pairs {twice['near']}, "
            f"identical ones {twice['identical']}; confidences {_confidences(scored)}"
        )
    if scored["labels"] is not None:
        yield f"of each mask or point counts: {scored['labels']}"
    if scored["contested_points"] is not None:
        yield f"points that several masks claim: {percent(scored['contested_points'])} % of those in masks"
    if scored["coverage"] is None:
        yield "coverage: unknown, the ground truth has no coordinates"
    else:
        shares = " / ".join(percent(share) for share in scored["coverage"].values())
        yield f"scored points with a predicted one within 2.5 / 5 / 10 cm: {shares} %"
    if any(scored["intervals"].values()) and (line := few_scenes(int(scored["n_scenes"]))):
        yield line
    warnings = [
        f"{said}, in {len(scenes)} scenes ({some(scenes, 3)})" if len(scenes) > 1 else ": ".join([*scenes, said])
        for said, scenes in summed(scored["warnings"], scored["per_scene"])
    ]
    yield from (f"WARNING: {printable(line)}" for line in warnings[:MOST_NOTES])
    if len(warnings) > MOST_NOTES:
        yield f"and {len(warnings) - MOST_NOTES} more warnings, all in the --json file"


def _confidences(scored: Mapping[str, Any]) -> str:
    confidences = scored["confidences"]
    return (
        f"all {confidences['min']:g}"
        if confidences["constant"]
        else f"{confidences['min']:g} to {confidences['max']:g}"
    )


def _classes(protocol: str, scored: Mapping[str, Any]) -> list[Table | Prose]:
    """A row a class; those without a value in any column are named beneath."""
    classes = {
        name: values for name, values in scored["per_class"].items() if any(v is not None for v in values.values())
    }
    if not classes:
        return [Prose(("no class has a value",))]
    columns = list(next(iter(classes.values())))
    rows = [["class", *(NAMES.get(column, column) for column in columns)]]
    rows += [[name, *(percent(values[column]) for column in columns)] for name, values in classes.items()]
    without = [name for name in scored["per_class"] if name not in classes]
    note = [Prose((f"no value ({NOT_MEASURED}): {', '.join(without)}",))] if without else []
    return [text_table(f"{protocol}-classes", rows), *note]
