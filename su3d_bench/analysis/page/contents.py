"""All contents of the HTML report of runs: their numbers and their scenes, computed in parallel."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.analysis.attribution import Explained, JobCounts, attribution_of, explained_of
from su3d_bench.analysis.comparison import compare_pairs
from su3d_bench.analysis.costs import cost_rows
from su3d_bench.analysis.page.gallery import GalleryOfScene, SceneGallery, photos_of_each
from su3d_bench.analysis.page.maps import MapOfRun, PageMap, PageScene, Spaces, page_scene, points_of_each
from su3d_bench.analysis.page.scene import SceneData
from su3d_bench.analysis.sides import Side, SideNumbers
from su3d_bench.analysis.sweeps import without_cells
from su3d_bench.core.errors import ConfigError, DataError, Su3dError, printable, printable_json
from su3d_bench.core.files.atomic import is_file
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.attribution.arrays import EvaluatedScene
from su3d_bench.metrics.costs import MAP, TOTAL, MethodSummary, UpdateTimes, summarise
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.semantic.confusion import SemanticCounts
from su3d_bench.reports.tables.costs import cost_values
from su3d_bench.reports.tables.run import not_scored_lines
from su3d_bench.runs.executors import SCENE_DONE, Event, Report, run_inline, run_processes
from su3d_bench.runs.finished import FinishedRun, read_run, read_update_times
from su3d_bench.runs.summary import found_in, without_score
from su3d_bench.runs.verify import read_checked
from su3d_bench.store.records import ResultRecord, plain

MAX_BINS = 160  # points of a line: more than a plot can show
DIGITS = 4  # significant digits of a time


def confusion_cells(confusion: Int64Array) -> list[list[int]]:
    """Rows (true class, predicted class, points) of the non-zero cells; a predicted class of -1 means no class.

    >>> confusion_cells(np.array([[3, 0, 1], [0, 2, 0]]))
    [[0, 0, 3], [0, -1, 1], [1, 1, 2]]
    """
    n_classes = len(confusion)
    return [
        [int(true), int(called) if called < n_classes else -1, int(confusion[true, called])]
        for true, called in np.argwhere(confusion)
    ]


def series_of(times: UpdateTimes) -> dict[str, Any]:
    """A scene's update times as means of ``per`` updates each, in ms, and the map's number of points if known."""
    per = max(1, -(-len(times) // MAX_BINS))
    starts = np.arange(0, len(times), per)

    def binned(values: Float64Array) -> list[float]:
        sums = np.add.reduceat(values, starts) if len(values) else values
        return [short(value) for value in sums / np.diff(np.append(starts, len(values)))]

    series: dict[str, Any] = {"per": per, "n": len(times)}
    series |= {stage: binned(times.ms(stage)) for stage in (TOTAL, MAP)}
    if "n_points" in times.columns:
        series["points"] = [int(value) for value in binned(times.columns["n_points"])]
    return series


def short(value: float) -> float:
    """``value`` with ``DIGITS`` significant digits, more than a plot or a table shows.

    >>> short(12.34567)
    12.35
    """
    return float(f"{value:.{DIGITS}g}")


def summary_data(summary: MethodSummary) -> dict[str, Any]:
    """A method's costs; times in ms, None if nothing was measured."""
    shown = {name: value for name, value in vars(summary).items() if name not in ("run", "frames_per_s")}
    numbers = {name: _number(value) if isinstance(value, float) else value for name, value in shown.items()}
    stages = []
    for stage in summary.stages:
        times = {"first": stage.first, "p50": stage.p50, "p95": stage.p95, "max": stage.worst, "share": stage.share}
        growths = {"by_points": stage.against_points, "by_instances": stage.against_instances}
        growths["by_updates"] = stage.against_frames
        reported = {name: growth and {**asdict(growth), "words": growth.words} for name, growth in growths.items()}
        stages.append({"name": stage.name, **{name: _number(value) for name, value in times.items()}, **reported})
    return numbers | {"stages": stages}


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else short(value)


