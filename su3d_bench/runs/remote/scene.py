"""One scene of a run whose worker, data or run folder is elsewhere: fetch, run as everywhere, send back.

A store has no rename and no lock. So ``done.json``, which vouches for a job's other files by their SHA-256, is sent
after them: a job that was sent in part has no seal, or one that its files do not match, and is run again.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import make_folder, write_bytes
from su3d_bench.core.files.locks import is_unfinished
from su3d_bench.core.files.scratch import TemporaryFolder
from su3d_bench.runs.executors.local import Report
from su3d_bench.runs.job import MethodOutcome, SceneJob
from su3d_bench.runs.planning.scenes import cache_root as own_cache_root
from su3d_bench.runs.remote.folder import RemoteFolder
from su3d_bench.runs.scene import failed_outcomes, run_scene
from su3d_bench.store.run_folder import JOBS, RECORDS, RunFolder

SEAL = "done.json"
REPLIES = "language"  # of language models, which the scenes of a run share
LARGE = ("prediction.npz", ".features.npy", ".png")  # ends of names that no table or comparison reads


@dataclass(frozen=True)
class DistantJob:
    """A job for a worker that shares a disk or nothing with whoever asked; it runs in ``folder`` where that exists.

    ``store`` and ``data`` are URLs, None where the job's own folders are on a shared disk; ``files`` are those of the
    scene in ``data`` with their sizes; ``cache_root`` None: the worker's own.
    """

    job: SceneJob
    here: Path
    store: str | None = None
    data: str | None = None
    files: Mapping[str, int] = field(default_factory=dict)
    cache_root: Path | None = None


def run_distant_scene(distant: DistantJob, report: Report) -> tuple[MethodOutcome, ...]:
    """What ``run_scene`` gives, its files sent to the store."""
    if distant.here.is_dir():
        os.chdir(distant.here)  # relative paths in the configuration are meant from there
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
    """The files of a job, from the store at the start of the block and back to it at its end."""
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
    """Inode and time of every file, which a file that is written again does not keep."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and not is_unfinished(path.name)]
    stats = {path.relative_to(folder).as_posix(): path.stat() for path in paths}
    return {name: (about.st_ino, about.st_mtime_ns) for name, about in stats.items()}


def _scene_folder(job: SceneJob) -> str:
    return RunFolder(job.folder).job(job.scene, "any").path.parent.relative_to(job.folder).as_posix()


def failed_distant(distant: DistantJob, reason: str) -> tuple[MethodOutcome, ...]:
    """The outcome of a scene whose worker was lost; its logs say so, in the store too."""
    outcomes = failed_outcomes(distant.job, reason)
    if distant.store is not None:
        logs = [RunFolder(distant.job.folder).job(outcome.scene, outcome.method).log for outcome in outcomes]
        names = [log.relative_to(distant.job.folder).as_posix() for log in logs if log.is_file()]
        RemoteFolder(distant.store).send(distant.job.folder, names)
    return outcomes


def mirror_of(url: str, cache_root: Path) -> Path:
    """Where this machine keeps the small files of the run folder at ``url``."""
    return cache_root / "runs" / f"{url.rstrip('/').rpartition('/')[2]}-{digest_bytes(url.rstrip('/').encode())[:8]}"


def fetch_state(url: str, mirror: Path) -> None:
    """Make ``mirror`` hold the records and seals of the store and no others, so that a plan meets what is there."""
    store = RemoteFolder(url)
    names = [name for name in store.files() if name in RECORDS or re.fullmatch(rf"{JOBS}/[^/]+/[^/]+/{SEAL}", name)]
    if not names and not mirror.exists():
        return
    with RunFolder(mirror).locked():
        for path in (*mirror.glob(f"{JOBS}/*/*/{SEAL}"), *(mirror / name for name in RECORDS)):
            path.unlink(missing_ok=True)
        _write(mirror, store, names)


def remove_jobs(url: str, mirror: Path, kept: Collection[Path]) -> None:
    """Remove from the store all jobs but those whose folders in ``mirror`` are ``kept``, first their seals."""
    store = RemoteFolder(url)
    going = [name for name in store.files(JOBS) if mirror.joinpath(*Path(name).parts[:3]) not in kept]
    store.remove(sorted(going, key=lambda name: (not name.endswith(f"/{SEAL}"), name)))


def fetch_results(url: str, mirror: Path) -> None:
    """Bring every file of the run's jobs that aggregation, tables and comparisons read."""
    store = RemoteFolder(url)
    _write(mirror, store, [name for name in store.files("scenes") if not _is_large(name)])


def _is_large(name: str) -> bool:
    file = name.rpartition("/")[2]
    is_early_map = file.startswith("anytime-") and not file.endswith("-counts.npz")
    return is_early_map or file.endswith(LARGE)


def _write(mirror: Path, store: RemoteFolder, names: Sequence[str]) -> None:
    for name, content in store.read(names):
        make_folder((mirror / name).parent)
        write_bytes(mirror / name, content)


def send_records(url: str, mirror: Path) -> None:
    """Bring the run's own records in the store up to those of ``mirror``."""
    store = RemoteFolder(url)
    store.remove(name for name in RECORDS if not (mirror / name).is_file())
    store.send(mirror, [name for name in RECORDS if (mirror / name).is_file()])
