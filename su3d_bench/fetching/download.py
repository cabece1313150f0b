"""One file brought here whole or not at all: taken up where it broke off, bounded, held against its checksums.

What has come so far lies beside its place under the name that ``store.unfinished`` gives, held by a lock, with a note
of the server's state beside it; it takes its place when size and checksum are right.
"""

from __future__ import annotations

import http.client
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

from su3d_bench.core.errors import DataError, StoreError, printable
from su3d_bench.core.files.atomic import read_json, write_error, write_json
from su3d_bench.core.files.locks import SHARED, beside, own_file
from su3d_bench.fetching.checksums import Stated, checked
from su3d_bench.fetching.http import TIMEOUT_S, Answer, Broken, Stale, Validator, ask
from su3d_bench.fetching.sources import MOST_BYTES

PIECE = 1 << 18
MOST_STARTS_ANEW = 2  # of one file in one command: a server that changes it each time is given up

Watch = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class Wanted:
    """A file of a server: from ``hosts`` alone; ``n_bytes`` and ``stated`` as far as anybody states them."""

    name: str
    address: str
    hosts: tuple[str, ...]
    n_bytes: int | None = None
    stated: Stated = field(default_factory=Stated)


@dataclass(frozen=True)
class Patience:
    """How often a broken download is taken up again, counted anew when bytes came, and after which pause at first."""

    n_retries: int = 3
    pause_s: float = 1.0
    timeout_s: float = TIMEOUT_S


def unfinished_bytes(place: Path) -> int:
    """How much of the file that is to lie at ``place`` has come so far."""
    try:
        return beside(place, SHARED).stat().st_size
    except OSError:
        return 0


