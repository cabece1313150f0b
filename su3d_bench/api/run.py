"""Runs and evaluations from Python: the commands ``run`` and ``evaluate`` as functions."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

import numpy as np
from numpy.typing import NDArray

from su3d_bench.api.tables import Names, Place, Run, Scores
from su3d_bench.core import registry
from su3d_bench.core.arguments import several, typed
from su3d_bench.core.errors import ConfigError, PredictionError, RunIncomplete, counted
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.evaluation.result import Confidences, Request, ValuesForm, default_name
from su3d_bench.runs.existing import Into

if TYPE_CHECKING:
    from su3d_bench.predictions.base import Content
    from su3d_bench.runs.executors import Event, Report

Predictions = Place | Sequence[Place]
Methods = str | type | Sequence[str | type]
# One scene's map: as a method returns it; masks (N, M), or (masks, scores, classes), over the N ground-truth points;
# or the dict of pred_masks, pred_scores and pred_classes of ScanNet's and OpenMask3D's evaluators.
SceneMap = Prediction | NDArray[Any] | tuple[NDArray[Any] | None, ...] | Mapping[str, NDArray[Any]]

Given = Predictions | Mapping[str, Predictions | SceneMap | Mapping[str, SceneMap]]


@typed
def run(
    scenes: Names,
    methods: Methods = "opensu3d",
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
    into: Into = "own",
    report: Report | None = None,
    **more: Any,
) -> Run:
    """Run methods over scenes, score their maps, and return the finished run, as ``su3d-bench run``.

    The keywords are its options, None is the default: ``scenes`` are addresses or patterns (``rooms/*``),
    ``methods`` names or classes, which run in this process with ``jobs=1``, ``settings`` are those of ``--set``
    such as ``{"opensu3d.top_m": 10}``, ``more`` any other key of a ``run.toml``, such as ``executor`` or
    ``anytime``. ``out`` is the folder (default: one in ``runs/`` named after the request): the same call resumes a
    run in it; another request is an error, unless ``into`` is ``extend`` or ``replace``, as ``--extend`` or
    ``--replace``. ``report`` is called with every ``Event``, to show progress.

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

    given = several("methods", methods, str | type)
    targets = [registry.target_of("method", one) if isinstance(one, type) else one for one in given]
    if any(isinstance(one, type) and one.__module__.partition(".")[0] != "su3d_bench" for one in given):
        if jobs not in (None, 1) or more.get("executor", "inline") not in ("auto", "inline") or more.get("memory"):
            raise ConfigError("run: a class runs in this process; use jobs=1, or save it and pass 'file.py:Class'")
        jobs = 1
    values = {
        "scenes": list(several("scenes", scenes)),
        "methods": targets,
        "protocols": None if protocols is None else list(several("protocols", protocols)),
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
    place = None if out is None else Path(out)
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


class _Options(TypedDict, total=False):
    dataset: str | None
    ground_truth: Place | None
    ground_truth_values: ValuesForm | None
    protocols: Names
    scenes: Names
    input_format: str | None
    text_features: Place | None
    confidences: Confidences | None
    queries: Place | None


@overload
def evaluate(predictions: Given, *, out: None = ..., **options: Unpack[_Options]) -> Scores: ...


@overload
def evaluate(predictions: Given, *, out: Place, **options: Unpack[_Options]) -> Run: ...


@typed
def evaluate(
    predictions: Given,
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
    """Score existing predictions with the dataset's headline protocol if that fits, otherwise or with
    ``protocols="all"`` with all that fit, as ``su3d-bench evaluate``.

    ``predictions`` is a folder, a file or several of them; or a run, of which all methods are scored; or for each scene
    its map, ``{"scene0011_00": map}``: as a method returns it, or ``(masks, scores, classes)`` with masks (N, M) over
    the N ground-truth points, M scores and M class ids. For several methods it is a mapping, ``{"mine": folder,
    "theirs": folder}``. The keywords are the options of the command. Returns the numbers; with ``out`` they are written
    there and returned as a ``Run``, which also has ``instances``, ``errors`` and ``compare``.

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
    from su3d_bench.evaluation.run_output import evaluate_methods
    from su3d_bench.predictions.formats import IN_MEMORY
    from su3d_bench.predictions.run_predictions import methods_of

    place = None if out is None else Path(out)
    named: Mapping[Any, Any] = predictions if isinstance(predictions, Mapping) else {default_name(place): predictions}
    if not named:
        raise ConfigError("evaluate: no predictions; pass a folder, files, maps by scene, or a mapping of methods")
    if all(map(_is_map, named.values())):
        named = {default_name(place): named}
    if isinstance(predictions, str | Path) and (methods := methods_of(Path(predictions))):
        named = dict.fromkeys(methods, predictions)
    requests: dict[str, Request] = {}
    for method, given in named.items():
        contents = {str(scene): _content(scene, one) for scene, one in given.items()} if _are_maps(given) else None
        paths = (IN_MEMORY,) if contents else several(f"predictions of {method}", given, str | Path)
        requests[str(method)] = Request(
            tuple(map(Path, paths)),
            contents=contents,
            dataset=dataset,
            ground_truth=_path(ground_truth),
            ground_truth_values=ground_truth_values,
            protocols=several("protocols", protocols),
            scenes=several("scenes", scenes) or tuple(contents or ()),
            format=input_format,
            text_features=_path(text_features),
            confidences=confidences,
            queries=_path(queries),
            method=str(method),
        )
    evaluated = evaluate_methods(requests, place)
    remarks = [
        f"{method}: {line}" if len(requests) > 1 else line
        for method, evaluation in evaluated.evaluations.items()
        for line in warnings_of(evaluation)
    ]
    return Scores(evaluated.metrics, remarks) if place is None else Run(place, remarks)


def _is_map(value: Any) -> bool:
    """Whether a value is the map of one scene, in a form of ``SceneMap``."""
    if isinstance(value, Mapping):
        return "pred_masks" in value
    is_array = isinstance(value, np.ndarray) or (
        isinstance(value, tuple) and any(isinstance(one, np.ndarray) for one in value)
    )
    return is_array or isinstance(value, Instances | Partition | DenseFeatures)


def _are_maps(value: Any) -> bool:
    return isinstance(value, Mapping) and bool(value) and all(map(_is_map, value.values()))


def _content(scene: str, value: Any) -> Content:
    """The checked map of a scene; ``PredictionError`` if it cannot be scored."""
    from su3d_bench.predictions.masks import matrix_masks
    from su3d_bench.runs.plugins import in_stored_form, validation_error

    if isinstance(value, Mapping):
        value = tuple(value.get(key) for key in ("pred_masks", "pred_scores", "pred_classes"))
    if isinstance(value, np.ndarray | tuple):
        arrays = value if isinstance(value, tuple) else (value,)
        if len(arrays) > 3:
            raise PredictionError(f"{scene}: {len(arrays)} arrays; expected (masks, scores, classes)")
        return matrix_masks(scene, arrays[0], *(None if one is None else np.asarray(one) for one in arrays[1:]))
    found: Content = in_stored_form(value)
    if fault := validation_error(found):
        raise PredictionError(f"{scene}: {fault}")
    return found


def _path(place: Place | None) -> Path | None:
    return None if place is None else Path(place)
