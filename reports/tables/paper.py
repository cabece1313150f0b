"""Tables II and III of OpenSU3D's paper and other selections, from measured and published numbers."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from su3d_bench.core.errors import ConfigError, counted, printable, some, suggest
from su3d_bench.core.system.files import file_text
from su3d_bench.formats.tables.table import (
    NOT_MEASURED,
    Cell,
    Origin,
    Table,
    TableRow,
    Unit,
    bracketed,
    is_count,
    percent,
)
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.metrics.questions.score import RELATIVE, remarks_starting
from su3d_bench.numerics.statistics import SignFlipTest, holm, sign_flip_test
from su3d_bench.reports.tables.model import Measured, confidence_notes, few_scenes, label_notes

FILE = Path(__file__).resolve().parent / "published.toml"
Number = Annotated[str, Field(pattern=r"^\d*\.?\d+$")]  # as printed, with all decimals
PaperTable = Literal["I", "II", "III", "IV", "V", "reasoning"]  # reasoning: in the text, not a table


OPEN = "open"  # not stated in any source that was read
Fact = Annotated[str, Field(min_length=1, max_length=200)]


class System(BaseModel):
    """The system behind a published number, as far as a source states it.

    ``labels`` per mask or point; ``time`` per scene or frame, with hardware; ``frames`` used; ``proposals``: model that
    proposes masks, and its training data.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: Annotated[str, Field(min_length=1)] = OPEN
    labels: Fact = OPEN
    time: Fact = OPEN
    frames: Fact = OPEN
    proposals: Fact = OPEN

    @property
    def words(self) -> str:
        """The known facts, then the ones not stated.

        >>> System(labels="one").words
        'labels per mask: one; time, frames, proposals: not stated'
        """
        facts = {"labels per mask": self.labels, "time": self.time, "frames": self.frames, "proposals": self.proposals}
        known = [f"{what}: {fact}" for what, fact in facts.items() if fact != OPEN]
        unknown = ", ".join(what for what, fact in facts.items() if fact == OPEN)
        return "; ".join([*known, *([f"{unknown}: not stated"] if unknown else [])])


class Figure(BaseModel):
    """One published row: ``values`` is metric -> number as printed, in ``unit``; ``system``: the system behind it.

    ``table`` and ``row``: its table in OpenSU3D's paper, and its label there. ``protocol``: the protocol here closest
    to the set-up. ``read_from``: the paper itself, or another paper that quotes it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    method: Annotated[str, Field(min_length=1)]
    dataset: Annotated[str, Field(min_length=1)]
    setup: Annotated[str, Field(min_length=1)]
    source: Annotated[str, Field(min_length=1)]
    read_from: Literal["paper", "quoted"] = "paper"
    unit: Literal["percent", "fraction"] = "percent"
    values: Annotated[dict[str, Number], Field(min_length=1)]
    system: System = System()
    protocol: str | None = None
    table: PaperTable | None = None
    row: str | None = None
    note: str | None = None

    def percent(self, metric: str) -> str | None:
        """Return the number in per cent with the decimals as printed; None if it was not printed.

        >>> Figure(method="a", dataset="b", setup="c", source="d", unit="fraction", values={"AP": ".204"}).percent("AP")
        '20.4'
        """
        text = self.values.get(metric)
        if text is None or self.unit == "percent":
            return text
        return f"{Decimal(text).scaleb(2):f}"


@cache
def published() -> tuple[Figure, ...]:
    """Return the numbers of ``published.toml``, each figure with its system instead of the system's name."""
    table = tomllib.loads(file_text(FILE))
    systems = {entry["name"]: entry for entry in table["system"]}
    figures = [one | ({"system": systems[one["system"]]} if "system" in one else {}) for one in table["figure"]]
    return tuple(map(Figure.model_validate, figures))


