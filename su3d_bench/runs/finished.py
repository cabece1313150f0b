"""A run folder as whoever compares or explains it needs it: what was scored, on which data, by which rules."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from su3d_bench.core.config import KeyPath, read_file
from su3d_bench.core.errors import ConfigError, DataError, StoreError, printable, suggest
from su3d_bench.core.types import Float64Array
from su3d_bench.metrics.costs import MapCost, UpdateTimes
from su3d_bench.metrics.scoring import SceneScore, unpack_scores
from su3d_bench.runs.job import CEILING_METHOD
from su3d_bench.store.atomic import is_file, read_json
from su3d_bench.store.run_folder import RunFolder

Model = TypeVar("Model", bound=BaseModel)


class _Protocol(BaseModel):
    name: str
    version: int
    digest: str


class _Record(BaseModel):
    """What is read of ``run.json``."""

    status: str
    is_partial: bool
    code: str
    hardware: str
    processor: str = ""  # runs of the first version do not say
    profile: str | None
    encoder_digest: str | None
    data_digests: dict[str, str]
    protocols: tuple[_Protocol, ...]
    methods: tuple[str, ...] = Field(min_length=1)
    scenes: tuple[str, ...]


class _Values(BaseModel):
    metrics: dict[str, float | None]


class _Midway(_Values):
    share: float


class _Result(BaseModel):
    """What is read of a result in ``metrics.json``."""

    method: str
    protocol: str
    encoder: str | None
    encoder_digest: str | None
    failed: tuple[str, ...]
    caveat: str | None
    headline: tuple[str, ...]
    result: _Values | None
    anytime: tuple[_Midway, ...] = ()


class _Metrics(BaseModel):
    limit: int
    results: tuple[_Result, ...]


@dataclass(frozen=True)
class ResultRecord:
    """How a method fared under a protocol; ``encoder`` is None where it named its instances itself.

    ``metrics`` are those of the final maps, None where none was scored; ``anytime`` those of maps midway, by the share
    of the updates.
    """

    encoder: str | None
    encoder_digest: str | None
    failed: tuple[str, ...]
    caveat: str | None
    headline: tuple[str, ...]
    metrics: Mapping[str, float | None] | None
    anytime: Mapping[float, Mapping[str, float | None]]


@dataclass(frozen=True)
class FinishedRun:
    """The records of a run; ``protocols`` holds version and digest of the rules that scored it."""

    folder: RunFolder
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    protocols: Mapping[str, tuple[int, str]]
    data_digests: Mapping[str, str]
    results: Mapping[tuple[str, str], ResultRecord]
    is_partial: bool
    is_incomplete: bool
    limit: int
    code: str
    hardware: str
    processor: str
    profile: str | None
    encoder_digest: str | None
    settings: Mapping[KeyPath, Any]

    @property
    def name(self) -> str:
        return printable(str(self.folder.path), 200)

    def check_method(self, method: str) -> None:
        """A ``ConfigError`` where the run holds no scores of ``method``."""
        if method not in self.methods and not self.has_scores(method):
            known = [*self.methods, *([CEILING_METHOD] if self.has_scores(CEILING_METHOD) else [])]
            hint = suggest(method, known) or f"; it has {', '.join(known)}"
            raise ConfigError(f"{self.name}: holds no scores of the method '{printable(method, 80)}'{hint}")

    def has_scores(self, method: str) -> bool:
        """Whether any scene was scored for ``method``; those of the ceiling stand in no table."""
        is_name = "/" not in method
        return is_name and any(is_file(self.folder.job(scene, method).counts) for scene in self.scenes)

    def scores(self, method: str) -> dict[str, dict[str, SceneScore]]:
        """Protocol -> scene -> counts, of every scene that was scored."""
        found: dict[str, dict[str, SceneScore]] = {name: {} for name in self.protocols}
        for scene in self.scenes:
            file = self.folder.job(scene, method).counts
            if not is_file(file):
                continue
            try:
                of_scene = unpack_scores(file.read_bytes())
            except DataError as error:
                raise DataError(f"{printable(scene, 120)}: {method}: {error}") from error
            for protocol, score in of_scene.items():
                found.setdefault(protocol, {})[scene] = score
        return found


class _Rules(dict[str, tuple[int, str]]):
    """Version and digest of protocols; one that the run's record does not name is a ``StoreError``."""

    def __init__(self, rules: Mapping[str, tuple[int, str]], shown: str) -> None:
        super().__init__(rules)
        self._shown = shown

    def __missing__(self, protocol: str) -> tuple[int, str]:
        raise StoreError(f"{self._shown}: run.json does not name the protocol '{protocol}'; run its command again")


