"""A folder in a store that fsspec reaches: ``s3://bucket/runs/one``, ``gs://``, ``memory://``, ``file:///shared/x``.

Names that a store lists are checked before they become paths here. What a driver of fsspec raises is its own; here it
is a ``StoreError`` that names the store.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import ConfigError, ModelMissing, StoreError, printable
from su3d_bench.core.files.atomic import make_folder, replacing

AT_ONCE = 256  # small files that one request to the driver asks for; it fetches them side by side
BUCKETS = ("s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "oss")  # have no folders, and to make one makes a bucket
MOST_NAME_CHARACTERS = 1024  # the longest key of an S3 object


def is_url(text: str) -> bool:
    """Whether ``text`` names a store rather than a folder of this machine."""
    return "://" in text


class RemoteFolder:
    """The files below ``url``, by their names relative to it."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        try:
            import fsspec
        except ImportError as error:
            raise ModelMissing(f"{url}: a store needs the stores extra: pip install 'su3d-bench[stores]'") from error
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
        """Size in bytes of every file in the folder ``below``, by name; empty where there is none."""
        start = f"{self._root}/{below}".rstrip("/")
        with self._telling("cannot be listed"):
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
        """A name from a store may not lead out of the folder that it is copied to."""
        parts = name.split("/")
        is_plain = name.isprintable() and "\\" not in name and not {"", ".", ".."} & set(parts)
        if not is_plain or len(name) > MOST_NAME_CHARACTERS:
            raise StoreError(f"{self.url}: holds '{printable(name, 120)}', which is no name of a file; remove it")

    def fetch(self, sizes: Mapping[str, int], into: Path) -> None:
        """Copy the files named in ``sizes`` below ``into``; one that came with another size is an error."""
        for name, size in sizes.items():
            target = into / name
            make_folder(target.parent)
            with replacing(target) as stream, self._telling(f"{name} cannot be copied to {into}"):
                self._driver.get_file(f"{self._root}/{name}", str(stream.name))
            if target.stat().st_size != size:
                raise StoreError(
                    f"{self.url}: {name} has {target.stat().st_size} bytes here and {size} there; try again"
                )

    def read(self, names: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Name and content of small files; one that is gone meanwhile is left out."""
        wanted = list(names)
        for start in range(0, len(wanted), AT_ONCE):
            paths = {f"{self._root}/{name}": name for name in wanted[start : start + AT_ONCE]}
            with self._telling("cannot be read"):
                contents = self._driver.cat(list(paths), on_error="omit")
            yield from ((paths[path], content) for path, content in contents.items())

    def send(self, folder: Path, names: Sequence[str]) -> None:
        """Copy the files ``names`` of ``folder`` here, one after the other, in this order."""
        for name in names:
            with self._telling(f"{name} cannot be written"):
                path = f"{self._root}/{name}"
                if not self._has_buckets:
                    self._driver.makedirs(path.rpartition("/")[0], exist_ok=True)
                self._driver.put_file(str(folder / name), path)

    def remove(self, names: Iterable[str]) -> None:
        """Remove the files ``names`` where they exist."""
        for name in names:
            with self._telling(f"{name} cannot be removed"):
                if self._driver.exists(f"{self._root}/{name}"):
                    self._driver.rm_file(f"{self._root}/{name}")

    @contextmanager
    def _telling(self, what: str) -> Iterator[Any]:
        try:
            yield
        except Exception as error:  # each driver has errors of its own (botocore's, gcsfs's), with no class in common
            reason = printable(" ".join(str(error).split()) or type(error).__name__, 200)
            raise StoreError(f"{self.url}: {what}: {reason}") from error
