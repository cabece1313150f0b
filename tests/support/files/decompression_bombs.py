"""Small files that expand when read: archives, streams and images that state or contain far more than their size.

Nothing large is created: the compressed form of a mebibyte of zeros is repeated.
"""

from __future__ import annotations

import functools
import struct
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

MIB = 1 << 20


@dataclass(frozen=True)
class Member:
    """A member of an archive: its compressed bytes, the compression method, and its size as stated by the archive."""

    name: str
    packed: bytes
    n_promised: int
    method: int = zipfile.ZIP_DEFLATED
    checksum: int = 0


@functools.cache
def _mebibyte_of(byte: int) -> bytes:
    """A mebibyte of one byte as deflate blocks that may be repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(bytes([byte]) * MIB) + packer.flush(zlib.Z_FULL_FLUSH)


def deflated(first: bytes, n_mebibytes: int, byte: int = 0, last: bytes = b"") -> bytes:
    """Raw deflate of ``first``, that many mebibytes of one byte, and ``last``."""
    head, tail = (zlib.compressobj(9, zlib.DEFLATED, -15) for _ in range(2))
    begin = head.compress(first) + head.flush(zlib.Z_FULL_FLUSH)
    return begin + _mebibyte_of(byte) * n_mebibytes + tail.compress(last) + tail.flush()


def whole_member(name: str, content: bytes) -> Member:
    """A correctly described member."""
    return Member(name, deflated(content, 0), len(content), checksum=zlib.crc32(content))


def zip_of(members: Sequence[Member]) -> bytes:
    """A zip archive of members with their stated sizes."""
    out, directory = bytearray(), bytearray()
    for one in members:
        name, at = one.name.encode(), len(out)
        sizes = struct.pack("<HHHLLLHH", one.method, 0, 33, one.checksum, len(one.packed), one.n_promised, len(name), 0)
        out += b"PK\x03\x04" + struct.pack("<HH", 20, 0) + sizes + name + one.packed
        directory += b"PK\x01\x02" + struct.pack("<HHH", 20, 20, 0) + sizes + struct.pack("<HHHLL", 0, 0, 0, 0, at)
        directory += name
    end = struct.pack("<HHHHLLH", 0, 0, len(members), len(members), len(directory), len(out), 0)
    return bytes(out + directory + b"PK\x05\x06" + end)


def npy_head(shape: tuple[int, ...], code: str = "|b1") -> bytes:
    """The header before the values of a .npy file."""
    text = f"{{'descr': '{code}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def npz_of_zeros(name: str, n_mebibytes: int) -> bytes:
    """An .npz file of one matrix of that many mebibytes of False."""
    head = npy_head((n_mebibytes << 10, 1024))
    packed = deflated(head, n_mebibytes)
    return zip_of([Member(f"{name}.npy", packed, len(head) + n_mebibytes * MIB)])


def gzip_of(first: bytes, n_mebibytes: int, byte: int = 0, last: bytes = b"") -> bytes:
    """A gzip stream of ``first``, that many mebibytes of one byte, and ``last``; its checksum is 0."""
    return b"\x1f\x8b\x08" + bytes(6) + b"\xff" + deflated(first, n_mebibytes, byte, last) + bytes(8)


def png_of_zeros(width: int, height: int, bits: int = 8, colour_type: int = 2) -> bytes:
    """A black PNG."""
    n_bytes = height * (1 + width * bits // 8 * (3 if colour_type == 2 else 1))
    packer = zlib.compressobj(9)
    pixels = b"".join([*(packer.compress(bytes(MIB)) for _ in range(-(-n_bytes // MIB))), packer.flush()])
    header = struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(map(_chunk, (b"IHDR" + header, b"IDAT" + pixels, b"IEND")))


def _chunk(content: bytes) -> bytes:
    return struct.pack(">I", len(content) - 4) + content + struct.pack(">I", zlib.crc32(content))


def jpeg_of_scans(width: int, height: int, n_scans: int) -> bytes:
    """A progressive JPEG, grey, in which every scan repeats that it is empty."""
    tables = b"\xff\xdb\x00\x43\x00" + bytes([1]) * 64
    frame = b"\xff\xc2" + struct.pack(">HBHHBBBB", 11, 8, height, width, 1, 1, 0x11, 0)
    codes = b"\xff\xc4\x00\x14\x10\x01" + bytes(15) + b"\xe0"  # one code of one bit: 32,767 blocks end
    n_blocks = -(-width // 8) * -(-height // 8)
    n_bytes = -(-(n_blocks // (1 << 14) + 1) * 15 // 8)
    scan = b"\xff\xda" + struct.pack(">HBBBBBB", 8, 1, 1, 0x00, 1, 63, 0x00) + bytes(n_bytes)
    return b"\xff\xd8" + tables + frame + codes + scan * n_scans + b"\xff\xd9"
