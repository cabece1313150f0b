"""A finished run as comparisons and explanations need it: what was scored, on which data, by which rules."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from su3d_bench.core import registry
from su3d_bench.core.config import KeyPath, Settings, flatten, read_file, resolve, toml_value
from su3d_bench.core.errors import (
    ConfigError,
    DataError,
    PredictionError,
    StoreError,
    Su3dError,
    printable,
    shown,
    some,
    suggest,
)
from su3d_bench.core.files.atomic import is_file, read_json
from su3d_bench.core.maps import Prediction
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.system.timing import processor_digest
from su3d_bench.metrics.costs import UpdateTimes
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names, read_rules
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import unpack_scores
from su3d_bench.predictions.formats import recognise
from su3d_bench.runs.clock import read_schedule
from su3d_bench.runs.job import Part, build_dataset, part_of
from su3d_bench.runs.real_time import NOT_TIMED
from su3d_bench.runs.scenes import cache_root, data_root, dataset_targets, looks_like_scene, nearest_scene
from su3d_bench.store import records
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.run_folder import JobFolder, RunFolder

if TYPE_CHECKING:
    from su3d_bench.core.interfaces import Encoder


MAX_NAMED = 8  # scenes or methods of a run in a message
AS_SUBMITTED = "as submitted"  # times that were not measured again


def external(formats: Sequence[str]) -> str:
    """The note below every table of predictions that were not made here."""
    return f"external predictions, read from files ({printable(', '.join(formats), 120)})"


@dataclass(frozen=True)
class RunData:
    """The data of a run, opened with the options that it had; ``digests`` are those of its scenes.

    ``truth_files``: the folder of ground truth that external predictions were compared with, if not a dataset.
    """

    settings: Settings
    digests: Mapping[str, str]
    truth_files: str | None = None

    @cached_property
    def _datasets(self) -> dict[str, Any]:
        addresses = {entry.path: entry.value for entry in self.settings.entries}.get(("scenes",), ())
        datasets = {}
        for target in dataset_targets([str(address) for address in addresses]):
            part = part_of("dataset", target, self.settings)
            datasets[part.name] = build_dataset(part, data_root())
        return datasets

    def dataset(self, scene: str) -> Any:
        """The dataset of ``scene``; a ``DataError`` if it is unknown, or its data differ from those of the run."""
        name, _, of_dataset = scene.partition("/")
        if self.truth_files is not None:
            raise DataError(
                f"{printable(scene, 100)}: was evaluated against the files in {printable(self.truth_files, 200)}, "
                "which have no frames, colours or positions; evaluate against the dataset itself with --dataset"
            )
        if name not in self._datasets:
            raise DataError(f"{printable(scene, 100)}: run.toml names no dataset '{printable(name, 60)}'")
        dataset = self._datasets[name]
        if dataset.digest(of_dataset) != self.digests.get(scene):
            raise DataError(f"{printable(scene, 100)}: its data have changed since the run; run it again")
        return dataset


@dataclass(frozen=True)
class FinishedRun:
    """The records of a run; ``protocols`` are the rules that scored it, ``results`` are by method and protocol."""

    folder: RunFolder
    record: records.RunRecord
    protocols: Mapping[str, records.ProtocolRecord]
    results: Mapping[tuple[str, str], records.ResultRecord]
    metrics: records.MetricsRecord
    data: RunData

    @property
    def scenes(self) -> tuple[str, ...]:
        return self.record.scenes

    @property
    def methods(self) -> tuple[str, ...]:
        return self.record.methods

    @property
    def hardware(self) -> str:
        """The machine of the run; its times are only known as submitted if this machine has another processor."""
        is_here = self.record.processor == processor_digest()
        return self.record.hardware if is_here else f"{self.record.hardware}; times {AS_SUBMITTED}, not measured here"

    @property
    def limit(self) -> int:
        return self.metrics.limit

    @property
    def is_incomplete(self) -> bool:
        return self.record.status != "complete"

    @cached_property
    def settings(self) -> Mapping[KeyPath, Any]:
        return {entry.path: entry.value for entry in self.data.settings.entries}

    def changed(self, method: str) -> tuple[str, ...]:
        """The settings of ``method`` that are not its defaults, such as ``top_m = 3``; empty if it is unknown."""
        with suppress(ConfigError):
            own = dict(flatten(json.loads(part_of("method", method, Settings()).options)))
            given = {path[2:]: value for path, value in self.settings.items() if path[:2] == ("method", method)}
            stride = self.settings.get(("stride",), 0)
            given |= {("stride",): stride} if stride and ("stride",) in own else {}
            differ = [path for path, value in given.items() if path in own and own[path] != value]
            return tuple(printable(f"{'.'.join(path)} = {toml_value(given[path])}", 80) for path in differ)
        return ()

    def dataset(self, scene: str) -> Any:
        """The dataset of ``scene``; a ``DataError`` if its data differ from those of the run."""
        return self.data.dataset(scene)

    def truth_part(self, method: str) -> Part | None:
        """The method with its settings if it is a built-in one that uses ground truth, otherwise None."""
        is_built_in = method in registry.METHODS and method not in self.external
        uses_truth = is_built_in and hasattr(registry.load("method", method), "receive_ground_truth")
        return part_of("method", method, self.data.settings) if uses_truth else None

    def encoder(self, device: str = "cpu") -> Encoder:
        """The text encoder that matches the run's features; a ``PredictionError`` if a different one is used here."""
        return encoder_of(self.folder, device)

    @property
    def name(self) -> str:
        return printable(str(self.folder.path), 200)

    @cached_property
    def external(self) -> Mapping[str, records.PredictionsRecord]:
        """The external predictions, by method name."""
        return {record.method: record for record in self.record.predictions}

    def elsewhere_lines(self) -> list[str]:
        """One line per method with external predictions."""
        of_methods = self.external.items()
        return [f"{printable(method, 80)}: {external(record.formats)}" for method, record in of_methods]

    def rules(self, protocol: str, *, to_the_letter: bool = False) -> ProtocolRules:
        """The rules that scored the run: built-in ones, otherwise those stored in ``run.json``.

        A ``ConfigError`` if they are neither here nor in ``run.json``, or have a different version;
        ``to_the_letter``: or differ under the same version.
        """
        recorded, shown = self.protocols.get(protocol), printable(protocol, 80)
        if recorded is None:
            raise ConfigError(f"{self.name}: run.json does not list the protocol {shown} of its scores")
        here = load_protocol(protocol) if protocol in protocol_names() else self._own_rules(recorded)
        if here.version != recorded.version:
            raise ConfigError(
                f"{self.name}: was scored under {shown} version {recorded.version}, now it is version {here.version}; "
                "score it again"
            )
        if here.digest != recorded.digest and (to_the_letter or recorded.rules is not None):
            raise ConfigError(f"{self.name}: the rules of {shown} are not those that scored it (same version)")
        return here

    def _own_rules(self, recorded: records.ProtocolRecord) -> ProtocolRules:
        """User-defined rules, stored in ``run.json``."""
        where = f"{self.name}: the rules of {printable(recorded.name, 80)}"
        own = None if recorded.rules is None else read_rules(recorded.rules, where)
        if own is None or own.name != recorded.name:
            raise ConfigError(f"{where} are neither built-in nor in run.json; run its command again")
        return own

    def check_method(self, method: str) -> None:
        """A ``ConfigError`` if the run has no scores of ``method``."""
        if method not in self.methods and not self.has_scores(method):
            has_truth = CEILING_METHOD not in self.methods and self.has_scores(CEILING_METHOD)
            known = [*self.methods, *([CEILING_METHOD] if has_truth else [])]
            hint = suggest(method, known, "it has")
            raise ConfigError(f"{self.name}: has no scores of the method '{printable(method, 80)}'{hint}")

    def check_protocol(self, protocol: str) -> None:
        """A ``ConfigError`` if the run was not scored under ``protocol``."""
        if protocol not in self.protocols:
            hint = suggest(protocol, self.protocols, "it has")
            raise ConfigError(f"{self.name}: was not scored under '{printable(protocol, 80)}'{hint}")

    def has_scores(self, method: str) -> bool:
        """Whether any scene was scored for ``method``; the scores of the ceiling are in no table."""
        is_name = "/" not in method
        return is_name and any(is_file(self.folder.job(scene, method).counts) for scene in self.scenes)

    def scores(
        self, method: str, file_of: Callable[[JobFolder], Path] = attrgetter("counts")
    ) -> dict[str, dict[str, SceneScore]]:
        """Protocol -> scene -> counts, for every scene that was scored."""
        scores: dict[str, dict[str, SceneScore]] = {name: {} for name in self.protocols}
        for scene in self.scenes:
            file = file_of(self.folder.job(scene, method))
            if not is_file(file):
                continue
            try:
                of_scene = unpack_scores(file_bytes(file))
            except DataError as error:
                raise DataError(f"{printable(scene, 120)}: {method}: {error}") from error
            for protocol, score in of_scene.items():
                scores.setdefault(protocol, {})[scene] = score
        return scores


