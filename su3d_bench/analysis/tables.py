"""Numbers of finished runs for tables, and checks of a paper's table cells against them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from su3d_bench.analysis.sides import Side, check_comparable
from su3d_bench.core.errors import ConfigError, Su3dError, counted, printable, reading, suggest
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.system.files import file_bytes
from su3d_bench.formats.tables.table import Origin, Table, is_count
from su3d_bench.human_eval.items import SCHEMA
from su3d_bench.human_eval.scores import FILE as SCORES_FILE
from su3d_bench.human_eval.scores import LABEL_METRICS, ScoreCell, Scores, read_scores
from su3d_bench.metrics.costs import UpdateTimes
from su3d_bench.numerics.statistics import SignFlipTest
from su3d_bench.reports.tables.ablation import ablation_table
from su3d_bench.reports.tables.judged import JUDGED, ROLE_LABELS, judged_table
from su3d_bench.reports.tables.latex import PrintedCell, printed_cells
from su3d_bench.reports.tables.model import ANNOTATED_SUFFIX, Measured
from su3d_bench.reports.tables.paper import PaperTable, Shown, paper_table
from su3d_bench.reports.tables.run import found_table
from su3d_bench.reports.tables.timing import SEEN, SEEN_CEILING, WHOLE, AnytimePoint
from su3d_bench.runs.ablation import read_rows
from su3d_bench.runs.finished import FinishedRun, is_scores_file, read_run
from su3d_bench.runs.summary import found_in, without_score
from su3d_bench.runs.verify import read_checked
from su3d_bench.store.records import NumbersRecord, ResultRecord

MAX_SOURCE_BYTES, MAX_SOURCES = 1 << 24, 500  # of a paper's LaTeX
_READ_SOURCE = re.compile(r"\\(?:input|include)\s*\{([^{}\0]{1,200})\}")
_COMMENT = re.compile(r"(?<!\\)%.*")


def measured_results(folders: Sequence[Path]) -> list[Measured]:
    """The results of every method and protocol of the runs, after a check that those of one protocol are comparable.

    A folder or file of ``scores.json`` gives the scores by annotators.

    Raises ``ConfigError`` if data, rules or encoder of two runs differ.
    """
    paths = dict.fromkeys(folders)
    runs = {str(folder): read_checked(folder) for folder in paths if not is_scores(folder)}
    measured = [row for path in paths if is_scores(path) for row in _annotated_rows(path)]
    first: dict[str, tuple[FinishedRun, Measured]] = {}
    for name, run in runs.items():
        for row in results_of(name, run):
            if row.protocol in first and first[row.protocol][0] is not run:
                other, known = first[row.protocol]
                common = sorted(known.scenes & row.scenes)
                check_comparable(Side(other, known.method), Side(run, row.method), row.protocol, common)
            first.setdefault(row.protocol, (run, row))
            measured.append(row)
    return measured


def check_scored(measured: Sequence[Measured], paths: Sequence[Path]) -> None:
    """Raise a ``ConfigError`` if no row has a scene with a score."""
    if not any(row.per_scene for row in measured):
        raise ConfigError(f"{', '.join(map(str, paths))}: no scene was scored, so there is nothing to put in a table")


def found_tables(paths: Sequence[Path], methods: Sequence[str] = (), datasets: Sequence[str] = ()) -> list[Table]:
    """One table per run of what its methods found in scenes without scores."""
    runs = [read_run(path) for path in dict.fromkeys(paths) if not is_scores(path)]
    tables = []
    for run in runs:
        jobs = [
            (scene, method)
            for scene, method in without_score(run)
            if (not methods or method in methods) and (not datasets or scene.partition("/")[0] in datasets)
        ]
        if found := tuple(found_in(run.folder, jobs)):
            tables.append(found_table(found, run.name if len(runs) > 1 else ""))
    return tables


def is_scores(path: Path) -> bool:
    """Whether ``path`` is what ``sheets score`` writes, rather than a run."""
    if path.suffix == ".json":
        return not is_scores_file(path)
    return is_file(path / SCORES_FILE) and not is_file(path / "run.json")


def _annotated_rows(path: Path) -> list[Measured]:
    """The annotators' scores of each method and dataset."""
    scores = read_scores(path)
    groups: dict[tuple[str, str], list[ScoreCell]] = {}
    for cell in scores.cells:
        if cell.judge == "people":
            groups.setdefault((cell.dataset, cell.method), []).append(cell)
    measured = []
    for (dataset, method), cells in groups.items():
        scenes = sorted({scene for cell in cells for scene in cell.per_scene})
        measured.append(
            Measured(
                run=str(path),
                method=method,
                protocol=f"{dataset}-{scores.kind}{ANNOTATED_SUFFIX}",
                version=SCHEMA,
                kind=scores.kind,
                headline=tuple(cell.metric for cell in cells),
                metrics={cell.metric: cell.value for cell in cells}
                | {f"n_{cell.metric}": float(cell.n_items) for cell in cells},
                intervals={cell.metric: cell.interval for cell in cells},
                per_scene={scene: {cell.metric: cell.per_scene.get(scene) for cell in cells} for scene in scenes},
                n_planned=len(scenes),
                caveat=_annotator_summary(scores, cells),
                limit=scores.limit,
                profile=scores.profile or None,
                encoder=scores.encoder or None,
                changed=tuple(scores.changed.get(method, ())),
                warnings=(
                    *scores.remarks,
                    *([f"{ROLE_LABELS[scores.kind]}{scores.answered_by}"] if scores.answered_by else []),
                ),
                tests=_tests_of(scores, dataset, method),
            )
        )
    return measured


