"""What the small files of a run hold: ``run.json``, ``metrics.json``, the seals of ``done.json``, ``updates.csv``.

Whoever writes one of them writes these records, and whoever reads one gets them. Their fields stand in the order in
which a file has them; one with a default may be missing, for earlier versions did not write it.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from su3d_bench.core.errors import DataError, StoreError, printable
from su3d_bench.core.files.atomic import read_json
from su3d_bench.core.system.files import opened_text
from su3d_bench.core.types import Float64Array

SCHEMA = 1
MAX_UPDATES = 10_000_000
Kind = TypeVar("Kind")
ROUNDING = 1e-9  # by how much a mean of shares may pass 1
MAX_VALUE = 1e18  # milliseconds, bytes or things: more than there are
Number = Annotated[float, Field(allow_inf_nan=False)]  # NaN would differ from nothing, and so pass every comparison
Amount = Annotated[float, Field(ge=0, le=MAX_VALUE, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=int(MAX_VALUE))]
Share = Annotated[float, Field(ge=0, le=1 + ROUNDING, allow_inf_nan=False)]


def impossible_value(name: str, value: float) -> str | None:
    """A clause where the value ``name`` of a result cannot be ``value``: ``n_...`` are numbers of things, all others
    fractions.

    >>> impossible_value("mAcc", 7e300), impossible_value("n_classes", 7)
    ("'mAcc' is 7e+300, a fraction lies from 0 to 1", None)
    """
    if name.startswith("n_"):
        return None if 0 <= value <= MAX_VALUE else f"'{name}' is {value:g}, of which there are none or more"
    return None if 0 <= value <= 1 + ROUNDING else f"'{name}' is {value:g}, a fraction lies from 0 to 1"


def _possible(values: Mapping[str, float | None]) -> Mapping[str, float | None]:
    for name, value in values.items():
        if value is not None and (fault := impossible_value(name, value)) is not None:
            raise ValueError(fault)
    return values


Values = Annotated[Mapping[str, Number | None], AfterValidator(_possible)]


@dataclass(frozen=True)
class ProtocolRecord:
    """The rules that scored a run. ``rules``: all of them, where they are somebody's own and not the program's."""

    name: str
    version: int
    digest: str
    rules: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class FailureRecord:
    """A scene under a method that failed, with its line."""

    scene: str
    method: str
    error: str


@dataclass(frozen=True)
class UnscoredRecord:
    """Why a scene under a method has no score of a protocol."""

    scene: str
    method: str
    protocol: str
    reason: str


@dataclass(frozen=True)
class TruthRecord:
    """What predictions made elsewhere were held against: a dataset, or the files at ``path``.

    ``values``: what a text was said to hold; ``queries``: SHA-256 of the file of queries.
    """

    dataset: str | None
    path: str | None
    values: str | None = None
    queries: str | None = None


@dataclass(frozen=True)
class PredictionsRecord:
    """Predictions made elsewhere that a run took for those of ``method``.

    ``files``: SHA-256 of every file that was read, by scene and path. ``confidences`` is ``file`` where those of the
    files count even where a protocol has 1 for every mask. ``texts``: the file of the features of class names and its
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
    """``run.json``: where the numbers come from; that of a run that is not finished, or of an older version, says less.

    ``models`` holds the SHA-256 of weight files by model and file name.

    ``status`` is ``running``, ``interrupted``, ``incomplete`` or ``complete``. ``predictions`` are those that were made
    elsewhere, ``ground_truth`` what they were held against.
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
        """The folder of ground truth that predictions were compared with in place of a dataset."""
        return None if self.ground_truth is None else self.ground_truth.path


@dataclass(frozen=True, kw_only=True)
class NumbersRecord:
    """``result`` of a result: the numbers over the scored scenes as fractions, null where undefined."""

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
    """The metrics of the maps after ``share`` of the updates."""

    share: Share
    metrics: Values


@dataclass(frozen=True, kw_only=True)
class ResultRecord:
    """One method under one protocol; ``encoder`` is null where the method named its instances itself.

    ``result`` is null where no scene was scored; ``anytime`` is missing where no map midway was asked for;
    ``confidences``: what ranked the predictions of an average precision, null where none was formed. ``labels``: how
    many labels of a mask or point count, null where none does, or where an older run does not say.
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
    confidences: str | None = None
    labels: str | None = None


