"""Comparison of reported and measured numbers: the difference with its interval, and possible causes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from su3d_bench.analysis.tables import choose, measured_results, numbered_tables
from su3d_bench.core.config import toml_value
from su3d_bench.core.errors import ConfigError, counted, printable, some
from su3d_bench.core.files.atomic import is_file, make_folder
from su3d_bench.formats.tables.table import Cell, Prose, Table, TableRow
from su3d_bench.human_eval.drawing import Figures
from su3d_bench.human_eval.sources import RunSource
from su3d_bench.metrics.costs import summarise
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.reports.pictures.canvas import scale_stops
from su3d_bench.reports.pictures.figures import draw_grid
from su3d_bench.reports.tables.model import Measured
from su3d_bench.reports.tables.paper import OPEN, PAPER_PROFILE, PAPER_SCENES, Figure, Shown
from su3d_bench.reports.tables.timing import timing_tables
from su3d_bench.reproducing.recipe import Experiment, Recipe, method_of_row, methods_of
from su3d_bench.runs.finished import FinishedRun, read_update_times
from su3d_bench.runs.job import GENERATED_SCENES
from su3d_bench.runs.verify import read_checked

_NAMES = ("name", "version", "summary", "original", "headline", "not_comparable_with", "datasets", "by_default")
_ENCODER = ("perception", "models", "encoder")
_EVERY = re.compile(r"every (\d+)(?:st|nd|rd|th)")
MAX_RULES = 4
WARM_UP, CAMERA_HZ = 3, 30.0  # as `report timing` has them
SCHEMA = 1


@dataclass(frozen=True)
class Compared:
    """A printed cell. ``reported``: as printed, in per cent; ``measured``, ``interval``, ``difference``: in percentage
    points, None if nothing was measured (``missing_reason`` has the reason); ``causes``: in order of importance."""

    experiment: str
    method: str
    row: str
    dataset: str
    metric: str
    reported: str
    measured: float | None = None
    interval: tuple[float, float] | None = None
    protocol: str | None = None
    run: str | None = None
    run_method: str | None = None
    n_scenes: int = 0
    causes: tuple[str, ...] = ()
    missing_reason: str = ""
    source: str = ""

    @property
    def difference(self) -> float | None:
        return None if self.measured is None else self.measured - float(self.reported)

    @property
    def difference_interval(self) -> tuple[float, float] | None:
        if self.interval is None:
            return None
        return self.interval[0] - float(self.reported), self.interval[1] - float(self.reported)

    @property
    def is_within(self) -> bool:
        """Whether the printed number lies in the interval of the measured one."""
        return self.interval is not None and self.interval[0] <= float(self.reported) <= self.interval[1]


@dataclass(frozen=True)
class Results:
    """The finished runs of a reproduction, each read once."""

    folders: tuple[Path, ...]

    @cached_property
    def runs(self) -> Mapping[str, FinishedRun]:
        return {str(folder): read_checked(folder) for folder in self.folders}

    @cached_property
    def measured(self) -> Sequence[Measured]:
        return measured_results(self.folders)

    def of(self, experiment: Experiment) -> Results:
        """The runs of an experiment: those with its encoder and stride, and predictions made elsewhere.

        If no run matches, all runs, because then other values were requested instead of the recipe's.
        """
        made = {name: run.settings for name, run in self.runs.items() if _ENCODER in run.settings}
        wanted = experiment.encoder, experiment.stride
        others = {name for name, extra in made.items() if (extra[_ENCODER], extra.get(("stride",), 0)) != wanted}
        if len(others) in (0, len(made)):
            return self
        folders = tuple(folder for folder in self.folders if str(folder) not in others)
        return self._parts.setdefault(folders, Results(folders))

    @cached_property
    def _parts(self) -> dict[tuple[Path, ...], Results]:
        return {}


def compared(experiment: Experiment, results: Results) -> list[Compared]:
    """Every printed cell of an experiment, in the order of ``published.toml``."""
    return [_cell(experiment, figure, metric, results) for figure in experiment.printed() for metric in figure.values]


def _cell(experiment: Experiment, figure: Figure, printed: str, results: Results) -> Compared:
    method = method_of_row(experiment, figure.method, figure.row)
    name = experiment.metric(figure, printed)
    reported = figure.percent(printed)
    assert reported is not None
    blank = Compared(
        experiment.name, figure.method, figure.row or figure.method, figure.dataset, printed, reported,
        source=f"{figure.source}: {figure.setup}",
    )  # fmt: skip
    row = _measured(experiment, figure, method, name, results)
    if row is None:
        return replace(blank, missing_reason=_missing_reason(experiment, figure, method, name, results))
    interval = row.intervals.get(name)
    value = row.metrics[name]
    assert value is not None
    return replace(
        blank,
        measured=100.0 * value,
        interval=None if interval is None else (100.0 * interval[0], 100.0 * interval[1]),
        protocol=row.protocol,
        run=row.run,
        run_method=row.method,
        n_scenes=len(row.per_scene),
        causes=tuple(causes(figure, row, results.runs.get(row.run))),
    )


def _measured(experiment: Experiment, figure: Figure, method: str, metric: str, results: Results) -> Measured | None:
    """The row to compare with a figure: under its own protocol, otherwise the experiment's first with the metric."""
    wanted = list(dict.fromkeys([*([figure.protocol] if figure.protocol else []), *experiment.protocols]))
    wanted = [name for name in wanted if name in experiment.protocols]
    for protocol in wanted:
        for row in results.measured:
            is_of_data = bool(row.per_scene) and figure.dataset.startswith(row.datasets)
            if (row.method, row.protocol) == (method, protocol) and is_of_data and row.metrics.get(metric) is not None:
                return row
    return None