def record_of_rules(rules: ProtocolRules) -> records.ProtocolRecord:
    """The record in ``run.json`` of the rules that scored a run."""
    own = None if rules.name in protocol_names() else rules.as_json
    return records.ProtocolRecord(rules.name, rules.version, rules.digest, own)


def read_run(path: Path) -> FinishedRun:
    """The run in the folder ``path``; a ``StoreError`` if there is none, or it is not finished."""
    shown = printable(str(path), 200)
    if not is_file(path / "run.json"):
        raise StoreError(f"{shown}: {_no_run_message(path)}")
    if not is_file(path / "metrics.json"):
        raise StoreError(f"{shown}: contains no metrics.json, so the run is not finished; run its command again")
    record = records.read_record(records.RunRecord, path / "run.json", shown)
    metrics = records.read_record(records.MetricsRecord, path / "metrics.json", shown)
    if not record.methods:
        raise StoreError(f"{shown}: run.json: methods is empty; run it again")
    named = {
        "run.json: names the protocol": [rules.name for rules in record.protocols],
        "run.json: names the scene": record.scenes,
        "run.json: names the method": record.methods,
        "metrics.json: names the result": [f"{one.method} / {one.protocol}" for one in metrics.results],
    }
    for what, names in named.items():  # of two different ones, one would be ignored
        if twice := [name for name, n in Counter(names).items() if n > 1]:
            raise StoreError(f"{shown}: {what} '{printable(twice[0], 100)}' twice; run its command again")
    protocols = {rules.name: rules for rules in record.protocols}
    bad = [name for name in (*record.methods, *record.scenes) if not name.isprintable() or len(name.encode()) > 255]
    if bad := [*bad, *(name for name in record.methods if "/" in name)]:
        raise StoreError(f"{shown}: run.json: '{printable(bad[0], 80)}' is not a valid name of a method or scene")
    if unnamed := [one.protocol for one in metrics.results if one.protocol not in protocols]:
        raise StoreError(f"{shown}: run.json does not name the protocol '{unnamed[0]}'; run its command again")
    return FinishedRun(
        folder=RunFolder(path),
        record=record,
        protocols=protocols,
        results={(result.method, result.protocol): result for result in metrics.results},
        metrics=metrics,
        data=RunData(read_file(path / "run.toml"), record.data_digests, record.truth_files),
    )