def figures_of(*, is_wanted: bool = True, **fields: str) -> list[Figure]:
    """Return the figures whose ``fields`` match, such as ``method="sam3d"``; an empty list if not wanted."""
    figures = published() if is_wanted else ()
    return [figure for figure in figures if all(getattr(figure, name) == value for name, value in fields.items())]


LEVEL = 0.05
PAPER_PROFILE = "paper"
PAPER_SCENES: Mapping[str, tuple[str, ...]] = {
    "replica": ("office0", "office1", "office2", "office3", "office4", "room0", "room1", "room2"),
    "scannet": ("scene0000_00", "scene0034_00", "scene0164_03", "scene0525_01", "scene0549_00"),
}


@dataclass(frozen=True)
class Layout:
    """A table of the paper, or half of one: its metrics, the protocol closest to its set-up, and its subject."""

    metrics: tuple[str, ...]
    protocol: str
    subject: str = ""


LAYOUTS: Mapping[PaperTable, Layout] = {
    "II": Layout(("mAcc", "F-mIoU"), "replica-conceptgraphs-ex6", "Semantic segmentation"),
    "III": Layout(("AP", "AP50", "AP25"), "replica-openmask3d", "Instance segmentation"),
}


@dataclass(frozen=True)
class Shown:
    """Options for the content of cells and the marking of best values; ``unit``: unit of shares.

    ``n_judged``: show the number of questions or instances behind each share.
    """

    metrics: tuple[str, ...] = ()
    intervals: bool = False
    ceilings: bool = False
    scenes_count: bool = False
    only_significant: bool = False
    n_judged: bool = False
    unit: Unit = "percent"


def paper_table(number: PaperTable, measured: Sequence[Measured], shown: Shown, *, with_published: bool) -> list[Table]:
    """Return Table II or III of the paper under the protocol of its set-up.

    Without scores under that protocol: one table for each other protocol with its metrics.
    """
    layout = LAYOUTS[number]
    metrics = shown.metrics or layout.metrics
    fitting = [row for row in measured if all(name in row.metrics for name in metrics)]
    if not fitting:
        have = ", ".join(dict.fromkeys(row.protocol for row in measured))
        raise ConfigError(
            f"Table {number}: needs {', '.join(metrics)}, which none of the runs' protocols has ({have}); score them "
            f"also with --protocols {layout.protocol}"
        )
    scored = [row for row in fitting if row.per_scene] or fitting
    names = list(dict.fromkeys(row.protocol for row in scored))
    names = [layout.protocol] if layout.protocol in names else names
    figures = figures_of(is_wanted=with_published, table=number)
    tables = []
    for name in names:
        rows = [row for row in fitting if row.protocol == name]
        table = protocol_table(rows, replace(shown, metrics=metrics), figures)
        where = next((row.datasets for row in rows if row.per_scene), "no scene")
        setup = other_setup(rows, is_its_protocol=name == layout.protocol)
        caption = f"{layout.subject} on {where}, {name}{setup}."
        tables.append(replace(table, name=f"{number}-{name}", caption=caption))
    return tables


def other_setup(
    rows: Sequence[Measured],
    *,
    is_its_protocol: bool,
    datasets: Sequence[str] = ("replica",),
    more: Sequence[str] = (),
) -> str:
    """Return the addition to a caption if the set-up of ``rows`` differs from the paper's; otherwise "".

    ``datasets``: those of the paper's table; ``more``: other known differences.
    """
    scored = [row for row in rows if row.per_scene]
    profiles = {row.profile for row in scored} - {None}
    differs = [
        *([] if is_its_protocol else ["protocol"]),
        *([] if all(row.scenes == _papers_scenes(row, datasets) for row in scored) else ["scenes"]),
        *(["frames"] if any(row.limit or _of_stride(row) for row in scored) else []),
        *(["settings"] if any(set(row.changed) - _of_stride(row) for row in scored) else []),
        *(["perception"] if profiles - {PAPER_PROFILE} else []),
        *(["encoder"] if profiles <= {PAPER_PROFILE} and not all(map(_has_its_encoder, scored)) else []),
        *more,
    ]
    return f"; not the paper's set-up: other {', '.join(differs)}" if differs else ""


