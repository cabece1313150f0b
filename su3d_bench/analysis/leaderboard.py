"""Runs below a folder, as a list and as rankings of comparable numbers.

A number is ranked if its run is complete, its protocol is installed here with the same digest, every scene's data have
the digest that most runs have, the run's counts reproduce it, and it uses the same number of labels per mask or point
as most. Everything else is excluded with the reason. Of a sweep over corruptions the clean methods are ranked.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import numpy as np

from su3d_bench.analysis.sweeps import cells_of, family_means
from su3d_bench.core.errors import ConfigError, StoreError, Su3dError, counted, printable, shown, some
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.files.locks import is_locked
from su3d_bench.core.types import Interval
from su3d_bench.corruptions.apply import Cell as SweepCell
from su3d_bench.formats.tables.table import NOT_MEASURED, Cell, Origin, Table, TableRow, bracketed, percent
from su3d_bench.numerics.statistics import rank_intervals
from su3d_bench.reports.tables.model import confidence_notes, few_scenes, is_ceiling
from su3d_bench.runs.finished import FinishedRun, read_run
from su3d_bench.runs.verify import examine
from su3d_bench.store.records import MetricsRecord, NumbersRecord, ResultRecord, RunRecord, read_record
from su3d_bench.store.run_folder import MARKS, RunFolder

MAX_RUNS = 10_000
ELSEWHERE = "made elsewhere"  # shown instead of a profile
MAX_NAMED = 4  # methods named per line of what is excluded
MAX_FOLDERS = 1_000_000  # a folder that contains more was given by mistake
MAX_RANKED = 60  # rows with rank intervals: 1,770 pairwise tests, a few minutes at worst


@dataclass(frozen=True)
class RankingRow:
    """The numbers of a method of a run under a protocol, as one row of a ranking.

    Values are fractions, in the order of ``headline``.

    ``of_scenes``: the first headline metric of each scene, from which rank intervals are computed. ``ranks``: best and
    worst possible rank among rows that are not ceilings; None if not requested. ``changes``: of a sweep, the mean
    change of the first headline metric in each family of corruptions, None if undefined.
    """

    run: str
    method: str
    protocol: str
    version: int
    digest: str
    headline: tuple[str, ...]
    values: tuple[float | None, ...]
    intervals: tuple[Interval | None, ...]
    of_scenes: tuple[float | None, ...]
    data: tuple[tuple[str, str], ...]
    profile: str
    confidences: str | None
    labels: str | None
    is_ceiling: bool
    ranks: tuple[int, int] | None = None
    changes: tuple[tuple[str, float | None], ...] = ()

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(scene for scene, _ in self.data)

    @property
    def ranking(self) -> tuple[str, str, tuple[str, ...]]:
        """What rows of one ranking share; with the rules' digest, as two custom protocols may have the same name."""
        return self.protocol, self.digest, self.scenes


AnyRow = TypeVar("AnyRow", bound=RankingRow)


@dataclass(frozen=True)
class Refused:
    """What is excluded from the rankings, and why."""

    run: str
    what: str
    reason: str


@dataclass(frozen=True)
class Leaderboard:
    """One ranking per protocol and set of scenes, the best first."""

    boards: tuple[tuple[RankingRow, ...], ...]
    refused: tuple[Refused, ...]


def leaderboard(folder: Path, protocols: Sequence[str] = (), *, with_ranks: bool = False) -> Leaderboard:
    """The rankings of all runs below ``folder``, for all protocols or only ``protocols``; links are not followed.

    ``with_ranks``: compute rank intervals from tests of all pairs, for rankings of up to ``MAX_RANKED`` rows.
    """
    entries: list[RankingRow] = []
    refused: list[Refused] = []
    for path in runs_below(folder):
        name = printable(path.relative_to(folder).as_posix(), 200)
        try:
            run = read_run(path)
        except Su3dError as error:
            refused.append(Refused(name, "run", printable(str(error), 300)))
            continue
        for each in entries_of(name, run, protocols):
            (entries if isinstance(each, RankingRow) else refused).append(each)  # type: ignore[arg-type]
    if not entries and not refused:
        raise ConfigError(
            f"{printable(str(folder), 200)}: contains no runs; create one with su3d-bench run, or with evaluate --out "
            "for predictions made elsewhere"
        )
    boards: list[tuple[RankingRow, ...]] = []
    for key in dict.fromkeys(entry.ranking for entry in entries):
        alike, others = _alike([entry for entry in entries if entry.ranking == key])
        board = in_order(alike)
        boards.append(ranked(board) if with_ranks else board)
        refused += others
    return Leaderboard(tuple(boards), tuple(refused))