def read_run(path: Path) -> FinishedRun:
    """The run in the folder ``path``; a ``StoreError`` where it holds none, or one that is not finished."""
    shown = printable(str(path), 200)
    if not is_file(path / "run.json"):
        raise StoreError(f"{shown}: holds no run.json; name the folder of a run, such as runs/my-run")
    if not is_file(path / "metrics.json"):
        raise StoreError(f"{shown}: holds no metrics.json, so the run is not finished; run its command again")
    record = _checked(_Record, path / "run.json", shown)
    metrics = _checked(_Metrics, path / "metrics.json", shown)
    return FinishedRun(
        folder=RunFolder(path),
        scenes=record.scenes,
        methods=record.methods,
        protocols=_Rules({one.name: (one.version, one.digest) for one in record.protocols}, shown),
        data_digests=record.data_digests,
        results={(one.method, one.protocol): _result_record(one) for one in metrics.results},
        is_partial=record.is_partial,
        is_incomplete=record.status != "complete",
        limit=metrics.limit,
        code=record.code,
        hardware=record.hardware,
        processor=record.processor,
        profile=record.profile,
        encoder_digest=record.encoder_digest,
        settings={entry.path: entry.value for entry in read_file(path / "run.toml").entries},
    )


def _result_record(one: _Result) -> ResultRecord:
    return ResultRecord(
        encoder=one.encoder,
        encoder_digest=one.encoder_digest,
        failed=one.failed,
        caveat=one.caveat,
        headline=one.headline,
        metrics=None if one.result is None else one.result.metrics,
        anytime={midway.share: midway.metrics for midway in one.anytime},
    )


def _checked(model: type[Model], file: Path, shown: str) -> Model:
    try:
        return model.model_validate(read_json(file))
    except RecursionError as error:
        raise StoreError(f"{shown}: {file.name}: is nested too deep for a record of a run; run it again") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = printable(".".join(map(str, first["loc"])), 120)
        raise StoreError(f"{shown}: {file.name}: {key or 'it'} is not as a run writes it; run it again") from error


MAX_UPDATES = 10_000_000


def read_update_times(run: FinishedRun, method: str) -> list[UpdateTimes]:
    """The updates of every scene that ``method`` finished; scenes where it looks at no frame are left out."""
    run.check_method(method)
    found = []
    for scene in run.scenes:
        job = run.folder.job(scene, method)
        if not is_file(job.updates):
            continue
        where = f"{printable(scene, 120)}: {job.updates.name}"
        columns = _columns(job.updates, where)
        if not columns or not len(columns["total_ms"]):
            continue
        costs = _costs(job.remarks("predict").get("costs"), where)
        found.append(UpdateTimes(run.name, scene, method, columns, *costs))
    return found


def _columns(path: Path, where: str) -> dict[str, Float64Array]:
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            reader = csv.reader(stream)
            header = next(reader, [])
            rows = [row for row, _ in zip(reader, range(MAX_UPDATES), strict=False)]
            if "total_ms" not in header:
                return {}
            table = np.array(rows, np.float64).reshape(len(rows), len(header))
    except (ValueError, csv.Error, UnicodeDecodeError) as error:
        raise DataError(f"{where}: is not a table of numbers; run the same command again to mend it") from error
    if not np.isfinite(table).all():
        raise DataError(f"{where}: holds a number that is not finite; run the same command again to mend it")
    return {name: table[:, column] for column, name in enumerate(header)}


def _costs(costs: Any, where: str) -> tuple[tuple[MapCost, ...], int | None, int | None, float | None]:
    if costs is None:
        return (), None, None, None
    try:
        maps = tuple(MapCost(int(one["n_updates"]), float(one["finish_ms"])) for one in costs["maps"])
        peak, device = (None if costs[key] is None else int(costs[key]) for key in ("peak_rss_bytes", "device_bytes"))
        calibration = None if costs["calibration_ms"] is None else float(costs["calibration_ms"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{where}: the costs in done.json are not as a run writes them; run it again") from error
    return maps, peak, device, calibration
