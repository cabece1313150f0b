"""Members of published archives, unpacked into a folder: no more than is wanted, nowhere else, no further than bounded.

A member goes where ``goes_to`` says, a path relative to the folder, or nowhere (None). One that would leave the
folder, a link in the place of a wanted file, and an archive that unpacks to far more than it is, end it.
"""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePosixPath
from stat import S_ISDIR, S_ISREG
from typing import IO

from su3d_bench.core.errors import DataError, StoreError, printable
from su3d_bench.core.files.atomic import replacing, write_error
from su3d_bench.core.files.unpacking import Allowance, UnpackingError, allowance_of, check_member
from su3d_bench.core.system.files import opened
from su3d_bench.fetching.download import Watch

PIECE = 1 << 20
BLOCK = 512
MOST_HEADER = 1 << 20  # of the words that precede a member of a tar archive
MOST_MEMBERS = 10_000_000
FAULTS = (
    DataError,
    UnpackingError,
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    EOFError,
    OSError,
    ValueError,
    RuntimeError,  # of zipfile: a password, a way of packing
)
Place = Callable[[PurePosixPath], PurePosixPath | None]


def members(archive: Path) -> list[tuple[str, int]]:
    """Name and size of every file in a zip archive."""
    with _reading(archive), opened(archive) as stream, zipfile.ZipFile(stream) as file:
        return [(info.filename, info.file_size) for info in file.infolist() if not _is_folder(info)]


def unpack_zip(archive: Path, folder: Path, goes_to: Place, watch: Watch) -> int:
    """Bring the wanted members of a zip archive below ``folder``; how many. What is there whole is passed over."""
    with _reading(archive), opened(archive) as stream, zipfile.ZipFile(stream) as file:
        allowance = allowance_of(file)
        wanted = []
        for info in file.infolist():
            target = None if _is_folder(info) else goes_to(_plain(info.filename))
            if target is None:
                continue
            mode = info.external_attr >> 16
            if mode and not (S_ISREG(mode) or mode & 0o170000 == 0):
                raise DataError(f"'{printable(info.filename, 120)}' is {'a folder' if S_ISDIR(mode) else 'a link'}")
            check_member(info, allowance)
            wanted.append((info, target))
        _refuse_twice([target for _, target in wanted])
        for n_done, (info, target) in enumerate(wanted):
            watch("unpacking", n_done, len(wanted))
            place = folder / target
            if place.is_file() and place.stat().st_size == info.file_size:
                continue
            with file.open(info) as member:
                _write(member, place, info.file_size)
        watch("unpacking", len(wanted), len(wanted))
    return len(wanted)


def unpack_tar_gz(parts: Sequence[Path], folder: Path, goes_to: Place, watch: Watch) -> int:
    """As ``unpack_zip``, of a packed tar archive in ``parts``, which are read one after another as one stream."""
    n_found, done = 0, set[PurePosixPath]()
    with _reading(parts[0]), ExitStack() as stack:
        n_packed = sum(part.stat().st_size for part in parts)
        packed = stack.enter_context(io.BufferedReader(_Joined(parts, watch, n_packed), PIECE))  # type: ignore[type-var]
        unpacked = gzip.GzipFile(fileobj=packed, mode="rb")
        stack.callback(unpacked.close)
        plain = _Bounded(unpacked, Allowance(n_packed))
        for name, kind, size in _tar_members(plain):
            is_file = kind in (tarfile.REGTYPE, tarfile.AREGTYPE)
            target = None if kind == tarfile.DIRTYPE else goes_to(_plain(name))
            if target is not None and not is_file:
                raise DataError(f"'{printable(name, 120)}' is no plain file")
            padded = -(-size // BLOCK) * BLOCK
            if target is None:
                plain.skip(padded)
                continue
            if target in done:
                raise DataError(f"holds '{printable(str(target), 120)}' twice")
            done.add(target)
            n_found += 1
            place = folder / target
            if place.is_file() and place.stat().st_size == size:
                plain.skip(padded)
                continue
            _write(plain.part(size), place, size)
            plain.skip(padded - size)
        while plain.read(PIECE):  # to the checksum of the whole
            pass
    return n_found


def _is_folder(info: zipfile.ZipInfo) -> bool:
    return info.filename.endswith("/")  # ``is_dir`` of Python 3.11 fails for a name without a character


def _plain(name: str) -> PurePosixPath:
    """A member's path within the archive; ``DataError`` where it leads out of any folder, or is none."""
    path = PurePosixPath(name)
    if not path.parts:
        raise DataError("holds a file without a name")
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name or name[1:2] == ":":
        raise DataError(f"'{printable(name, 120)}' leads out of the folder")
    return path


def _refuse_twice(targets: Sequence[PurePosixPath]) -> None:
    seen = set[PurePosixPath]()
    for target in targets:
        if target in seen:
            raise DataError(f"holds '{printable(str(target), 120)}' twice")
        seen.add(target)


def _write(source: IO[bytes], place: Path, size: int) -> None:
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(place, error) from error
    with replacing(place) as stream:
        n_left = size
        while n_left and (piece := source.read(min(PIECE, n_left))):
            stream.write(piece)
            n_left -= len(piece)
        if n_left or source.read(1):
            raise DataError(f"'{place.name}' holds other than the {size:,} bytes that it promises")


@contextmanager
def _reading(archive: Path) -> Iterator[None]:
    """Whatever is wrong with an archive as one ``DataError`` with its name and what to do."""
    try:
        yield
    except StoreError:
        raise
    except FAULTS as error:
        reason = printable(str(error), 200) or type(error).__name__
        raise DataError(f"{archive}: {reason}; nothing of it was put in place: delete it and fetch anew") from error


class _Joined(io.RawIOBase):
    """Files read one after another as one."""

    def __init__(self, parts: Sequence[Path], watch: Watch, n_bytes: int) -> None:
        self._parts, self._watch, self._n_bytes = list(parts), watch, n_bytes
        self._open: IO[bytes] | None = None
        self._n_read = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: bytearray) -> int:  # type: ignore[override]
        while True:
            if self._open is None:
                if not self._parts:
                    return 0
                self._open = opened(self._parts.pop(0))
            piece = self._open.read(len(buffer))
            if piece:
                buffer[: len(piece)] = piece
                self._n_read += len(piece)
                self._watch("unpacking", self._n_read, self._n_bytes)
                return len(piece)
            self._open.close()
            self._open = None

    def close(self) -> None:
        if self._open is not None:
            self._open.close()
        super().close()


