"""All that a page of some runs holds: its scenes are made side by side, or taken as they were kept."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from su3d_bench.analysis.attribution import Explained, MendedJob, explained_of
from su3d_bench.analysis.page.errors import errors_of, packed, unpacked
from su3d_bench.analysis.page.gallery import GalleryOfScene, SceneGallery, photos_of_each
from su3d_bench.analysis.page.kept import Piece, piece, state_of_counts, state_of_job, state_of_run
from su3d_bench.analysis.page.maps import MapOfRun, PageMap, PageScene, Spaces, page_scene, points_of_each
from su3d_bench.analysis.page.numbers import are_all_read, is_scored, page_numbers, scored_maps
from su3d_bench.analysis.page.scene_data import SceneData
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
Kept = TypeVar("Kept")
Job = tuple[int, str]  # index of the run, method
_SCENES: TypeAdapter[PageScene] = TypeAdapter(PageScene)
_GALLERIES: TypeAdapter[SceneGallery] = TypeAdapter(SceneGallery)


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
    """What is needed of one scene and was not kept: the ``errors`` of some jobs, the scene with its ``maps``, and the
    gallery of the errors of the jobs in ``shown``."""

    scene: str
    errors: Mapping[Job, Piece]
    maps: tuple[Job, ...]
    page: Piece | None
    shown: tuple[Job, ...]
    gallery: Piece | None

    @property
    def explained(self) -> list[Job]:
        """The jobs whose errors are looked at."""
        return list(dict.fromkeys([*self.errors, *self.shown]))

    @property
    def n_steps(self) -> int:
        return len(self.explained) + len(self.maps) + bool(self.shown)


@dataclass
class Made:
    """What was made of one scene; the errors of a job are a text where they cannot be had."""

    scene: str
    errors: dict[Job, MendedJob | str] = field(default_factory=dict)
    page: PageScene | None = None
    gallery: SceneGallery | None = None


@dataclass(frozen=True)
class Batch:
    """The scenes that one process makes."""

    folders: tuple[Path, ...]
    queries: tuple[str, ...]
    most_points: int
    most_photos: int
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
    made, asked = _kept(runs, maps, told, wishes, most_photos)
    begin(Amount(len(asked), sum(one.n_steps for one in asked), len(made) - len(asked)))
    for fresh in _all_made(Batch(folders, wishes.queries, most_points, most_photos, tuple(asked)), wishes.jobs, report):
        made[fresh.scene].errors.update(fresh.errors)
        made[fresh.scene].page = made[fresh.scene].page or fresh.page
        made[fresh.scene].gallery = made[fresh.scene].gallery or fresh.gallery
    errors = []
    for (index, method), one in explained.items():
        of_scenes = {
            scene: made[scene].errors[index, method]
            for scene in runs[index].scenes
            if scene in made and (index, method) in made[scene].errors
        }
        errors.append({**errors_of(one, method, of_scenes), "run": index})  # which has the name of the run
    pages = {scene: made[scene].page for scene in dict.fromkeys(scene for _, _, scene, _ in maps)}
    galleries = tuple(one.gallery for one in made.values() if one.gallery is not None and one.gallery.of_methods)
    shown = tuple(page for page in pages.values() if page is not None)
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


def _kept(
    runs: Sequence[FinishedRun],
    maps: Sequence[MapOfRun],
    explained: Sequence[Job],
    wishes: Wishes,
    most_photos: int,
) -> tuple[dict[str, Made], list[Asked]]:
    """What was made of the scenes before, and what is yet to be made."""
    most_points = points_of_each(len(maps), wishes.most_bytes)
    shown = {scene: [one for one in maps if one[2] == scene] for scene in dict.fromkeys(one[2] for one in maps)}
    counted_jobs: dict[str, list[Job]] = {}
    for index, method in explained:
        for scene in runs[index].scenes:
            if is_file(runs[index].folder.job(scene, method).counts):
                counted_jobs.setdefault(scene, []).append((index, method))
    made, asked = {}, []
    for scene in dict.fromkeys([*shown, *counted_jobs]):
        made[scene] = Made(scene)
        state = cache(partial(_state, runs, scene))
        places = {
            job: piece(runs[job[0]], ("errors", scene, job[1]), state(job)) for job in counted_jobs.get(scene, ())
        }
        for job, place in places.items():
            mended = None if (content := place.load()) is None else unpacked(content, runs[job[0]].rules)
            if mended is not None:
                made[scene].errors[job] = mended
        of_maps = [(index, method) for index, _, _, method in shown.get(scene, ())]
        place_of_page = None
        if of_maps:
            made_from = [[[*job, state(job)] for job in of_maps], list(wishes.queries), most_points]
            place_of_page = piece(runs[of_maps[0][0]], ("maps", scene), made_from)
            made[scene].page = _read(_SCENES, place_of_page)
        told = tuple(places) if wishes.with_gallery else ()
        place_of_gallery = None
        if told:
            # what an error costs depends on the counts of every scene
            counts = [[*job, state(job), state_of_counts(runs[job[0]], job[1])] for job in told]
            place_of_gallery = piece(runs[told[0][0]], ("gallery", scene), [counts, most_photos])
            made[scene].gallery = _read(_GALLERIES, place_of_gallery)
        to_make = {job: place for job, place in places.items() if job not in made[scene].errors}
        to_draw = () if made[scene].page is not None else tuple(of_maps)
        to_show = () if made[scene].gallery is not None else told
        if to_make or to_draw or to_show:
            asked.append(Asked(scene, to_make, to_draw, place_of_page, to_show, place_of_gallery))
    return made, asked


def _state(runs: Sequence[FinishedRun], scene: str, job: Job) -> list[Any]:
    index, method = job
    return [state_of_run(runs[index], scene), state_of_job(runs[index], scene, method)]


def _read(form: TypeAdapter[Kept], place: Piece) -> Kept | None:
    content = place.load()
    with suppress(ValidationError):
        return None if content is None else form.validate_json(content)
    return None


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
            looked_at = of_job.look_at(asked.scene, partial(data.truth_of_run, run), partial(spaces.encoder, run))
            seen[index, method] = looked_at
            if (index, method) in asked.errors:
                mended = of_job.mended(asked.scene, looked_at)
                made.errors[index, method] = mended
                asked.errors[index, method].save(packed(mended, run.rules))
            if (index, method) in asked.shown:
                gallery.add(index, of_job, looked_at)
        except Su3dError as error:
            made.errors[index, method] = str(error)
            gallery.lack()
    if asked.shown:
        tell("photos of errors")
        made.gallery = gallery.finish(_dataset_of(runs[asked.shown[0][0]], asked.scene), data)
        if asked.gallery is not None and made.gallery.is_whole:
            asked.gallery.save(_GALLERIES.dump_json(made.gallery))
    if asked.maps:
        maps = [(index, runs[index], asked.scene, method) for index, method in asked.maps]
        made.page = page_scene(asked.scene, maps, spaces, data, batch.most_points, tell, seen)
        if asked.page is not None and made.page.is_whole:
            asked.page.save(_SCENES.dump_json(made.page))
    report(Event(asked.scene, SCENE_DONE, asked.n_steps, asked.n_steps))
    return made


def _dataset_of(run: FinishedRun, scene: str) -> Any:
    """The dataset of a run, or why it cannot be had."""
    try:
        return run.dataset(scene)
    except Su3dError as error:
        return str(error)
