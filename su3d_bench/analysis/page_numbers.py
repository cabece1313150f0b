"""What the page of some runs shows besides their maps: numbers, confusions, errors, times, comparisons, provenance."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field, ValidationError

from su3d_bench.analysis.attribution import EncoderOf, attribute
from su3d_bench.analysis.comparison import SideNumbers, compare
from su3d_bench.core.config import KeyPath
from su3d_bench.core.errors import StoreError, Su3dError, printable, printable_json
from su3d_bench.metrics.costs import summarise
from su3d_bench.metrics.protocols import load_protocol
from su3d_bench.metrics.semantic.confusion import SemanticCounts, concatenate
from su3d_bench.reports.page.numbers import confusion_cells, series_of, summary_data
from su3d_bench.runs.finished import FinishedRun, read_run, read_update_times
from su3d_bench.store.atomic import read_json

MOST_PAIRS = 40  # pairs of methods that are compared: all of nine methods, and a few seconds
# Jobs (a scene under a method) up to which each is read. The courses and comparisons of more take minutes to make and
# are no more to be looked at one by one.
MOST_JOBS = 500
MOST_MAPS = 16  # of a page of more jobs: two scenes under eight methods
LEFT_OUT = (
    "what each job's own files say is left out: errors (su3d-bench attribute), confusions, times (report timing), "
    f"comparisons (compare) and all maps but those of the first scenes, at most {MOST_MAPS}"
)
Number = Annotated[float, Field(allow_inf_nan=False)]
Values = dict[str, Number | None]
Model = TypeVar("Model", bound=BaseModel)
Progress = Callable[[str], None]


class _Values(BaseModel):
    metrics: Values
    pooled: Values = {}
    intervals: dict[str, tuple[Number, Number] | None]
    scenes: tuple[str, ...]
    per_scene: dict[str, Values]
    per_class: dict[str, Values] = {}
    groups: dict[str, Values] = {}
    coverage: Values = {}
    n_predictions: dict[str, int] = {}
    warnings: tuple[str, ...] = ()


class _Midway(BaseModel):
    share: Number
    metrics: Values


class _Result(BaseModel):
    method: str
    protocol: str
    version: int
    kind: str
    headline: tuple[str, ...]
    profile: str | None
    caveat: str | None
    encoder: str | None
    n_planned: int
    failed: tuple[str, ...]
    unscored: tuple[str, ...]
    ceiling: Values | None
    result: _Values | None
    anytime: tuple[_Midway, ...] = ()


class _Metrics(BaseModel):
    results: tuple[_Result, ...]


class _Git(BaseModel):
    commit: str
    is_dirty: bool


class _Record(BaseModel):
    """What is read of ``run.json`` for the provenance alone."""

    git: _Git | None = None
    packages: dict[str, str] = {}
    seed: int | None = None
    encoder: str | None = None
    failed: tuple[dict[str, Any], ...] = ()
    warnings: tuple[Any, ...] = ()


def page_numbers(
    folders: Sequence[Path], encoder_of: EncoderOf, *, with_errors: bool = True, progress: Progress = lambda line: None
) -> dict[str, Any]:
    """Plain values for the page of the runs in ``folders``, every text in them on one line and printable.

    ``with_errors``: predictions are scored again with each kind of error mended, which takes as long as scoring them.
    Of more than ``MOST_JOBS`` jobs the page shows what the runs' own records say, and ``left_out`` says what it lacks.
    Raises a ``StoreError`` where a folder holds no finished run; what cannot be had of one is a reason on the page.
    """
    runs = [read_run(folder) for folder in dict.fromkeys(folders)]
    n_jobs = _n_jobs(runs)
    results: list[dict[str, Any]] = []
    confusions: list[dict[str, Any]] = []
    timing: list[dict[str, Any]] = []
    errors: list[dict[str, Any]] = []
    for index, run in enumerate(runs):
        progress(f"{run.name}: numbers")
        results += [{"run": index, **one.model_dump()} for one in _results(run)]
        if n_jobs > MOST_JOBS:
            continue
        timing += [{"run": index, **one} for method in run.methods if (one := _times(run, method)) is not None]
        for method in run.methods:
            confusions += [{"run": index, **one} for one in _confusions(run, method)]
            if with_errors:
                progress(f"{run.name}: errors of {printable(method, 80)}")
                errors.append({"run": index, **_errors(run, method, encoder_of)})
    progress("comparisons")
    found = {
        "left_out": f"{n_jobs} jobs, more than {MOST_JOBS}: {LEFT_OUT}" if n_jobs > MOST_JOBS else None,
        "runs": [_about(run) for run in runs],
        "results": results,
        "confusions": confusions,
        "errors": errors,
        "timing": timing,
        "comparisons": _comparisons(runs) if n_jobs <= MOST_JOBS else [],
    }
    plain: dict[str, Any] = printable_json(found)
    return plain


def _results(run: FinishedRun) -> tuple[_Result, ...]:
    return _read(_Metrics, run, "metrics.json").results


def _read(model: type[Model], run: FinishedRun, name: str) -> Model:
    try:
        return model.model_validate(read_json(run.folder.path / name))
    except (ValidationError, RecursionError) as error:
        key = ".".join(map(str, error.errors()[0]["loc"])) if isinstance(error, ValidationError) else "it"
        raise StoreError(
            f"{run.name}: {name}: {printable(key, 120)} is not as a run writes it; run it again"
        ) from error


def _about(run: FinishedRun) -> dict[str, Any]:
    record = _read(_Record, run, "run.json")
    return {
        "name": run.name,
        "is_partial": run.is_partial,
        "is_incomplete": run.is_incomplete,
        "limit": run.limit,
        "scenes": run.scenes,
        "methods": run.methods,
        "profile": run.profile,
        "encoder": record.encoder,
        "encoder_digest": run.encoder_digest,
        "code": run.code,
        "git": None if record.git is None else record.git.model_dump(),
        "seed": record.seed,
        "hardware": run.hardware,
        "packages": record.packages,
        "data_digests": dict(run.data_digests),
        "protocols": [{"name": name, "version": v, "digest": d} for name, (v, d) in run.protocols.items()],
        "settings": [{"key": _dotted(path), "value": value} for path, value in run.settings.items()],
        "failed": [" ".join(f"{value}" for value in one.values()) for one in record.failed],
        "warnings": [one if isinstance(one, str) else str(one) for one in record.warnings],
    }


def _dotted(path: KeyPath) -> str:
    return ".".join(path)


def _confusions(run: FinishedRun, method: str) -> list[dict[str, Any]]:
    """The confusion of every semantic protocol, its scenes added up; none where the rules here are not the run's."""
    found = []
    for name, of_scene in run.scores(method).items():
        counts = [score.counts for score in of_scene.values() if isinstance(score.counts, SemanticCounts)]
        if not counts:
            continue
        rules = load_protocol(name)
        one: dict[str, Any] = {"method": method, "protocol": name}
        if rules.digest != run.protocols[name][1] or any(len(c.is_present) != len(rules.classes) for c in counts):
            found.append(one | {"reason": f"the rules of {name} here are not those that scored the run"})
            continue
        names = [entry.name for entry in rules.classes]
        found.append(one | {"names": names, "cells": confusion_cells(concatenate(counts).confusion)})
    return found


