"""What the runs below a folder are: what they were asked for, how far they came, their headline numbers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from su3d_bench.analysis.leaderboard import runs_below
from su3d_bench.core.errors import StoreError, counted, printable, shown, some
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.files.locks import is_held
from su3d_bench.formats.tables.table import Cell, Table, TableRow, percent
from su3d_bench.store.records import MetricsRecord, RequestRecord, read_record
from su3d_bench.store.run_folder import MARKS, RunFolder

MOST_NAMED = 3  # methods of a run, or protocols of a method
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
    record, is_damaged = RequestRecord(), False
    try:
        if is_file(path / "run.json"):
            record = read_record(RequestRecord, path / "run.json", shown(path))
    except StoreError:
        is_damaged = True
    metrics = None
    if is_file(path / "metrics.json"):
        with suppress(StoreError):
            metrics = read_record(MetricsRecord, path / "metrics.json", shown(path))
    return RunEntry(
        name=printable(name or str(path), 200),
        when=datetime.fromtimestamp(_written(path)).isoformat(" ", "minutes"),
        state=DAMAGED if is_damaged else _state(path, record, metrics),
        scenes=tuple(printable(scene, 120) for scene in record.scenes),
        methods=tuple(printable(method, 80) for method in record.methods),
        headlines=() if metrics is None else tuple(_headlines(metrics)),
    )


def _written(path: Path) -> float:
    return max((os.stat(path / mark).st_mtime for mark in MARKS if is_file(path / mark)), default=0.0)


def _state(path: Path, record: RequestRecord, metrics: MetricsRecord | None) -> str:
    if is_held(path):
        return "running now"
    if record.status in ("complete", "incomplete"):
        failed = {scene for one in metrics.results for scene in one.failed} if metrics is not None else set()
        how_far = f"{counted(len(failed), 'scene')} failed" if record.status == "incomplete" else "complete"
        limit = metrics.limit if metrics is not None else 0
        return f"{how_far}, first {counted(limit, 'frame')} only" if limit else how_far
    return "not finished"  # a run that was killed still says that it is running


def _headlines(metrics: MetricsRecord) -> list[Headline]:
    return [
        Headline(
            printable(one.method, 80),
            printable(one.protocol, 80),
            printable(one.headline[0], 40),
            None if one.result is None else one.result.metrics.get(one.headline[0]),
        )
        for one in metrics.results
        if one.headline
    ]


def runs_table(entries: Sequence[RunEntry]) -> Table:
    """A row a run and method, numbers in per cent."""
    rows = []
    for entry in entries:
        first = (entry.when, entry.state, str(len(entry.scenes)))
        for method in entry.methods or ("",):
            mine = [one for one in entry.headlines if one.method == method]
            numbers = some([f"{one.protocol} {one.metric} {percent(one.value)}" for one in mine], MOST_NAMED)
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
    if is_held(whole):
        raise StoreError(f"{shown(path)}: a run is writing here; end it or wait for it")
    stranger = next(folder.strangers(), None)
    if stranger is not None:
        raise StoreError(
            f"{shown(path)}: holds '{printable(stranger, 200)}', which no run wrote; move it elsewhere first"
        )
    return folder


def size_bytes(path: Path) -> int:
    """Bytes of all files below ``path``."""
    return sum(os.lstat(os.path.join(above, name)).st_size for above, _, names in os.walk(path) for name in names)
