"""Tables of a run, from ``metrics.json``, and of an evaluation of external predictions."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from su3d_bench.core.english import is_countable, plural
from su3d_bench.core.errors import counted, printable, some
from su3d_bench.formats.tables.table import NOT_MEASURED, Prose, Table, is_count, percent, text_table, with_interval
from su3d_bench.metrics.scoring import EVERY_SCENE
from su3d_bench.reports.tables.model import confidence_notes, few_scenes, is_ceiling, label_count_notes, label_notes
from su3d_bench.store.records import UnscoredRecord

# A count, and the text up to the first named item. Counts of classes are not summed, because scenes share classes.
_COUNTED = re.compile(r"(?P<n>\d+) (?:of (?P<of>\d+) )?(?P<what>(?!class)[^,:;(]+)(?:[,:;(].*)?", re.DOTALL)
EXAMPLE = ", such as "  # begins the part of a counted sentence that holds for several scenes
_PLURAL = {"mask": "masks", "pair": "pairs", "has": "have", "counts": "count", "is": "are"}


def summed(warnings: Sequence[str], scenes: Collection[str]) -> list[tuple[str, list[str]]]:
    """Group equal warnings of several ``scenes`` and add up their counts.

    A warning begins with its scene and a colon, or belongs to no scene.

    >>> summed(["a: 1 empty mask, the first is mask 3", "b: 2 empty masks, the first is mask 0", "c"], ["a", "b"])
    [('3 empty masks', ['a', 'b']), ('c', [])]
    >>> summed(["a: 1 of 4 masks has no class: 1 of class 7", "b: 2 of 6 masks have no class: 2 of class 9"], "ab")
    [('3 of 10 masks have no class', ['a', 'b'])]
    >>> summed(["a: 2 of 4 labels are no classes, such as 'A'", "b: 1 of 6 labels are no classes, such as 'B'"], "ab")
    [("3 of 10 labels are no classes, such as 'A'", ['a', 'b'])]
    """
    groups: dict[str, list[tuple[str, str, re.Match[str] | None]]] = {}
    for line in warnings:
        scene, _, sentence = line.partition(": ")
        if scene not in scenes:
            groups.setdefault(line, []).append(("", line, None))
            continue
        found = _COUNTED.fullmatch(sentence)
        groups.setdefault(sentence if found is None else _in_plural(found["what"]), []).append((scene, sentence, found))
    return [(_sentence(key, group), [scene for scene, _, _ in group if scene]) for key, group in groups.items()]


def _sentence(key: str, group: Sequence[tuple[str, str, re.Match[str] | None]]) -> str:
    counts = [found for _, _, found in group if found is not None]
    if len(group) == 1 or not counts:
        return group[0][1]
    total = f"{sum(int(found['n']) for found in counts)} "
    if all(found["of"] for found in counts):
        total += f"of {sum(int(found['of']) for found in counts)} "
    _, sentence, found = group[0]
    rest = sentence[found.end("what") :] if found is not None else ""
    return total + key + (rest if rest.startswith(EXAMPLE) else "")


def _in_plural(words: str) -> str:
    first, *rest = words.strip().split(" ")
    verb = next((k for k, word in enumerate(rest) if word in ("has", "have")), len(rest))
    plural = [_PLURAL.get(word, word) if k <= verb or word == "counts" else word for k, word in enumerate(rest)]
    return " ".join([_PLURAL.get(first, first), *plural])


MAX_NAMES = 8  # names shown per scene; the rest is counted
UNNAMED = "unnamed"


@dataclass(frozen=True)
class Found:
    """The map of a method in a scene; ``n_instances`` is None for maps with features only, ``update_ms`` is None if the
    method uses no frames.

    ``names``: names and their number of instances, most frequent first; ``extents_m``: the longest box edges of the
    smallest, the median and the largest instance.
    """

    scene: str
    method: str
    n_points: int
    n_instances: int | None
    names: tuple[tuple[str, int], ...]
    extents_m: tuple[float, float, float] | None
    n_updates: int
    update_ms: float | None


def found_table(rows: Sequence[Found], run: str = "") -> Table:
    """Return one row per scene and method; ``run``: shown in the caption if there are several."""
    head = ["scene", "method", "instances", "points", "smallest / median / largest (m)", "updates", "ms per update"]
    body = [
        [
            row.scene,
            row.method,
            NOT_MEASURED if row.n_instances is None else str(row.n_instances),
            f"{row.n_points:,}",
            NOT_MEASURED if row.extents_m is None else " / ".join(f"{extent:.2f}" for extent in row.extents_m),
            str(row.n_updates),
            NOT_MEASURED if row.update_ms is None else f"{row.update_ms:.0f}",
            names_text(row.names),
        ]
        for row in rows
    ]
    note = "sizes: longest edges of the instances' boxes; ms per update: median, including perception"
    of = run and f": {run}"
    return text_table("found", [[*head, "names"], *body], heading="Maps without scores", caption=of, notes=(note,))


def names_text(names: Sequence[tuple[str, int]], most: int = MAX_NAMES) -> str:
    """Return the most frequent names with their counts.

    >>> names_text((("chair", 3), ("sofa", 1), ("", 2))), names_text((("lamp", 1), ("bed", 1)), most=1)
    ('3 chairs, sofa, 2 unnamed', 'lamp and 1 name more')
    """
    if not names:
        return NOT_MEASURED
    shown = ", ".join(_of_name(name, n) for name, n in names[:most])
    n_more = len(names) - most
    return f"{shown} and {counted(n_more, 'name')} more" if n_more > 0 else shown


def _of_name(name: str, n: int) -> str:
    if not name.strip():
        return f"{n} {UNNAMED}"
    return name if n == 1 else f"{n} {plural(name) if is_countable(name) else name}"


def not_scored_lines(reasons: Iterable[UnscoredRecord]) -> list[str]:
    """Return one line per reason; protocols are listed together, similar scenes are counted."""
    of_kind: dict[tuple[str, tuple[str, ...]], list[UnscoredRecord]] = {}
    for reason in reasons:
        of_kind.setdefault((reason.protocol, _kind(reason)), []).append(reason)
    protocols: dict[tuple[str, str, int], list[str]] = {}
    for (protocol, _), alike in of_kind.items():
        first = alike[0]
        scene = printable(first.scene)
        why = first.reason if first.reason.startswith((first.scene, scene)) else f"{scene}: {first.reason}"
        methods = some(list(dict.fromkeys(reason.method for reason in alike)), MAX_NAMES)
        n_scenes = len({reason.scene for reason in alike})
        protocols.setdefault((methods, why, n_scenes), []).append(protocol)
    return [
        f"{methods}: not scored under {', '.join(names)}: {why}{f' (and similarly in {n - 1} more)' if n > 1 else ''}"
        for (methods, why, n), names in protocols.items()
    ]


def _kind(reason: UnscoredRecord) -> tuple[str, ...]:
    """Return the words of a reason that do not depend on its scene: no paths, no words with the scene's name."""
    own = reason.scene.rpartition("/")[2]
    return tuple(word for word in reason.reason.split() if "/" not in word and own not in word)