def runs_below(folder: Path) -> Iterator[Path]:
    """The run folders below ``folder``, sorted by name; links are not followed."""
    if not folder.is_dir():
        if folder.is_file():
            read_run(folder)  # its error says what the file is
        raise ConfigError(f"{printable(str(folder), 200)}: is not a folder; name one that contains runs")
    n_runs = 0
    for n_folders, (path, folders, files) in enumerate(os.walk(folder, followlinks=False)):
        if n_folders >= MAX_FOLDERS or n_runs >= MAX_RUNS:
            raise ConfigError(f"{printable(str(folder), 200)}: has more than {MAX_RUNS} runs; name a smaller folder")
        folders.sort()
        if "run.json" in files:
            folders.clear()  # runs are not nested
            n_runs += 1
            yield Path(path)


def entries_of(name: str, run: FinishedRun, protocols: Sequence[str] = ()) -> Iterator[RankingRow | Refused]:
    """Each number of ``run``, called ``name``, that can be ranked, or why not; for ``protocols`` or all."""
    run, found = examine(run)
    faults = dict(reversed(found))  # the first of each place
    places = {key: printable(" / ".join(key), 200) for key in run.results}
    if others := [fault for fault in found if fault[0] not in places.values()]:
        yield Refused(name, *others[0])
        return
    cells = cells_of(run.methods)
    corrupted = {cell.name for own in cells.values() for cell in own}
    for (method, protocol), record in run.results.items():
        if (protocols and protocol not in protocols) or method in corrupted:
            continue
        what, result = places[method, protocol], record.result
        of_cells = {cell: run.results.get((cell.name, protocol)) for cell in cells.get(method, ())}
        wrong = (faults.get(places.get((cell.name, protocol), "")) for cell in of_cells)
        reason = _exclusion_reason(run, record.failed) or faults.get(what) or next(filter(None, wrong), None)
        if reason or result is None:
            yield Refused(name, what, reason or "was not scored")
            continue
        scenes = sorted(result.scenes)
        yield RankingRow(
            run=name,
            method=printable(method, 120),
            protocol=protocol,
            version=result.version,
            digest=run.protocols[protocol].digest,
            headline=result.headline,
            values=tuple(result.metrics.get(key) for key in result.headline),
            intervals=tuple(result.intervals.get(key) for key in result.headline),
            of_scenes=tuple(result.per_scene[scene][result.headline[0]] for scene in scenes),
            data=tuple((scene, run.record.data_digests[scene]) for scene in scenes),
            profile=ELSEWHERE if method in run.external else printable(record.profile or "", 40),
            confidences=None if record.confidences is None else printable(record.confidences, 80),
            labels=record.labels,
            is_ceiling=is_ceiling(method, record.caveat),
            changes=tuple(_changes(result, of_cells)),
        )


def _changes(
    clean: NumbersRecord, cells: Mapping[SweepCell, ResultRecord | None]
) -> Iterator[tuple[str, float | None]]:
    """The mean change of the first headline metric in each family; None if a cell lacks it or has other scenes."""

    def value(numbers: NumbersRecord | None) -> float:
        found = numbers.metrics.get(clean.headline[0]) if numbers and numbers.scenes == clean.scenes else None
        return np.nan if found is None else found

    changes = {cell: value(None if one is None else one.result) - value(clean) for cell, one in cells.items()}
    yield from ((family, None if np.isnan(mean) else mean) for family, mean in family_means(changes).items())


def _exclusion_reason(run: FinishedRun, failed: Sequence[str]) -> str | None:
    if run.record.is_partial:
        return f"is partial: only the first {counted(run.limit, 'frame')} of each scene"
    if failed:
        return f"is incomplete: {counted(len(failed), 'scene')} failed"
    return None


def _alike(entries: Sequence[RankingRow]) -> tuple[list[RankingRow], list[Refused]]:
    """The entries that can be ranked together, and why the others cannot.

    Their scenes have the data that most entries have (the first on a tie), and except for ceilings they use the number
    of labels that most use.
    """
    refused = []
    common, _ = Counter(entry.data for entry in entries).most_common(1)[0]
    alike = [entry for entry in entries if entry.data == common]
    for entry in entries:
        if entry.data != common:
            scene = next(scene for (scene, mine), (_, other) in zip(entry.data, common, strict=True) if mine != other)
            reason = f"data of {printable(scene, 80)} differ from those of {len(alike)} of {len(entries)} entries"
            refused.append(Refused(entry.run, f"{entry.method} / {entry.protocol}", reason))
    rivals = [entry for entry in alike if not entry.is_ceiling]
    if rivals:
        (labels, n), *_ = Counter(entry.labels for entry in rivals).most_common(1)
        for entry in rivals:
            if entry.labels != labels:
                reason = f"uses {printable(str(entry.labels), 80)}; {n} of {len(rivals)} entries use {labels}"
                refused.append(Refused(entry.run, f"{entry.method} / {entry.protocol}", reason))
        alike = [entry for entry in alike if entry.is_ceiling or entry.labels == labels]
    return alike, refused


