"""Downloads of one file from a loopback server that behaves well, badly, or interrupts the transfer."""

from __future__ import annotations

import hashlib
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from file_server import FileServer, Served

from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.fetching import download
from su3d_bench.fetching.download import Download, Expected, download_file, part_of

CONTENT = np.random.default_rng(0).bytes(900_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()
OTHER = np.random.default_rng(1).bytes(900_000)
NAME = "weights.pth"
UNSTATED: dict[str, Any] = {"n_bytes": None, "stated": Expected()}


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    monkeypatch.setattr(download, "FIRST_PAUSE_S", 0.0)
    monkeypatch.setattr(download, "TIMEOUT_S", 5.0)
    with FileServer() as running:
        yield running


def fetched(server: FileServer, place: Path, n_retries: int = 0, **changes: Any) -> str:
    known: dict[str, Any] = {"n_bytes": len(CONTENT), "stated": Expected(sha256=SHA256)}
    wanted = Download(NAME, f"{server.url}/{NAME}", changes.pop("hosts", ("127.0.0.1",)), **(known | changes))
    return download_file(wanted, place, lambda *words: None, n_retries)


def test_interrupted_download_is_resumed_and_leaves_no_temporary_files(server: FileServer, tmp_path: Path) -> None:
    place = tmp_path / NAME
    server.files[f"/{NAME}"] = Served(CONTENT, breaks_after=[500_000])
    with pytest.raises(DataError, match="500,000 bytes were downloaded; rerun to resume"):
        fetched(server, place, **UNSTATED)
    assert not place.exists() and part_of(place).read_bytes() == CONTENT[:500_000]
    assert fetched(server, place, **UNSTATED) == SHA256
    assert place.read_bytes() == CONTENT
    assert server.asked[-1].range == "bytes=500000-" and server.asked[-1].headers["if-range"]
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


def test_retry_count_restarts_after_progress(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT, breaks_after=[100_000, 100_000, 0, 100_000, 0, 100_000])
    fetched(server, tmp_path / NAME, 2)
    assert (tmp_path / NAME).read_bytes() == CONTENT and len(server.asked) == 7


@pytest.mark.parametrize(
    "first",
    [
        Served(CONTENT, breaks_after=[500_000], takes_ranges=False),
        Served(OTHER, breaks_after=[500_000]),  # the file changes after the break
        Served(OTHER, etag='W/"weak"', breaks_after=[500_000]),  # a change cannot be detected
        Served(CONTENT + b"more", etag='"one"', breaks_after=[900_002]),  # the partial file is longer than the file
    ],
)
def test_parts_of_two_files_are_never_joined(server: FileServer, tmp_path: Path, first: Served) -> None:
    server.files[f"/{NAME}"] = first
    with pytest.raises(DataError):
        fetched(server, tmp_path / NAME, **UNSTATED)
    server.files[f"/{NAME}"] = Served(CONTENT, etag=first.etag, takes_ranges=first.takes_ranges)
    assert fetched(server, tmp_path / NAME, 1, **UNSTATED) == SHA256


@pytest.mark.parametrize(
    "stated",
    [
        Expected(sha256="0" * 64),
        Expected(md5_prefix="4b8939"),
        Expected(git_blob="1" * 40),
        Expected(recorded="2" * 64),
    ],
)
def test_file_with_a_wrong_checksum_is_deleted(server: FileServer, tmp_path: Path, stated: Expected) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT)
    with pytest.raises(DataError, match="it was deleted"):
        fetched(server, tmp_path / NAME, stated=stated)
    assert not list(tmp_path.iterdir())


def test_md5_prefix_is_compared_with_the_full_md5(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT)
    fetched(server, tmp_path / NAME, stated=Expected(md5_prefix=hashlib.md5(CONTENT).hexdigest()[:6]))
    assert (tmp_path / NAME).is_file()


def test_redirects_are_followed_only_to_allowed_hosts(server: FileServer, tmp_path: Path) -> None:
    server.files["/store"] = Served(CONTENT)
    server.files[f"/{NAME}"] = Served(b"", redirect=f"{server.other_host}/store")
    with pytest.raises(DataError, match="host 'localhost' is not allowed for it"):
        fetched(server, tmp_path / NAME)
    assert [asked.path for asked in server.asked] == [f"/{NAME}"]
    fetched(server, tmp_path / NAME, hosts=("127.0.0.1", "localhost"))
    assert (tmp_path / NAME).read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("served", "text"),
    [
        (Served(b"", status=404), "status 404"),
        (Served(b"", status=503), "status 503.*nothing was downloaded"),
        (Served(CONTENT, headers={"Content-Encoding": "gzip"}), "is sent compressed"),
        (Served(CONTENT, states_size=False), "its size is unknown"),
        (Served(b"", redirect="http://example.org/weights.pth"), "is not encrypted"),
        (Served(b"", redirect=f"/{NAME}"), "redirect"),
    ],
)
def test_each_server_refusal_is_a_one_line_error(server: FileServer, tmp_path: Path, served: Served, text: str) -> None:
    server.files[f"/{NAME}"] = served
    with pytest.raises(DataError, match=text) as raised:
        fetched(server, tmp_path / NAME, n_bytes=None, hosts=("127.0.0.1", "example.org"))
    assert "\n" not in str(raised.value) and not list(tmp_path.iterdir())


def test_download_stops_at_the_stated_size(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT + b"more")
    with pytest.raises(DataError, match="has 900,004 bytes, expected 900,000"):
        fetched(server, tmp_path / NAME)
    server.files[f"/{NAME}"] = Served(CONTENT * 3, states_size=False)
    fetched(server, tmp_path / NAME)
    assert (tmp_path / NAME).read_bytes() == CONTENT


def test_download_interrupted_by_a_full_disk_is_resumed(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, before[1]))
    try:
        with pytest.raises(StoreError, match="cannot write"):
            fetched(server, tmp_path / NAME)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert 0 < part_of(tmp_path / NAME).stat().st_size <= 300_000
    assert fetched(server, tmp_path / NAME) == SHA256 and server.asked[-1].range is not None