def _missing_reason(experiment: Experiment, figure: Figure, method: str, metric: str, results: Results) -> str:
    if figure.method in experiment.predictions:
        return f"not implemented here: give its predictions with --predictions '{figure.method}=DIR'"
    mine = [row for row in results.measured if row.method == method and row.protocol in experiment.protocols]
    if not mine:
        return f"no run has {printable(method, 60)} under {some(experiment.protocols, 3)}"
    failed = [scene for row in mine for scene in row.failed]
    if failed:
        return f"{printable(method, 60)} failed on {some(failed, 3)}"
    if all(metric not in row.metrics for row in mine):
        return f"no such metric under {some([row.protocol for row in mine], 3)}"
    return f"not scored on {figure.dataset}"


# ---- causes


def causes(figure: Figure, row: Measured, run: FinishedRun | None) -> Iterator[str]:
    """The known differences between how the row of a run and the printed number were produced."""
    if "judged by a person" in figure.setup and not row.is_by_people:
        yield "judges: ground truth instead of an annotator, on other questions"
    yield from _of_protocol(figure, row)
    yield from _of_scenes(figure, row)
    yield from _of_encoder(figure, row)
    yield from _of_proposals(figure, row, run)
    yield from _of_frames(figure, row, run)
    yield from _of_labels(figure, row, run)
    if row.changed and not (figure.row and "=" in figure.row):
        yield f"settings: {some(row.changed, 4)}"


def _of_protocol(figure: Figure, row: Measured) -> Iterator[str]:
    if figure.protocol is None or figure.protocol == row.protocol:
        return
    if not {figure.protocol, row.protocol} <= set(protocol_names()):
        yield f"protocol rule: {row.protocol} instead of {figure.protocol}"
        return
    theirs, ours = (load_protocol(name).as_json for name in (figure.protocol, row.protocol))
    keys = [key for key in dict.fromkeys([*theirs, *ours]) if key not in _NAMES and theirs.get(key) != ours.get(key)]
    extra = f" (other {', '.join(keys[:MAX_RULES])}{' and more' if len(keys) > MAX_RULES else ''})" if keys else ""
    yield f"protocol rule: {row.protocol} instead of {figure.protocol}{extra}"


def _of_scenes(figure: Figure, row: Measured) -> Iterator[str]:
    made = next((part for part in (row.caveat or "").split("; ") if part.startswith(GENERATED_SCENES)), None)
    if made is not None:
        yield f"scenes: {counted(len(row.scenes), 'procedurally generated room')}, not {figure.dataset}'s scenes"
        return
    papers = {f"{row.datasets}/{name}" for name in PAPER_SCENES.get(row.datasets, ())}
    if papers and figure.dataset == row.datasets and row.scenes != papers:
        yield f"scenes: {len(row.scenes & papers)} of the paper's {len(papers)}, {len(row.scenes - papers)} others"
    if row.failed or row.unscored:
        yield f"scenes: {len(row.failed) + len(row.unscored)} of {row.n_planned} without a score"