MAX_SCENES = 20  # named per line
MAX_NOTES = 12  # printed warnings of a method; the file has all
MEAN, POOLED, EVERY_CLASS = "mean over scenes", "all scenes pooled", "each mask under each class"
NOTE_OF_MEAN = (
    "values over all scenes pool their counts (for AP, the detections of all scenes are ranked together); the mean "
    "over scenes weights each scene equally and averages over the classes in it, so the two differ"
)
CHEAP = {"chance": "by chance", "names-alone": "by names alone"}  # prefix of metric names -> row label


def run_tables(
    metrics: Mapping[str, Any],
    found: Sequence[Found] = (),
    evaluated: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    per_class: bool = False,
) -> list[Table | Prose]:
    """Return one table per protocol with scores or failures: one row per method, details and notes below.

    ``metrics``: content of ``metrics.json``; ``found``: maps without scores; ``evaluated``: by method, the JSON of an
    evaluation of external predictions. Numbers are percentages with their 95 % confidence interval over scenes.
    """
    rows_of: dict[str, list[Mapping[str, Any]]] = {}
    for result in metrics["results"]:
        rows_of.setdefault(str(result["protocol"]), []).append(result)
    results = metrics["results"]
    with_results = [rows for rows in rows_of.values() if any(row["result"] or row["failed"] for row in rows)]
    if any(row["result"] for row in results):
        parts: list[Table | Prose] = []
        for rows in with_results:
            parts.append(_protocol_table(rows, metrics, evaluated or {}))
            parts += [part for row in rows if per_class and row["result"] for part in _classes(row)]
    else:  # one list instead of empty tables
        failed = {f"{row['method']} failed on {', '.join(row['failed'])}" for row in results if row["failed"]}
        parts = [Prose(tuple(sorted(failed)) or ("no protocol applies to these scenes",), is_list=bool(failed))]
    return [*parts, *([found_table(found)] if found else [])]


