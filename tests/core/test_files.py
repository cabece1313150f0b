"""Opening files for reading."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

import pytest

from su3d_bench.core.config import read_file
from su3d_bench.core.errors import ConfigError
from su3d_bench.core.system.files import file_bytes, file_text, opened, opened_text, parse_toml, regular


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("pipe", "a pipe is in the place of a file"),
        ("device", "a device is in the place of a file"),
        ("socket", "a socket is in the place of a file"),
        ("folder", "Is a directory"),
        ("nothing", "No such file or directory"),
    ],
)
def test_anything_but_a_regular_file_is_rejected_at_once(kind: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "x"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        socket.socket(socket.AF_UNIX).bind(os.path.relpath(path))
    elif kind == "folder":
        path.mkdir()
    for read in (regular, opened, opened_text, file_bytes, file_text):
        with pytest.raises(OSError) as caught:
            read(path)
        assert caught.value.strerror == reason


def test_file_behind_a_link_is_read_unchanged(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes("ä\r\nb".encode())
    (tmp_path / "link").symlink_to("file")
    assert file_bytes(tmp_path / "link") == "ä\r\nb".encode()
    assert file_text(tmp_path / "link") == "ä\nb"
    with opened_text(tmp_path / "link", newline="") as stream:
        assert stream.read() == "ä\r\nb"
    assert regular(tmp_path / "link") == tmp_path / "link"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (".".join("a" * 990) + " = 1", "key has more than 64 parts"),
        ("\n[" + ".".join(["a"] * 65) + "]", "key has more than 64 parts"),
        (" . ".join(['"a b"'] * 30_000) + " = 1", "key has more than 64 parts"),
        ("x = {" + ".".join(["'a'"] * 20_000) + " = 1}", "key has more than 64 parts"),
        ("x = " + "[" * 20_000, "cannot be read"),
        ("x = " + "1" * 5000, "(?i)exceeds the limit"),
    ],
)
def test_excessive_toml_is_rejected_quickly_in_one_line(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(text)
    started = time.process_time()
    with pytest.raises(ConfigError, match=reason):
        read_file(path)
    assert time.process_time() - started < 3


def test_normal_toml_with_many_dots_is_read() -> None:
    floats, words = ", ".join(["0.5"] * 500), "one. two, three.four " * 50
    assert parse_toml(f"x = [{floats}]\ny = '{words}'") == {"x": [0.5] * 500, "y": words}
    deep = ".".join("abcdefghijklmnopqrstuvwxyz")
    assert "a" in parse_toml(f"[{deep}]\n{deep} = 1")
