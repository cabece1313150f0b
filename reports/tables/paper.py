"""The tables of OpenSU3D's paper and any other selection, from measured results and what papers report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from su3d_bench.core.errors import ConfigError, printable, suggest
from su3d_bench.numerics.statistics import SignFlipTest, holm, sign_flip_test
from su3d_bench.reports.tables.model import (
    NOT_MEASURED,
    Cell,
    Measured,
    Origin,
    Table,
    TableRow,
    bracketed,
    few_scenes,
    is_count,
    percent,
    some,
)
from su3d_bench.reports.tables.published import Figure, PaperTable, figures_of

LEVEL = 0.05
PAPER_DATA = "replica"  # of Tables II and III


@dataclass(frozen=True)
class Layout:
    """A table of the paper: its metrics, the protocol of its set-up, and its subject."""

    metrics: tuple[str, ...]
    protocol: str
    subject: str


LAYOUTS: Mapping[PaperTable, Layout] = {
    "II": Layout(("mAcc", "F-mIoU"), "replica-conceptgraphs-ex6", "Semantic segmentation"),
    "III": Layout(("AP", "AP50", "AP25"), "replica-openmask3d", "Instance segmentation"),
}


@dataclass(frozen=True)
class Shown:
    """What stands in the cells, and which best values are marked."""

    metrics: tuple[str, ...] = ()
    intervals: bool = False
    ceilings: bool = False
    scenes_count: bool = False
    only_significant: bool = False


def paper_table(number: PaperTable, measured: Sequence[Measured], shown: Shown, *, with_published: bool) -> list[Table]:
    """Table II or III of the paper: under the protocol of its set-up, or one each for the others that have its metrics.

    ``found`` under several protocols of which one is the paper's gives that one alone.
    """
    layout = LAYOUTS[number]
    metrics = shown.metrics or layout.metrics
    fitting = [row for row in measured if all(name in row.metrics for name in metrics)]
    if not fitting:
        have = ", ".join(dict.fromkeys(row.protocol for row in measured))
        raise ConfigError(
            f"Table {number}: needs {', '.join(metrics)}, which none of the runs' protocols has ({have}); score them "
            f"with --protocols {layout.protocol} too"
        )
    names = list(dict.fromkeys(row.protocol for row in fitting))
    names = [layout.protocol] if layout.protocol in names else names
    figures = figures_of(is_wanted=with_published, table=number)
    tables = []
    for name in names:
        rows = [row for row in fitting if row.protocol == name]
        table = protocol_table(rows, replace(shown, metrics=metrics), figures)
        where = next((row.datasets for row in rows if row.per_scene), "no scene")
        setup = "" if name == layout.protocol else ", not the paper's set-up"
        setup += " and data" if setup and where != PAPER_DATA else ""
        caption = f"{layout.subject} on {where}, {name}{setup}."
        tables.append(replace(table, name=f"{number}-{name}", caption=caption))
    return tables


def selection_tables(measured: Sequence[Measured], shown: Shown, *, with_published: bool) -> list[Table]:
    """One table a protocol, in the order of the runs; of chosen metrics those that it has, none where it has none."""
    tables = []
    known = {name for row in measured for name in row.metrics}
    for name in dict.fromkeys(row.protocol for row in measured):
        rows = [row for row in measured if row.protocol == name]
        metrics = shown.metrics
        if known.issuperset(metrics):  # else the table says which is known nowhere
            metrics = tuple(metric for metric in metrics if metric in rows[0].metrics)
        if metrics or not shown.metrics:
            figures = figures_of(is_wanted=with_published, protocol=name)
            tables.append(protocol_table(rows, replace(shown, metrics=metrics), figures))
    return tables


def protocol_table(measured: Sequence[Measured], shown: Shown, figures: Sequence[Figure]) -> Table:
    """The table of what was ``measured`` under one protocol, reported ``figures`` beneath.

    A method that failed has a row without values; one that the protocol cannot score is named in a note.
    """
    rows = [row for row in measured if row.per_scene or row.failed]
    if not rows:
        raise ConfigError(f"{measured[0].protocol}: scored none of {', '.join(row.method for row in measured)}")
    first = next((row for row in rows if row.per_scene), rows[0])
    left_out = [row.method for row in measured if row not in rows]
    metrics = shown.metrics or rows[0].headline
    for name in metrics:
        if name not in rows[0].metrics:
            known = suggest(name, rows[0].metrics) or f"; it has {', '.join(rows[0].metrics)}"
            raise ConfigError(f"{rows[0].protocol}: has no metric '{printable(name, 60)}'{known}")
    shown = replace(shown, metrics=metrics, scenes_count=shown.scenes_count or not _are_alike(rows))
    best, why = best_rows(rows, shown)
    labels = labels_of(rows)
    body = [
        TableRow(label, tuple(cells_of(row, shown, {name for name in metrics if k in best.get(name, ())})))
        for k, (row, label) in enumerate(zip(rows, labels, strict=True))
    ]
    reported, sources = reported_rows(figures, metrics, len(_columns(shown)))
    return Table(
        name=rows[0].protocol,
        caption=f"Protocol {rows[0].protocol} on {first.datasets}.",
        head="method",
        columns=tuple(_columns(shown)),
        rows=(*body, *reported),
        notes=(
            units(first, shown),
            *run_notes(rows, labels),
            *([f"not scored under this protocol: {', '.join(left_out)}"] if left_out else []),
            *([why] if why else []),
            *sources,
        ),
    )


def units(row: Measured, shown: Shown) -> str:
    """What the numbers of a table are."""
    interval = ""
    if shown.intervals:
        interval = f"; in brackets the 95 % interval over {'items' if row.is_by_people else 'scenes'}"
        rough = None if row.is_by_people else few_scenes(len(row.scenes))
        interval += f" ({rough})" if rough else ""
    ceiling = "; ceil.: what the truth itself scores" if shown.ceilings else ""
    return f"Protocol {row.protocol}, version {row.version}, on {row.datasets}; per cent{interval}{ceiling}."


def _are_alike(rows: Sequence[Measured]) -> bool:
    """Whether all rows are of the same whole scenes, so that their number need not be shown."""
    return all(row.is_whole and row.scenes == rows[0].scenes for row in rows)


def labels_of(rows: Sequence[Measured]) -> list[str]:
    """The method, with the run's name where two rows are of one method."""
    names = [row.method for row in rows]
    short = [row.run.rstrip("/").rpartition("/")[2] for row in rows]
    pairs = list(zip(names, short, strict=True))
    runs = [row.run if pairs.count(pair) > 1 else pair[1] for row, pair in zip(rows, pairs, strict=True)]
    return [f"{name} ({run})" if names.count(name) > 1 else name for name, run in zip(names, runs, strict=True)]


