"""A key of the content of a Replica scene that does not read half a gigabyte of depth to see a changed frame."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import DataError
from su3d_bench.formats.images import PNG_SIGNATURE

PNG_HEAD_BYTES = 64  # signature, and the chunk with the size
PNG_TAIL_BYTES = 1024  # the end of the pixels, and what little writers put behind it


def digest_of(parts: Iterable[str], files: Sequence[Path], images: Sequence[Path], where: str) -> str:
    """A key of ``parts``, the content of ``files``, and the names, sizes and content of ``images``."""
    total = hashlib.sha256("\n".join(parts).encode())
    try:
        for path in files:
            total.update(f"{path.name} {digest_file(path)}\n".encode())
        for path in images:
            total.update(f"{path.name} {image_key(path)}\n".encode())
    except OSError as error:
        raise DataError(f"{where}: {error.filename} cannot be read: {error.strerror}") from error
    return total.hexdigest()


def image_key(path: Path) -> str:
    """A key of an image: of every byte, except of a PNG, whose own checksum of all pixels stands near its end.

    The pixels of a PNG are a zlib stream, which ends with the Adler-32 of the uncompressed rows. What this cannot see:
    other pixels of the same checksum (one in 2**32) and size, and damage amid a PNG, which the reader of frames
    refuses because the checksum of the chunk fails.
    """
    with path.open("rb") as file:
        head = file.read(PNG_HEAD_BYTES)
        key = hashlib.sha256(head)
        size = file.seek(0, 2)
        file.seek(max(len(head), size - PNG_TAIL_BYTES) if head.startswith(PNG_SIGNATURE) else len(head))
        key.update(file.read())
    return f"{size} {key.hexdigest()}"