def in_order(rows: Sequence[AnyRow]) -> tuple[AnyRow, ...]:
    """Rows sorted by the first headline metric, the best first; rows that use ground truth last."""

    def rank(row: RankingRow) -> tuple[bool, float, str, str]:
        first = row.values[0]
        return row.is_ceiling, -(first if first is not None else -1.0), row.method, row.run

    return tuple(sorted(rows, key=rank))


def ranked(board: tuple[AnyRow, ...]) -> tuple[AnyRow, ...]:
    """The board with rank intervals; unchanged if fewer than two or more than ``MAX_RANKED`` rows are ranked."""
    rivals = [entry for entry in board if not entry.is_ceiling]
    if not 1 < len(rivals) <= MAX_RANKED:
        return board
    ranks = rank_intervals([np.array(entry.of_scenes, np.float64) for entry in rivals])
    return (
        *(replace(entry, ranks=of_entry) for entry, of_entry in zip(rivals, ranks, strict=True)),
        *(entry for entry in board if entry.is_ceiling),
    )


def tables(board_of_runs: Leaderboard, *, intervals: bool) -> list[Table]:
    """One table per ranking; excluded numbers are listed in the notes of the last one."""
    made = [_table(board, index, intervals) for index, board in enumerate(board_of_runs.boards)]
    notes = tuple(_left_out(board_of_runs.refused))
    if not made:
        return [Table("leaderboard", "Leaderboard: no run can be ranked.", "method", (), (), notes)]
    return [*made[:-1], replace(made[-1], notes=(*made[-1].notes, *notes))]