def _no_run_message(path: Path) -> str:
    """What ``path`` contains instead of a run, and how to get a run."""
    if is_file(path) and is_scores_file(path):
        return (
            "contains numbers without the counts of scenes that are needed here; evaluate again with --out "
            "runs/mine, and name that folder"
        )
    with suppress(Su3dError, OSError):
        reader = recognise(path)
        if path.is_dir() and reader.scenes(path):
            made = f"su3d-bench evaluate {shlex.quote(str(path))} --out runs/mine"
            return f"contains predictions ({reader.name}) and no run.json; create a run from them with: {made}"
    return "contains no run.json; name the folder of a run, such as runs/my-run"


def is_scores_file(file: Path) -> bool:
    """Whether ``file`` is an output of ``evaluate --json``."""
    try:
        value = read_json(file)
    except StoreError:
        return False
    methods = value.get("methods") if isinstance(value, dict) else None
    first = next(iter(methods.values()), None) if isinstance(methods, dict) else value
    return isinstance(first, dict) and {"formats", "ground_truth", "protocols"} <= first.keys()


def map_of_scene(scene: str, method: str, run: Path | None) -> tuple[RunFolder, JobFolder, Prediction]:
    """The map of ``scene`` by ``method`` and its location, in ``run`` or in the latest run below ``runs/``."""
    folder = latest_run(scene, method) if run is None else RunFolder(run)
    job = folder.job(scene, method)
    if not job.prediction.is_file():
        raise _no_map(folder, scene, method)
    return folder, job, read_prediction(job.prediction)


def latest_run(scene: str, method: str) -> RunFolder:
    """The run folder below ``runs/`` with the newest map of the scene."""
    runs = [RunFolder(path) for path in Path("runs").glob("*") if path.is_dir()]
    made = [(run.job(scene, method).prediction, run) for run in runs if run.job(scene, method).prediction.is_file()]
    if not made:
        known = dict.fromkeys(name for run in runs for name in _request_of(run).scenes)
        hint = nearest_scene(scene, known)
        if not hint and looks_like_scene(scene):
            command = shlex.join(["su3d-bench", "run", scene, "--methods", method])
            hint = f"; create one: {printable(command, 300)}"
        raise StoreError(f"no run in runs/ has {printable(scene, 120)} by {printable(method, 80)}{hint}")
    return max(made, key=lambda pair: pair[0].stat().st_mtime)[1]