def _tests_of(scores: Scores, dataset: str, method: str) -> dict[tuple[str, str], SignFlipTest]:
    """The tests of a method, by metric and other method; the test of its own two labels has its own name as key."""
    found = {}
    labels = [f"{method} {name}" for name in LABEL_METRICS]
    for test in scores.tests:
        pair = [test.left, test.right]
        if test.dataset == dataset and (method in pair or pair == labels):
            other = method if pair == labels else pair[1 - pair.index(method)]
            found[test.metric, other] = SignFlipTest(test.p, test.smallest_p, test.n_differ, test.is_exact)
    return found


def _annotator_summary(scores: Scores, cells: Sequence[ScoreCell]) -> str:
    n_people = len(scores.annotators)
    n_items = max(cell.n_items for cell in cells)
    of = "" if scores.n_judged == scores.n_items else f", {scores.n_judged} of the set's {scores.n_items} judged"
    return f"judged by {counted(n_people, 'annotator')}, {counted(n_items, 'item')}{of}"


def results_of(name: str, run: FinishedRun) -> list[Measured]:
    names = {one.protocol: one.result.metrics for one in run.results.values() if one.result is not None}
    return [_measured(name, run, one, names.get(one.protocol, one.headline)) for one in run.results.values()]


def _measured(name: str, run: FinishedRun, record: ResultRecord, names: Iterable[str]) -> Measured:
    """``names``: the protocol's metrics, None for a method without numbers."""
    nothing = dict.fromkeys(names)
    numbers = record.result or NumbersRecord(scenes=(), metrics=nothing, intervals={}, per_scene={}, per_class={})
    return Measured(
        run=name,
        method=record.method,
        protocol=record.protocol,
        version=record.version,
        kind=record.kind,
        headline=record.headline,
        metrics=numbers.metrics,
        intervals=numbers.intervals,
        per_scene=numbers.per_scene,
        ceilings=record.ceiling or {},
        n_planned=record.n_planned,
        failed=record.failed,
        unscored=record.unscored,
        limit=run.limit,
        profile=record.profile,
        encoder=record.encoder,
        confidences=record.confidences,
        caveat=record.caveat,
        changed=run.changed(record.method),
        warnings=numbers.warnings,
    )


def anytime_points(runs: Sequence[FinishedRun], times: Sequence[UpdateTimes]) -> list[AnytimePoint]:
    """The intermediate maps and the final one of a method in one of ``runs``, if intermediate maps were scored: against
    the whole ground truth, then against what was seen, and this ground truth itself."""
    run = next(run for run in runs if run.name == times[0].run)
    method = times[0].method
    points = []
    for (name, protocol), record in run.results.items():
        if name != method or not record.anytime or record.result is None:
            continue
        midway = sorted(record.anytime, key=lambda point: point.share)
        n_maps, is_every = len(midway) + 1, midway[0].n_updates > 0
        if any(len(each.maps) > n_maps or len(each.maps) < (1 if is_every else n_maps) for each in times):
            continue  # the record of a scene's maps is damaged
        shares = [*(point.share for point in midway), 1.0]
        seconds = [sum(_seconds_until(one, index, share) for one in times) for index, share in enumerate(shares)]
        curves = {WHOLE: [*(point.metrics for point in midway), record.result.metrics]}
        if record.seen is not None and len(record.seen) == n_maps:
            curves |= {SEEN: [point.metrics for point in record.seen]}
            curves |= {SEEN_CEILING: [point.ceiling or {} for point in record.seen]}
        for truth, of_curve in curves.items():
            for share, until, metrics in zip(shares, seconds, of_curve, strict=True):
                headline = {metric: metrics.get(metric) for metric in record.headline}
                points.append(AnytimePoint(run.name, method, protocol, share, until, headline, truth))
    return points