def headline(result: Mapping[str, Any]) -> str:
    """Return the headline metrics in one line: ``F-mIoU 31.2 [28.9, 33.4] (8 scenes, GT ceiling 97.1), ...``."""
    parts = []
    for name in result["headline"]:
        remarks = [_scenes_text(result) + " scenes"]
        if result["ceiling"] is not None:
            remarks.append(f"GT ceiling {percent(result['ceiling'].get(name))}")
        parts.append(f"{name} {_value_text(result, name)} ({', '.join(remarks)})")
    return ", ".join(parts)


def _protocol_table(
    rows: Sequence[Mapping[str, Any]], metrics: Mapping[str, Any], evaluated: Mapping[str, Mapping[str, Any]]
) -> Table:
    first = rows[0]
    names = list(first["headline"])
    title = f"{first['protocol']} (version {first['version']})"
    if metrics["is_partial"]:
        title += f": PARTIAL, only the first {counted(int(metrics['limit']), 'frame')} of each scene"
    header = ["method", *names, f"GT ceiling ({' / '.join(names)})", "scenes", "coverage @ 2.5 / 5 / 10 cm"]
    scored = {
        str(row["method"]): document["protocols"].get(first["protocol"])
        for row in rows
        if (document := evaluated.get(row["method"]))
    }
    body, notes = [], []
    for row in rows:
        body.append([row["method"], *(_value_text(row, name) for name in names), *_context(row, names)])
        details = _details(row, names, scored.get(row["method"]))
        for label, values in details.items():
            shares = [f"{row['method']}: {label}", *(percent(values.get(name)) for name in names)]
            body.append([*shares, *[NOT_MEASURED] * (len(header) - len(shares))])
        notes += [NOTE_OF_MEAN] if {MEAN, POOLED} & details.keys() and NOTE_OF_MEAN not in notes else []
    body += _cheap_rows(rows, names, len(header))
    notes += [line for row in rows for line in _notes(row)]
    for method, one in scored.items():
        whose = f"{method}: " if len(rows) > 1 else ""
        notes += [f"{whose}{line}" for line in (_facts_of_files(one) if one else ())]
    notes += confidence_notes({str(row["method"]): row.get("confidences") for row in rows})
    own = [row for row in rows if not is_ceiling(str(row["method"]), row["caveat"])]
    notes += label_count_notes({str(row["method"]): row.get("labels") for row in own})
    n_scenes = [row["result"]["n_scenes"] for row in rows if row["result"] and any(row["result"]["intervals"].values())]
    notes += label_notes(names)
    notes += [line for line in (few_scenes(min(n_scenes, default=0)),) if line]
    return text_table(str(first["protocol"]), [header, *body], heading=title, notes=notes)