def _columns(shown: Shown) -> list[str]:
    ceilings = [f"{name} ceil." for name in shown.metrics] if shown.ceilings else []
    return [*shown.metrics, *ceilings, *(["scenes"] if shown.scenes_count else [])]


def cells_of(row: Measured, shown: Shown, best: set[str]) -> list[Cell]:
    cells = []
    for name in shown.metrics:
        interval = row.intervals.get(name) if shown.intervals else None
        value = row.metrics.get(name)
        beside = bracketed(interval, partial(shown_as, name))
        origin = None if value is None else _origin(row, name, value, interval=interval)
        cells.append(Cell(shown_as(name, value), beside, name in best, origin))
    for name in shown.metrics if shown.ceilings else ():
        value = row.ceilings.get(name)
        origin = None if value is None else replace(_origin(row, name, value), what="ceiling")
        cells.append(Cell(shown_as(name, value), origin=origin))
    if shown.scenes_count:
        n = float(len(row.per_scene))
        cells.append(Cell(row.scenes_text, origin=replace(_origin(row, "scenes", n), what="scenes")))
    return cells


def _origin(row: Measured, metric: str, value: float, interval: tuple[float, float] | None = None) -> Origin:
    return Origin(row.run, row.method, row.protocol, row.version, metric, "value", value, interval)


def shown_as(metric: str, value: float | None) -> str:
    """``value`` as a table shows it: a share in per cent, a count as it is."""
    return percent(value) if value is None or not is_count(metric) else f"{value:.1f}".removesuffix(".0")


