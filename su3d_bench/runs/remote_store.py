"""Stores that fsspec can access (``s3://bucket/runs/one``, ``gs://``, ``memory://``), and a data root in one.

Names listed by a store are checked before they become local paths. Any error of an fsspec driver is raised as a
``StoreError`` that names the store.

The folder of a run is on a disk (``LocalRun``), or in a store whose small files are mirrored on this machine
(``StoredRun``). A plan or a run works in ``folder`` and notifies the place when its records change, when the results of
jobs are needed, and when jobs are removed.

Datasets find scenes by file names. So a plan is made over an *outline* of a data root in a store: its tree as empty
files. A job gets only the real files of its scene.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.errors import ConfigError, ModelMissing, StoreError, printable
from su3d_bench.core.files.atomic import TemporaryFolder, make_folder, replacing, write_bytes
from su3d_bench.runs.job import Part, build_dataset
from su3d_bench.store.run_folder import JOBS, RECORDS, JobFolder, RunFolder

AT_ONCE = 256  # small files per request to the driver, which fetches them in parallel
BUCKETS = ("s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "oss")  # no folders: creating one would create a bucket
MAX_NAME_CHARACTERS = 1024  # the longest key of an S3 object


def is_url(text: str) -> bool:
    """Whether ``text`` names a store rather than a folder of this machine."""
    return "://" in text


class RemoteFolder:
    """The files below ``url``, by name relative to it."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        try:
            import fsspec
        except ImportError as error:
            raise ModelMissing(f"{url}: needs the stores extra: pip install 'su3d-bench[stores]'") from error
        try:
            self._driver, root = fsspec.url_to_fs(self.url)
        except ImportError as error:
            line = " ".join(str(error).split())[:200]
            raise ModelMissing(f"{url}: the driver of this store is not installed ({line})") from error
        except ValueError as error:
            raise ConfigError(f"{url}: {' '.join(str(error).split())[:200]}; such as s3://bucket/folder") from error
        self._root = str(root).rstrip("/")
        self._has_buckets = self.url.partition(":")[0] in BUCKETS

    def files(self, below: str = "") -> dict[str, int]:
        """Size in bytes of every file in the folder ``below``, by name; empty if there is none."""
        start = f"{self._root}/{below}".rstrip("/")
        with self._with_context("cannot be listed"):
            self._driver.invalidate_cache()
            try:
                entries = self._driver.find(start, detail=True)
            except FileNotFoundError:
                return {}
        sizes = {}
        for path, about in entries.items():
            name = str(path)[len(self._root) :].lstrip("/")
            self._check(name)
            sizes[name] = int(about.get("size") or 0)
        return sizes

    def _check(self, name: str) -> None:
        """A ``StoreError`` if a name from a store would lead out of the folder that it is copied to."""
        parts = name.split("/")
        is_plain = name.isprintable() and "\\" not in name and not {"", ".", ".."} & set(parts)
        if not is_plain or len(name) > MAX_NAME_CHARACTERS:
            raise StoreError(f"{self.url}: has '{printable(name, 120)}', which is not a valid file name; remove it")

    def fetch(self, sizes: Mapping[str, int], into: Path) -> None:
        """Copy the files named in ``sizes`` below ``into``; a file that arrives with another size is an error."""
        for name, size in sizes.items():
            target = into / name
            make_folder(target.parent)
            with replacing(target) as stream, self._with_context(f"{name} cannot be copied to {into}"):
                self._driver.get_file(f"{self._root}/{name}", str(stream.name))
            if target.stat().st_size != size:
                raise StoreError(
                    f"{self.url}: {name} has {target.stat().st_size} bytes here but {size} in the store; try again"
                )

    def read(self, names: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Name and content of small files, except those removed meanwhile."""
        wanted = list(names)
        for start in range(0, len(wanted), AT_ONCE):
            paths = {f"{self._root}/{name}": name for name in wanted[start : start + AT_ONCE]}
            with self._with_context("cannot be read"):
                contents = self._driver.cat(list(paths), on_error="omit")
            yield from ((paths[path], content) for path, content in contents.items())

    def send(self, folder: Path, names: Sequence[str]) -> None:
        """Copy the files ``names`` of ``folder`` to the store, one after the other, in this order."""
        for name in names:
            with self._with_context(f"{name} cannot be written"):
                path = f"{self._root}/{name}"
                if not self._has_buckets:
                    self._driver.makedirs(path.rpartition("/")[0], exist_ok=True)
                self._driver.put_file(str(folder / name), path)

    def remove(self, names: Iterable[str]) -> None:
        """Remove those of the files ``names`` that exist."""
        for name in names:
            with self._with_context(f"{name} cannot be removed"):
                if self._driver.exists(f"{self._root}/{name}"):
                    self._driver.rm_file(f"{self._root}/{name}")

    @contextmanager
    def _with_context(self, what: str) -> Iterator[Any]:
        try:
            yield
        except Exception as error:  # each driver has its own errors (botocore's, gcsfs's), without a common class
            reason = printable(" ".join(str(error).split()) or type(error).__name__, 200)
            raise StoreError(f"{self.url}: {what}: {reason}") from error


MAX_SHARED_BYTES = 1 << 26  # label tables and camera files; the largest has 1 MB


@dataclass(frozen=True)
class RemoteData:
    """The data root in a store, and per scene (``<dataset>/<scene>``) the files that a job needs, with their sizes."""

    url: str
    files: Mapping[str, Mapping[str, int]]


@dataclass(frozen=True)
class DataPlace:
    """Where a plan looks for scenes: the data root, or the outline of the one at ``url``, with the sizes there."""

    root: Path
    url: str | None = None
    sizes: Mapping[str, int] = field(default_factory=dict)

    def needed(self, datasets: Iterable[Part]) -> RemoteData | None:
        """The files that the scenes of ``datasets`` need; None if the data root is on this machine."""
        if self.url is None:
            return None
        files: dict[str, Mapping[str, int]] = {}
        for part in datasets:
            of_scenes = files_of_scenes(self.sizes, build_dataset(part, self.root).scenes())
            files |= {f"{part.name}/{scene}": sizes for scene, sizes in of_scenes.items()}
        return RemoteData(self.url, files)


@contextmanager
def data_place(url: str) -> Iterator[DataPlace]:
    """The outline of the store at ``url``, for the duration of the block."""
    sizes = RemoteFolder(url).files()
    if not sizes:
        raise ConfigError(f"SU3D_DATA={url}: contains no file; set it to the folder that contains the datasets")
    with TemporaryFolder("su3d-outline-") as folder:
        for below in {str(Path(name).parent) for name in sizes}:
            make_folder(folder / below)
        for name in sizes:
            (folder / name).touch()
        yield DataPlace(folder, url, sizes)


def files_of_scenes(sizes: Mapping[str, int], scenes: Sequence[str]) -> dict[str, dict[str, int]]:
    """Files and sizes per scene of one dataset: files named after it or in a folder so named, and shared files.

    A folder or file is named after a scene if it contains the scene's name between separators, however the name itself
    is separated: ``room0_mesh.ply`` and ``room_0/`` belong to ``room0``. Files of no scene are shared if they are next
    to scenes, in the same folder of the root, and are small.
    """
    of_key: dict[str, list[str]] = {}
    for scene in scenes:
        of_key.setdefault(_key(scene), []).append(scene)
    owners = {name: _owner(name, of_key) for name in sizes}
    tops = {_top(name) for name, owner in owners.items() if owner is not None}
    shared = {
        name: sizes[name]
        for name, owner in owners.items()
        if owner is None and _top(name) in tops and sizes[name] <= MAX_SHARED_BYTES
    }
    files: dict[str, dict[str, int]] = {scene: dict(shared) for scene in scenes}
    for name, owner in owners.items():
        for scene in of_key.get(owner or "", ()):  # names that differ only in separators share their files
            files[scene][name] = sizes[name]
    return files


def _top(name: str) -> str:
    return name.partition("/")[0] if "/" in name else ""


def _owner(name: str, of_key: Mapping[str, Sequence[str]]) -> str | None:
    for part in name.split("/"):
        for key in _keys(part):
            if key in of_key:
                return key
    return None


def _keys(part: str) -> Iterable[str]:
    """The scene keys that ``part`` may contain, the longest first."""
    words = [word for word in re.split(r"[._-]+", part) if word]
    for n in range(len(words), 0, -1):
        yield from ("".join(words[k : k + n]) for k in range(len(words) - n + 1))


def _key(scene: str) -> str:
    return "".join(re.split(r"[._-]+", scene))


# ---- where the folder of a run is


SEAL = "done.json"
LARGE = ("prediction.npz", ".features.npy", ".png")  # name endings of files that no table or comparison reads


@dataclass(frozen=True)
class LocalRun:
    """A run whose folder is on a disk: all files are where they are needed."""

    folder: RunFolder
    url: None = None

    @property
    def name(self) -> str:
        """Its name in messages."""
        return str(self.folder.path)

    def publish(self) -> None:
        """Update the run's records to those of ``folder``."""

    def fetch_results(self) -> None:
        """Copy every file of the run's jobs that aggregation, tables and comparisons read to ``folder``."""

    def remove(self, jobs: Sequence[JobFolder]) -> None:
        """Remove jobs with all their files."""
        for job in jobs:
            job.remove()


@dataclass(frozen=True)
class StoredRun:
    """A run whose folder is in the store at ``url``; ``folder`` mirrors its small files."""

    url: str
    folder: RunFolder

    @classmethod
    def opened(cls, url: str, cache_root: Path) -> StoredRun:
        """The run at ``url``; the mirror then contains exactly its records and completion records."""
        place = cls(url, RunFolder(mirror_of(url, cache_root)))
        mirror, store = place.folder.path, RemoteFolder(url)
        completion = re.compile(rf"{JOBS}/[^/]+/[^/]+/{SEAL}")
        names = [name for name in store.files() if name in RECORDS or completion.fullmatch(name)]
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
        """Remove their completion records first, because other files are ignored without them; jobs without a
        completion record are removed too."""
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


RunPlace = LocalRun | StoredRun


def mirror_of(url: str, cache_root: Path) -> Path:
    """The local mirror of the small files of the run folder at ``url``."""
    return cache_root / "runs" / f"{url.rstrip('/').rpartition('/')[2]}-{digest_bytes(url.rstrip('/').encode())[:8]}"


def _is_large(name: str) -> bool:
    file = name.rpartition("/")[2]
    is_early_map = file.startswith("anytime-") and not file.endswith("-counts.npz")
    return is_early_map or file.endswith(LARGE)
