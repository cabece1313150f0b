"""The run folder: where its files are, content keys, one writer at a time.

A job is one scene under one method. It has two *steps*, ``predict`` and ``score``; ``done.json`` seals each with the
key of all its inputs and the SHA-256 of the files that it vouches for. A file that is damaged or missing makes its
step run anew; a step sealed under another key is refused, naming the field that changed.
"""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import StoreError
from su3d_bench.store.atomic import make_folder, read_json, remove_file, write_error, write_json
from su3d_bench.store.predictions import features_beside
from su3d_bench.store.records import SCHEMA, SealRecord, checked, plain

# What a lock on a folder itself gets from network disks, which lock files that are open for writing only: flock(2).
NO_FOLDER_LOCKS = (errno.EBADF, errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)
LOCK_FILE = ".lock"
WRITTEN_BY_ALL = ("language", "language/images")  # where all jobs of a run write; a job clears its own folders


@dataclass(frozen=True)
class RunFolder:
    """Where one run's files are; see DESIGN for the layout."""

    path: Path

    def job(self, scene: str, method: str) -> JobFolder:
        """The folder of one scene (``<dataset>/<scene>``) under one method."""
        return JobFolder(self.path / "scenes" / scene.replace("/", ".", 1).replace("/", "_") / method)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder against a second run; the lock dies with the process and leaves no file behind."""
        make_folder(self.path)
        handle = _lock(self.path)
        try:
            for folder in (self.path, *(self.path / name for name in WRITTEN_BY_ALL)):
                _clear_half_written(folder)
            yield
        finally:
            os.close(handle)


def _lock(folder: Path) -> int:
    """An open file that holds the lock of ``folder``; a ``StoreError`` where another process has it."""
    handle = -1
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in NO_FOLDER_LOCKS:
                raise
            os.close(handle)
            handle = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o666)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if handle >= 0:
            os.close(handle)
        if isinstance(error, BlockingIOError):
            message = f"{folder}: another run is writing here; wait for it or choose another folder with --out"
            raise StoreError(message) from error
        raise write_error(folder, error) from error
    return handle


def _clear_half_written(folder: Path) -> None:
    for leftover in folder.glob(".*.tmp"):
        remove_file(leftover)


@dataclass(frozen=True)
class JobFolder:
    """The files of one scene under one method."""

    path: Path

    @property
    def prediction(self) -> Path:
        return self.path / "prediction.npz"

    def anytime(self, share: float) -> Path:
        """The map after the first ``share`` of the updates."""
        return self.path / f"anytime-{share:g}.npz"

    def anytime_counts(self, share: float) -> Path:
        """The counts of that map."""
        return self.path / f"anytime-{share:g}-counts.npz"

    @property
    def counts(self) -> Path:
        return self.path / "counts.npz"

    @property
    def updates(self) -> Path:
        return self.path / "updates.csv"

    @property
    def log(self) -> Path:
        return self.path / "log.txt"

    @property
    def pictures(self) -> Path:
        return self.path / "pictures"

    @property
    def done(self) -> Path:
        return self.path / "done.json"

    def prepare(self) -> None:
        """Make the folder and clear what a killed run left half written."""
        make_folder(self.path)
        for folder in (self.path, self.pictures):
            _clear_half_written(folder)

    def seals(self) -> dict[str, SealRecord]:
        """The sealed steps; nothing where ``done.json`` is missing or damaged."""
        try:
            record = read_json(self.done)
        except StoreError:
            return {}
        steps = record.get("steps") if isinstance(record, dict) and record.get("schema") == SCHEMA else None
        seals = {}
        for step, seal in steps.items() if isinstance(steps, dict) else ():
            with suppress(ValidationError, RecursionError):
                seals[step] = checked(SealRecord, seal)
        return seals

    def seal(
        self, step: str, key: Mapping[str, str], files: Sequence[Path], remarks: Mapping[str, Any] | None = None
    ) -> None:
        """Vouch for ``files`` as the outcome of ``step`` under ``key``; sealing ``predict`` breaks the other seal.

        The features beside a dense prediction go with it. ``remarks`` are kept beside them for whoever resumes.
        """
        steps = {} if step == "predict" else self.seals()
        beside = [table for file in files if (table := features_beside(file)) != file and table.is_file()]
        digests = {file.relative_to(self.path).as_posix(): digest_file(file) for file in [*files, *beside]}
        steps[step] = SealRecord(key, digests, remarks or {})
        write_json(self.done, {"schema": SCHEMA, "steps": {name: plain(seal) for name, seal in steps.items()}})

    def remarks(self, step: str) -> Mapping[str, Any]:
        """What was kept beside the seal of ``step``."""
        seal = self.seals().get(step)
        return {} if seal is None else seal.remarks

    def changed_field(self, step: str, key: Mapping[str, str], *, known_later: Sequence[str] = ()) -> str | None:
        """A clause that names the first field in which the sealed key differs from ``key``; None where none does.

        Fields in ``known_later`` are not compared.
        """
        seal = self.seals().get(step)
        sealed = {} if seal is None else seal.key
        if not sealed or (key.items() <= sealed.items() and sealed.keys() - key.keys() <= set(known_later)):
            return None
        for name in [*key, *(name for name in sealed if name not in key)]:
            if name not in known_later and sealed.get(name) != key.get(name):
                return f"{name} was {sealed.get(name, 'not set')}, now {key.get(name, 'not set')}"
        return None

    def is_done(self, step: str, key: Mapping[str, str]) -> bool:
        """Whether ``step`` is sealed under exactly ``key`` and every file that it vouches for is whole."""
        return self.is_whole(self.seals().get(step), key)

    def is_whole(self, seal: SealRecord | None, key: Mapping[str, str]) -> bool:
        """Whether ``seal``, one of ``seals``, is of exactly ``key`` and every file that it vouches for is whole."""
        if seal is None or seal.key != dict(key):
            return False
        files = {self.path / name: digest for name, digest in seal.files.items()}
        return all(file.is_file() and digest_file(file) == digest for file, digest in files.items())