def _of_stride(row: Measured) -> set[str]:
    """Return the changed settings that select frames."""
    return {setting for setting in row.changed if setting.startswith("stride = ")}


def _papers_scenes(row: Measured, datasets: Sequence[str]) -> set[str]:
    """Return the paper's scenes of the dataset of ``row``; empty if its table does not have that dataset."""
    names = PAPER_SCENES.get(row.datasets, ()) if row.datasets in datasets else ()
    return {f"{row.datasets}/{name}" for name in names}


def _has_its_encoder(row: Measured) -> bool:
    """Whether the encoder is the one that the protocol requires; True if either is unknown."""
    is_known = row.encoder is not None and row.protocol in protocol_names()
    return not is_known or load_protocol(row.protocol).encoder in (None, row.encoder)


def selection_tables(measured: Sequence[Measured], shown: Shown, *, with_published: bool) -> list[Table]:
    """Return one table per protocol, in run order, with the selected metrics that it has; none without any."""
    tables = []
    known = {name for row in measured for name in row.metrics}
    for name in dict.fromkeys(row.protocol for row in measured):
        rows = [row for row in measured if row.protocol == name]
        metrics = shown.metrics
        if known.issuperset(metrics):  # otherwise the table reports the unknown metric
            metrics = tuple(metric for metric in metrics if metric in rows[0].metrics)
        if metrics or not shown.metrics:
            figures = figures_of(is_wanted=with_published, protocol=name)
            tables.append(protocol_table(rows, replace(shown, metrics=metrics), figures))
    return tables


def protocol_table(measured: Sequence[Measured], shown: Shown, figures: Sequence[Figure]) -> Table:
    """Return the table of ``measured`` results under one protocol, with the published ``figures`` below.

    A failed method has a row without values; methods that the protocol cannot score are listed in a note.
    """
    rows = [row for row in measured if row.per_scene or row.failed]
    if not rows:
        raise ConfigError(f"{measured[0].protocol}: has no scores of {', '.join(row.method for row in measured)}")
    first = next((row for row in rows if row.per_scene), rows[0])
    left_out = [row.method for row in measured if row not in rows]
    metrics = shown.metrics or rows[0].headline
    for name in metrics:
        if name not in rows[0].metrics:
            known = suggest(name, rows[0].metrics, "it has")
            raise ConfigError(f"{rows[0].protocol}: has no metric '{printable(name, 60)}'{known}")
    are_alike = all(row.is_whole and row.scenes == rows[0].scenes for row in rows)
    shown = replace(shown, metrics=metrics, scenes_count=shown.scenes_count or not are_alike)
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
            *label_notes(metrics),
            *run_notes(rows, labels),
            *([f"not scored under this protocol: {', '.join(left_out)}"] if left_out else []),
            *([why] if why else []),
            *sources,
        ),
    )


def units(row: Measured, shown: Shown) -> str:
    """Return the note on protocol, data, units and intervals of a table."""
    interval = ""
    if shown.intervals:
        interval = f"; in brackets the 95 % confidence interval over {'items' if row.is_by_people else 'scenes'}"
        rough = None if row.is_by_people else few_scenes(len(row.scenes))
        interval += f" ({rough})" if rough else ""
    ceiling = "; (GT ceiling): score of the ground truth" if shown.ceilings else ""
    unit = "per cent" if shown.unit == "percent" else "fractions"
    n = "; n: number of judged items" if shown.n_judged else ""
    scenes = counted(len(row.per_scene), "scene")
    return (
        f"Protocol {row.protocol}, version {row.version}, on {row.datasets} ({scenes}); {unit}{interval}{ceiling}{n}."
    )


