"""Members of published archives, unpacked into a folder: no more than is wanted, nowhere else, no further than bounded.

A member goes where ``goes_to`` says, a path relative to the folder, or nowhere (None). One that would leave the
folder, a link in the place of a wanted file, and an archive that unpacks to far more than it is, end it.
"""

from __future__ import annotations

import gzip
import io
import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path, PurePosixPath
from stat import S_ISREG
from typing import IO, Any, Self

from su3d_bench.core.errors import DataError, StoreError, printable
from su3d_bench.core.files.atomic import Allowance, allowance_of, check_member, replacing, write_error
from su3d_bench.core.system.files import opened
from su3d_bench.fetching.download import Progress

PIECE = 1 << 20
MAX_HEADER_BYTES = 1 << 20  # of the long name or extended header before a member of a tar archive
MAX_MEMBERS = 1_000_000
LONG_HEADERS = (tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, tarfile.XHDTYPE, tarfile.XGLTYPE)
# RuntimeError is of zipfile: a password, a way of packing.
FAULTS = (DataError, zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, OSError, ValueError, RuntimeError)
GoesTo = Callable[[PurePosixPath], PurePosixPath | None]


def members(archive: Path) -> list[tuple[str, int]]:
    """Name and size of every file in a zip archive."""
    with _reading(archive), opened(archive) as stream, zipfile.ZipFile(stream) as file:
        return [(info.filename, info.file_size) for info in file.infolist() if not info.filename.endswith("/")]


def unpack_zip(archive: Path, folder: Path, goes_to: GoesTo, watch: Progress) -> int:
    """Bring the wanted members of a zip archive below ``folder``; how many. What is there whole is passed over."""
    with _reading(archive), opened(archive) as stream, zipfile.ZipFile(stream) as file:
        allowance, targets = allowance_of(file), _Targets(folder, goes_to)
        wanted = []
        for info in file.infolist():
            mode = info.external_attr >> 16
            is_file = S_ISREG(mode) or not mode & 0o170000
            if not info.filename.endswith("/") and (place := targets.place(info.filename, is_file=is_file)) is not None:
                check_member(info, allowance)
                wanted.append((info, place))
        for n_done, (info, place) in enumerate(wanted, 1):
            with file.open(info) as member:
                _write(member, place, info.file_size)
            watch("unpacking", n_done, len(wanted))
    return len(wanted)


def unpack_tar_gz(parts: Sequence[Path], folder: Path, goes_to: GoesTo, watch: Progress) -> int:
    """As ``unpack_zip``, of a packed tar archive in ``parts``, which are read one after another as one stream."""
    with _reading(parts[0]), ExitStack() as stack:
        joined = stack.enter_context(closing(_Joined(parts, watch)))
        packed: Any = joined  # all that is asked of it is to be read
        plain = _Bounded(stack.enter_context(gzip.GzipFile(fileobj=packed, mode="rb")), Allowance(joined.n_bytes))
        targets, n_found = _Targets(folder, goes_to), 0
        with tarfile.open(fileobj=plain, mode="r|", tarinfo=_BoundedMember) as archive:  # type: ignore[call-overload]
            for n, info in enumerate(archive):
                if n >= MAX_MEMBERS:
                    raise DataError(f"holds more than {MAX_MEMBERS:,} members")
                place = None if info.isdir() else targets.place(info.name, is_file=info.isreg() and not info.sparse)
                if place is not None:
                    _write(archive.extractfile(info), place, info.size)
                    n_found += 1
        while plain.read(PIECE):  # to the checksum of the whole
            pass
    return n_found


class _Targets:
    """Where the members of an archive go below a folder, each to a place of its own."""

    def __init__(self, folder: Path, goes_to: GoesTo) -> None:
        self._folder, self._goes_to, self._known = folder, goes_to, set[PurePosixPath]()

    def place(self, name: str, *, is_file: bool) -> Path | None:
        """Where the member called ``name`` goes; None where it is not wanted."""
        path, shown = PurePosixPath(name), printable(name, 120)
        if not path.parts:
            raise DataError("holds a file without a name")
        if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name or name[1:2] == ":":
            raise DataError(f"'{shown}' leads out of the folder")
        target = self._goes_to(path)
        if target is None:
            return None
        if not is_file:
            raise DataError(f"'{shown}' is no plain file")
        if target in self._known:
            raise DataError(f"holds '{shown}' twice")
        self._known.add(target)
        return self._folder / target


def _write(source: IO[bytes] | None, place: Path, size: int) -> None:
    assert source is not None
    if place.is_file() and place.stat().st_size == size:
        return
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(place, error) from error
    with replacing(place) as stream:
        shutil.copyfileobj(source, stream, PIECE)
        if stream.tell() != size:
            raise EOFError("ends in the middle of a member")


@contextmanager
def _reading(archive: Path) -> Iterator[None]:
    try:
        yield
    except StoreError:
        raise
    except FAULTS as error:
        reason = printable(str(error), 200) or type(error).__name__
        raise DataError(f"{archive}: {reason}; nothing of it was put in place: delete it and fetch it again") from error


class _BoundedMember(tarfile.TarInfo):
    """A header that ``tarfile`` believes only where what it announces can be held in memory."""

    @classmethod
    def frombuf(cls, buf: Any, encoding: Any, errors: Any) -> Self:
        info = super().frombuf(buf, encoding, errors)
        if info.size < 0 or info.type == tarfile.GNUTYPE_SPARSE:
            raise DataError("a member written in an unusual way")
        if info.type in LONG_HEADERS and info.size > MAX_HEADER_BYTES:
            raise DataError(f"a member's name of {info.size:,} bytes")
        return info


class _Joined:
    """Files read one after another as one."""

    def __init__(self, parts: Sequence[Path], watch: Progress) -> None:
        self._left, self._watch, self._stream = list(parts), watch, io.BytesIO()
        self._n_read, self.n_bytes = 0, sum(part.stat().st_size for part in parts)

    def read(self, n: int) -> bytes:
        while not (content := self._stream.read(n)) and self._left:
            self.close()
            self._stream = opened(self._left.pop(0))  # type: ignore[assignment]
        self._n_read += len(content)
        self._watch("unpacking", self._n_read, self.n_bytes)
        return content

    def close(self) -> None:
        self._stream.close()


class _Bounded:
    """A stream of which each byte is counted against an allowance before it is made."""

    def __init__(self, stream: gzip.GzipFile, allowance: Allowance) -> None:
        self._stream, self._allowance = stream, allowance

    def read(self, n: int) -> bytes:
        self._allowance.spend(n)
        return self._stream.read(n)
