"""Runs below a folder, as a list, and as one ranking where their numbers answer the same question.

A number enters where its run is whole, its protocol is the one installed here, to the digest, every scene's data have
the digest that most runs have, it follows from the run's own counts, and it is of as many labels a mask or point as
most are. Everything else is named with the reason.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import numpy as np

from su3d_bench.core.errors import ConfigError, StoreError, Su3dError, counted, printable, shown, some
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.files.locks import is_locked
from su3d_bench.core.types import Interval
from su3d_bench.formats.tables.table import NOT_MEASURED, Cell, Origin, Table, TableRow, bracketed, percent
from su3d_bench.metrics.protocols.loading import protocol_names
from su3d_bench.metrics.scoring import combine
from su3d_bench.numerics.statistics import rank_intervals
from su3d_bench.reports.tables.model import confidence_notes, few_scenes, is_ceiling
from su3d_bench.runs.finished import FinishedRun, read_run
from su3d_bench.runs.verify import count_mismatch, rules_of_run
from su3d_bench.store.records import MetricsRecord, RunRecord, read_record
from su3d_bench.store.run_folder import MARKS, RunFolder

MAX_RUNS = 10_000
ELSEWHERE = "made elsewhere"  # in the place of a profile
MAX_NAMED = 4  # methods of what is left out
MAX_FOLDERS = 1_000_000  # a folder that holds more was not meant
MAX_RANKED = 60  # rows whose ranks have an interval: 1,770 tests of pairs, some minutes at worst


@dataclass(frozen=True)
class RankingRow:
    """The numbers of a method of a run under a protocol, as it may stand in a ranking.

    Values are fractions, in the order of ``headline``.

    ``of_scenes``: the first headline metric of each scene, by which it is told which ranks differ. ``ranks``: the best
    and the worst that it may have among those that are no ceiling; None where that was not asked for.
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

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(scene for scene, _ in self.data)

    @property
    def ranking(self) -> tuple[str, str, tuple[str, ...]]:
        """What rows of one ranking share: two people may call their own rules alike, so the rules' digest too."""
        return self.protocol, self.digest, self.scenes


AnyRow = TypeVar("AnyRow", bound=RankingRow)


@dataclass(frozen=True)
class Refused:
    """What stands in no ranking, and why."""

    run: str
    what: str
    reason: str


@dataclass(frozen=True)
class Leaderboard:
    """One ranking a protocol and set of scenes, the best first."""

    boards: tuple[tuple[RankingRow, ...], ...]
    refused: tuple[Refused, ...]