def labels_of(rows: Sequence[Measured]) -> list[str]:
    """Return the method names, with the run's name if several rows have the same method."""
    names = [row.method for row in rows]
    short = [row.run.rstrip("/").rpartition("/")[2] for row in rows]
    pairs = list(zip(names, short, strict=True))
    runs = [row.run if pairs.count(pair) > 1 else pair[1] for row, pair in zip(rows, pairs, strict=True)]
    return [f"{name} ({run})" if names.count(name) > 1 else name for name, run in zip(names, runs, strict=True)]


def _columns(shown: Shown) -> list[str]:
    ceilings = [f"{name} (GT ceiling)" for name in shown.metrics] if shown.ceilings else []
    return [*shown.metrics, *ceilings, *(["scenes"] if shown.scenes_count else [])]


def cells_of(row: Measured, shown: Shown, best: set[str]) -> list[Cell]:
    cells = []
    for name in shown.metrics:
        interval = row.intervals.get(name) if shown.intervals else None
        value = row.metrics.get(name)
        beside = bracketed(interval, partial(shown_as, name, unit=shown.unit))
        n_judged = row.metrics.get(f"n_{name}") if shown.n_judged else None
        beside += "" if n_judged is None else f" n={n_judged:.0f}"
        origin = None if value is None else replace(_origin(row, name, value, interval), unit=shown.unit)
        cells.append(Cell(shown_as(name, value, shown.unit), beside.lstrip(), name in best, origin))
    for name in shown.metrics if shown.ceilings else ():
        value = row.ceilings.get(name)
        origin = None if value is None else replace(_origin(row, name, value), what="ceiling", unit=shown.unit)
        cells.append(Cell(shown_as(name, value, shown.unit), origin=origin))
    if shown.scenes_count:
        n = float(len(row.per_scene))
        cells.append(Cell(row.scenes_text, origin=replace(_origin(row, "scenes", n), what="scenes")))
    return cells


def _origin(row: Measured, metric: str, value: float, interval: tuple[float, float] | None = None) -> Origin:
    return Origin(row.run, row.method, row.protocol, row.version, metric, "value", value, interval)


def shown_as(metric: str, value: float | None, unit: Unit = "percent") -> str:
    """Format ``value`` for a table: shares in their unit, counts as numbers.

    >>> shown_as("AP", 0.1234), shown_as("AP", 0.1234, "fraction"), shown_as("n_classes", 12.0)
    ('12.3', '0.123', '12')
    """
    if value is not None and is_count(metric):
        return f"{value:.1f}".removesuffix(".0")
    return percent(value) if value is None or unit == "percent" else f"{value:.3f}"


def best_rows(rows: Sequence[Measured], shown: Shown) -> tuple[dict[str, set[int]], str | None]:
    """Return metric -> rows to mark as best, and the note on the marks; rows of different scenes are not compared.

    Rows with the same printed best value are all marked, or none if only significant best values are marked.
    """
    scored = [k for k, row in enumerate(rows) if row.per_scene]
    competing = [k for k in scored if not rows[k].is_ceiling] or scored
    if len(competing) < 2:
        return {}, None
    if len({(rows[k].scenes, rows[k].limit) for k in competing}) > 1:
        return {}, "The rows have different scenes or frames, so that no best value is marked."
    marked: dict[str, set[int]] = {}
    tests: dict[str, SignFlipTest | None] = {}
    is_contradicted: dict[str, bool] = {}
    for name in shown.metrics:
        values = np.array([np.nan if row.metrics.get(name) is None else row.metrics[name] for row in rows], np.float64)
        order = sorted(competing, key=lambda k: -np.nan_to_num(values[k], nan=-1.0))
        if np.isnan(values[order[0]]):
            continue
        best = {k for k in competing if percent(rows[k].metrics.get(name)) == percent(float(values[order[0]]))}
        if shown.only_significant:
            tests[name], is_contradicted[name] = _paired_test(rows[order[0]], rows[order[1]], name)
        if len(best) < len(competing):
            marked[name] = best
    if not shown.only_significant:
        return marked, "Bold: the highest measured value." if any(marked.values()) else None
    for name, p in zip(tests, holm([None if test is None else test.p for test in tests.values()]), strict=True):
        if name in marked and (len(marked[name]) > 1 or p is None or p >= LEVEL or is_contradicted[name]):
            marked[name] = set()
    least = holm([None if test is None else test.smallest_p for test in tests.values()])
    smallest = min((p for p in least if p is not None), default=1.0)
    corrected = f", corrected by Holm for {len(tests)} metrics" if len(tests) > 1 else ""
    over = "items" if rows[0].is_by_people and any(row.tests for row in rows) else "scenes"
    if smallest >= LEVEL:
        return marked, nothing_can_be_marked(over, smallest)
    return marked, (
        f"Bold: the highest measured value if it differs from the second (two-sided sign-flip test over {over}, "
        f"p < {LEVEL}{corrected}; with these {over} p cannot be below {smallest:.2g})."
    )