def bring(wanted: Wanted, place: Path, watch: Watch, patience: Patience | None = None) -> str:
    """Put the file at ``place``, where nothing is, and give its SHA-256; ``watch`` hears how much has come.

    Raises ``StoreError`` where the disk refuses or another process brings the same, and ``DataError`` where the server
    does not give the file that was stated; what has come of it by then is kept, unless it is known to be wrong.
    """
    patience = patience or Patience()
    part = beside(place, SHARED)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        handle = own_file(part, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        raise write_error(place, error) from error
    if handle is None:
        raise StoreError(f"{place}: another process is bringing it; wait for its end and run the same command again")
    with os.fdopen(handle, "r+b") as stream:
        _Download(wanted, place, stream, watch, patience).run()
        sha256, wrong = checked(part, wanted.stated)
        if wrong is not None:
            _forget(part, place)
            raise DataError(
                f"{place.name} from {wanted.address}: {wrong}; it was thrown away: run the same command again, or name "
                "a mirror with --mirror"
            )
        try:
            os.fsync(stream.fileno())
            os.replace(part, place)
        except OSError as error:
            raise write_error(place, error) from error
    _note(place).unlink(missing_ok=True)
    return sha256


def _note(place: Path) -> Path:
    """Where it is kept which state of the server's file the unfinished one is the beginning of."""
    return place.with_name(f".{place.name}.state.json")


def _forget(part: Path, place: Path) -> None:
    for path in (part, _note(place)):
        with suppress(OSError):
            path.unlink(missing_ok=True)


class _Download:
    def __init__(self, wanted: Wanted, place: Path, stream: IO[bytes], watch: Watch, patience: Patience) -> None:
        self._wanted, self._place, self._stream = wanted, place, stream
        self._watch, self._patience = watch, patience
        self._n_held = stream.seek(0, os.SEEK_END)
        self._validator, self._n_bytes = self._kept()
        if not self._validator.words and not wanted.stated.is_published:
            self._begin_anew()  # nothing would tell whether both parts are of one file
        if wanted.n_bytes is not None and self._n_held > wanted.n_bytes:
            self._begin_anew()

    def run(self) -> None:
        n_idle, n_anew = 0, 0
        while not self._is_whole():
            n_before = self._n_held
            try:
                self._attempt()
            except Stale as reason:
                if reason.n_bytes == self._n_held and self._n_bytes == self._n_held:
                    return
                n_anew += 1
                if n_anew > MOST_STARTS_ANEW:
                    raise DataError(
                        f"{self._wanted.address}: {printable(str(reason), 200)}, and it is another file each time; "
                        "name a mirror with --mirror"
                    ) from None
                self._begin_anew()
            except Broken as reason:
                n_idle = 1 if self._n_held > n_before else n_idle + 1
                if n_idle > self._patience.n_retries:
                    raise DataError(self._broken_off(reason)) from None
                time.sleep(min(self._patience.pause_s * 2 ** min(n_idle - 1, 6), 60.0))

    def _is_whole(self) -> bool:
        """Without a stated size, the server is asked once more whether that is all."""
        return self._n_held > 0 and self._n_held == self._wanted.n_bytes

    def _attempt(self) -> None:
        wanted = self._wanted
        answer = ask(wanted.address, wanted.hosts, self._n_held, self._validator, self._patience.timeout_s)
        with answer.body:
            n_bytes = self._size_of(answer)
            if answer.start != self._n_held:
                self._begin_anew()  # the server gives no parts, or the file is another by now
            elif self._n_held and self._n_bytes not in (None, n_bytes):
                raise Stale(f"had {self._n_bytes:,} bytes and has {n_bytes:,}")
            self._keep(answer.validator, n_bytes)
            self._take(answer, n_bytes)
        if wanted.n_bytes is None:
            self._wanted = replace(wanted, n_bytes=n_bytes)

    def _size_of(self, answer: Answer) -> int:
        stated, wanted = self._wanted.n_bytes, answer.n_bytes
        if stated is not None and wanted not in (None, stated):
            raise DataError(
                f"{self._wanted.address}: has {wanted:,} bytes, stated are {stated:,}: it is another file by now; name "
                "a mirror with --mirror, or its facts with --sources"
            )
        size = stated if wanted is None else wanted
        if size is None:
            raise DataError(f"{self._wanted.address}: nobody says how large it is; name a mirror with --mirror")
        if not 0 < size <= MOST_BYTES:
            raise DataError(f"{self._wanted.address}: has {size:,} bytes, which is no file of this kind")
        return size

    def _take(self, answer: Answer, n_bytes: int) -> None:
        self._watch(self._wanted.name, self._n_held, n_bytes)
        while True:
            try:
                piece = answer.body.read(min(PIECE, n_bytes - self._n_held + 1))
            except (OSError, http.client.HTTPException, ValueError) as error:
                raise Broken(printable(str(error), 120) or type(error).__name__) from None
            if not piece:
                break
            if self._n_held + len(piece) > n_bytes:
                raise Stale(f"sends more than the {n_bytes:,} bytes that it promised")
            try:
                self._stream.write(piece)
                self._stream.flush()
            except OSError as error:
                raise write_error(self._place, error) from error
            self._n_held += len(piece)
            self._watch(self._wanted.name, self._n_held, n_bytes)
        if self._n_held < n_bytes:
            raise Broken("the connection was closed")

    def _begin_anew(self) -> None:
        self._stream.seek(0)
        self._stream.truncate()
        self._n_held = 0
        self._n_bytes = None
        self._validator = Validator()

    def _broken_off(self, reason: Broken) -> str:
        come = f"{self._n_held:,} bytes of it are here" if self._n_held else "nothing of it is here"
        return f"{self._wanted.address}: {printable(str(reason), 200)}; {come}, and the same command goes on from there"

    def _kept(self) -> tuple[Validator, int | None]:
        """The state and size of the server's file of which the beginning is here; a damaged note counts as none."""
        unknown = Validator(), None
        if not self._n_held:
            return unknown
        try:
            content: Any = read_json(_note(self._place))
        except StoreError:
            return unknown
        if not isinstance(content, dict) or content.get("address") != self._wanted.address:
            return unknown
        texts, n_bytes = (content.get("etag"), content.get("last_modified")), content.get("n_bytes")
        if type(n_bytes) is not int or not all(isinstance(t, str) and t.isascii() and t.isprintable() for t in texts):
            return unknown
        return Validator(*map(str, texts)), n_bytes

    def _keep(self, validator: Validator, n_bytes: int) -> None:
        self._validator, self._n_bytes = validator, n_bytes
        state = {
            "address": self._wanted.address,
            "n_bytes": n_bytes,
            "etag": validator.etag,
            "last_modified": validator.last_modified,
        }
        write_json(_note(self._place), state)