def _left_out(refused: Sequence[Refused]) -> Iterator[str]:
    """One line per run, protocol and reason for what is excluded."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for refusal in refused:
        method, slash, protocol = refusal.what.rpartition(" / ")
        groups.setdefault((refusal.run, slash + protocol, refusal.reason), []).append(method)
    for (run, where, reason), methods in groups.items():
        yield f"Excluded: {run}, {some(methods, MAX_NAMED)}{where}: {reason}"


def _table(board: Sequence[RankingRow], index: int, intervals: bool) -> Table:
    first = board[0]
    rivals = [entry for entry in board if not entry.is_ceiling]
    best = [
        max((percent(value) for entry in rivals if (value := entry.values[k]) is not None), key=float, default="")
        for k in range(len(first.headline))
    ]
    has_ranks = any(entry.ranks for entry in board)
    rows = []
    for entry in board:
        cells = [_cell(entry, k, best[k], intervals) for k in range(len(first.headline))]
        if has_ranks:
            ranks = " to ".join(map(str, dict.fromkeys(entry.ranks or ())))
            cells.append(Cell(ranks or NOT_MEASURED))
        about = (*cells, Cell(entry.profile), Cell(entry.run))
        rows.append(TableRow(entry.method, about, group=str(entry.is_ceiling)))
    scenes = counted(len(first.scenes), "scene")
    notes = [f"Scenes: {', '.join(first.scenes)}."]
    if any(entry.is_ceiling for entry in board):
        notes.append("Rows that use ground truth are listed last and not ranked.")
    notes += confidence_notes({f"{entry.method} of {entry.run}": entry.confidences for entry in rivals})
    notes += [f"Labels: {note}." for note in {entry.labels: None for entry in rivals if entry.labels}]
    if has_ranks:
        notes.append(
            f"Rank: simultaneous 95 % interval of the rank by {first.headline[0]}, from sign-flip tests of the means "
            "over scenes of all pairs, corrected by Holm."
        )
    elif intervals and len(rivals) > MAX_RANKED:
        notes.append(f"No ranks: {len(rivals)} rows exceed the limit of {MAX_RANKED} for testing all pairs.")
    if intervals and (rough := few_scenes(len(first.scenes))):
        notes.append(f"{rough[:1].upper()}{rough[1:]}.")
    caption = f"{first.protocol}, version {first.version}, {scenes}; per cent."
    columns = (*first.headline, *(["rank"] if has_ranks else []), "profile", "run")
    return Table(f"leaderboard-{index + 1}", caption, "method", columns, tuple(rows), tuple(notes))


def _cell(entry: RankingRow, k: int, best: str, intervals: bool) -> Cell:
    value, interval = entry.values[k], entry.intervals[k]
    if value is None:
        return Cell(NOT_MEASURED)
    text, beside = percent(value), bracketed(interval) if intervals else ""
    origin = Origin(entry.run, entry.method, entry.protocol, entry.version, entry.headline[k], "value", value, interval)
    return Cell(text, beside, is_best=text == best and not entry.is_ceiling, origin=origin)


MAX_PROTOCOLS_NAMED = 3  # methods of a run, or protocols of a method
DAMAGED = "run.json is damaged"


@dataclass(frozen=True)
class Headline:
    """The first headline metric of a method under a protocol, as a fraction; None if nothing was scored."""

    method: str
    protocol: str
    metric: str
    value: float | None


@dataclass(frozen=True)
class RunEntry:
    """A run in a folder; ``when``: last write of its records, to the minute; ``state``: a readable description."""

    name: str
    when: str
    state: str
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    headlines: tuple[Headline, ...]


def list_runs(folder: Path) -> list[RunEntry]:
    """One entry per run below ``folder``, the latest last."""
    found = [(_written(path), run_entry(path, path.relative_to(folder).as_posix())) for path in runs_below(folder)]
    return [entry for _, entry in sorted(found, key=lambda pair: (pair[0], pair[1].name))]


def run_entry(path: Path, name: str | None = None) -> RunEntry:
    """The entry of the run in the folder ``path``; ``StoreError`` if there is none."""
    if not any(is_file(path / mark) for mark in MARKS):
        raise StoreError(f"{shown(path)}: is not a run folder; a run has a run.json")
    record, is_damaged = RunRecord(), False
    try:
        if is_file(path / "run.json"):
            record = read_record(RunRecord, path / "run.json", shown(path))
    except StoreError:
        is_damaged = True
    metrics, headlines = None, list[Headline]()
    if is_file(path / "metrics.json"):
        with suppress(StoreError):
            metrics = read_record(MetricsRecord, path / "metrics.json", shown(path))
    for one in () if metrics is None else metrics.results:
        if one.headline:
            first = one.headline[0]
            value = None if one.result is None else one.result.metrics.get(first)
            headlines.append(
                Headline(printable(one.method, 80), printable(one.protocol, 80), printable(first, 40), value)
            )
    return RunEntry(
        name=printable(name or str(path), 200),
        when=datetime.fromtimestamp(_written(path)).isoformat(" ", "minutes"),
        state=DAMAGED if is_damaged else _state(path, record, metrics),
        scenes=tuple(printable(scene, 120) for scene in record.scenes),
        methods=tuple(printable(method, 80) for method in record.methods),
        headlines=tuple(headlines),
    )


def _written(path: Path) -> float:
    return max((os.stat(path / mark).st_mtime for mark in MARKS if is_file(path / mark)), default=0.0)


def _state(path: Path, record: RunRecord, metrics: MetricsRecord | None) -> str:
    if is_locked(path):
        return "running now"
    if record.status in ("complete", "incomplete"):
        failed = {scene for one in metrics.results for scene in one.failed} if metrics is not None else set()
        how_far = f"{counted(len(failed), 'scene')} failed" if record.status == "incomplete" else "complete"
        limit = metrics.limit if metrics is not None else 0
        return f"{how_far}, first {counted(limit, 'frame')} only" if limit else how_far
    return "not finished"  # the record of a killed run still has the status "running"


def runs_table(entries: Sequence[RunEntry]) -> Table:
    """One row per run and method, numbers in per cent."""
    rows = []
    for entry in entries:
        first = (entry.when, entry.state, str(len(entry.scenes)))
        for method in entry.methods or ("",):
            mine = [one for one in entry.headlines if one.method == method]
            numbers = some([f"{one.protocol} {one.metric} {percent(one.value)}" for one in mine], MAX_PROTOCOLS_NAMED)
            cells = tuple(Cell(text) for text in (*first, method, numbers or "-"))
            rows.append(TableRow(entry.name, cells))
    columns = ("written", "state", "scenes", "method", "first number of each protocol")
    return Table("runs", counted(len(entries), "run"), "run", columns, tuple(rows), ())


def removable(path: Path) -> RunFolder:
    """The run folder at ``path``; ``StoreError`` if it must not be removed or contains other files."""
    whole = Path(os.path.abspath(path))
    if whole.is_symlink():
        raise StoreError(f"{shown(path)}: is a link; name the folder that it points to, or remove the link yourself")
    if not whole.is_dir() or not any(is_file(whole / mark) for mark in MARKS):
        raise StoreError(f"{shown(path)}: is not a run folder; nothing was removed")
    folder = RunFolder(whole)
    if is_locked(whole):
        raise StoreError(f"{shown(path)}: a run is writing here; stop it or wait until it finishes")
    stranger = next(folder.foreign_files(), None)
    if stranger is not None:
        raise StoreError(
            f"{shown(path)}: contains '{printable(stranger, 200)}', which no run wrote; move it elsewhere first"
        )
    return folder


def size_bytes(path: Path) -> int:
    """Bytes of all files below ``path``."""
    return sum(os.lstat(os.path.join(above, name)).st_size for above, _, names in os.walk(path) for name in names)