@dataclass(frozen=True, kw_only=True)
class MetricsRecord:
    """``metrics.json``: what the run measured; ``limit`` is 0 where all frames were used."""

    schema: int = SCHEMA
    is_partial: bool = False
    limit: Count
    seed: int = 0
    scenes: tuple[str, ...] = ()
    results: tuple[ResultRecord, ...]


@dataclass(frozen=True)
class MapCost:
    """What one map took: the updates before it, milliseconds of ``finish``, and what of them was perception's."""

    n_updates: Count
    finish_ms: Amount
    perception_ms: Amount = 0.0


@dataclass(frozen=True)
class CostsRecord:
    """``costs`` beside the seal of ``predict``: maps midway and the last one, null for what was not measured.

    ``calibration_ms``: the time of a fixed piece of work, measured between the updates; ``start_ms`` and ``close_ms``:
    what the method took before the first frame and after the last map. What a method measures itself stands beside the
    numbers of a map.
    """

    maps: tuple[MapCost, ...] = ()
    calibration_ms: Amount | None = None
    peak_rss_bytes: Count | None = None
    device_bytes: Count | None = None
    start_ms: Amount | None = None
    close_ms: Amount | None = None


@dataclass(frozen=True)
class CompletionRecord:
    """A step of ``done.json``: the key of its inputs, the SHA-256 of the files that it vouches for, and remarks."""

    key: Mapping[str, str]
    files: Annotated[Mapping[str, str], Field(min_length=1)]
    remarks: Mapping[str, Any]


_ADAPTERS: dict[Any, TypeAdapter[Any]] = {
    kind: TypeAdapter(kind) for kind in (RunRecord, MetricsRecord, CostsRecord, CompletionRecord)
}


def plain(record: Any) -> dict[str, Any]:
    """``record`` as it is written."""
    written = asdict(record)
    if isinstance(record, RunRecord) and record.ground_truth is None:
        del written["predictions"], written["ground_truth"]
    for result in written["results"] if isinstance(record, MetricsRecord) else ():
        if result["anytime"] is None:
            del result["anytime"]
    for protocol in written["protocols"] if isinstance(record, RunRecord) else ():
        if protocol["rules"] is None:
            del protocol["rules"]
    return written


def checked(kind: type[Kind], value: Any) -> Kind:
    """The record that ``value`` is; a ``ValidationError`` or ``RecursionError`` where it is none."""
    record: Kind = _ADAPTERS[kind].validate_python(value)
    return record


def read_record(kind: type[Kind], file: Path, shown: str) -> Kind:
    """The record in ``file``; ``shown`` begins the ``StoreError`` where it holds none."""
    try:
        return checked(kind, read_json(file))
    except (RecursionError, ValidationError) as error:
        key, reason = "it", "nested too deep"
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            key, reason = ".".join(map(str, first["loc"])) or "it", first["msg"].removeprefix("Value error, ")
        what = f"{printable(key, 120)} is not as a run writes it ({printable(reason, 160)})"
        raise StoreError(f"{shown}: {file.name}: {what}; run it again") from error


def updates_text(rows: Sequence[Mapping[str, float | int]]) -> str:
    """``updates.csv``: the updates of a scene, one row each; a stage that an update lacks is 0."""
    columns = list(dict.fromkeys(name for row in rows for name in row if name != "total_ms"))
    text = io.StringIO()
    writer = csv.DictWriter(text, [*columns, "total_ms"] if rows else ["update"], restval=0, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def read_updates(file: Path, where: str) -> dict[str, Float64Array]:
    """The columns (N,) of an ``updates.csv``, none where no update was timed; ``where`` begins a ``DataError``."""
    try:
        with opened_text(file, newline="") as stream:
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
    if table.size and not 0 <= table.min() <= table.max() <= MAX_VALUE:
        raise DataError(
            f"{where}: holds {table.min():g} and {table.max():g}; times and sizes lie from 0 to {MAX_VALUE:g}"
        )
    if len(set(header)) != len(header):
        raise DataError(f"{where}: has two columns of one name; run the same command again to mend it")
    return {name: table[:, column] for column, name in enumerate(header)}