def _errors(run: FinishedRun, method: str, encoder_of: EncoderOf) -> dict[str, Any]:
    try:
        return {**attribute(run.folder.path, encoder_of, method=method).to_json(), "reason": None}
    except Su3dError as error:
        return {"method": method, "protocols": [], "remarks": [], "reason": str(error)}


def _times(run: FinishedRun, method: str) -> dict[str, Any] | None:
    if not run.has_scores(method):
        return None
    times = read_update_times(run, method)
    if not times:
        return None
    return {**summary_data(summarise(times)), "series": {one.scene: series_of(one) for one in times}}


def _comparisons(runs: Sequence[FinishedRun]) -> list[dict[str, Any]]:
    """The first ``MOST_PAIRS`` pairs: methods of one name in two runs, then methods within a run."""
    pairs: list[tuple[FinishedRun, str, FinishedRun, str]] = []
    for one, other in itertools.combinations(runs, 2):
        pairs += [(one, method, other, method) for method in one.methods if method in other.methods]
    for run in runs:
        pairs += [(run, first, run, second) for first, second in itertools.combinations(run.methods, 2)]
    numbers = SideNumbers()
    return [_compared(runs, numbers, *pair) for pair in pairs[:MOST_PAIRS]]


def _compared(
    runs: Sequence[FinishedRun], numbers: SideNumbers, one: FinishedRun, first: str, other: FinishedRun, second: str
) -> dict[str, Any]:
    sides = {"left": [runs.index(one), first], "right": [runs.index(other), second]}
    try:
        left, right = (f"{run.folder.path}:{method}" for run, method in ((one, first), (other, second)))
        found = compare(left, right, numbers=numbers).to_json()
    except Su3dError as error:
        return {**sides, "protocols": [], "remarks": [], "reason": str(error)}
    return {**sides, "protocols": found["protocols"], "remarks": found["remarks"], "reason": None}


def _n_jobs(runs: Sequence[FinishedRun]) -> int:
    return sum(len(run.scenes) * len(run.methods) for run in runs)


def scored_maps(folders: Sequence[Path]) -> list[tuple[int, FinishedRun, str, str]]:
    """Index of the run, run, scene and method of every map there is, all methods of a scene together.

    Of more than ``MOST_JOBS`` jobs only the maps of the first scenes, at most ``MOST_MAPS``.
    """
    runs = [read_run(folder) for folder in dict.fromkeys(folders)]
    found = (
        (index, run, scene, method)
        for index, run in enumerate(runs)
        for scene in run.scenes
        for method in run.methods
        if run.folder.job(scene, method).prediction.is_file()
    )
    return list(itertools.islice(found, MOST_MAPS) if _n_jobs(runs) > MOST_JOBS else found)
