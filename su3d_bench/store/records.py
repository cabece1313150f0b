"""The records in the small files of a run: ``run.json``, ``metrics.json``, ``done.json`` and ``updates.csv``.

These files are written from and read into these records. Fields have the order of the file; a field with a default may
be missing, because earlier versions did not write it.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from su3d_bench.core.errors import DataError, StoreError, printable
from su3d_bench.core.files.atomic import read_json
from su3d_bench.core.system.files import opened_text
from su3d_bench.core.types import Float64Array

SCHEMA = 1
MAX_UPDATES = 10_000_000
Kind = TypeVar("Kind")
ROUNDING = 1e-9  # a mean of fractions may exceed 1 by this much
MAX_VALUE = 1e18  # milliseconds, bytes or things: more than possible
Number = Annotated[float, Field(allow_inf_nan=False)]  # NaN would pass every comparison
Amount = Annotated[float, Field(ge=0, le=MAX_VALUE, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=int(MAX_VALUE))]
Share = Annotated[float, Field(ge=0, le=1 + ROUNDING, allow_inf_nan=False)]
Values = Mapping[str, Number | None]


@dataclass(frozen=True)
class ProtocolRecord:
    """The protocol that scored a run. ``rules``: the complete rules of a user-defined protocol."""

    name: str
    version: int
    digest: str
    rules: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class FailureRecord:
    """A scene that failed with a method, with the error message."""

    scene: str
    method: str
    error: str


@dataclass(frozen=True)
class UnscoredRecord:
    """The reason why a scene has no score for a method and protocol."""

    scene: str
    method: str
    protocol: str
    reason: str


@dataclass(frozen=True)
class TruthRecord:
    """The ground truth of imported predictions: a dataset, or the files at ``path``.

    ``values``: the declared meaning of the values in a text file; ``queries``: SHA-256 of the file of queries.
    """

    dataset: str | None
    path: str | None
    values: str | None = None
    queries: str | None = None


@dataclass(frozen=True)
class PredictionsRecord:
    """Imported predictions that a run used as those of ``method``.

    ``files``: SHA-256 of every file that was read, by scene and path. ``confidences`` is ``file`` if those of the files
    are used even if a protocol has 1 for every mask. ``texts``: the file of text features of the class names and its
    SHA-256.
    """

    method: str
    formats: tuple[str, ...]
    paths: tuple[str, ...]
    files: Mapping[str, Mapping[str, str]]
    confidences: str
    texts: tuple[str, str] | None = None


@dataclass(frozen=True)
class GitRecord:
    """The checkout that the code ran from."""

    commit: str
    is_dirty: bool


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """``run.json``: the provenance of the numbers; with fewer fields for an unfinished run or an older version.

    ``models`` has the SHA-256 of weight files by model and file name.

    ``status`` is ``running``, ``interrupted``, ``incomplete`` or ``complete``. ``predictions`` are imported ones,
    ``ground_truth`` what they were compared with.
    """

    schema: int = SCHEMA
    status: str = ""
    is_partial: bool = False
    code: str = ""
    git: GitRecord | None = None
    packages: Mapping[str, str] = field(default_factory=dict)
    hardware: str = ""
    processor: str = ""
    n_workers: int = 1
    seed: int | None = None
    profile: str | None = None
    models: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    encoder: str | None = None
    encoder_digest: str | None = None
    data_digests: Mapping[str, str] = field(default_factory=dict)
    protocols: tuple[ProtocolRecord, ...] = ()
    methods: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    failed: tuple[FailureRecord, ...] = ()
    unscored: tuple[UnscoredRecord, ...] = ()
    warnings: tuple[str, ...] = ()
    predictions: tuple[PredictionsRecord, ...] = ()
    ground_truth: TruthRecord | None = None

    @property
    def truth_files(self) -> str | None:
        """The folder of ground-truth files used in place of a dataset."""
        return None if self.ground_truth is None else self.ground_truth.path


@dataclass(frozen=True, kw_only=True)
class NumbersRecord:
    """``result`` of a result: the numbers over the scored scenes as fractions, null if undefined.

    ``metrics``: as reported; ``pooled``: from the summed counts; ``scene_mean``: mean over scenes.
    """

    protocol: str = ""
    version: int = 0
    headline: tuple[str, ...] = ()
    n_scenes: Count = 0
    scenes: tuple[str, ...]
    metrics: Values
    intervals: Mapping[str, tuple[Share, Share] | None]
    pooled: Values = field(default_factory=dict)
    scene_mean: Values = field(default_factory=dict)
    per_scene: Mapping[str, Values]
    per_class: Mapping[str, Values]
    groups: Mapping[str, Values] = field(default_factory=dict)
    coverage: Values = field(default_factory=dict)
    n_predictions: Mapping[str, Count] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class MidwayRecord:
    """The metrics of the maps after the fraction ``share`` of the updates.

    ``n_updates``: after this number of updates, of which ``share`` is the fraction in the longest scene; 0 if fractions
    were requested.
    """

    share: Share
    metrics: Values
    n_updates: Count = 0


@dataclass(frozen=True)
class SeenRecord(MidwayRecord):
    """The same against the ground truth restricted to what the frames until then have shown; ``ceiling``: its own."""

    ceiling: Values | None = None


@dataclass(frozen=True, kw_only=True)
class ResultRecord:
    """One method under one protocol; ``encoder`` is null if the method labelled its instances itself.

    ``result`` is null if no scene was scored; ``anytime`` is missing if no intermediate map was requested, ``seen`` if
    they were not scored against what was seen, the last point for the last map; ``areas`` of the headline metrics are
    those under the curves ``anytime``, ``seen`` and the ``ceiling`` of the latter, by curve and metric.
    ``confidences``: what ranked the predictions for average precision, null without that metric. ``labels``: how many
    labels per mask or point count, null if labels are not scored, or if an older run did not record it.
    """

    method: str
    protocol: str
    version: int
    kind: str
    headline: tuple[str, ...]
    profile: str | None
    caveat: str | None
    encoder: str | None
    encoder_digest: str | None
    n_planned: Count
    failed: tuple[str, ...]
    unscored: tuple[str, ...]
    ceiling: Values | None
    result: NumbersRecord | None
    anytime: tuple[MidwayRecord, ...] | None = None
    seen: tuple[SeenRecord, ...] | None = None
    areas: Mapping[str, Values] | None = None
    confidences: str | None = None
    labels: str | None = None


@dataclass(frozen=True, kw_only=True)
class MetricsRecord:
    """``metrics.json``: the results of the run; ``limit`` is 0 if all frames were used."""

    schema: int = SCHEMA
    is_partial: bool = False
    limit: Count
    seed: int = 0
    scenes: tuple[str, ...] = ()
    results: tuple[ResultRecord, ...]


@dataclass(frozen=True)
class MapCost:
    """The cost of one map: the updates before it, milliseconds of ``finish``, the part of perception in these, and the
    bytes of its files.
    """

    n_updates: Count
    finish_ms: Amount
    perception_ms: Amount = 0.0
    n_bytes: Count | None = None


@dataclass(frozen=True)
class RealTimeRecord:
    """The clock of a real-time run on one scene.

    ``n_frames`` arrived, ``n_processed`` of them were finished in time, ``n_dropped`` were never started;
    ``latency_ms``: mean from the arrival to the end of the update. ``device``: the machine of the durations, which were
    measured or simulated.
    """

    rate_hz: Annotated[float, Field(gt=0, le=1e6)]
    queue: str
    queue_size: Count
    device: str
    is_simulated: bool
    n_frames: Count
    n_processed: Count
    n_dropped: Count
    latency_ms: Amount | None = None

    @property
    def duration_s(self) -> float:
        """The duration of the recording."""
        return self.n_frames / self.rate_hz


@dataclass(frozen=True)
class CostsRecord:
    """``costs`` in the completion record of ``predict``: intermediate maps and the last one, null if not measured.

    ``calibration_ms``: the time of a fixed workload, measured between the updates; ``start_ms`` and ``close_ms``:
    the method's time before the first frame and after the last map. Numbers that a method measures itself are stored
    with those of a map.
    """

    maps: tuple[MapCost, ...] = ()
    calibration_ms: Amount | None = None
    peak_rss_bytes: Count | None = None
    device_bytes: Count | None = None
    start_ms: Amount | None = None
    close_ms: Amount | None = None
    realtime: RealTimeRecord | None = None


@dataclass(frozen=True)
class CompletionRecord:
    """The completion record of a step in ``done.json``: the key of its inputs, SHA-256 of its files, and remarks."""

    key: Mapping[str, str]
    files: Annotated[Mapping[str, str], Field(min_length=1)]
    remarks: Mapping[str, Any]


@cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def plain(record: Any) -> dict[str, Any]:
    """``record`` as a dict in the form that is written."""
    written = asdict(record)
    if isinstance(record, RunRecord) and record.ground_truth is None:
        del written["predictions"], written["ground_truth"]
    for result in written["results"] if isinstance(record, MetricsRecord) else ():
        for name in ("anytime", "seen", "areas"):
            if result[name] is None:
                del result[name]
    for protocol in written["protocols"] if isinstance(record, RunRecord) else ():
        if protocol["rules"] is None:
            del protocol["rules"]
    return written


def checked(kind: type[Kind], value: Any) -> Kind:
    """``value`` as a record; raises ``ValidationError`` or ``RecursionError`` if it is invalid."""
    record: Kind = _adapter(kind).validate_python(value)  # type: ignore[arg-type]  # every class is hashable
    return record


def read_record(kind: type[Kind], file: Path, shown: str) -> Kind:
    """The record in ``file``; ``shown`` begins the ``StoreError`` if it is invalid."""
    try:
        return checked(kind, read_json(file))
    except (RecursionError, ValidationError) as error:
        key, reason = "it", "too deeply nested"
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            key, reason = ".".join(map(str, first["loc"])) or "it", first["msg"].removeprefix("Value error, ")
        what = f"{printable(key, 120)} is invalid ({printable(reason, 160)})"
        raise StoreError(f"{shown}: {file.name}: {what}; run it again") from error


def updates_text(rows: Sequence[Mapping[str, float | int]]) -> str:
    """``updates.csv``: the updates of a scene, one row each; a missing stage is 0."""
    columns = list(dict.fromkeys(name for row in rows for name in row if name != "total_ms"))
    text = io.StringIO()
    writer = csv.DictWriter(text, [*columns, "total_ms"] if rows else ["update"], restval=0, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def read_updates(file: Path, where: str) -> dict[str, Float64Array]:
    """The columns (N,) of an ``updates.csv``, empty if no update was timed; ``where`` begins a ``DataError``."""
    try:
        with opened_text(file, newline="") as stream:
            reader = csv.reader(stream)
            header = next(reader, [])
            rows = [row for row, _ in zip(reader, range(MAX_UPDATES), strict=False)]
            if "total_ms" not in header:
                return {}
            table = np.array(rows, np.float64).reshape(len(rows), len(header))
    except (ValueError, csv.Error, UnicodeDecodeError) as error:
        raise DataError(f"{where}: is not a table of numbers; run the same command again to repair it") from error
    if not np.isfinite(table).all():
        raise DataError(f"{where}: has a number that is not finite; run the same command again to repair it")
    if table.size and not 0 <= table.min() <= table.max() <= MAX_VALUE:
        raise DataError(f"{where}: has {table.min():g} and {table.max():g}; expected 0 to {MAX_VALUE:g}")
    if len(set(header)) != len(header):
        raise DataError(f"{where}: has two columns with the same name; run the same command again to repair it")
    return {name: table[:, column] for column, name in enumerate(header)}