def best_rows(rows: Sequence[Measured], shown: Shown) -> tuple[dict[str, set[int]], str | None]:
    """Metric -> the rows to mark, and what must be said of the marks; rows of other scenes are not compared.

    Rows that print the same best value are all marked; where only a significant best is marked, none of them.
    """
    scored = [k for k, row in enumerate(rows) if row.per_scene]
    competing = [k for k in scored if not rows[k].is_ceiling] or scored
    if len(competing) < 2:
        return {}, None
    if len({(rows[k].scenes, rows[k].limit) for k in competing}) > 1:
        return {}, "The rows are of different scenes or frames, so that none is marked as the best."
    marked: dict[str, set[int]] = {}
    tests: dict[str, SignFlipTest | None] = {}
    for name in shown.metrics:
        values = np.array([np.nan if row.metrics.get(name) is None else row.metrics[name] for row in rows], np.float64)
        order = sorted(competing, key=lambda k: -np.nan_to_num(values[k], nan=-1.0))
        if np.isnan(values[order[0]]):
            continue
        best = {k for k in competing if percent(rows[k].metrics.get(name)) == percent(float(values[order[0]]))}
        if shown.only_significant:
            tests[name] = sign_flip_test(_of_scenes(rows[order[0]], name) - _of_scenes(rows[order[1]], name))
        if len(best) < len(competing):
            marked[name] = best
    if not shown.only_significant:
        return marked, "Bold: the highest measured value." if any(marked.values()) else None
    for name, p in zip(tests, holm([None if test is None else test.p for test in tests.values()]), strict=True):
        if name in marked and (len(marked[name]) > 1 or p is None or p >= LEVEL):
            marked[name] = set()
    smallest = min((test.smallest_p for test in tests.values() if test is not None), default=1.0)
    corrected = f", corrected by Holm for {len(tests)} metrics" if len(tests) > 1 else ""
    return marked, (
        "Bold: the highest measured value where it differs from the second (two-sided sign-flip test over scenes, "
        f"p < {LEVEL}{corrected}; with these scenes p cannot be below {smallest:.2g})."
    )


def _of_scenes(row: Measured, metric: str) -> np.ndarray:
    values = [row.per_scene[scene].get(metric) for scene in sorted(row.per_scene)]
    return np.array([np.nan if value is None else value for value in values], np.float64)


def run_notes(rows: Sequence[Measured], labels: Sequence[str]) -> list[str]:
    """What must be known of measured rows: missing scenes, partial runs, where masks come from, who names."""
    notes: dict[str, list[str]] = {}
    for row, label in zip(rows, labels, strict=True):
        if row.limit:
            notes.setdefault(f"PARTIAL: only the first {row.limit} frames of each scene", []).append(label)
        if row.failed:
            notes.setdefault(f"INCOMPLETE: failed on {some(row.failed, 4)}", []).append(label)
        if row.unscored:
            notes.setdefault(f"unscored on {some(row.unscored, 4)}", []).append(label)
        if row.caveat:
            notes.setdefault(row.caveat, []).append(label)
        if row.profile:
            encoder = f", encoder {row.encoder}" if row.encoder else ""
            notes.setdefault(f"perception {row.profile}{encoder}", []).append(label)
    everyone = len(rows)
    return [
        f"{'all measured rows' if len(who) == everyone > 1 else ', '.join(who)}: {what}" for what, who in notes.items()
    ]


def reported_rows(
    figures: Sequence[Figure], metrics: Sequence[str], n_columns: int, *, as_fractions: bool = False
) -> tuple[list[TableRow], list[str]]:
    """A row for each figure that has one of ``metrics``, marked, and the notes that say where the marks lead."""
    rows: list[TableRow] = []
    marks: dict[str, str] = {}
    for figure in figures:
        values = [figure.values.get(name) if as_fractions else figure.percent(name) for name in metrics]
        if not any(values):
            continue
        how = "as quoted in" if figure.read_from == "quoted" else "as reported in"
        source = f"{how} {figure.source}: {figure.setup}"
        source += f"; {figure.note}" if figure.note else ""
        mark = marks.setdefault(source, _mark(len(marks)))
        cells = [Cell(value or NOT_MEASURED) for value in values]
        cells += [Cell("")] * (n_columns - len(cells))
        rows.append(TableRow(figure.row or figure.method, tuple(cells), is_reported=True, mark=mark))
    notes = [f"[{mark}] {source}. Not measured here." for source, mark in marks.items()]
    return rows, notes