def leaderboard(folder: Path, protocols: Sequence[str] = (), *, with_ranks: bool = False) -> Leaderboard:
    """The rankings of all runs below ``folder``, of all protocols or only ``protocols``; links are not followed.

    ``with_ranks``: the ranks that each row of up to ``MAX_RANKED`` may have are found, from tests of all pairs.
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
            f"{printable(str(folder), 200)}: holds no run below it; su3d-bench run writes one, and evaluate --out "
            "of predictions made elsewhere"
        )
    boards: list[tuple[RankingRow, ...]] = []
    for key in dict.fromkeys(entry.ranking for entry in entries):
        alike, others = _alike([entry for entry in entries if entry.ranking == key])
        board = in_order(alike)
        boards.append(ranked(board) if with_ranks else board)
        refused += others
    return Leaderboard(tuple(boards), tuple(refused))


def runs_below(folder: Path) -> Iterator[Path]:
    """The folders of runs below ``folder``, in the order of their names; links are not followed."""
    if not folder.is_dir():
        if folder.is_file():
            read_run(folder)  # says what the file is
        raise ConfigError(f"{printable(str(folder), 200)}: is no folder; name one that holds runs")
    n_runs = 0
    for n_folders, (path, folders, files) in enumerate(os.walk(folder, followlinks=False)):
        if n_folders >= MAX_FOLDERS or n_runs >= MAX_RUNS:
            raise ConfigError(f"{printable(str(folder), 200)}: holds more than {MAX_RUNS} runs; name a smaller folder")
        folders.sort()
        if "run.json" in files:
            folders.clear()  # below a run there is no other
            n_runs += 1
            yield Path(path)


def entries_of(name: str, run: FinishedRun, protocols: Sequence[str] = ()) -> Iterator[RankingRow | Refused]:
    """Each number of ``run``, called ``name``, that may stand in a ranking, or why not; of ``protocols`` or all."""
    for (method, protocol), record in run.results.items():
        if protocols and protocol not in protocols:
            continue
        what = f"{printable(method, 80)} / {printable(protocol, 80)}"
        if reason := _missing_reason(run, protocol, record.failed):
            yield Refused(name, what, reason)
            continue
        try:
            rules = rules_of_run(run, protocol)
            scores = run.scores(method).get(protocol, {})
            if reason := count_mismatch(run, method, protocol, scores):
                yield Refused(name, what, printable(reason, 300))
                continue
            result = combine(rules, scores)
        except Su3dError as error:
            yield Refused(name, what, printable(str(error), 300))
            continue
        recomputed = result.to_json()
        unknown = [scene for scene in result.scenes if scene not in run.record.data_digests]
        if unknown:
            yield Refused(name, what, f"the data of {printable(unknown[0], 80)} have no digest")
            continue
        yield RankingRow(
            run=name,
            method=printable(method, 120),
            protocol=protocol,
            version=result.version,
            digest=rules.digest,
            headline=result.headline,
            values=tuple(recomputed["metrics"].get(key) for key in result.headline),
            intervals=tuple(result.intervals.get(key) for key in result.headline),
            of_scenes=tuple(recomputed["per_scene"][scene][result.headline[0]] for scene in sorted(result.scenes)),
            data=tuple((scene, run.record.data_digests[scene]) for scene in sorted(result.scenes)),
            profile=ELSEWHERE if method in run.external else printable(run.record.profile or "", 40),
            confidences=None if record.confidences is None else printable(record.confidences, 80),
            labels=run.labels(method, protocol, rules),
            is_ceiling=is_ceiling(method, record.caveat),
        )


def _missing_reason(run: FinishedRun, protocol: str, failed: Sequence[str]) -> str | None:
    if run.record.is_partial:
        return f"is partial: the first {counted(run.limit, 'frame')} of each scene"
    if failed:
        return f"is incomplete: {counted(len(failed), 'scene')} failed"
    if protocol in protocol_names() or (protocol in run.protocols and run.protocols[protocol].rules is not None):
        return None
    return "its protocol is none of those installed here"  # a file that somebody else's run names is not looked for


def _alike(entries: Sequence[RankingRow]) -> tuple[list[RankingRow], list[Refused]]:
    """The entries that may stand in one ranking, and why the others may not.

    Their scenes have the data that most have, the first seen of equals, and they give as many labels as most do, but
    for the ceilings.
    """
    refused = []
    common, _ = Counter(entry.data for entry in entries).most_common(1)[0]
    alike = [entry for entry in entries if entry.data == common]
    for entry in entries:
        if entry.data != common:
            scene = next(scene for (scene, mine), (_, other) in zip(entry.data, common, strict=True) if mine != other)
            reason = f"other data of {printable(scene, 80)} than {len(alike)} of {len(entries)} entries have"
            refused.append(Refused(entry.run, f"{entry.method} / {entry.protocol}", reason))
    rivals = [entry for entry in alike if not entry.is_ceiling]
    if rivals:
        (labels, n), *_ = Counter(entry.labels for entry in rivals).most_common(1)
        for entry in rivals:
            if entry.labels != labels:
                reason = f"is of {printable(str(entry.labels), 80)}, {n} of {len(rivals)} entries are of {labels}"
                refused.append(Refused(entry.run, f"{entry.method} / {entry.protocol}", reason))
        alike = [entry for entry in alike if entry.is_ceiling or entry.labels == labels]
    return alike, refused


def in_order(rows: Sequence[AnyRow]) -> tuple[AnyRow, ...]:
    """The best by the first headline metric first; what was told the truth last."""

    def rank(row: RankingRow) -> tuple[bool, float, str, str]:
        first = row.values[0]
        return row.is_ceiling, -(first if first is not None else -1.0), row.method, row.run

    return tuple(sorted(rows, key=rank))


def ranked(board: tuple[AnyRow, ...]) -> tuple[AnyRow, ...]:
    """The board with the ranks that each row may have; unchanged where nothing competes, or too many rows do."""
    rivals = [entry for entry in board if not entry.is_ceiling]
    if not 1 < len(rivals) <= MAX_RANKED:
        return board
    ranks = rank_intervals([np.array(entry.of_scenes, np.float64) for entry in rivals])
    return (
        *(replace(entry, ranks=of_entry) for entry, of_entry in zip(rivals, ranks, strict=True)),
        *(entry for entry in board if entry.is_ceiling),
    )


def tables(board_of_runs: Leaderboard, *, intervals: bool) -> list[Table]:
    """One table a ranking; what was refused stands beneath the last one."""
    made = [_table(board, index, intervals) for index, board in enumerate(board_of_runs.boards)]
    notes = tuple(_left_out(board_of_runs.refused))
    if not made:
        return [Table("leaderboard", "Leaderboard: no run may stand in a ranking.", "method", (), (), notes)]
    return [*made[:-1], replace(made[-1], notes=(*made[-1].notes, *notes))]


def _left_out(refused: Sequence[Refused]) -> Iterator[str]:
    """One line for what is refused of one run under one protocol for one reason."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for refusal in refused:
        method, slash, protocol = refusal.what.rpartition(" / ")
        groups.setdefault((refusal.run, slash + protocol, refusal.reason), []).append(method)
    for (run, where, reason), methods in groups.items():
        yield f"Left out: {run}, {some(methods, MAX_NAMED)}{where}: {reason}"


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
        notes.append("Rows that were told the truth stand last and compete with none.")
    notes += confidence_notes({f"{entry.method} of {entry.run}": entry.confidences for entry in rivals})
    notes += [f"Labels: {said}." for said in {entry.labels: None for entry in rivals if entry.labels}]
    if has_ranks:
        notes.append(
            f"Rank: from which to which it may go by {first.headline[0]}, with 95 % for all rows together: sign-flip "
            "tests of all pairs, of their means over scenes, corrected by Holm."
        )
    elif intervals and len(rivals) > MAX_RANKED:
        notes.append(f"No ranks: {len(rivals)} rows are more than the {MAX_RANKED} whose pairs are all tested.")
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
    """The first headline metric of a method under a protocol, as a fraction; None where nothing was scored."""

    method: str
    protocol: str
    metric: str
    value: float | None


