"""Tables II and III of OpenSU3D's paper and any other selection, from measured results and what papers report."""

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
Number = Annotated[str, Field(pattern=r"^\d*\.?\d+$")]  # as printed: the number of decimals says something
PaperTable = Literal["I", "II", "III", "IV", "V", "reasoning"]  # the last is of the text alone


OPEN = "open"  # no source that was read says it
Fact = Annotated[str, Field(min_length=1, max_length=200)]


class System(BaseModel):
    """What made a printed number, as far as a source says.

    ``labels`` a mask or point; ``time`` of a scene or frame, with hardware; ``frames`` that were used; ``proposals``:
    what finds masks, and on what it was trained.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: Annotated[str, Field(min_length=1)] = OPEN
    labels: Fact = OPEN
    time: Fact = OPEN
    frames: Fact = OPEN
    proposals: Fact = OPEN

    @property
    def words(self) -> str:
        """What is known, and then what is open.

        >>> System(labels="one").words
        'labels a mask: one; time, frames, proposals: open'
        """
        facts = {"labels a mask": self.labels, "time": self.time, "frames": self.frames, "proposals": self.proposals}
        known = [f"{what}: {fact}" for what, fact in facts.items() if fact != OPEN]
        unknown = ", ".join(what for what, fact in facts.items() if fact == OPEN)
        return "; ".join([*known, *([f"{unknown}: {OPEN}"] if unknown else [])])


class Figure(BaseModel):
    """One printed row: ``values`` is metric -> number as printed, in ``unit``; ``system`` is what made it.

    ``table`` and ``row``: the table of OpenSU3D's paper in which it stands, and its label there. ``protocol``: ours
    that comes nearest to the set-up. ``read_from``: the paper itself, or somebody who quotes it.
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
        """The number in per cent with the decimals that it was printed with; None where it was not printed.

        >>> Figure(method="a", dataset="b", setup="c", source="d", unit="fraction", values={"AP": ".204"}).percent("AP")
        '20.4'
        """
        text = self.values.get(metric)
        if text is None or self.unit == "percent":
            return text
        return f"{Decimal(text).scaleb(2):f}"


@cache
def published() -> tuple[Figure, ...]:
    """What papers report, as ``published.toml`` has it, each figure with its system in place of that one's name."""
    table = tomllib.loads(file_text(FILE))
    systems = {entry["name"]: entry for entry in table["system"]}
    figures = [one | ({"system": systems[one["system"]]} if "system" in one else {}) for one in table["figure"]]
    return tuple(map(Figure.model_validate, figures))


def figures_of(*, is_wanted: bool = True, **fields: str) -> list[Figure]:
    """What is reported where each of ``fields`` is as given, such as ``method="sam3d"``; none where not wanted."""
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
    """A table of the paper, or half of one: its metrics, the protocol of its set-up, and its subject."""

    metrics: tuple[str, ...]
    protocol: str
    subject: str = ""


LAYOUTS: Mapping[PaperTable, Layout] = {
    "II": Layout(("mAcc", "F-mIoU"), "replica-conceptgraphs-ex6", "Semantic segmentation"),
    "III": Layout(("AP", "AP50", "AP25"), "replica-openmask3d", "Instance segmentation"),
}


@dataclass(frozen=True)
class Shown:
    """What stands in the cells, and which best values are marked; ``unit``: in which shares stand there.

    ``n_judged``: beside a share, of how many questions or instances it is.
    """

    metrics: tuple[str, ...] = ()
    intervals: bool = False
    ceilings: bool = False
    scenes_count: bool = False
    only_significant: bool = False
    n_judged: bool = False
    unit: Unit = "percent"


def paper_table(number: PaperTable, measured: Sequence[Measured], shown: Shown, *, with_published: bool) -> list[Table]:
    """Table II or III of the paper: under the protocol of its set-up, or one each for the others that have its metrics.

    What was scored under several protocols of which one is the paper's gives that one alone.
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
    """What a caption adds where ``rows`` were not made as the paper's were, and in what they differ; else nothing.

    ``datasets``: those of the paper's table; ``more``: what else is known to differ.
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
    """What of the changed settings says which frames are taken."""
    return {setting for setting in row.changed if setting.startswith("stride = ")}


def _papers_scenes(row: Measured, datasets: Sequence[str]) -> set[str]:
    """The paper's scenes of the data of ``row``, none where its table has no such data."""
    names = PAPER_SCENES.get(row.datasets, ()) if row.datasets in datasets else ()
    return {f"{row.datasets}/{name}" for name in names}