def _of_encoder(figure: Figure, row: Measured) -> Iterator[str]:
    if row.encoder is None:
        return
    name = figure.protocol or row.protocol
    wanted = load_protocol(name).encoder if name in protocol_names() else None
    if "ncoder is open" in figure.setup:
        yield f"encoder: {row.encoder}; the paper does not state which it used"
    elif wanted is not None and row.encoder != wanted:
        yield f"encoder: {row.encoder} instead of {wanted}"
    elif "OVSeg" in figure.setup:
        yield f"encoder: {row.encoder} instead of OVSeg's"


def _of_proposals(figure: Figure, row: Measured, run: FinishedRun | None) -> Iterator[str]:
    theirs = figure.system.proposals
    own = None if run is None else run.settings.get(("method", row.method, "proposals"))
    if isinstance(own, str):
        yield f"proposals: {toml_value(own)} of {row.method} instead of {_open(theirs)}"
    elif row.profile is not None and row.profile != PAPER_PROFILE:
        yield f"proposals: masks of the profile '{row.profile}' instead of {_open(theirs)}"


def _open(fact: str) -> str:
    return "those of the paper (not stated)" if fact == OPEN else fact


def _of_frames(figure: Figure, row: Measured, run: FinishedRun | None) -> Iterator[str]:
    if row.limit:
        yield f"stride: only the first {counted(row.limit, 'update')} of each scene"
    theirs = figure.system.frames
    ours = None if run is None else _stride(row, run)
    every = _EVERY.match(theirs)
    if ours is None or theirs == OPEN:
        return
    wanted = 1 if theirs.startswith("all") else int(every[1]) if every else None
    if wanted is not None and wanted != ours:
        yield f"stride: one frame in {ours} instead of {theirs}"


def _stride(row: Measured, run: FinishedRun) -> int | None:
    stride = run.settings.get(("stride",), 0) or run.settings.get(("method", row.method, "stride"))
    return None if stride is None else int(stride)


def _of_labels(figure: Figure, row: Measured, run: FinishedRun | None) -> Iterator[str]:
    theirs = figure.system.labels
    if run is None or theirs == OPEN or not theirs.startswith("the "):
        return
    record = run.results.get((row.method, row.protocol))
    ours = None if record is None else record.labels
    if ours is not None and ours != theirs:
        yield f"labels per mask: {ours} instead of {theirs}"


# ---- tables


def comparison_table(experiment: Experiment, cells: Sequence[Compared]) -> Table:
    """One row per printed row and dataset; for each metric the reported and measured value and their difference."""
    metrics = list(dict.fromkeys(cell.metric for cell in cells))
    marks: dict[tuple[str, ...], str] = {}
    rows = []
    for key in dict.fromkeys((cell.source, cell.row, cell.method, cell.dataset) for cell in cells):
        mine = {cell.metric: cell for cell in cells if (cell.source, cell.row, cell.method, cell.dataset) == key}
        extra = tuple(dict.fromkeys(line for cell in mine.values() for line in _notes_of(cell)))
        mark = marks.setdefault(extra, f"[{len(marks) + 1}]")
        shown = tuple(text for metric in metrics for text in _shown(mine.get(metric)))
        rows.append(TableRow(f"{key[1]} on {key[3]} {mark}", tuple(map(Cell, shown))))
    notes = [f"{mark} {'; '.join(extra)}" for extra, mark in marks.items()]
    n = len(cells)
    n_measured = sum(cell.measured is not None for cell in cells)
    n_within = sum(cell.is_within for cell in cells)
    return Table(
        name=f"compared-{experiment.name}",
        caption=f": {experiment.title}; reported and measured values, per cent; difference = measured - reported.",
        head="row",
        columns=tuple(f"{metric} {what}" for metric in metrics for what in ("reported", "measured", "difference")),
        rows=tuple(rows),
        notes=(
            f"{n_measured} of {counted(n, 'printed cell')} measured, {n_within} printed within the 95 % interval of "
            "the measured value; intervals of differences only include variation of the measured value over scenes",
            *notes,
            *([experiment.note] if experiment.note else []),
        ),
        heading=experiment.name,
    )