@dataclass(frozen=True)
class RunEntry:
    """A run in a folder; ``when`` its records were last written, to the minute; ``state`` in words."""

    name: str
    when: str
    state: str
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    headlines: tuple[Headline, ...]


def list_runs(folder: Path) -> list[RunEntry]:
    """An entry for each run below ``folder``, the latest last."""
    found = [(_written(path), run_entry(path, path.relative_to(folder).as_posix())) for path in runs_below(folder)]
    return [entry for _, entry in sorted(found, key=lambda pair: (pair[0], pair[1].name))]


def run_entry(path: Path, name: str | None = None) -> RunEntry:
    """The entry of the run in the folder ``path``; a ``StoreError`` where it holds none."""
    if not any(is_file(path / mark) for mark in MARKS):
        raise StoreError(f"{shown(path)}: holds no run; a run has a run.json")
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
    return "not finished"  # a run that was killed still says that it is running


def runs_table(entries: Sequence[RunEntry]) -> Table:
    """A row a run and method, numbers in per cent."""
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
    """The run folder at ``path``, which holds a run and nothing else; else a ``StoreError`` that says what keeps it."""
    whole = Path(os.path.abspath(path))
    if whole.is_symlink():
        raise StoreError(f"{shown(path)}: is a link; name the folder that it leads to, or remove the link yourself")
    if not whole.is_dir() or not any(is_file(whole / mark) for mark in MARKS):
        raise StoreError(f"{shown(path)}: is no folder of a run, so nothing there is removed")
    folder = RunFolder(whole)
    if is_locked(whole):
        raise StoreError(f"{shown(path)}: a run is writing here; end it or wait for it")
    stranger = next(folder.foreign_files(), None)
    if stranger is not None:
        raise StoreError(
            f"{shown(path)}: holds '{printable(stranger, 200)}', which no run wrote; move it elsewhere first"
        )
    return folder


def size_bytes(path: Path) -> int:
    """Bytes of all files below ``path``."""
    return sum(os.lstat(os.path.join(above, name)).st_size for above, _, names in os.walk(path) for name in names)
