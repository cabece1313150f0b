"""The door through which files are read, and that there is no other."""

from __future__ import annotations

import ast
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import ROOT

from su3d_bench.core.config import read_file
from su3d_bench.core.errors import ConfigError
from su3d_bench.core.system.files import file_bytes, file_text, opened, opened_text, parse_toml, regular

PACKAGES = ("su3d_bench", "baselines", "datasets", "reports")
# The door; what looks at /proc alone; what a resource of the package hands out.
OTHER_DOORS = {
    "su3d_bench/core/system/files.py", "su3d_bench/core/system/timing.py", "baselines/command/supervisor.py",
}  # fmt: skip
OWN_RESOURCE = 'files("su3d_bench.'
READS_A_PATH = {"load", "memmap", "open_memmap", "fromfile", "loadtxt", "genfromtxt", "imread", "ZipFile", "File"}


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("pipe", "a pipe stands where a file should be"),
        ("device", "a device stands where a file should be"),
        ("socket", "a socket stands where a file should be"),
        ("folder", "Is a directory"),
        ("nothing", "No such file or directory"),
    ],
)
def test_what_is_no_regular_file_is_refused_at_once(kind: str, reason: str, tmp_path: Path) -> None:
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


def test_a_file_behind_a_link_is_read_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes("ä\r\nb".encode())
    (tmp_path / "link").symlink_to("file")
    assert file_bytes(tmp_path / "link") == "ä\r\nb".encode()
    assert file_text(tmp_path / "link") == "ä\nb"
    with opened_text(tmp_path / "link", newline="") as stream:
        assert stream.read() == "ä\r\nb"
    assert regular(tmp_path / "link") == tmp_path / "link"


def test_nothing_opens_a_file_for_reading_but_by_the_door() -> None:
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    names = {path.resolve().relative_to(ROOT).as_posix() for path in paths} - OTHER_DOORS
    assert [place for name in sorted(names) for place in other_doors(name)] == []


def other_doors(name: str) -> Iterator[str]:
    """The lines of a module that open a file by a path themselves."""
    text = (ROOT / name).read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call):
            continue
        call, is_method = ast.unparse(node.func), isinstance(node.func, ast.Attribute)
        own, last = ast.unparse(node).replace("'", '"').startswith(OWN_RESOURCE), call.rpartition(".")[2]
        opens = last == "open" and any(mode in ast.unparse(node) for mode in ("'r", "'rb'", "encoding="))
        opens = opens and not call.startswith(("gzip", "os", "archive", "tarfile"))
        by_library = last in READS_A_PATH and call.startswith(("np.", "numpy.", "cv2.", "zipfile.", "h5py.", "torch."))
        first = ast.unparse(node.args[0]) if node.args else ""
        by_library = by_library and not first.startswith(("regular", "io.", "stream", "buffer", "spill", "self._file"))
        by_library = by_library and not any(isinstance(one, ast.Constant) and one.value == "w" for one in node.args)
        if (is_method and last in ("read_bytes", "read_text") and not node.args and not own) or opens or by_library:
            yield f"{name}:{node.lineno}: {ast.unparse(node)[:80]}"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (".".join("a" * 990) + " = 1", "a key of more than 64 parts"),
        ("\n[" + ".".join(["a"] * 65) + "]", "a key of more than 64 parts"),
        (" . ".join(['"a b"'] * 30_000) + " = 1", "a key of more than 64 parts"),
        ("x = {" + ".".join(["'a'"] * 20_000) + " = 1}", "a key of more than 64 parts"),
        ("x = " + "[" * 20_000, "cannot be read"),
        ("x = " + "1" * 5000, "(?i)exceeds the limit"),
    ],
)
def test_toml_deeper_or_longer_than_use_is_one_line_at_once(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(text)
    started = time.process_time()
    with pytest.raises(ConfigError, match=reason):
        read_file(path)
    assert time.process_time() - started < 3


def test_toml_of_use_is_read_whatever_its_dots() -> None:
    floats, words = ", ".join(["0.5"] * 500), "one. two, three.four " * 50
    assert parse_toml(f"x = [{floats}]\ny = '{words}'") == {"x": [0.5] * 500, "y": words}
    deep = ".".join("abcdefghijklmnopqrstuvwxyz")
    assert "a" in parse_toml(f"[{deep}]\n{deep} = 1")