def _details(
    row: Mapping[str, Any], names: Sequence[str], scored: Mapping[str, Any] | None
) -> dict[str, Mapping[str, Any]]:
    """Return further values of a method by their label: mean over scenes, bounds, and groups of classes."""
    result = row["result"]
    if result is None or is_ceiling(str(row["method"]), row["caveat"]):
        return {}
    details: dict[str, Mapping[str, Any]] = {}
    mean, pooled = result.get("scene_mean"), result.get("pooled")
    if result["n_scenes"] > 1 and mean and pooled:
        is_pooled = all(result["metrics"].get(name) == pooled.get(name) for name in names)
        details = {MEAN: mean} if is_pooled else {POOLED: pooled}
    for label, key in (("all confidences 1", "every_confidence_1"), (EVERY_CLASS, "every_mask_every_class")):
        if scored is not None and scored[key] is not None:
            details[label] = {name: scored[key].get(name.lower()) for name in names}
    groups: dict[str, Mapping[str, Any]] = result.get("groups", {})
    shown = {label for label in groups if any(name.endswith(f" {label}") for name in names)}  # as columns
    return details | {label: values for label, values in groups.items() if label not in shown}


def _cheap_rows(rows: Sequence[Mapping[str, Any]], names: Sequence[str], n_columns: int) -> list[list[str]]:
    """Return the rows of chance level, names-only baseline and number of questions; empty without a chance level."""
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
    """Yield the notes below a table: incomplete scenes, the caveat of the profile, warnings with their scenes."""
    method = row["method"]
    if row["failed"]:
        yield f"INCOMPLETE: {method} failed on {', '.join(row['failed'])}"
    if row["unscored"]:
        yield f"{method} is not scored on {some(row['unscored'], MAX_SCENES)}"
    if row["caveat"]:
        yield f"{method}: {row['caveat']}"
    warnings = [] if row["result"] is None else [str(line) for line in row["result"]["warnings"]]
    lines = summed(warnings, {line.partition(": ")[0] for line in warnings if ": " in line})
    for said, scenes in lines[:MAX_NOTES]:
        where = [EVERY_SCENE] if EVERY_SCENE in scenes else scenes
        yield f"{method}: {said}" + (f" ({some(where, 3)})" if where else "")
    if len(lines) > MAX_NOTES:
        yield f"{method}: and {len(lines) - MAX_NOTES} more warnings, all in --json"


def _facts_of_files(scored: Mapping[str, Any]) -> Iterable[str]:
    """Yield what an evaluation knows of the files of predictions."""
    counts = list(scored["n_predictions"].values())
    if counts and scored["confidences"] is not None:
        spread = f" ({min(counts)} to {max(counts)})" if min(counts) < max(counts) else ""
        twice, of = scored["duplicates"], scored["confidences"]
        said = f"all {of['min']:g}" if of["constant"] else f"{of['min']:g} to {of['max']:g}"
        yield (
            f"predictions per scene: {sum(counts) / len(counts):.1f}{spread}; near-duplicate pairs {twice['near']}, "
            f"identical pairs {twice['identical']}; confidences {said}"
        )
    if scored["labels"] is not None:
        yield f"counted per mask or point: {scored['labels']}"
    if scored["contested_points"] is not None:
        yield f"points in several masks: {percent(scored['contested_points'])} % of the points in masks"
    if scored["coverage"] is None:
        yield "coverage: unknown because the ground truth has no coordinates"


def _classes(row: Mapping[str, Any]) -> list[Table | Prose]:
    """Return one row per class of a method; classes without any value are named below."""
    all_classes = row["result"]["per_class"]
    classes = {name: values for name, values in all_classes.items() if any(v is not None for v in values.values())}
    heading = f"{row['protocol']}, classes of {printable(str(row['method']), 80)}"
    if not classes:
        return [Prose((f"{heading}: none has a value",))]
    columns = [name for name in next(iter(classes.values())) if not is_count(name)]
    rows = [["class", *columns]]
    rows += [[name, *(percent(values[column]) for column in columns)] for name, values in classes.items()]
    without = [name for name in all_classes if name not in classes]
    note = [f"no value ({NOT_MEASURED}): {', '.join(without)}"] if without else []
    return [text_table(f"{row['protocol']}-classes", rows, heading=heading, notes=note)]
