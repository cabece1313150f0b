"""One scene of a run whose worker, data or run folder is on another machine: fetch, run as usual, send back.

A store has no rename and no lock. So ``done.json``, which lists the SHA-256 of a job's other files, is sent after
them: a job that was sent only in part has no completion record, or one that its files do not match, and is run again.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import TemporaryFolder, make_folder
from su3d_bench.core.files.locks import is_unfinished
from su3d_bench.runs.executors import ELSEWHERE, Report
from su3d_bench.runs.job import MethodOutcome, SceneJob
from su3d_bench.runs.plan import Plan
from su3d_bench.runs.remote_store import SEAL, RemoteFolder
from su3d_bench.runs.scene import failed_outcomes, run_scene
from su3d_bench.runs.scenes import cache_root as own_cache_root
from su3d_bench.store.run_folder import RunFolder

REPLIES = "language"  # replies of language models, shared by the scenes of a run


@dataclass(frozen=True)
class DistantJob:
    """A job for a worker that shares a disk or nothing with this process; it runs in the folder ``here`` if it exists.

    ``store`` and ``data`` are URLs, None if the job's own folders are on a shared disk; ``files`` are those of the
    scene in ``data`` with their sizes; ``cache_root`` None: the worker's own.
    """

    job: SceneJob
    here: Path
    store: str | None = None
    data: str | None = None
    files: Mapping[str, int] = field(default_factory=dict)
    cache_root: Path | None = None


def run_distant_scene(distant: DistantJob, report: Report) -> tuple[MethodOutcome, ...]:
    """The outcomes of ``run_scene``, with its files sent to the store."""
    if distant.here.is_dir():
        os.chdir(distant.here)  # relative paths in the configuration start there
    cache_root = distant.cache_root or own_cache_root()
    with TemporaryFolder("su3d-scene-") as scratch:
        job = replace(distant.job, cache_root=cache_root)
        if distant.data is not None:
            job = replace(job, data_root=scratch / "data")
            make_folder(job.data_root)
            RemoteFolder(distant.data).fetch(distant.files, job.data_root)
        if distant.store is None:
            return run_scene(job, report)
        job = replace(job, folder=scratch / "run")
        with _stored(RemoteFolder(distant.store), job):
            return run_scene(job, report)


@contextmanager
def _stored(store: RemoteFolder, job: SceneJob) -> Iterator[None]:
    """Fetch the files of a job from the store at the start of the block and send them back at its end."""
    make_folder(job.folder)
    store.fetch(store.files(_scene_folder(job)) | store.files(REPLIES), job.folder)
    before = _stamps(job.folder)
    try:
        yield
    except StoreError as error:
        raise StoreError(str(error).replace(str(job.folder), store.url)) from error
    after = _stamps(job.folder)
    store.remove(name for name in before if name not in after)
    changed = [name for name, stamp in after.items() if before.get(name) != stamp]
    store.send(job.folder, sorted(changed, key=lambda name: (name.endswith(f"/{SEAL}"), name)))


def _stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Inode and modification time of every file, which change when a file is rewritten."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and not is_unfinished(path.name)]
    stats = {path.relative_to(folder).as_posix(): path.stat() for path in paths}
    return {name: (about.st_ino, about.st_mtime_ns) for name, about in stats.items()}


def _scene_folder(job: SceneJob) -> str:
    return RunFolder(job.folder).job(job.scene, "any").path.parent.relative_to(job.folder).as_posix()


def failed_distant(distant: DistantJob, reason: str) -> tuple[MethodOutcome, ...]:
    """The outcome of a scene whose worker was lost; its logs report it, in the store too."""
    outcomes = failed_outcomes(distant.job, reason)
    if distant.store is not None:
        logs = [RunFolder(distant.job.folder).job(outcome.scene, outcome.method).log for outcome in outcomes]
        names = [log.relative_to(distant.job.folder).as_posix() for log in logs if log.is_file()]
        RemoteFolder(distant.store).send(distant.job.folder, names)
    return outcomes


def distant_jobs(plan: Plan) -> list[DistantJob]:
    """The jobs of a plan whose workers, data or run folder are on another machine."""
    has_own_cache = plan.config.executor in ELSEWHERE and "SU3D_CACHE" not in os.environ
    url, files = (None, {}) if plan.data is None else (plan.data.url, plan.data.files)
    return [
        DistantJob(
            job=replace(job, folder=job.folder.absolute()),
            here=Path.cwd(),
            store=plan.place.url,
            data=url,
            files=files.get(job.scene, {}),
            cache_root=None if has_own_cache else own_cache_root(),
        )
        for job in plan.jobs
    ]
