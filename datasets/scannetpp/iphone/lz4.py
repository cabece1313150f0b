"""LZ4 blocks, without the frame around them: the format of depth images in ScanNet++'s ``depth.bin``.

Source: doc/lz4_Block_format.md of lz4/lz4.
"""

from __future__ import annotations

LEAST_MATCH = 4


class NotLz4(Exception):
    """The content is no block of the length that was asked for."""


def unpacked_block(content: bytes, n_bytes: int) -> bytes:
    """The ``n_bytes`` that a block holds."""
    out, at = bytearray(), 0
    try:
        while True:
            token = content[at]
            n_literals, at = _length(content, token >> 4, at + 1)
            if len(out) + n_literals > n_bytes or at + n_literals > len(content):
                raise NotLz4
            out += content[at : at + n_literals]
            at += n_literals
            if at == len(content):
                break
            offset = content[at] | content[at + 1] << 8
            n_match, at = _length(content, token & 15, at + 2)
            n_match += LEAST_MATCH
            if not 0 < offset <= len(out) or len(out) + n_match > n_bytes:
                raise NotLz4
            start = len(out) - offset
            if offset >= n_match:
                out += out[start : start + n_match]
            else:  # the match reaches into what it writes: its pattern goes on
                pattern = bytes(out[start:])
                out += (pattern * (n_match // offset + 1))[:n_match]
    except IndexError:
        raise NotLz4 from None
    if len(out) != n_bytes:
        raise NotLz4
    return bytes(out)


def _length(content: bytes, first: int, at: int) -> tuple[int, int]:
    """A length, whose ``first`` four bits say 15 where bytes follow, and where what comes next is."""
    length = first
    if first == 15:
        while True:
            length += content[at]
            at += 1
            if content[at - 1] != 255:
                break
    return length, at