class _Bounded:
    """A stream of which each byte is counted against an allowance before it is made."""

    def __init__(self, stream: gzip.GzipFile, allowance: Allowance) -> None:
        self._stream, self._allowance = stream, allowance

    def exactly(self, n: int) -> bytes:
        pieces, n_left = [], n
        while n_left:
            piece = self.read(n_left)
            if not piece:
                raise EOFError("ends in the middle of a member")
            pieces.append(piece)
            n_left -= len(piece)
        return b"".join(pieces)

    def read(self, n: int) -> bytes:
        n = min(n, PIECE)
        self._allowance.spend(n)
        return self._stream.read(n)

    def skip(self, n: int) -> None:
        while n:
            piece = self.read(n)
            if not piece:
                raise EOFError("ends in the middle of a member")
            n -= len(piece)

    def part(self, size: int) -> IO[bytes]:
        return io.BufferedReader(_Part(self, size), BLOCK)  # type: ignore[type-var]


class _Part(io.RawIOBase):
    """The next ``size`` bytes of a bounded stream."""

    def __init__(self, stream: _Bounded, size: int) -> None:
        self._stream, self._n_left = stream, size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: bytearray) -> int:  # type: ignore[override]
        piece = self._stream.read(min(len(buffer), self._n_left)) if self._n_left else b""
        buffer[: len(piece)] = piece
        self._n_left -= len(piece)
        return len(piece)


def _tar_members(stream: _Bounded) -> Iterator[tuple[str, bytes, int]]:
    """Name, kind and size of each member; whoever asks has read or skipped its padded content before the next.

    ``tarfile`` itself believes the sizes of the words that precede a member.
    """
    long_name: str | None = None
    long_size, n_zero, n_members = None, 0, 0
    while n_zero < 2:
        block = stream.exactly(BLOCK)
        if not block.strip(b"\0"):
            n_zero += 1
            continue
        n_zero, n_members = 0, n_members + 1
        if n_members > MOST_MEMBERS:
            raise DataError(f"holds more than {MOST_MEMBERS:,} members")
        info = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        if info.size < 0:
            raise DataError("a member of negative size")
        if info.type in (tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, tarfile.XHDTYPE, tarfile.XGLTYPE):
            if info.size > MOST_HEADER:
                raise DataError(f"a member's name of {info.size:,} bytes")
            content = stream.exactly(-(-info.size // BLOCK) * BLOCK)[: info.size]
            if info.type == tarfile.GNUTYPE_LONGNAME:
                long_name = content.rstrip(b"\0").decode("utf-8", "surrogateescape")
            elif info.type == tarfile.XHDTYPE:
                values = _pax(content)
                if any(key.startswith("GNU.sparse") for key in values):
                    raise DataError("a member written in an unusual way")
                long_name = values.get("path", long_name)
                long_size = int(values["size"]) if values.get("size", "").isdecimal() else None
            continue
        if info.type == tarfile.GNUTYPE_SPARSE:
            raise DataError("a member written in an unusual way")
        has_content = info.type in (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.CONTTYPE)
        size = info.size if long_size is None else long_size
        yield long_name or info.name, info.type, size if has_content else 0
        long_name = long_size = None


def _pax(content: bytes) -> dict[str, str]:
    """The words of an extended header: ``LENGTH KEY=VALUE``, a line each."""
    values, at = {}, 0
    while at < len(content):
        length, space, _ = content[at : at + 20].partition(b" ")
        if not space or not length.isdigit() or int(length) <= len(length) + 1:
            raise DataError("a damaged extended header")
        line = content[at + len(length) + 1 : at + int(length) - 1]
        key, _, value = line.partition(b"=")
        values[key.decode("utf-8", "surrogateescape")] = value.decode("utf-8", "surrogateescape")
        at += int(length)
    return values