MAX_PAIRS = 40  # pairs of methods that are compared: all pairs of nine methods, in a few seconds
# Maximum number of jobs (scene and method) of which each is read. For more, time series and comparisons take minutes to
# compute, and no one looks at them one by one.
MAX_JOBS = 500
MAX_MAPS = 16  # on a page of more jobs: two scenes under eight methods
LEFT_OUT = (
    "details of single jobs are omitted: errors (su3d-bench report attribution), confusions, times (report timing), "
    f"comparisons (compare) and all maps except those of the first scenes, at most {MAX_MAPS}"
)
# Fields of a result record that the page shows elsewhere, or not at all.
NOT_SHOWN = ("encoder_digest", "anytime", "seen", "areas")
NUMBERS_NOT_SHOWN = ("protocol", "version", "headline", "n_scenes", "scene_mean")


def page_numbers(runs: Sequence[FinishedRun], errors: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """JSON values for the page of ``runs``, every text in them on one line and printable.

    For more than ``MAX_JOBS`` jobs the page only shows the runs' own records, and ``left_out`` names what is omitted.
    """
    reads_all = are_all_read(runs)
    results: list[dict[str, Any]] = []
    confusions: list[dict[str, Any]] = []
    timing: list[dict[str, Any]] = []
    timed: dict[tuple[str, str], list[UpdateTimes]] = {}
    for index, run in enumerate(runs):
        results += [{"run": index, **_shown(result)} for result in run.results.values()]
        if reads_all:
            times = {method: read_update_times(run, method) for method in run.methods if run.has_scores(method)}
            timing += [{"run": index, **_timing(of_method)} for of_method in times.values() if of_method]
            timed |= {(run.name, method): of_method for method, of_method in times.items()}
            confusions += [{"run": index, **one} for method in run.methods for one in _confusions(run, method)]
    reported = {result["protocol"] for result in results if result["result"] is not None or result["failed"]}
    numbers = {
        "left_out": None if reads_all else f"{_n_jobs(runs)} jobs, more than {MAX_JOBS}: {LEFT_OUT}",
        "runs": [_about(run) for run in runs],
        "results": [result for result in results if result["protocol"] in reported],
        "found": [
            {"run": index, **asdict(one)}
            for index, run in enumerate(runs)
            for one in found_in(run.folder, without_score(run) if reads_all else ())
        ],
        "confusions": confusions,
        "errors": errors,
        "timing": timing,
        "costs": cost_values(cost_rows(runs, timed)),
        "comparisons": _comparisons(runs) if reads_all and any(map(is_scored, runs)) else [],
    }
    shown: dict[str, Any] = printable_json(numbers)
    return shown


def are_all_read(runs: Sequence[FinishedRun]) -> bool:
    """Whether the files of each job are read; False if there are too many."""
    return _n_jobs(runs) <= MAX_JOBS


def is_scored(run: FinishedRun) -> bool:
    return any(result.result is not None for result in run.results.values())


def _shown(result: ResultRecord) -> dict[str, Any]:
    shown: dict[str, Any] = {key: value for key, value in plain(result).items() if key not in NOT_SHOWN}
    if result.result is not None:
        shown["result"] = {key: value for key, value in shown["result"].items() if key not in NUMBERS_NOT_SHOWN}
    return shown | {curve: list(map(plain, getattr(result, curve) or ())) for curve in ("anytime", "seen")}


def _about(run: FinishedRun) -> dict[str, Any]:
    record = run.record
    of_record = plain(record)
    shared = ("profile", "encoder", "encoder_digest", "code", "git", "seed", "packages", "data_digests")
    return {
        "name": run.name,
        "is_partial": record.is_partial,
        "is_incomplete": run.is_incomplete,
        "limit": run.limit,
        "scenes": run.scenes,
        "methods": run.methods,
        **{key: of_record[key] for key in shared},
        "hardware": run.hardware,
        "protocols": [{key: rules[key] for key in ("name", "version", "digest")} for rules in of_record["protocols"]],
        "settings": [{"key": ".".join(path), "value": value} for path, value in run.settings.items()],
        "failed": [f"{failure.scene} {failure.method} {failure.error}" for failure in record.failed],
        "warnings": list(record.warnings),
        "unscored": not_scored_lines(record.unscored),
    }


def _confusions(run: FinishedRun, method: str) -> list[dict[str, Any]]:
    """The confusion of every semantic protocol, summed over scenes; a reason if the installed rules differ."""
    confusions = []
    for name, of_scene in run.scores(method).items():
        rules: ProtocolRules | None = None
        counts = [score.counts for score in of_scene.values() if isinstance(score.counts, SemanticCounts)]
        if not counts:
            continue
        confusion: dict[str, Any] = {"method": method, "protocol": name}
        with suppress(ConfigError):
            rules = run.rules(name, to_the_letter=True)
        if rules is None or any(len(c.is_present) != len(rules.classes) for c in counts):
            confusions.append(confusion | {"reason": f"installed rules of {name} are not those that scored the run"})
            continue
        names = [entry.name for entry in rules.classes]
        confusions.append(
            confusion | {"names": names, "cells": confusion_cells(SemanticCounts.joined(counts).confusion)}
        )
    return confusions


def _timing(times: Sequence[UpdateTimes]) -> dict[str, Any]:
    return {**summary_data(summarise(times)), "series": {of_scene.scene: series_of(of_scene) for of_scene in times}}


def _comparisons(runs: Sequence[FinishedRun]) -> list[dict[str, Any]]:
    """The first ``MAX_PAIRS`` pairs: methods of the same name in two runs, then methods within a run."""
    pairs: list[tuple[Side, Side]] = []
    for first, second in itertools.combinations(runs, 2):
        pairs += [(Side(first, method), Side(second, method)) for method in first.methods if method in second.methods]
    for run in runs:
        pairs += itertools.combinations((Side(run, method) for method in run.methods), 2)
    numbers, compared = SideNumbers(), []
    for pair in pairs[:MAX_PAIRS]:
        left, right = ([runs.index(side.run), side.method] for side in pair)
        found: dict[str, Any] = {"left": left, "right": right, "protocols": [], "remarks": [], "reason": None}
        try:
            comparison = compare_pairs([pair], numbers=numbers).to_json()
            found |= {name: comparison[name] for name in ("protocols", "remarks")}
        except Su3dError as error:
            found["reason"] = str(error)
        compared.append(found)
    return compared


def _n_jobs(runs: Sequence[FinishedRun]) -> int:
    return sum(len(run.scenes) * len(run.methods) for run in runs)


def scored_maps(runs: Sequence[FinishedRun]) -> list[tuple[int, FinishedRun, str, str]]:
    """Index of the run, run, scene and method of every existing map, all methods of a scene together.

    For more than ``MAX_JOBS`` jobs only the maps of the first scenes, at most ``MAX_MAPS``.
    """
    maps = (
        (index, run, scene, method)
        for index, run in enumerate(runs)
        for scene in run.scenes
        for method in run.methods
        if run.folder.job(scene, method).prediction.is_file()
    )
    return list(maps if are_all_read(runs) else itertools.islice(maps, MAX_MAPS))


QUERIES = (
    "somewhere to sit",
    "somewhere to sleep",
    "a lamp that gives light",
    "a plant",
    "something to read",
    "an electronic device",
    "a place to store things",
    "something to eat or drink from",
)


@dataclass(frozen=True)
class PageOptions:
    """Options of a page: ``queries``: texts that instances are compared with; ``max_bytes``: its approximate size.

    The gallery of individual errors requires error attribution.
    ``jobs``: number of scenes computed in parallel; 0: one per core.
    """

    queries: tuple[str, ...] = QUERIES
    max_bytes: int = 30_000_000
    with_maps: bool = True
    with_errors: bool = True
    with_gallery: bool = True
    jobs: int = 0


@dataclass(frozen=True)
class Contents:
    """JSON-like ``numbers``, the ``scenes`` with maps of at most ``max_points`` points, and their ``galleries``."""

    numbers: Mapping[str, Any]
    scenes: tuple[PageScene, ...]
    galleries: tuple[SceneGallery, ...]
    max_points: int

    @property
    def maps(self) -> list[PageMap]:
        return [page_map for scene in self.scenes for page_map in scene.maps]


Job = tuple[int, str]  # index of the run, method


@dataclass
class SceneContent:
    """The results of one scene; the errors of a job are a text if they could not be computed."""

    scene: str
    errors: dict[Job, JobCounts | str] = field(default_factory=dict)
    page: PageScene | None = None
    gallery: SceneGallery | None = None


@dataclass(frozen=True)
class SceneRequest:
    """What is needed for one scene: maps of some jobs, and errors of some jobs."""

    scene: str
    maps: tuple[Job, ...]
    explained: tuple[Job, ...]

    @property
    def n_steps(self) -> int:
        return len(self.explained) + len(self.maps) + bool(self.explained)


@dataclass(frozen=True)
class Batch:
    """The scenes that one process computes."""

    folders: tuple[Path, ...]
    options: PageOptions
    max_points: int
    max_photos: int
    scenes: tuple[SceneRequest, ...]


def page_contents(
    folders: Sequence[Path],
    options: PageOptions,
    *,
    begin: Callable[[int], None] = lambda n_steps: None,
    report: Report = lambda event: None,
) -> Contents:
    """The contents of the page of the runs in ``folders``.

    ``begin`` is called once with the number of steps, ``report`` for each step. Raises ``StoreError`` if a folder has
    no finished run; parts that cannot be computed have a reason on the page. Of a sweep over corruptions only the clean
    methods are listed.
    """
    folders = tuple(dict.fromkeys(folders))
    runs = [without_cells(read_checked(folder)) for folder in folders]
    maps = scored_maps(runs) if options.with_maps else []
    max_points = points_of_each(len(maps), options.max_bytes)
    explained = _explained(runs) if options.with_errors and are_all_read(runs) else {}
    reported = [job for job, one in explained.items() if isinstance(one, Explained)]
    max_photos = photos_of_each(len({scene for index, _ in reported for scene in runs[index].scenes}), len(reported))
    wanted = _wanted(runs, maps, reported)
    begin(sum(one.n_steps for one in wanted))
    found = {
        one.scene: one for one in _all_made(Batch(folders, options, max_points, max_photos, tuple(wanted)), report)
    }
    made = {one.scene: found[one.scene] for one in wanted}
    errors = []
    for (index, method), one in explained.items():
        job = index, method
        of_scenes = {scene: made[scene].errors[job] for scene in made if job in made[scene].errors}
        errors.append({**_errors_of(one, method, of_scenes), "run": index})  # replaces the name of the run
    shown = tuple(one.page for one in made.values() if one.page is not None)
    galleries = tuple(one.gallery for one in made.values() if one.gallery is not None and one.gallery.of_methods)
    return Contents(page_numbers(runs, errors), shown, galleries, max_points)


def _explained(runs: Sequence[FinishedRun]) -> dict[Job, Explained | str]:
    """The attribution of each method, or the reason why there is none."""
    explained: dict[Job, Explained | str] = {}
    for index, run in enumerate(runs):
        for method in run.methods if is_scored(run) else ():
            try:
                explained[index, method] = explained_of(run, method)
            except Su3dError as error:
                explained[index, method] = str(error)
    return explained


def _wanted(runs: Sequence[FinishedRun], maps: Sequence[MapOfRun], explained: Sequence[Job]) -> list[SceneRequest]:
    """What is needed for each scene; scenes with maps first."""
    shown: dict[str, list[Job]] = {}
    for index, _, scene, method in maps:
        shown.setdefault(scene, []).append((index, method))
    counted_jobs: dict[str, list[Job]] = {}
    for index, method in explained:
        for scene in runs[index].scenes:
            if is_file(runs[index].folder.job(scene, method).counts):
                counted_jobs.setdefault(scene, []).append((index, method))
    scenes = dict.fromkeys([*shown, *counted_jobs])
    return [SceneRequest(scene, tuple(shown.get(scene, ())), tuple(counted_jobs.get(scene, ()))) for scene in scenes]


def _errors_of(explained: Explained | str, method: str, of_scenes: Mapping[str, JobCounts | str]) -> dict[str, Any]:
    """The errors of a method in the page's form; a text in place of errors becomes their ``reason``."""
    reasons = [explained] if isinstance(explained, str) else [one for one in of_scenes.values() if isinstance(one, str)]
    try:
        if not isinstance(explained, str) and not reasons:
            corrected = {scene: one for scene, one in of_scenes.items() if not isinstance(one, str)}
            return {**attribution_of(explained, corrected).to_json(), "reason": None}
    except Su3dError as error:
        reasons = [str(error)]
    return {"method": method, "protocols": [], "remarks": [], "reason": reasons[0]}


def _all_made(batch: Batch, report: Report) -> list[SceneContent]:
    """The scenes of ``batch``, distributed over processes if there are several."""
    n_workers = min(batch.options.jobs or os.cpu_count() or 1, len(batch.scenes))
    dealt = [replace(batch, scenes=batch.scenes[k::n_workers]) for k in range(n_workers)]
    if n_workers > 1:
        outcomes = run_processes(_make, dealt, report, jobs=n_workers, lost=_lost)
    else:
        outcomes = run_inline(_make, dealt, report)
    return [made for of_batch in outcomes for made in of_batch]


def _lost(batch: Batch, cause: str) -> list[SceneContent]:
    scenes = printable(", ".join(asked.scene for asked in batch.scenes), 200)
    raise DataError(f"{scenes}: {cause}")


def _make(batch: Batch, report: Report) -> list[SceneContent]:
    """The scenes of ``batch``."""
    runs = [read_run(folder) for folder in batch.folders]
    spaces = Spaces(batch.options.queries)
    explained = cache(lambda index, method: explained_of(runs[index], method))
    return [_make_scene(asked, runs, spaces, explained, batch, report) for asked in batch.scenes]


def _make_scene(
    asked: SceneRequest,
    runs: Sequence[FinishedRun],
    spaces: Spaces,
    explained: Callable[[int, str], Explained],
    batch: Batch,
    report: Report,
) -> SceneContent:
    made, data, n_done = SceneContent(asked.scene), SceneData(asked.scene), 0

    def report_activity(doing: str) -> None:
        nonlocal n_done
        report(Event(asked.scene, doing, n_done, asked.n_steps))
        n_done += 1

    gallery = GalleryOfScene(asked.scene, batch.max_photos)
    seen: dict[Job, Mapping[str, EvaluatedScene]] = {}
    for index, method in asked.explained:
        report_activity(f"errors of {printable(method, 60)}")
        run, of_job = runs[index], explained(index, method)
        try:
            found = of_job.matched(asked.scene, partial(data.truth_of_run, run), partial(spaces.encoder, run))
            evaluated = {one.rules.name: one.evaluated for one in found}
            seen[index, method] = evaluated
            made.errors[index, method] = of_job.corrected(asked.scene, evaluated)
            if batch.options.with_gallery:
                gallery.add(index, of_job, evaluated)
        except Su3dError as error:
            made.errors[index, method] = str(error)
    if asked.explained and batch.options.with_gallery:
        report_activity("photos of errors")
        try:
            dataset = runs[asked.explained[0][0]].dataset(asked.scene)
        except Su3dError as error:
            dataset = str(error)
        made.gallery = gallery.finish(dataset, data)
    if asked.maps:
        maps = [(index, runs[index], asked.scene, method) for index, method in asked.maps]
        made.page = page_scene(asked.scene, maps, spaces, data, batch.max_points, report_activity, seen)
    report(Event(asked.scene, SCENE_DONE, asked.n_steps, asked.n_steps))
    return made