def _seconds_until(times: UpdateTimes, index: int, share: float) -> float:
    """Seconds of the updates before a map, or before the last one if the scene has fewer, and of finishing it, without
    reading frames; in real time those of the recording."""
    if times.realtime is not None:
        return share * times.realtime.duration_s
    made = times.maps[min(index, len(times.maps) - 1)]
    return float((times.ms("total") - times.ms("decode"))[: made.n_updates].sum() + made.finish_ms) / 1e3


def choose(
    measured: Sequence[Measured], methods: Sequence[str], protocols: Sequence[str], datasets: Sequence[str] = ()
) -> list[Measured]:
    """The rows of ``methods``, ``protocols`` and ``datasets`` (by default all), methods in the order asked for."""
    for wanted, known, what in (
        (datasets, {scene.partition("/")[0] for row in measured for scene in row.per_scene}, "dataset"),
        (methods, {row.method for row in measured}, "method"),
        (protocols, {row.protocol for row in measured}, "protocol"),
    ):
        for name in wanted:
            if name not in known:
                hint = suggest(name, sorted(known), "they have")
                raise ConfigError(f"these runs have no scores of the {what} '{printable(name, 80)}'{hint}")
    kept = [row for row in measured if not datasets or _is_of(row, datasets)]
    kept = [row for row in kept if not protocols or row.protocol in protocols]
    kept = [row for name in methods for row in kept if row.method == name] if methods else kept
    return [row for name in protocols for row in kept if row.protocol == name] if protocols else kept


def _is_of(row: Measured, datasets: Sequence[str]) -> bool:
    """Whether all its scenes are of ``datasets``; an error if only some are, because its numbers cover all of them."""
    own = {scene.partition("/")[0] for scene in (*row.per_scene, *row.failed, *row.unscored)}
    if own & set(datasets) and not own <= set(datasets):
        raise ConfigError(
            f"{row.protocol}: its numbers cover {row.datasets} together; name all or none of them, or run each alone"
        )
    return bool(own) and own <= set(datasets)


@dataclass(frozen=True)
class CellCheck:
    """A cell of a paper: the number shown, the number from the run (None: none), and the fault, None if correct."""

    file: str
    line: int
    shown: str
    found: str | None
    fault: str | None


class _Recomputed:
    """Numbers recomputed from the counts of runs, each run and protocol once."""

    def __init__(self, roots: Sequence[Path]) -> None:
        self._roots = roots
        self._runs: dict[str, FinishedRun] = {}

    def _run(self, name: str) -> FinishedRun:
        if name not in self._runs:
            self._runs[name] = read_checked(self._place(name, lambda place: is_file(place / "run.json")))
        return self._runs[name]

    def _place(self, name: str, is_it: Callable[[Path], bool]) -> Path:
        """The path of the run or the scores ``name``."""
        places = [root / name for root in self._roots]
        return next(filter(is_it, places), places[0])

    def numbers(self, origin: Origin) -> Measured:
        """The numbers of a cell; ``Su3dError`` if they cannot be computed or have another version than the cell."""
        result = self._of_people(origin) if origin.protocol.endswith(ANNOTATED_SUFFIX) else self._result(origin)
        if result.version != origin.version:
            raise ConfigError(f"the cell has version {origin.version} of {origin.protocol}, the run {result.version}")
        return result

    def _of_people(self, origin: Origin) -> Measured:
        path = self._place(origin.run, lambda place: is_file(place) or is_file(place / SCORES_FILE))
        for row in _annotated_rows(path):
            if (row.protocol, row.method) == (origin.protocol, origin.method):
                return row
        raise ConfigError(f"{path}: has no scores of '{printable(origin.method, 80)}' by annotators")

    def _result(self, origin: Origin) -> Measured:
        run = self._run(origin.run)
        run.check_method(origin.method)
        record = run.results.get((origin.method, origin.protocol))
        if record is None or record.result is None:
            raise ConfigError(f"{run.name}: was not scored under '{printable(origin.protocol, 80)}'")
        row = _measured(run.name, run, record, ())
        return replace(row, metrics=row.ceilings) if origin.what == "ceiling" else row


