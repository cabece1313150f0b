"""Pieces of a page that were made before, kept in the folder of their run under a key of all that they were made from.

A piece lies in ``RUN/.cache/page`` as a SHA-256 of its key and its content, a line end and the content. One that is
damaged, or was made from anything else, counts as absent; a folder that takes no files only means that the next page
makes its pieces again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from su3d_bench.core.digests import (
    NUMERIC_PACKAGES,
    code_digest,
    digest_bytes,
    digest_file,
    digest_json,
    package_digest,
    package_versions,
)
from su3d_bench.core.errors import StoreError, Su3dError
from su3d_bench.core.files.atomic import filling
from su3d_bench.core.files.locks import is_unfinished
from su3d_bench.core.system.files import file_bytes
from su3d_bench.runs.finished import FinishedRun
from su3d_bench.store.predictions import features_beside
from su3d_bench.store.run_folder import refuse_links

FOLDER = Path(".cache", "page")
MOST_BYTES = 1 << 28  # of a piece; one of a scene under fifty methods has a tenth of it
MOST_OF_EACH = 3  # of one scene's pieces made from different things, such as other --queries
FORMAT = 3  # moves every key: raise it when the form of a piece changes


@dataclass(frozen=True)
class Piece:
    """The place of one piece below the folder of a run, ``top``, and the key of what it is made from."""

    top: Path
    name: str
    key: str

    @property
    def _place(self) -> Path:
        return self.top / FOLDER / f"{self.name}-{self.key[:16]}"

    def load(self) -> bytes | None:
        """What was kept; None where there is no whole piece of this key."""
        place = self._place
        try:
            refuse_links(self.top, place)
            if place.stat().st_size > MOST_BYTES:
                return None
            seal, _, content = file_bytes(place).partition(b"\n")
        except (OSError, StoreError):
            return None
        if seal != self._seal(content):
            return None
        with suppress(OSError):
            os.utime(place)  # what is asked for stays
        return content

    def save(self, content: bytes) -> None:
        """Keep ``content``, and of the other pieces of this name the youngest, where the folder takes files."""
        with suppress(OSError, StoreError):
            refuse_links(self.top, self._place)
            with filling(self._place) as stream:
                stream.write(self._seal(content) + b"\n" + content)
            self._remove_old()

    def _seal(self, content: bytes) -> bytes:
        return digest_bytes(self.key.encode() + content).encode()

    def _remove_old(self) -> None:
        of_name = [place for place in self._place.parent.glob(f"{self.name}-*") if not is_unfinished(place.name)]
        for place in sorted(of_name, key=lambda place: place.lstat().st_mtime_ns)[:-MOST_OF_EACH]:
            place.unlink(missing_ok=True)


def piece(run: FinishedRun, what: Sequence[str], made_from: Any) -> Piece:
    """The piece ``what`` in the folder of ``run``; ``made_from`` is a JSON-like value of all that moves it."""
    code = [FORMAT, code_digest(), package_digest("analysis", "reports"), package_versions(NUMERIC_PACKAGES)]
    return Piece(run.folder.path, digest_json(list(what))[:16], digest_json([list(what), made_from, code]))


def state_of_run(run: FinishedRun, scene: str) -> list[Any]:
    """What moves each piece of a scene of a run: its records, the rules here, and whether its data are here."""
    return [
        *(_digest(run.folder.path / name) for name in ("run.json", "run.toml")),
        {name: _fault(partial(run.rules, name)) or run.rules(name).digest for name in run.protocols},
        _fault(partial(run.dataset, scene)),
    ]


def state_of_job(run: FinishedRun, scene: str, method: str) -> Mapping[str, str | None]:
    """The digests of what a page is made from of a scene under a method, None for a file that is missing."""
    job = run.folder.job(scene, method)
    files = (job.prediction, features_beside(job.prediction), job.counts, job.updates, job.done)
    return {file.name: _digest(file) for file in files}


def state_of_counts(run: FinishedRun, method: str) -> list[str | None]:
    """The digests of what a method counted in every scene."""
    return [_digest(run.folder.job(scene, method).counts) for scene in run.scenes]


def _digest(file: Path) -> str | None:
    with suppress(OSError):
        return digest_file(file)
    return None


def _fault(ask: Callable[[], Any]) -> str | None:
    try:
        ask()
    except Su3dError as error:
        return str(error)
    return None