def _no_map(run: RunFolder, scene: str, method: str) -> StoreError:
    """The error of a run without such a map, with the names that it has. It suggests no command that would write into
    the folder, which belongs to another request."""
    record = _request_of(run)
    if not record.scenes:
        return StoreError(f"{shown(run.path)}: contains no run; name a run folder, see: su3d-bench runs list")
    if scene not in record.scenes:
        known = [printable(name, 80) for name in record.scenes]
        hint = nearest_scene(scene, record.scenes) or f"; the run has {some(known, MAX_NAMED)}"
    elif method not in record.methods:
        hint = suggest(method, record.methods, "the run has")
    else:
        hint = ": the run is not finished; run its command again"
    return StoreError(f"{shown(run.path)}: contains no map of {printable(scene, 120)} by {printable(method, 80)}{hint}")


def _request_of(run: RunFolder) -> records.RunRecord:
    """The request of the run; empty if its record is missing or damaged."""
    with suppress(StoreError):
        return records.read_record(records.RunRecord, run.path / "run.json", shown(run.path))
    return records.RunRecord()


def data_of_map(run: Path, scene: str, map_file: Path) -> RunData:
    """The data from which ``map_file``, a completed map of ``scene`` in the folder ``run``, was made."""
    completion = JobFolder(map_file.parent).completion_records().get("predict")
    digests = {} if completion is None else {scene: completion.key.get("data", "")}
    return RunData(read_file(run / "run.toml"), digests, _request_of(RunFolder(run)).truth_files)


def encoder_of(run: RunFolder, device: str = "cpu") -> Encoder:
    """The text encoder that matches the run's features, on ``device``; a different one raises ``PredictionError``."""
    from su3d_bench.perception.cache import FrameCache
    from su3d_bench.perception.models.catalogue import encoder_known_as
    from su3d_bench.perception.models.encoders.encoder import FoundationEncoder
    from su3d_bench.perception.models.loading import load_encoder
    from su3d_bench.perception.profiles import PerceptionConfig

    record = records.read_record(records.RunRecord, run.path / "run.json", shown(run.path))
    entry = encoder_known_as(record.encoder)
    config = PerceptionConfig()
    if entry is not None:
        config = resolve(read_file(run.path / "run.toml"), ("perception",), PerceptionConfig)
    here = {"device": device, "precision": "auto", "batch": 0}
    models = config.models.model_copy(update={**here, "encoder": entry.name if entry else None})
    encoder = load_encoder(models, cache=FrameCache(cache_root() if config.cache else None))
    made_with = record.encoder_digest
    if made_with is None or made_with == encoder.digest:
        return encoder
    if isinstance(encoder, FoundationEncoder) and encoder.is_same_space(made_with):
        return encoder
    raise PredictionError(
        f"{run.path}: its features were made by encoder {record.encoder} ({made_with[:12]}), not by "
        f"{encoder.name} ({encoder.digest[:12]}); "
        + ("run it again" if record.ground_truth is None else "only texts encoded by it can be compared with them")
    )


def read_update_times(run: FinishedRun, method: str) -> list[UpdateTimes]:
    """The updates of every scene that ``method`` finished, except scenes for which it uses no frames."""
    run.check_method(method)
    times = []
    for scene in run.scenes:
        job = run.folder.job(scene, method)
        if not is_file(job.updates):
            continue
        where = f"{printable(scene, 120)}: {job.updates.name}"
        columns = records.read_updates(job.updates, where)
        if columns and len(columns["total_ms"]):
            try:
                costs = records.checked(records.CostsRecord, job.remarks("predict").get("costs") or {})
            except (ValidationError, RecursionError) as error:
                raise DataError(f"{where}: the costs in done.json are damaged; run the scene again") from error
            frame_ms = _frame_ms(run, job, columns)
            times.append(UpdateTimes(run.name, scene, method, columns, **vars(costs), frame_ms=frame_ms))
    return times


def _frame_ms(run: FinishedRun, job: JobFolder, columns: Mapping[str, Any]) -> list[float] | None:
    """Milliseconds (N,) of perception and method per update; None if perception may have been read from files.

    In real time those of the schedule: the updates that ``updates.csv`` times only repeat it.
    """
    if is_file(job.schedule):
        return read_schedule(job.schedule).fed_ms
    is_stored = bool({*(run.record.profile or "").split(", ")} & {*NOT_TIMED})
    if is_stored or run.settings.get(("perception", "cache")) is not False:
        return None
    return list(columns["total_ms"] - columns.get("decode_ms", 0.0))