def nothing_can_be_marked(over: str, smallest: float) -> str:
    """Return the note for samples too small for any significant difference."""
    return f"No best value is marked: with so few {over}, p < {LEVEL} is impossible (at least {smallest:.2g})."


def _paired_test(row: Measured, other: Measured, metric: str) -> tuple[SignFlipTest | None, bool]:
    """Return the paired test over items for annotators' judgements, otherwise over the scenes with values of both.

    Also whether the mean over scenes, which the test uses, contradicts the order of the two over all scenes together.
    """
    if row.is_by_people and (row.tests or other.tests):
        return row.tests.get((metric, other.method)), False
    change = of_scenes(row, metric) - of_scenes(other, metric)
    return sign_flip_test(change), bool(np.nansum(change) < 0)


def of_scenes(row: Measured, metric: str) -> np.ndarray:
    """Return the value of each scene, sorted by scene name; NaN without a value."""
    values = [row.per_scene[scene].get(metric) for scene in sorted(row.per_scene)]
    return np.array([np.nan if value is None else value for value in values], np.float64)


def run_notes(rows: Sequence[Measured], labels: Sequence[str]) -> list[str]:
    """Return the notes on measured rows: missing scenes, partial runs, changed settings, perception, confidences."""
    notes: dict[str, list[str]] = {}
    for row, label in zip(rows, labels, strict=True):
        parts = [
            f"PARTIAL: only the first {counted(row.limit, 'frame')} of each scene" if row.limit else "",
            f"with {some(row.changed, 8)}" if row.changed else "",
            f"INCOMPLETE: failed on {some(row.failed, 4)}" if row.failed else "",
            f"not scored on {some(row.unscored, 4)}" if row.unscored else "",
            row.caveat or "",
            f"perception {row.profile}{f', encoder {row.encoder}' if row.encoder else ''}" if row.profile else "",
            *(f"{RELATIVE}{one}" for one in remarks_starting(row.warnings, RELATIVE)),
        ]
        for what in filter(None, parts):
            notes.setdefault(what, []).append(label)
    everyone = len(rows)
    return [
        *(
            f"{'all measured rows' if len(who) == everyone > 1 else ', '.join(who)}: {what}"
            for what, who in notes.items()
        ),
        *confidence_notes({label: row.confidences for row, label in zip(rows, labels, strict=True)}),
    ]


def reported_rows(
    figures: Sequence[Figure], metrics: Sequence[str], n_columns: int, *, as_fractions: bool = False
) -> tuple[list[TableRow], list[str]]:
    """Return a marked row for each figure with one of ``metrics``, and the notes that give their sources."""
    rows: list[TableRow] = []
    marks: dict[str, str] = {}
    for figure in figures:
        values = [figure.values.get(name) if as_fractions else figure.percent(name) for name in metrics]
        if not any(values):
            continue
        how = "as quoted in" if figure.read_from == "quoted" else "as reported in"
        source = f"{how} {figure.source}: {figure.setup}"
        source += f"; {figure.note}" if figure.note else ""
        source += f"; {figure.system.words}"
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
