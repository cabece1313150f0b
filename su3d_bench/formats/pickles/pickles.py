"""Pickles of other programs, read as data by an own interpreter that imports and calls nothing."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO, cast

from su3d_bench.core.errors import PredictionError, printable, reading
from su3d_bench.core.files.unpacking import UnpackingError
from su3d_bench.core.system.files import opened
from su3d_bench.formats.pickles.pickle_constructors import CONSTRUCTORS, Constructors, Forgotten, Inert, RefusedError
from su3d_bench.formats.pickles.pickle_machine import PickleMachine

__all__ = ["Forgotten", "Inert", "read_pickle", "read_pickle_file"]

GZIP_START = b"\x1f\x8b"
MOST_INFLATED = 16 << 30  # bytes of a gzip stream; a map of ConceptGraphs with all its masks has some GiB
INFLATED_A_READ = 1 << 20


def read_pickle_file(path: Path, *, forget: Iterable[str] = ()) -> object:
    """The value of a pickle, plain or gzipped: plain values, lists, dicts, tuples, and read-only arrays.

    Payloads below a dict key in ``forget`` are read past and leave ``Forgotten`` in their place; settings and paths
    become ``Inert``. Raises ``PredictionError`` for whatever is damaged or not plain data.
    """
    where = printable(str(path), 300)
    with reading(where), opened(path) as stream:
        is_gzip = stream.read(2) == GZIP_START
        n_bytes = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        if not is_gzip:
            return read_pickle(stream, n_bytes, where, forget=forget)
        with gzip.open(stream, "rb") as inflated:
            buffered = io.BufferedReader(cast(io.RawIOBase, inflated), INFLATED_A_READ)
            return read_pickle(buffered, MOST_INFLATED, where, n_packed=n_bytes, forget=forget)


def read_pickle(
    stream: BinaryIO,
    n_bytes: int,
    where: str,
    *,
    n_packed: int | None = None,
    constructors: Constructors = CONSTRUCTORS,
    persistent: Callable[[object], object] | None = None,
    forget: Iterable[str] = (),
    is_last: bool = True,
) -> object:
    """The value of the pickle that ``stream`` holds from here to its end, at most ``n_bytes`` away.

    ``n_packed``: how many bytes the file has where the stream is compressed, which bound what is kept of it.
    ``constructors`` is the whole of what the pickle may name; ``persistent`` answers references to what is stored
    outside of it, which are refused without it. Where it is not the last, the stream stands behind it afterwards.
    """
    n_packed = n_bytes if n_packed is None else n_packed
    machine = PickleMachine(stream, n_bytes, n_packed, constructors, persistent, frozenset(forget), is_last)
    try:
        return machine.run()
    except (RefusedError, UnpackingError) as error:
        raise PredictionError(
            f"{where}: not read as a pickle of plain data, at byte {machine.n_read}: {error}"
        ) from error
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise PredictionError(f"{where}: the file is cut short or damaged; copy it again") from error