def _mark(k: int) -> str:
    """a, b, ... z, aa, ab, ...

    >>> _mark(0), _mark(27)
    ('a', 'ab')
    """
    letter = chr(ord("a") + k % 26)
    return letter if k < 26 else _mark(k // 26 - 1) + letter


SIDES = (LAYOUTS["II"], LAYOUTS["III"])  # its columns are those of Tables II and III together
METRICS = tuple(name for side in SIDES for name in side.metrics)


@dataclass(frozen=True)
class SweepRow:
    """A value of a parameter, and the method of the run that has it."""

    parameter: str
    value: str
    method: str


def ablation_table(
    measured: Sequence[Measured], sweep: Sequence[SweepRow], shown: Shown, *, with_published: bool
) -> Table:
    """A row for each of ``sweep``, the best of each parameter marked.

    Raises ``ConfigError`` where ``found`` lacks one of its methods, or a protocol of either kind.
    """
    sides = [_of_protocol(measured, side) for side in SIDES]
    looks = [replace(shown, metrics=side.metrics, ceilings=False, scenes_count=False) for side in SIDES]
    rows: list[TableRow] = []
    notes: dict[str, None] = {}
    marks: dict[str, None] = {}
    for parameter in dict.fromkeys(row.parameter for row in sweep):
        members = [row for row in sweep if row.parameter == parameter]
        halves = [_cells(members, side, look, marks) for side, look in zip(sides, looks, strict=True)]
        rows += [
            TableRow(f"{parameter} = {member.value}", (*left, *right), group=parameter)
            for member, left, right in zip(members, *halves, strict=True)
        ]
    used = {row.method for row in sweep}
    for side, look in zip(sides, looks, strict=True):
        own = [row for method, row in side.items() if method in used]
        notes[f"{', '.join(look.metrics)}: {units(own[0], look)}"] = None
        labels = [row.method if row.is_whole else f"{row.method} ({row.scenes_text} scenes)" for row in own]
        notes |= dict.fromkeys(run_notes(own, labels))
    is_papers = with_published and sweep[0].method.partition("@")[0] == "opensu3d"
    figures = figures_of(is_wanted=is_papers, table="I")
    reported, sources = reported_rows(figures, METRICS, len(METRICS))
    body = (*rows, *map(_named, reported))
    return Table("I", "Ablation of single parameters.", "parameter", METRICS, body, (*notes, *marks, *sources))


def _of_protocol(measured: Sequence[Measured], side: Layout) -> dict[str, Measured]:
    """Method -> its numbers under the protocol of that side's set-up, or the first that has its metrics."""
    fitting = [row for row in measured if all(name in row.metrics for name in side.metrics)]
    if not fitting:
        raise ConfigError(f"Table I: needs {', '.join(side.metrics)}; score the sweep under {side.protocol} too")
    names = [row.protocol for row in fitting]
    chosen = side.protocol if side.protocol in names else names[0]
    members: dict[str, Measured] = {}
    for row in fitting:
        if row.protocol == chosen and members.setdefault(row.method, row) is not row:
            raise ConfigError(f"Table I: {row.method} is in {members[row.method].run} and {row.run}; name one of them")
    return members


def _cells(
    sweep: Sequence[SweepRow], side: Mapping[str, Measured], shown: Shown, marks: dict[str, None]
) -> list[list[Cell]]:
    """The cells of one parameter's rows; what must be said of the best of them is entered in ``marks``."""
    for entry in sweep:
        if entry.method not in side:
            raise ConfigError(
                f"Table I: no scores of {entry.method} for {', '.join(shown.metrics)}; run the sweep again, it goes on "
                "where it stopped"
            )
    rows = [side[row.method] for row in sweep]
    best, why = best_rows(rows, shown)
    marks |= {why: None} if why else {}
    return [
        cells_of(row, shown, {name for name in shown.metrics if k in best.get(name, ())}) for k, row in enumerate(rows)
    ]


def _named(row: TableRow) -> TableRow:
    parameter, _, value = row.label.partition("=")
    return replace(row, label=f"{parameter} = {value}", group=parameter)
