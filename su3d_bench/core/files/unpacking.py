"""What is packed, unpacked no further than its size warrants, whatever a header promises of it."""

from __future__ import annotations

import io
import struct
import tokenize
import zipfile
import zlib

from su3d_bench.core.errors import printable

# What any file may unpack to: 600 masks of a scene's 120,000 points take 69 MiB, a byte a point.
FREE_BYTES = 128 << 20
# Beyond that so many bytes for one of the file; deflate alone reaches 1032. The masks above pack to a 95th.
MOST_RATIO = 100
PIECE = 1 << 20
# What readers raise on a damaged file, an .npz above all.
DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    SyntaxError,
    RuntimeError,  # zipfile's, of a compression unknown to it
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
)
ENCRYPTED = 0x1
LEAST_ZIP = 22  # bytes of an archive without members
METHODS = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})  # the others unpack without a bound


class UnpackingError(ValueError):
    """A file would unpack to far more than it is, or nobody can bound to how much."""


class Allowance:
    """How many bytes may still be unpacked from a file of ``n_packed`` bytes, all its parts together."""

    def __init__(self, n_packed: int) -> None:
        self.n_bytes = max(FREE_BYTES, n_packed * MOST_RATIO)
        self._n_left = self.n_bytes

    def spend(self, n: int) -> None:
        """Count ``n`` bytes before they are made; ``UnpackingError`` where there are too many."""
        if n > self._n_left:
            raise UnpackingError(
                f"unpacks to more than {self.n_bytes >> 20} MiB, over {MOST_RATIO} times its size; write it without "
                "compression if it is sound"
            )
        self._n_left -= n


def allowance_of(archive: zipfile.ZipFile) -> Allowance:
    """What may be unpacked from a zip archive by its real bytes; damage where none of them is a member."""
    assert archive.fp is not None
    n_bytes = archive.fp.seek(0, io.SEEK_END)
    if not archive.infolist() and n_bytes > LEAST_ZIP + len(archive.comment):
        raise zipfile.BadZipFile("holds bytes and names no member")
    return Allowance(n_bytes)


def check_member(info: zipfile.ZipInfo, allowance: Allowance) -> None:
    """Count the bytes that a member promises, beyond which ``zipfile`` reads none; refuse what it cannot bound."""
    if info.flag_bits & ENCRYPTED or info.compress_type not in METHODS:
        name = printable(info.filename, 80)
        raise UnpackingError(f"'{name}' is encrypted or compressed in an unusual way; write it plainly")
    allowance.spend(info.file_size)


def member_bytes(archive: zipfile.ZipFile, info: zipfile.ZipInfo, allowance: Allowance) -> bytes:
    """The content of a member, in pieces: asked for all at once, ``zipfile`` unpacks beyond what was promised."""
    check_member(info, allowance)
    content = io.BytesIO()
    with archive.open(info) as member:
        while piece := member.read(PIECE):
            content.write(piece)
    return content.getvalue()
