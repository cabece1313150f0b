"""One file brought here from a server on loopback that behaves well, badly, or breaks off."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from file_server import FileServer, Served, file_server

from su3d_bench.core.errors import DataError, StoreError
from su3d_bench.core.files.locks import SHARED, beside, own_file
from su3d_bench.fetching.checksums import Stated
from su3d_bench.fetching.download import Patience, Wanted, bring

CONTENT = np.random.default_rng(0).bytes(900_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()
OTHER = np.random.default_rng(1).bytes(900_000)
ONCE = Patience(n_retries=0, pause_s=0.0, timeout_s=5.0)
NAME = "weights.pth"
OPEN_FACTS: dict[str, Any] = {"n_bytes": None, "stated": Stated()}


@pytest.fixture
def server() -> Iterator[FileServer]:
    with file_server() as running:
        yield running


def wanted(server: FileServer, **changes: Any) -> Wanted:
    known: dict[str, Any] = {"n_bytes": len(CONTENT), "stated": Stated(sha256=SHA256)}
    return Wanted(NAME, f"{server.url}/{NAME}", ("127.0.0.1",), **(known | changes))


def fetched(server: FileServer, place: Path, patience: Patience = ONCE, **changes: Any) -> str:
    return bring(wanted(server, **changes), place, lambda *words: None, patience)


def unfinished(place: Path) -> bytes:
    part = beside(place, SHARED)
    return part.read_bytes() if part.exists() else b""


def test_a_file_comes_whole_and_leaves_nothing_beside_it(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT)
    assert fetched(server, tmp_path / NAME) == SHA256
    assert (tmp_path / NAME).read_bytes() == CONTENT
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


def test_what_broke_off_is_taken_up_by_the_next_command_where_it_ended(server: FileServer, tmp_path: Path) -> None:
    place = tmp_path / NAME
    server.files[f"/{NAME}"] = Served(CONTENT, breaks_after=[500_000])
    with pytest.raises(DataError, match="500,000 bytes of it are here, and the same command goes on from there"):
        fetched(server, place)
    assert not place.exists() and unfinished(place) == CONTENT[:500_000]
    fetched(server, place)
    assert place.read_bytes() == CONTENT
    assert server.asked[-1].range == "bytes=500000-" and server.asked[-1].headers["if-range"]


def test_one_command_takes_it_up_as_often_as_something_new_comes(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT, breaks_after=[100_000, 100_000, 0, 100_000, 0, 100_000])
    fetched(server, tmp_path / NAME, Patience(n_retries=2, pause_s=0.0))
    assert (tmp_path / NAME).read_bytes() == CONTENT
    assert len(server.asked) == 7


def test_a_server_that_ignores_ranges_is_read_from_the_beginning(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT, breaks_after=[500_000], takes_ranges=False)
    fetched(server, tmp_path / NAME, Patience(n_retries=1, pause_s=0.0))
    assert (tmp_path / NAME).read_bytes() == CONTENT
    assert server.asked[1].range is not None


def test_a_file_that_changed_after_the_break_is_read_from_the_beginning(server: FileServer, tmp_path: Path) -> None:
    place = tmp_path / NAME
    server.files[f"/{NAME}"] = Served(OTHER, breaks_after=[500_000])
    with pytest.raises(DataError, match="goes on"):
        fetched(server, place, **OPEN_FACTS)
    server.files[f"/{NAME}"] = Served(CONTENT)
    assert fetched(server, place, **OPEN_FACTS) == SHA256
    assert place.read_bytes() == CONTENT


def test_a_file_that_grew_under_a_tag_that_stayed_is_read_from_the_beginning(
    server: FileServer, tmp_path: Path
) -> None:
    place = tmp_path / NAME
    server.files[f"/{NAME}"] = Served(OTHER[:800_000], etag='"one"', breaks_after=[500_000])
    with pytest.raises(DataError, match="goes on"):
        fetched(server, place, **OPEN_FACTS)
    server.files[f"/{NAME}"] = Served(CONTENT, etag='"one"')
    fetched(server, place, **OPEN_FACTS)
    assert place.read_bytes() == CONTENT


def test_parts_that_nothing_ties_together_are_never_joined(server: FileServer, tmp_path: Path) -> None:
    place = tmp_path / NAME
    server.files[f"/{NAME}"] = Served(OTHER, etag='W/"weak"', breaks_after=[500_000])
    with pytest.raises(DataError, match="goes on"):
        fetched(server, place, **OPEN_FACTS)
    server.files[f"/{NAME}"] = Served(CONTENT, etag='W/"weak"')
    fetched(server, place, **OPEN_FACTS)
    assert place.read_bytes() == CONTENT and server.asked[-1].range is None


def test_a_file_of_another_size_than_stated_is_refused(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT + b"more")
    with pytest.raises(DataError, match="has 900,004 bytes, stated are 900,000: it is another file by now"):
        fetched(server, tmp_path / NAME)
    assert not (tmp_path / NAME).exists()


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (Stated(sha256="0" * 64), "SHA-256 is [0-9a-f]{64}, published is 0{64}; it was thrown away"),
        (Stated(md5_prefix="4b8939"), "MD5 is [0-9a-f]{32}, its published beginning 4b8939"),
        (Stated(git_blob="1" * 40), "git's SHA-1 is [0-9a-f]{40}, published is 1{40}"),
        (Stated(recorded="2" * 64), "that of the first download was 2{64}"),
    ],
)
def test_a_wrong_checksum_throws_the_file_away(server: FileServer, tmp_path: Path, stated: Stated, said: str) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT)
    with pytest.raises(DataError, match=said):
        fetched(server, tmp_path / NAME, stated=stated)
    assert not list(tmp_path.iterdir())


def test_the_beginning_of_an_md5_is_held_against_the_whole(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT)
    fetched(server, tmp_path / NAME, stated=Stated(md5_prefix=hashlib.md5(CONTENT).hexdigest()[:6]))
    assert (tmp_path / NAME).is_file()


def test_a_redirection_goes_to_named_hosts_alone(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(b"", redirect=f"{server.other_host}/store")
    server.files["/store"] = Served(CONTENT)
    with pytest.raises(DataError, match=r"is redirected, which is refused: host 'localhost' is not named for it"):
        fetched(server, tmp_path / NAME)
    assert server.paths() == [f"/{NAME}"]
    named = Wanted(NAME, f"{server.url}/{NAME}", ("127.0.0.1", "localhost"), len(CONTENT), Stated(sha256=SHA256))
    bring(named, tmp_path / NAME, lambda *words: None, ONCE)
    assert (tmp_path / NAME).read_bytes() == CONTENT


def test_a_redirection_to_an_unencrypted_address_is_refused(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(b"", redirect="http://example.org/weights.pth")
    with pytest.raises(DataError, match=r"is redirected, which is refused: .* is not encrypted"):
        bring(Wanted(NAME, f"{server.url}/{NAME}", ("example.org",)), tmp_path / NAME, lambda *words: None, ONCE)


def test_a_ring_of_redirections_ends(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(b"", redirect=f"{server.url}/{NAME}")
    with pytest.raises(DataError):
        fetched(server, tmp_path / NAME)


def test_without_any_word_of_its_size_nothing_is_read(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT, states_size=False)
    with pytest.raises(DataError, match="nobody says how large it is"):
        fetched(server, tmp_path / NAME, n_bytes=None)
    fetched(server, tmp_path / NAME)
    assert (tmp_path / NAME).read_bytes() == CONTENT


def test_a_server_that_never_ends_is_left_at_the_stated_size(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT * 3, states_size=False)
    with pytest.raises(DataError, match="sends more than the 900,000 bytes that it promised"):
        fetched(server, tmp_path / NAME)
    assert not (tmp_path / NAME).exists()


@pytest.mark.parametrize(
    ("served", "said"),
    [
        (Served(b"", status=404), r"status 404 .*: there is no such file any more; name where it lies now"),
        (Served(b"", status=401), r"status 401 .*: it asks who you are"),
        (Served(b"", status=503), r"status 503: .*nothing of it is here, and the same command goes on"),
        (Served(CONTENT, headers={"Content-Encoding": "gzip"}), "comes packed, which was not asked for"),
    ],
)
def test_what_a_server_refuses_is_one_line(server: FileServer, tmp_path: Path, served: Served, said: str) -> None:
    server.files[f"/{NAME}"] = served
    with pytest.raises(DataError, match=said) as raised:
        fetched(server, tmp_path / NAME)
    assert "\n" not in str(raised.value)


def test_a_server_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    gone = Wanted(NAME, "http://127.0.0.1:9/weights.pth", ("127.0.0.1",), 5)
    with pytest.raises(DataError, match=r"127.0.0.1:9/weights.pth: the connection failed: .*; nothing of it is here"):
        bring(gone, tmp_path / NAME, lambda *words: None, ONCE)


def test_two_processes_do_not_bring_the_same_file(server: FileServer, tmp_path: Path) -> None:
    server.files[f"/{NAME}"] = Served(CONTENT)
    held = own_file(beside(tmp_path / NAME, SHARED), os.O_RDWR | os.O_CREAT)
    assert held is not None
    with pytest.raises(StoreError, match="another process is bringing it"):
        fetched(server, tmp_path / NAME)
    os.close(held)
    fetched(server, tmp_path / NAME)


@pytest.mark.parametrize("note", [b"", b"[]", b"\xff", b'{"address": 1}', json.dumps({"etag": "\n"}).encode()])
def test_a_damaged_note_begins_the_file_anew(server: FileServer, tmp_path: Path, note: bytes) -> None:
    place = tmp_path / NAME
    beside(place, SHARED).write_bytes(OTHER[:1000])
    place.with_name(f".{NAME}.state.json").write_bytes(note)
    server.files[f"/{NAME}"] = Served(CONTENT)
    fetched(server, place, n_bytes=None, stated=Stated())
    assert place.read_bytes() == CONTENT


FULL_DISK = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
from pathlib import Path
from su3d_bench.core.errors import StoreError
from su3d_bench.fetching.download import Wanted, bring
try:
    bring(Wanted("weights.pth", sys.argv[1], ("127.0.0.1",)), Path(sys.argv[2]), lambda *words: None)
except StoreError as error:
    print(error)
"""


def test_a_disk_that_takes_no_more_keeps_what_came_and_the_next_command_goes_on(
    server: FileServer, tmp_path: Path
) -> None:
    place = tmp_path / NAME
    server.files[f"/{NAME}"] = Served(CONTENT)
    words = [sys.executable, "-c", FULL_DISK, f"{server.url}/{NAME}", str(place)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=os.environ)
    assert done.stdout.startswith(f"cannot write {place}: the file grows beyond what this disk"), done.stderr
    assert not place.exists() and 0 < len(unfinished(place)) <= 300_000
    assert fetched(server, place) == SHA256
    assert server.asked[-1].range is not None
