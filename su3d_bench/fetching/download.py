"""Download one file atomically: resumable, limited in size, verified against its checksums.

An incomplete download is next to its place as ``NAME.part``. No library does this: pooch 1.9 restarts an interrupted
download, and huggingface_hub resumes only files of its own hub and does not check their SHA-256.
"""

from __future__ import annotations

import hashlib
import http.client
import os
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from su3d_bench.core.errors import ConfigError, DataError, printable
from su3d_bench.core.files.atomic import write_error, write_text
from su3d_bench.core.system.devices import require
from su3d_bench.core.system.files import file_text, opened
from su3d_bench.fetching.sources import MAX_BYTES, Source, check_address

PIECE = 1 << 20
MAX_REDIRECTS = 5
STATUS_TO_RETRY = (408, 425, 429)
N_RETRIES = 3  # of an interrupted download, counted from 0 again after any progress
FIRST_PAUSE_S = 1.0  # before the first of them
TIMEOUT_S = 30.0  # without a byte
Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class Expected:
    """Known checksums of a file: ``git_blob`` is git's SHA-1, ``recorded`` the SHA-256 of an earlier download.

    ``md5_prefix``: the beginning of the MD5. All are hexadecimal digits in lower case.
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
        """The names of the known checksums."""
        kinds = (
            (self.sha256, "published SHA-256"),
            (self.md5_prefix, f"published beginning of the MD5 ({self.md5_prefix})"),
            (self.git_blob, "published git blob"),
            (self.recorded, "SHA-256 of the first download"),
        )
        return tuple(words for value, words in kinds if value)


def checked(path: Path, stated: Expected) -> tuple[str, str | None]:
    """The SHA-256 of a file, and a message on the first mismatch with ``stated``; None if all agree."""
    sha256, md5 = hashlib.sha256(), hashlib.md5(usedforsecurity=False)
    blob = hashlib.sha1(b"blob %d\0" % path.stat().st_size, usedforsecurity=False)
    wanted = [sha256, *([md5] if stated.md5_prefix else []), *([blob] if stated.git_blob else [])]
    with opened(path) as stream:
        while piece := stream.read(PIECE):
            for digest in wanted:
                digest.update(piece)
    found, git_blob = sha256.hexdigest(), blob.hexdigest()
    beginning = md5.hexdigest()[: len(stated.md5_prefix or "")]
    facts = (
        ("SHA-256", found, "published:", stated.sha256),
        ("MD5 begins with", beginning, "published:", stated.md5_prefix),
        ("git's SHA-1", git_blob, "published:", stated.git_blob),
        ("SHA-256", found, "first download:", stated.recorded),
    )
    wrong = (f"{name} {value}, {origin} {fact}" for name, value, origin, fact in facts if fact not in (None, value))
    return found, next(wrong, None)


@dataclass(frozen=True)
class Download:
    """A remote file: only from ``hosts``; ``n_bytes`` and ``stated`` if published."""

    name: str
    address: str
    hosts: tuple[str, ...]
    n_bytes: int | None = None
    stated: Expected = field(default_factory=Expected)


class _Broken(Exception):
    """The connection failed or was interrupted; a retry may succeed."""


def part_of(place: Path) -> Path:
    """The path of the incomplete download for ``place``."""
    return place.with_name(f"{place.name}.part")


def size_of(path: Path) -> int:
    """The size of a file in bytes; 0 if it does not exist."""
    return path.stat().st_size if path.is_file() else 0


def download_file(wanted: Download, place: Path, watch: Progress, n_retries: int = N_RETRIES) -> str:
    """Download the file to the free path ``place`` and return its SHA-256; ``watch`` is called with the progress.

    Raises ``StoreError`` for a disk error, and ``DataError`` if the server does not return the stated file; a partial
    download is kept, unless it is known to be wrong. One process at a time.
    """
    part, n_idle = part_of(place), 0
    while True:
        n_before = size_of(part)
        try:
            _receive(wanted, part, watch)
            break
        except _Broken as error:
            n_held = size_of(part)
            n_idle = 1 if n_held > n_before else n_idle + 1
            if n_idle > n_retries:
                come = f"{n_held:,} bytes were downloaded" if n_held else "nothing was downloaded"
                raise DataError(f"{wanted.address}: {printable(str(error), 200)}; {come}; rerun to resume") from None
            time.sleep(min(FIRST_PAUSE_S * 2 ** (n_idle - 1), 60.0))
    sha256, wrong = checked(part, wanted.stated)
    if wrong is None:
        os.replace(part, place)
    part.unlink(missing_ok=True)
    _state_of(part).unlink(missing_ok=True)
    if wrong is not None:
        raise DataError(
            f"{place.name} from {wanted.address}: {wrong}; it was deleted: run the same command again, or give a "
            "mirror with --mirror"
        )
    return sha256


def _state_of(part: Path) -> Path:
    """The file with the address and entity tag of the partial download ``part``."""
    return part.with_name(f"{part.name}.state")


def _receive(wanted: Download, part: Path, watch: Progress) -> None:
    """Append the missing rest of the file to ``part``.

    Without a published checksum, a download is only resumed if the entity tag or modification time is unchanged
    (RFC 9110, 13.1.5); otherwise the file is read from its beginning.
    """
    n_held, state = size_of(part), _state_of(part)
    if n_held and n_held == wanted.n_bytes:
        return
    address, _, tag = file_text(state).partition("\n") if state.is_file() else ("", "", "")
    headers = {"Accept-Encoding": "identity", "User-Agent": "su3d-bench"}
    is_known = address == wanted.address and bool(tag)
    if n_held and (is_known or wanted.stated.is_published):
        headers |= {"Range": f"bytes={n_held}-"} | ({"If-Range": tag} if is_known else {})
    try:
        response = _opened(wanted, headers)
    except urllib.error.HTTPError as error:
        if error.code != 416:
            raise _refusal(wanted.address, error) from None
        if (error.headers.get("Content-Range") or "").endswith(f"/{n_held}"):
            return
        part.unlink()
        raise _Broken("the file on the server has changed") from None
    with response:
        is_rest = response.status == 206 and response.headers.get("Content-Range", "").startswith(f"bytes {n_held}-")
        start = n_held if is_rest else 0
        n_bytes = _size_stated(wanted, response, start)
        tag = response.headers.get("ETag") or ""
        tag = tag if tag.startswith('"') else response.headers.get("Last-Modified") or ""
        write_text(state, f"{wanted.address}\n{tag.strip()}")
        _append(response, part, start, n_bytes, lambda n: watch(wanted.name, n, n_bytes))


def _append(response: Any, part: Path, start: int, n_bytes: int, watch: Callable[[int], None]) -> None:
    """Write the response into ``part`` from byte ``start`` up to ``n_bytes``."""
    n_held = start
    try:
        stream = part.open("ab")
    except OSError as error:
        raise write_error(part, error) from error
    with stream:
        stream.truncate(start)
        while n_held < n_bytes:
            watch(n_held)
            try:
                piece = response.read(min(PIECE, n_bytes - n_held))
            except (OSError, http.client.HTTPException, ValueError) as error:
                raise _Broken(printable(str(error), 120) or type(error).__name__) from None
            if not piece:
                raise _Broken("the connection was closed")
            try:
                stream.write(piece)
                stream.flush()
            except OSError as error:
                raise write_error(part, error) from error
            n_held += len(piece)
        os.fsync(stream.fileno())
    watch(n_held)


def _size_stated(wanted: Download, response: Any, start: int) -> int:
    """The size of the whole file, for a response that starts at byte ``start``."""
    if response.status not in (200, 206) or (response.status == 206) != (start > 0):
        raise DataError(f"{wanted.address}: returns another part than requested; give a mirror with --mirror")
    if (response.headers.get("Content-Encoding") or "identity").lower() != "identity":
        raise DataError(f"{wanted.address}: is sent compressed, which was not requested; give a mirror with --mirror")
    length = response.headers.get("Content-Length") or ""
    size = start + int(length) if length.isdecimal() and len(length) < 20 else wanted.n_bytes
    if size is None:
        raise DataError(f"{wanted.address}: its size is unknown; give a mirror with --mirror")
    if wanted.n_bytes not in (None, size):
        raise DataError(
            f"{wanted.address}: has {size:,} bytes, expected {wanted.n_bytes:,}: the file has changed; give a mirror "
            "with --mirror, or its new facts with --sources"
        )
    if not 0 < size <= MAX_BYTES:
        raise DataError(f"{wanted.address}: has {size:,} bytes; expected 1 to {MAX_BYTES:,}")
    return size


class _NamedHostsOnly(urllib.request.HTTPRedirectHandler):
    max_redirections = MAX_REDIRECTS

    def __init__(self, hosts: Sequence[str]) -> None:
        self._hosts = hosts

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        try:
            check_address(newurl, self._hosts)
        except ValueError as error:
            raise DataError(f"{req.full_url}: redirect refused: {error}") from error
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _opened(wanted: Download, headers: dict[str, str]) -> Any:
    opener = urllib.request.build_opener(_NamedHostsOnly(wanted.hosts))
    try:
        return opener.open(urllib.request.Request(wanted.address, headers=headers), timeout=TIMEOUT_S)
    except urllib.error.HTTPError:
        raise
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        raise _Broken(f"the connection failed: {printable(str(reason), 120) or type(error).__name__}") from None


def _refusal(address: str, error: urllib.error.HTTPError) -> Exception:
    with error:
        reason = f"status {error.code} ({printable(str(error.reason), 80)})"
    if error.code in STATUS_TO_RETRY or error.code >= 500:
        return _Broken(reason)
    return DataError(f"{address}: {reason}: access is restricted or the file has moved; give a mirror with --mirror")


HUB = "https://huggingface.co"


def hub_files(source: Source) -> list[Download]:
    """The files of ``source`` at the current revision of ``main``, the weights last.

    Raises ``ModelMissing`` without ``huggingface_hub``, ``ConfigError`` if the user has set it offline, and
    ``DataError`` if the hub does not answer or lacks a file.
    """
    assert source.hub is not None
    os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")
    hub = require("huggingface_hub", f"fetch {source.name}")
    constants = require("huggingface_hub.constants", f"fetch {source.name}")
    endpoint = _endpoint(source)
    hosts = source.hosts if endpoint == HUB else (*source.hosts, urlsplit(endpoint).hostname or "")
    try:
        check_address(endpoint)
    except ValueError as error:
        raise ConfigError(f"HF_ENDPOINT: {error}") from error
    if constants.HF_HUB_OFFLINE:
        raise ConfigError(f"fetch {source.name}: HF_HUB_OFFLINE is set; unset it to fetch")
    repository = source.hub.repository
    info = _info(hub, endpoint, repository)
    stated = {file.rfilename: file for file in info.siblings or ()}
    names = _names(source, stated)
    known = {weights.name: weights for weights in source.hub.weights}
    wanted = []
    for name in names:
        file, ours = stated[name], known.get(name)
        sha256 = None if file.lfs is None else str(file.lfs.sha256)
        if ours is not None and None not in (ours.sha256, sha256) and ours.sha256 != sha256:
            raise DataError(
                f"{endpoint}/{repository}: states SHA-256 {printable(str(sha256), 80)} for {name}, expected "
                f"{ours.sha256}: the file has changed; if that is intended, give its new facts with --sources"
            )
        n_bytes = file.size if ours is None or file.size is not None else ours.n_bytes
        checksums = Expected(sha256=sha256, git_blob=None if sha256 else file.blob_id)
        address = hub.hf_hub_url(repository, name, revision=info.sha, endpoint=endpoint)
        wanted.append(Download(name, address, hosts, n_bytes, checksums))
    return wanted


def _info(hub: Any, endpoint: str, repository: str) -> Any:
    try:
        info = hub.HfApi(endpoint=endpoint, token=False).model_info(repository, files_metadata=True, timeout=TIMEOUT_S)
    except Exception as error:  # HTTP, JSON and missing-field errors: the library has no common class
        if isinstance(error, MemoryError):
            raise
        reason = printable(str(error).split("\n")[0], 200) or type(error).__name__
        raise DataError(f"{endpoint}/{repository}: the hub does not list its files: {reason}") from error
    if not isinstance(info.sha, str) or not info.sha.isalnum():
        raise DataError(f"{endpoint}/{repository}: the hub states no revision; give another hub with --mirror")
    return info


def _names(source: Source, stated: Any) -> list[str]:
    """The files to download: for each requirement the first alternative with all its files, weights last."""
    assert source.hub is not None
    chosen: list[str] = []
    for requirement in source.hub.files:
        parts = [[name.strip() for name in part.split("+")] for part in requirement.split("|")]
        there = next((names for names in parts if all(name in stated for name in names)), None)
        if there is None:
            origin = requirement.replace(" | ", " or ").replace(" + ", " and ")
            raise DataError(f"hub repository {source.hub.repository}: has no {origin}; give another hub with --mirror")
        chosen += there
    settings = [*chosen[1:], *(name for name in source.hub.optional if name in stated)]
    return [*dict.fromkeys(name for name in settings if name != chosen[0]), chosen[0]]


def hub_addresses(source: Source) -> list[str]:
    """The addresses of the files, assuming the first alternatives, without contacting the hub."""
    assert source.hub is not None
    first = [name.strip() for requirement in source.hub.files for name in requirement.split("|")[0].split("+")]
    names = dict.fromkeys((*first, *source.hub.optional))
    return [f"{_endpoint(source)}/{source.hub.repository}/resolve/main/{name}" for name in names]


def _endpoint(source: Source) -> str:
    return source.endpoint or os.environ.get("HF_ENDPOINT", "").rstrip("/") or HUB
