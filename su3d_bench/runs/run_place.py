"""Where the folder of a run lies: on a disk, or in a store, whose small files are mirrored on this machine.

Both are one interface. Whoever plans or carries out a run works in ``folder`` and tells the place when its records
change, when the results of jobs are wanted, and when jobs go.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.files.atomic import make_folder, write_bytes
from su3d_bench.runs.remote_store import RemoteFolder
from su3d_bench.store.run_folder import JOBS, RECORDS, JobFolder, RunFolder

SEAL = "done.json"
LARGE = ("prediction.npz", ".features.npy", ".png")  # ends of names that no table or comparison reads


class RunPlace(Protocol):
    """``folder`` holds the run, or the small files of one in the store at ``url``."""

    @property
    def folder(self) -> RunFolder: ...

    @property
    def url(self) -> str | None: ...

    @property
    def name(self) -> str:
        """What messages call it."""

    def publish(self) -> None:
        """Bring the run's records up to those of ``folder``."""

    def fetch_results(self) -> None:
        """Bring every file of the run's jobs that aggregation, tables and comparisons read to ``folder``."""

    def remove(self, jobs: Sequence[JobFolder]) -> None:
        """Remove jobs with all their files."""


@dataclass(frozen=True)
class LocalRun:
    """A run whose folder is on a disk: all is where it is needed."""

    folder: RunFolder
    url: None = None

    @property
    def name(self) -> str:
        return str(self.folder.path)

    def publish(self) -> None:
        pass

    def fetch_results(self) -> None:
        pass

    def remove(self, jobs: Sequence[JobFolder]) -> None:
        for job in jobs:
            job.remove()


@dataclass(frozen=True)
class StoredRun:
    """A run whose folder is in the store at ``url``; ``folder`` mirrors its small files."""

    url: str
    folder: RunFolder

    @classmethod
    def opened(cls, url: str, cache_root: Path) -> StoredRun:
        """The run at ``url``; the mirror then holds its records and seals, and no others."""
        place = cls(url, RunFolder(mirror_of(url, cache_root)))
        mirror, store = place.folder.path, RemoteFolder(url)
        seal = re.compile(rf"{JOBS}/[^/]+/[^/]+/{SEAL}")
        names = [name for name in store.files() if name in RECORDS or seal.fullmatch(name)]
        if names or mirror.exists():
            with place.folder.locked():
                for path in (*mirror.glob(f"{JOBS}/*/*/{SEAL}"), *(mirror / name for name in RECORDS)):
                    path.unlink(missing_ok=True)
                place._fetch(store, names)
        return place

    @property
    def name(self) -> str:
        return self.url

    def publish(self) -> None:
        store, mirror = RemoteFolder(self.url), self.folder.path
        store.remove(name for name in RECORDS if not (mirror / name).is_file())
        store.send(mirror, [name for name in RECORDS if (mirror / name).is_file()])

    def fetch_results(self) -> None:
        store = RemoteFolder(self.url)
        self._fetch(store, [name for name in store.files(JOBS) if not _is_large(name)])

    def remove(self, jobs: Sequence[JobFolder]) -> None:
        """First their seals, without which their other files count for nothing; jobs without a seal go with them."""
        store, mirror = RemoteFolder(self.url), self.folder.path
        kept = {job.path for job in self.folder.jobs()} - {job.path for job in jobs}
        names = [name for name in store.files(JOBS) if mirror.joinpath(*Path(name).parts[:3]) not in kept]
        store.remove(sorted(names, key=lambda name: (not name.endswith(f"/{SEAL}"), name)))
        for job in jobs:
            job.remove()

    def _fetch(self, store: RemoteFolder, names: Sequence[str]) -> None:
        for name, content in store.read(names):
            make_folder((self.folder.path / name).parent)
            write_bytes(self.folder.path / name, content)


def mirror_of(url: str, cache_root: Path) -> Path:
    """Where this machine keeps the small files of the run folder at ``url``."""
    return cache_root / "runs" / f"{url.rstrip('/').rpartition('/')[2]}-{digest_bytes(url.rstrip('/').encode())[:8]}"


def _is_large(name: str) -> bool:
    file = name.rpartition("/")[2]
    is_early_map = file.startswith("anytime-") and not file.endswith("-counts.npz")
    return is_early_map or file.endswith(LARGE)
