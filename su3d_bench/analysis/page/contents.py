"""All that a page of some runs holds: its scenes are made side by side, or taken as they were kept."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from su3d_bench.analysis.attribution import Explained, explained_of
from su3d_bench.analysis.page.gallery import GalleryOfScene, SceneGallery, photos_of_each
from su3d_bench.analysis.page.kept import (
    Job,
    Made,
    Piece,
    errors_of,
    load_scene,
    piece,
    save_scene,
    state_of_counts,
    state_of_scene,
)
from su3d_bench.analysis.page.maps import MapOfRun, PageMap, PageScene, Spaces, page_scene, points_of_each
from su3d_bench.analysis.page.numbers import are_all_read, is_scored, page_numbers, scored_maps
from su3d_bench.analysis.page.scene import SceneData
from su3d_bench.core.errors import DataError, Su3dError, printable
from su3d_bench.core.files.atomic import is_file
from su3d_bench.metrics.attribution.arrays import LookedAt
from su3d_bench.runs.executors import SCENE_DONE, Event, Report, run_inline, run_processes
from su3d_bench.runs.finished import FinishedRun, read_run

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
class Wishes:
    """What a page shall hold: ``queries`` are texts that instances are compared with; ``most_bytes`` is about its size.

    There is a gallery of single errors only where errors are explained at all.
    ``jobs`` scenes are made side by side, 0: as many as there are cores.
    """

    queries: tuple[str, ...] = QUERIES
    most_bytes: int = 30_000_000
    with_maps: bool = True
    with_errors: bool = True
    with_gallery: bool = True
    jobs: int = 0


@dataclass(frozen=True)
class Amount:
    """What of a page must be made: ``n_steps`` of ``n_scenes``, while ``n_kept`` scenes were made before."""

    n_scenes: int
    n_steps: int
    n_kept: int


@dataclass(frozen=True)
class Contents:
    """Plain ``numbers``, the ``scenes`` with their maps, none of more than ``most_points``, and their ``galleries``."""

    numbers: Mapping[str, Any]
    scenes: tuple[PageScene, ...]
    galleries: tuple[SceneGallery, ...]
    most_points: int

    @property
    def maps(self) -> list[PageMap]:
        return [page_map for scene in self.scenes for page_map in scene.maps]


@dataclass(frozen=True)
class Asked:
    """What is needed of one scene: the maps of some jobs, the errors of some, and where all of it is kept."""

    scene: str
    maps: tuple[Job, ...]
    explained: tuple[Job, ...]
    place: Piece

    @property
    def n_steps(self) -> int:
        return len(self.explained) + len(self.maps) + bool(self.explained)


@dataclass(frozen=True)
class Batch:
    """The scenes that one process makes."""

    folders: tuple[Path, ...]
    queries: tuple[str, ...]
    most_points: int
    most_photos: int
    with_gallery: bool
    scenes: tuple[Asked, ...]


def page_contents(
    folders: Sequence[Path],
    wishes: Wishes,
    *,
    begin: Callable[[Amount], None] = lambda amount: None,
    report: Report = lambda event: None,
) -> Contents:
    """The contents of the page of the runs in ``folders``.

    ``begin`` is told once what there is to make, ``report`` of every step. Raises a ``StoreError`` where a folder holds
    no finished run; what cannot be had of one is a reason on the page.
    """
    folders = tuple(dict.fromkeys(folders))
    runs = [read_run(folder) for folder in folders]
    maps = scored_maps(runs) if wishes.with_maps else []
    most_points = points_of_each(len(maps), wishes.most_bytes)
    explained = _explained(runs) if wishes.with_errors and are_all_read(runs) else {}
    told = [job for job, one in explained.items() if isinstance(one, Explained)]
    most_photos = photos_of_each(len({scene for index, _ in told for scene in runs[index].scenes}), len(told))
    wanted = _wanted(runs, maps, told, [wishes.queries, most_points, most_photos, wishes.with_gallery])
    made = {one.scene: kept for one in wanted if (kept := load_scene(one.place, one.scene, runs)) is not None}
    asked = [one for one in wanted if one.scene not in made]
    begin(Amount(len(asked), sum(one.n_steps for one in asked), len(made)))
    batch = Batch(folders, wishes.queries, most_points, most_photos, wishes.with_gallery, tuple(asked))
    made |= {one.scene: one for one in _all_made(batch, wishes.jobs, report)}
    made = {one.scene: made[one.scene] for one in wanted}
    errors = []
    for (index, method), one in explained.items():
        job = index, method
        of_scenes = {scene: made[scene].errors[job] for scene in made if job in made[scene].errors}
        errors.append({**errors_of(one, method, of_scenes), "run": index})  # which has the name of the run
    shown = tuple(one.page for one in made.values() if one.page is not None)
    galleries = tuple(one.gallery for one in made.values() if one.gallery is not None and one.gallery.of_methods)
    return Contents(page_numbers(runs, errors), shown, galleries, most_points)


def _explained(runs: Sequence[FinishedRun]) -> dict[Job, Explained | str]:
    """What can be explained of each method, or the reason why nothing can."""
    explained: dict[Job, Explained | str] = {}
    for index, run in enumerate(runs):
        for method in run.methods if is_scored(run) else ():
            try:
                explained[index, method] = explained_of(run, method)
            except Su3dError as error:
                explained[index, method] = str(error)
    return explained


def _wanted(
    runs: Sequence[FinishedRun], maps: Sequence[MapOfRun], explained: Sequence[Job], wishes: Sequence[Any]
) -> list[Asked]:
    """What is needed of each scene; those with maps first."""
    shown: dict[str, list[Job]] = {}
    for index, _, scene, method in maps:
        shown.setdefault(scene, []).append((index, method))
    counted_jobs: dict[str, list[Job]] = {}
    for index, method in explained:
        for scene in runs[index].scenes:
            if is_file(runs[index].folder.job(scene, method).counts):
                counted_jobs.setdefault(scene, []).append((index, method))
    asked = []
    for scene in dict.fromkeys([*shown, *counted_jobs]):
        of_maps, of_errors = shown.get(scene, []), counted_jobs.get(scene, [])
        jobs = dict.fromkeys([*of_maps, *of_errors])
        # what an error costs depends on the counts of every scene
        counts = [state_of_counts(runs[index], method) for index, method in of_errors]
        states = [[index, *state_of_scene(runs[index], scene, method)] for index, method in jobs]
        place = piece(runs[next(iter(jobs))[0]], scene, [of_maps, of_errors, states, counts, *wishes])
        asked.append(Asked(scene, tuple(of_maps), tuple(of_errors), place))
    return asked


def _all_made(batch: Batch, jobs: int, report: Report) -> list[Made]:
    """The scenes of ``batch``, dealt out to processes where there is more than one."""
    n_workers = min(jobs or os.cpu_count() or 1, len(batch.scenes))
    dealt = [replace(batch, scenes=batch.scenes[k::n_workers]) for k in range(n_workers)]
    if n_workers > 1:
        outcomes = run_processes(_make, dealt, report, jobs=n_workers, lost=_lost)
    else:
        outcomes = run_inline(_make, dealt, report)
    return [made for of_batch in outcomes for made in of_batch]


def _lost(batch: Batch, cause: str) -> list[Made]:
    scenes = printable(", ".join(asked.scene for asked in batch.scenes), 200)
    raise DataError(f"{scenes}: {cause}; scenes that were made are kept")


def _make(batch: Batch, report: Report) -> list[Made]:
    """The scenes of ``batch``, each kept as soon as it is made."""
    runs = [read_run(folder) for folder in batch.folders]
    spaces = Spaces(batch.queries)
    explained = cache(lambda index, method: explained_of(runs[index], method))
    return [_make_scene(asked, runs, spaces, explained, batch, report) for asked in batch.scenes]


def _make_scene(
    asked: Asked,
    runs: Sequence[FinishedRun],
    spaces: Spaces,
    explained: Callable[[int, str], Explained],
    batch: Batch,
    report: Report,
) -> Made:
    made, data, n_done = Made(asked.scene), SceneData(asked.scene), 0

    def tell(doing: str) -> None:
        nonlocal n_done
        report(Event(asked.scene, doing, n_done, asked.n_steps))
        n_done += 1

    gallery = GalleryOfScene(asked.scene, batch.most_photos)
    seen: dict[Job, Mapping[str, LookedAt]] = {}
    for index, method in asked.explained:
        tell(f"errors of {printable(method, 60)}")
        run, of_job = runs[index], explained(index, method)
        try:
            found = of_job.matched(asked.scene, partial(data.truth_of_run, run), partial(spaces.encoder, run))
            looked_at = {one.rules.name: one.looked_at for one in found}
            seen[index, method] = looked_at
            made.errors[index, method] = of_job.mended(asked.scene, looked_at)
            if batch.with_gallery:
                gallery.add(index, of_job, looked_at)
        except Su3dError as error:
            made.errors[index, method] = str(error)
            gallery.lack()
    if asked.explained and batch.with_gallery:
        tell("photos of errors")
        made.gallery = gallery.finish(_dataset_of(runs[asked.explained[0][0]], asked.scene), data)
    if asked.maps:
        maps = [(index, runs[index], asked.scene, method) for index, method in asked.maps]
        made.page = page_scene(asked.scene, maps, spaces, data, batch.most_points, tell, seen)
    if made.is_whole:
        save_scene(asked.place, made, runs)
    report(Event(asked.scene, SCENE_DONE, asked.n_steps, asked.n_steps))
    return made


def _dataset_of(run: FinishedRun, scene: str) -> Any:
    """The dataset of a run, or why it cannot be had."""
    try:
        return run.dataset(scene)
    except Su3dError as error:
        return str(error)