def _has_its_encoder(row: Measured) -> bool:
    """Whether the features are of the encoder that the protocol names, as far as both name one."""
    is_known = row.encoder is not None and row.protocol in protocol_names()
    return not is_known or load_protocol(row.protocol).encoder in (None, row.encoder)


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
    """What the numbers of a table are."""
    interval = ""
    if shown.intervals:
        interval = f"; in brackets the 95 % interval over {'items' if row.is_by_people else 'scenes'}"
        rough = None if row.is_by_people else few_scenes(len(row.scenes))
        interval += f" ({rough})" if rough else ""
    ceiling = "; (truth): what the truth itself scores" if shown.ceilings else ""
    unit = "per cent" if shown.unit == "percent" else "shares of 1"
    n = "; n: how many were judged" if shown.n_judged else ""
    scenes = counted(len(row.per_scene), "scene")
    return (
        f"Protocol {row.protocol}, version {row.version}, on {row.datasets} ({scenes}); {unit}{interval}{ceiling}{n}."
    )


def labels_of(rows: Sequence[Measured]) -> list[str]:
    """The method, with the run's name where two rows are of one method."""
    names = [row.method for row in rows]
    short = [row.run.rstrip("/").rpartition("/")[2] for row in rows]
    pairs = list(zip(names, short, strict=True))
    runs = [row.run if pairs.count(pair) > 1 else pair[1] for row, pair in zip(rows, pairs, strict=True)]
    return [f"{name} ({run})" if names.count(name) > 1 else name for name, run in zip(names, runs, strict=True)]


def _columns(shown: Shown) -> list[str]:
    ceilings = [f"{name} (truth)" for name in shown.metrics] if shown.ceilings else []
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
    """``value`` as a table shows it: a share in its unit, a count as it is.

    >>> shown_as("AP", 0.1234), shown_as("AP", 0.1234, "fraction"), shown_as("n_classes", 12.0)
    ('12.3', '0.123', '12')
    """
    if value is not None and is_count(metric):
        return f"{value:.1f}".removesuffix(".0")
    return percent(value) if value is None or unit == "percent" else f"{value:.3f}"


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
        f"Bold: the highest measured value where it differs from the second (two-sided sign-flip test over {over}, "
        f"p < {LEVEL}{corrected}; with these {over} p cannot be below {smallest:.2g})."
    )


def nothing_can_be_marked(over: str, smallest: float) -> str:
    """What is said, once, where no difference over so few could be told from chance."""
    return f"No best is marked: with so few {over} no difference can have p < {LEVEL} (the least is {smallest:.2g})."


def _paired_test(row: Measured, other: Measured, metric: str) -> tuple[SignFlipTest | None, bool]:
    """People's over the same items where they judged, else over the scenes that both have a value for.

    And whether ``row``, the higher over all scenes together, is the lower of the two in the mean over scenes, which is
    what a test over scenes is of.
    """
    if row.is_by_people and (row.tests or other.tests):
        return row.tests.get((metric, other.method)), False
    change = of_scenes(row, metric) - of_scenes(other, metric)
    return sign_flip_test(change), bool(np.nansum(change) < 0)


def of_scenes(row: Measured, metric: str) -> np.ndarray:
    """The value of each scene, by the scene's name; NaN where there is none."""
    values = [row.per_scene[scene].get(metric) for scene in sorted(row.per_scene)]
    return np.array([np.nan if value is None else value for value in values], np.float64)


def run_notes(rows: Sequence[Measured], labels: Sequence[str]) -> list[str]:
    """What must be known of measured rows: missing scenes, partial runs, where masks come from, who names."""
    notes: dict[str, list[str]] = {}
    for row, label in zip(rows, labels, strict=True):
        said = [
            f"PARTIAL: only the first {counted(row.limit, 'frame')} of each scene" if row.limit else "",
            f"with {some(row.changed, 8)}" if row.changed else "",
            f"INCOMPLETE: failed on {some(row.failed, 4)}" if row.failed else "",
            f"unscored on {some(row.unscored, 4)}" if row.unscored else "",
            row.caveat or "",
            f"perception {row.profile}{f', encoder {row.encoder}' if row.encoder else ''}" if row.profile else "",
            *(f"{RELATIVE}{one}" for one in remarks_starting(row.warnings, RELATIVE)),
        ]
        for what in filter(None, said):
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
