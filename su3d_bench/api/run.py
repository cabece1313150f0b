"""Runs and evaluations from Python: the commands ``run`` and ``evaluate`` as functions."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from su3d_bench.api.tables import Names, Place, Run, Scores, several
from su3d_bench.core.errors import ConfigError, RunIncomplete, counted, suggest

if TYPE_CHECKING:
    from su3d_bench.evaluation.result import Confidences, Request, ValuesForm
    from su3d_bench.runs.executors import Event, Report
    from su3d_bench.runs.existing import Into

Predictions = Place | Sequence[Place]


def run(
    scenes: Names,
    methods: Names = "opensu3d",
    *,
    protocols: Names | None = None,
    profile: str | None = None,
    device: str | None = None,
    stride: int | None = None,
    seed: int | None = None,
    limit: int | None = None,
    jobs: int | None = None,
    pictures: bool | None = None,
    settings: Mapping[str, Any] | None = None,
    config: Place | None = None,
    out: Place | None = None,
    into: Literal["own", "extend", "replace"] = "own",
    report: Report | None = None,
    **more: Any,
) -> Run:
    """Run methods over scenes, score their maps, and return the finished run, as ``su3d-bench run``.

    The keywords are its options, None is the default: ``scenes`` are addresses or patterns (``rooms/*``), ``settings``
    are those of ``--set`` such as ``{"opensu3d.top_m": 10}``, ``more`` any other key of a ``run.toml``, such as
    ``executor`` or ``anytime``. ``out`` is the folder (default: one in ``runs/`` named after the request): the same
    call resumes a run in it; another request is an error, unless ``into`` is ``extend`` or ``replace``, as ``--extend``
    or ``--replace``. ``report`` is called with every ``Event``, to show progress.

    Raises ``ConfigError`` for an invalid request, before any work; ``DataError`` or ``ModelMissing`` for missing data
    or models; ``StoreError`` for a folder with another run; ``RunIncomplete`` if scenes failed: the folder then
    contains all others.

    >>> import su3d_bench as su3d
    >>> small = {"rooms.n_frames": 8, "rooms.width": 160, "rooms.height": 120}
    >>> more = {"settings": small, "pictures": False, "jobs": 1, "out": "runs/first"}
    >>> run = su3d.run("rooms/bathroom7", "oracle", protocols="rooms-instance", **more)
    >>> run.metrics.query("metric == 'AP'")["value"].tolist()
    [1.0]
    >>> su3d.run("rooms/bathroom7", "oracel")
    Traceback (most recent call last):
    su3d_bench.core.errors.ConfigError: unknown method 'oracel'; did you mean 'oracle'? known: opensu3d, ...
    """
    from su3d_bench.core.config import toml_value
    from su3d_bench.runs.plan import asked_settings, make_plan
    from su3d_bench.runs.runner import run_plan

    chosen: tuple[Into, ...] = ("own", "extend", "replace")
    if into not in chosen:
        raise ConfigError(f"run(into={into!r}): expected one of {', '.join(chosen)}")
    values = {
        "scenes": list(several(scenes)),
        "methods": list(several(methods)),
        "protocols": None if protocols is None else list(several(protocols)),
        "profile": profile,
        "stride": stride,
        "seed": seed,
        "limit": limit,
        "jobs": jobs,
        "pictures": pictures,
    }
    asked = asked_settings(
        values | more,
        device=device,
        config=None if config is None else Path(config),
        source_of=lambda key: f"run({key}=...)",
    )
    try:
        assigned = [f"{key}={toml_value(value)}" for key, value in (settings or {}).items()]
    except TypeError as error:
        raise ConfigError(f"run(settings=...): {error}; expected text, numbers, bools, or lists of these") from error
    place = out if out is None or "://" in str(out) else Path(out)
    plan = make_plan(asked, assigned, place, into=into)
    with _script_kept_out_of_workers():
        result = run_plan(plan, report or _ignore_progress)
    folder = plan.folder.path
    if not result.is_complete:
        n_failed = len({scene for scene, _, _ in result.failures})
        raise RunIncomplete(
            f"{folder}: {n_failed} of {counted(len(plan.jobs), 'scene')} failed, the first with: "
            f"{result.failures[0][2]}; load_run has the others"
        )
    return Run(folder, (*plan.notes, *result.remarks))


def _ignore_progress(event: Event) -> None:
    """Ignore progress events."""


@contextmanager
def _script_kept_out_of_workers() -> Iterator[None]:
    """Keep workers started in the block from importing the calling script, which would run all its work again."""
    main = sys.modules["__main__"]
    file = getattr(main, "__file__", None)
    if file is None or getattr(main, "__spec__", None) is not None:
        yield
        return
    del main.__file__
    try:
        yield
    finally:
        main.__file__ = file


@overload
def evaluate(
    predictions: Predictions | Mapping[str, Predictions],
    *,
    dataset: str | None = ...,
    ground_truth: Place | None = ...,
    ground_truth_values: ValuesForm | None = ...,
    protocols: Names = ...,
    scenes: Names = ...,
    format: str | None = ...,
    text_features: Place | None = ...,
    confidences: Confidences | None = ...,
    queries: Place | None = ...,
    out: None = ...,
) -> Scores: ...


@overload
def evaluate(
    predictions: Predictions | Mapping[str, Predictions],
    *,
    dataset: str | None = ...,
    ground_truth: Place | None = ...,
    ground_truth_values: ValuesForm | None = ...,
    protocols: Names = ...,
    scenes: Names = ...,
    format: str | None = ...,
    text_features: Place | None = ...,
    confidences: Confidences | None = ...,
    queries: Place | None = ...,
    out: Place,
) -> Run: ...


def evaluate(
    predictions: Predictions | Mapping[str, Predictions],
    *,
    dataset: str | None = None,
    ground_truth: Place | None = None,
    ground_truth_values: ValuesForm | None = None,
    protocols: Names = (),
    scenes: Names = (),
    input_format: str | None = None,
    text_features: Place | None = None,
    confidences: Confidences | None = None,
    queries: Place | None = None,
    out: Place | None = None,
) -> Scores | Run:
    """Score existing predictions with every protocol that fits, as ``su3d-bench evaluate``.

    ``predictions`` is a folder, a file or several of them, or for several methods a mapping
    ``{"mine": folder, "theirs": folder}``. The keywords are the options of the command. Returns the numbers; with
    ``out`` they are written there and returned as a ``Run``, which also has ``instances``, ``errors`` and ``compare``.

    Raises ``PredictionError`` for predictions that cannot be scored, ``DataError`` for missing ground truth,
    ``ConfigError`` for an invalid request, ``StoreError`` if ``out`` contains another run.

    >>> import su3d_bench as su3d
    >>> run = su3d.evaluate("predictions", ground_truth="truth", protocols="scannet-instance", out="runs/mine")
    >>> run.metrics.query("is_headline")[["metric", "value"]].values.tolist()
    [['AP', 0.5], ['AP50', 0.5], ['AP25', 0.5]]
    >>> su3d.evaluate("predictions", ground_truth="truth", protocols="scanet-instance")
    Traceback (most recent call last):
    su3d_bench.core.errors.ConfigError: unknown protocol 'scanet-instance'; did you mean 'scannet-instance'? ...
    """
    from su3d_bench.evaluation.evaluate import warnings_of
    from su3d_bench.evaluation.result import Request, default_name
    from su3d_bench.evaluation.run_output import evaluate_methods

    _check_known("ground_truth_values", ground_truth_values, ("classes", "instances", "numbers"))
    _check_known("confidences", confidences, ("protocol", "file"))
    place = None if out is None else Path(out)
    named = predictions if isinstance(predictions, Mapping) else {default_name(place): predictions}
    if not named:
        raise ConfigError("evaluate: no predictions; pass a folder, files, or a mapping of methods")
    requests: dict[str, Request] = {
        str(method): Request(
            tuple(map(Path, [paths] if isinstance(paths, str | Path) else paths)),
            dataset=dataset,
            ground_truth=_path(ground_truth),
            ground_truth_values=ground_truth_values,
            protocols=several(protocols),
            scenes=several(scenes),
            format=input_format,
            text_features=_path(text_features),
            confidences=confidences,
            queries=_path(queries),
        )
        for method, paths in named.items()
    }
    evaluated = evaluate_methods(requests, place)
    remarks = [
        f"{method}: {line}" if len(requests) > 1 else line
        for method, evaluation in evaluated.evaluations.items()
        for line in warnings_of(evaluation)
    ]
    return Scores(evaluated.metrics, remarks) if place is None else Run(place, remarks)


def _path(place: Place | None) -> Path | None:
    return None if place is None else Path(place)


def _check_known(name: str, value: str | None, known: Sequence[str]) -> None:
    if value is not None and value not in known:
        raise ConfigError(f"evaluate({name}={value!r}): unknown value{suggest(value, known)}")