def check_paper(file: Path, root: Path | None = None) -> list[CellCheck]:
    """A check of every cell of a LaTeX source that names its run against the run's recomputed numbers.

    Files included with ``\\input`` or ``\\include`` from the source's folder are checked too. Runs are searched for in
    ``root``, by default in the current folder, then in that of ``file``. Raises ``ConfigError`` if no cell names a run.
    """
    recomputed = _Recomputed([root] if root is not None else [Path(), file.parent])
    checks = []
    for source, text in _sources(file):
        shown = printable(str(source), 200)
        checks += [_check(cell, shown, recomputed) for cell in printed_cells(text)]
    if not checks:
        shown = printable(str(file), 200)
        raise ConfigError(f"{shown}: no cell names its run; create the tables with: su3d-bench report tables")
    return checks


def _sources(file: Path) -> Iterator[tuple[Path, str]]:
    """The source itself, then the files it includes, each once."""
    waiting, known = [file], {os.path.realpath(file)}
    while waiting:
        source = waiting.pop(0)
        text = _source_text(source)
        yield source, text
        for name in _READ_SOURCE.findall(_COMMENT.sub("", text)):
            path = _read_from(file.parent, name)
            if path is not None and os.path.realpath(path) not in known and len(known) < MAX_SOURCES:
                known.add(os.path.realpath(path))
                waiting.append(path)


def _read_from(folder: Path, name: str) -> Path | None:
    """The file in ``folder`` that LaTeX finds as ``name``; None if there is none or it lies elsewhere."""
    try:
        for path in (folder / name, folder / f"{name}.tex"):
            if path.is_file() and path.resolve().is_relative_to(folder.resolve()):
                return path
    except (OSError, ValueError):  # not a valid file name on this system
        return None
    return None


def _source_text(file: Path) -> str:
    shown = printable(str(file), 200)
    with reading(shown, ConfigError):
        content = file_bytes(file)
    if len(content) > MAX_SOURCE_BYTES:
        raise ConfigError(f"{shown}: has {len(content)} bytes; a paper's source has at most {MAX_SOURCE_BYTES}")
    return content.decode("utf-8", "replace")


def _check(cell: PrintedCell, file: str, recomputed: _Recomputed) -> CellCheck:
    text = printable(cell.shown, 60)
    if cell.origin is None:
        return CellCheck(file, cell.line, text, None, "the comment that names its run is damaged")
    try:
        result = recomputed.numbers(cell.origin)
    except Su3dError as error:
        return CellCheck(file, cell.line, text, None, f"cannot be recomputed: {error}")
    numbers = _numbers(cell.origin, result)
    if numbers is None:
        return CellCheck(file, cell.line, text, None, f"the run has no '{printable(cell.origin.metric, 60)}'")
    given = " ".join(f"{number:.6f}".rstrip("0").rstrip(".") for number in numbers)
    printed = cell.numbers[: len(numbers)]
    if len(printed) < len(numbers):
        return CellCheck(file, cell.line, text, given, "shows fewer numbers than its comment")
    for figure, number in zip(printed, numbers, strict=True):
        n_decimals = len(figure.partition(".")[2])
        if figure != f"{number:.{n_decimals}f}":
            return CellCheck(file, cell.line, text, given, f"shows {figure}, the run gives {number:.{n_decimals}f}")
    return CellCheck(file, cell.line, text, given, None)


def _numbers(origin: Origin, result: Measured) -> list[float] | None:
    """The numbers the cell should show: a fraction in its unit or a count, then its interval; None if missing."""
    if origin.what == "scenes":
        return [float(len(result.scenes))]
    value = result.metrics.get(origin.metric)
    if value is None or value != value:
        return None
    interval = result.intervals.get(origin.metric) if origin.interval is not None else None
    if origin.interval is not None and interval is None:
        return None
    scale = 1.0 if is_count(origin.metric) or origin.unit == "fraction" else 100.0
    return [scale * value, *(scale * end for end in interval or ())]


def numbered_tables(
    numbers: Sequence[PaperTable],
    measured: Sequence[Measured],
    runs: Sequence[Path],
    shown: Shown,
    *,
    with_published: bool,
) -> list[Table]:
    """One or more tables per entry of ``numbers``; ``runs``: those of ``measured``, including the sweep of Table I."""
    tables: list[Table] = []
    for number in numbers:
        if number == "I":
            sweep = [row for run in runs if not is_scores(run) for row in read_rows(run)]
            tables.append(ablation_table(measured, sweep, shown, with_published=with_published))
        elif number in JUDGED:
            tables.append(judged_table(number, measured, shown, with_published=with_published))
        else:
            tables += paper_table(number, measured, shown, with_published=with_published)
    return tables
