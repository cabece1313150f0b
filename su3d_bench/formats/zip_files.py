"""Members of zip archives, read whole with their checksum, never more than the archive can really hold."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.plain_text import printable, shown

MOST_MEMBER = 4 << 30  # bytes; masks of a scene are some hundred MiB
MOST_RATIO = 1032  # deflate cannot do better
NEEDED_BY_DEFLATE = 64
ENCRYPTED = 0x1
# What zipfile raises on damaged archives; an unusual compression is a NotImplementedError, which is a RuntimeError.
DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError, struct.error)


@contextmanager
def opened_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """The archive at ``path``; damage, inside the block too, is a ``PredictionError`` that names the file."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except OSError as error:
        raise PredictionError(f"{shown(path)}: cannot be read: {error.strerror or 'wrong offsets'}") from error
    except DAMAGE as error:
        raise PredictionError(f"{shown(path)}: not a whole zip archive; copy the file again") from error


def read_member(archive: zipfile.ZipFile, name: str, where: str) -> bytes:
    """The content of a member, stored or deflated, with its checksum held against it."""
    try:
        info = archive.getinfo(name)
    except KeyError as error:
        raise PredictionError(f"{where}: '{name}' is not in the archive") from error
    packed, name = info.compress_size, printable(name, 80)
    if archive.fp is None or packed > archive.fp.seek(0, io.SEEK_END):
        raise PredictionError(f"{where}: '{name}' promises more bytes than the archive has; copy the file again")
    if info.flag_bits & ENCRYPTED or info.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
        raise PredictionError(f"{where}: '{name}' is encrypted or compressed in an unusual way; write it plainly")
    most = packed if info.compress_type == zipfile.ZIP_STORED else packed * MOST_RATIO + NEEDED_BY_DEFLATE
    if info.file_size > min(most, MOST_MEMBER):
        raise PredictionError(
            f"{where}: '{name}' promises {info.file_size} bytes out of {packed}; the file is damaged or hostile"
        )
    content = archive.read(info)
    if len(content) != info.file_size:
        raise PredictionError(f"{where}: '{name}' has {len(content)} of {info.file_size} bytes; copy the file again")
    return content
