"""Checksums of what was brought here, held against what publishers state, or what the first download had."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.system.files import opened

PIECE = 1 << 20


@dataclass(frozen=True)
class Stated:
    """What is said of a file's content: ``git_blob`` is git's SHA-1 of it, ``recorded`` the SHA-256 of an earlier one.

    ``md5_prefix``: how the MD5 begins. Bytes are hexadecimal digits in lower case.
    """

    sha256: str | None = None
    md5_prefix: str | None = None
    git_blob: str | None = None
    recorded: str | None = None

    @property
    def is_published(self) -> bool:
        return bool(self.sha256 or self.md5_prefix or self.git_blob)

    @property
    def kinds(self) -> tuple[str, ...]:
        """What a file was held against, in words."""
        kinds = (
            (self.sha256, "published SHA-256"),
            (self.md5_prefix, f"published beginning of the MD5 ({self.md5_prefix})"),
            (self.git_blob, "published git blob"),
            (self.recorded, "SHA-256 of the first download"),
        )
        return tuple(words for value, words in kinds if value)


def sha256_of(path: Path) -> str:
    return checked(path, Stated())[0]


def checked(path: Path, stated: Stated) -> tuple[str, str | None]:
    """The SHA-256 of a file, and what of ``stated`` it contradicts, in words; None where it agrees with all."""
    sha256, md5 = hashlib.sha256(), hashlib.md5(usedforsecurity=False)
    blob = hashlib.sha1(b"blob %d\0" % path.stat().st_size, usedforsecurity=False)
    wanted = [sha256, *([md5] if stated.md5_prefix else []), *([blob] if stated.git_blob else [])]
    with opened(path) as stream:
        while piece := stream.read(PIECE):
            for digest in wanted:
                digest.update(piece)
    found = sha256.hexdigest()
    if stated.sha256 not in (None, found):
        return found, f"SHA-256 is {found}, published is {stated.sha256}"
    if stated.md5_prefix is not None and not md5.hexdigest().startswith(stated.md5_prefix):
        return found, f"MD5 is {md5.hexdigest()}, its published beginning {stated.md5_prefix}"
    if stated.git_blob not in (None, blob.hexdigest()):
        return found, f"git's SHA-1 is {blob.hexdigest()}, published is {stated.git_blob}"
    if stated.recorded not in (None, found):
        return found, f"SHA-256 is {found}, that of the first download was {stated.recorded}"
    return found, None