def _notes_of(cell: Compared) -> list[str]:
    if cell.measured is None:
        return [f"not measured: {cell.missing_reason}"]
    what = list(cell.causes) or ["no known differences: protocol, encoder, proposals and stride are the paper's"]
    return [f"under {cell.protocol}", *what]


def _shown(cell: Compared | None) -> tuple[str, str, str]:
    if cell is None:
        return "-", "-", "-"
    if cell.measured is None:
        return cell.reported, "-", "-"
    difference, ends = cell.difference, cell.difference_interval
    assert difference is not None
    measured = f"{cell.measured:.1f}"
    if cell.interval is not None:
        measured += f" [{cell.interval[0]:.1f}, {cell.interval[1]:.1f}]"
    return cell.reported, measured, f"{difference:+.1f}" + (f" [{ends[0]:+.1f}, {ends[1]:+.1f}]" if ends else "")


def compared_all(experiments: Sequence[Experiment], results: Results) -> dict[str, list[Compared]]:
    """The cells of every experiment that has printed figures."""
    return {one.name: compared(one, results.of(one)) for one in experiments if one.figures}


def tables_of(experiment: Experiment, results: Results) -> list[Table]:
    """The paper's own table of an experiment, as in ``report tables --tables``; empty if it has none."""
    if experiment.table is None:
        return []
    results = results.of(experiment)
    mine = [row for row in results.measured if row.protocol in experiment.protocols]
    methods = [name for name in methods_of(experiment) if any(row.method == name for row in mine)]
    folders = [folder for folder in results.folders if any(row.run == str(folder) for row in mine)]
    try:
        rows = choose(mine, methods, ())
        return numbered_tables([experiment.table], rows, folders, Shown(intervals=True), with_published=True)
    except ConfigError as error:
        raise ConfigError(f"experiment {experiment.name}: {error}") from error


def result_tables(
    experiments: Sequence[Experiment], cells: Mapping[str, Sequence[Compared]], results: Results
) -> list[Table | Prose]:
    """For each experiment the paper's own table, the comparison of reported and measured values, and timing tables."""
    tables: list[Table | Prose] = []
    for experiment in experiments:
        tables += tables_of(experiment, results)
        if cells.get(experiment.name):
            tables.append(comparison_table(experiment, cells[experiment.name]))
        if experiment.timing:
            tables += _timing(experiment, results.of(experiment))
    return tables


def _timing(experiment: Experiment, results: Results) -> Sequence[Table | Prose]:
    timed = [
        times
        for run in results.runs.values()
        for method in methods_of(experiment)
        if method in run.methods and set(experiment.protocols) & set(run.protocols)
        if (times := read_update_times(run, method))
    ]
    hardware = {run.name: run.record.hardware for run in results.runs.values()}
    return timing_tables([summarise(each, WARM_UP) for each in timed], [], hardware, CAMERA_HZ) if timed else []


def compared_json(recipe: Recipe, cells: Mapping[str, Sequence[Compared]]) -> dict[str, Any]:
    """Every printed cell with the measured value, as stored."""
    rows = [
        {**asdict(cell), "difference": cell.difference, "difference_interval": cell.difference_interval}
        for each in cells.values()
        for cell in each
    ]
    return {"schema": SCHEMA, "recipe": recipe.name, "cells": rows}


def draw_queries(experiments: Sequence[Experiment], results: Results, out: Path, device: str) -> Iterator[Path]:
    """One figure per experiment with queries: a row per text, a column per method, of the first scene of its run."""
    for experiment in experiments:
        wanted = set(methods_of(experiment))
        run = next((run for run in results.of(experiment).runs.values() if wanted <= set(run.methods)), None)
        if not experiment.queries or run is None:
            continue
        scene = next((scene for scene in run.scenes if scene in experiment.scenes), run.scenes[0])
        source = RunSource(run, methods_of(experiment), [scene])
        there = [method for method in source.methods if is_file(run.folder.job(scene, method).prediction)]
        drawn = [name for name in there if source.has_instances(scene, name) and source.has_features(scene, name)]
        if drawn:
            make_folder(out)
            figures, picture = Figures(source.of_methods(drawn)), out / f"{experiment.name}.png"
            rows = figures.similarity(experiment.queries, run.encoder(device), "paper")
            draw_grid(picture, figures.columns, rows, scale_stops("paper"))
            yield picture
