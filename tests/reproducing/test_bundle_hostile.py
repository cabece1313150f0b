"""Untrusted archives: names cannot leave the folder, sizes are checked, invalid bundles are one-line errors."""

from __future__ import annotations

import json
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_bytes
from su3d_bench.core.errors import StoreError
from su3d_bench.reproducing.bundle import unpack


def written(place: Path, members: dict[str, bytes], **changed: object) -> Path:
    """An archive whose manifest is correct except for what is ``changed``."""
    entries = {name: {"n_bytes": len(content), "sha256": digest_bytes(content)} for name, content in members.items()}
    manifest = {"schema": 1, "program": "su3d-bench", "recipe": "mine", "runs": [], "files": entries, **changed}
    with zipfile.ZipFile(place, "w") as archive:
        archive.writestr("manifest.json", json.dumps(manifest))
        for name, content in members.items():
            archive.writestr(name, content)
    return place


@pytest.mark.parametrize("name", ["../evil", "/evil", "a//b", "C:evil", "a\\..\\b"])
def test_names_that_lead_out_of_the_folder_are_rejected(tmp_path: Path, name: str) -> None:
    into = tmp_path / "into"
    with pytest.raises(StoreError, match="is not a plain file below its folder; not unpacked"):
        unpack(written(tmp_path / "b.zip", {name: b"x"}), into)
    assert not into.exists() and not (tmp_path / "evil").exists()


def test_links_are_not_unpacked(tmp_path: Path) -> None:
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        archive.writestr("manifest.json", "{}")
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(StoreError, match="'link' is not a plain file"):
        unpack(tmp_path / "b.zip", tmp_path / "into")


def test_decompression_bombs_are_rejected(tmp_path: Path) -> None:
    zeros = bytes(200 << 20)
    entries = {"runs/a/run.json": {"n_bytes": len(zeros), "sha256": digest_bytes(zeros)}}
    manifest = {"schema": 1, "program": "", "recipe": "", "runs": ["runs/a"], "files": entries}
    with zipfile.ZipFile(tmp_path / "b.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("manifest.json", json.dumps(manifest))
        archive.writestr("runs/a/run.json", zeros)
    with pytest.raises(StoreError, match="unpacks to more than 128 MiB"):
        unpack(tmp_path / "b.zip", tmp_path / "into")


RUN = {"runs/a/run.json": b"{}"}


def before(place: Path) -> Path:
    """An archive after a shell script."""
    written(place, RUN, runs=["runs/a"])
    place.write_bytes(b"#!/bin/sh\n" + place.read_bytes())
    return place


def linked(place: Path) -> Path:
    place.symlink_to(written(place.with_name("other.zip"), RUN, runs=["runs/a"]))
    return place


HOSTILE: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no runs": (lambda place: written(place, {}), "contains no runs"),
    "10,000 times": (lambda place: written(place, RUN, runs=["runs/a"] * 10_000), "names a run twice"),
    "of no run": (lambda place: written(place, RUN | {"runs/b/run.json": b"{}"}, runs=["runs/a"]), "belongs to no run"),
    "no recipe": (lambda place: written(place, RUN | {"compared.json": b"{}"}, runs=["runs/a"]), "belongs to no run"),
    "empty": (lambda place: written(place, RUN | {"runs/a/run.toml": b""}, runs=["runs/a"]), "or is empty"),
    "of no job": (
        lambda place: written(place, RUN | {"runs/a/scenes/r.a/m/counts.npz": b"x"}, runs=["runs/a"]),
        "belongs to no scene and method of its run.json",
    ),
    "a key twice": (
        lambda place: written(place, {"runs/a/run.json": b'{"seed": 1, "seed": 2}'}, runs=["runs/a"]),
        "damaged: has the key 'seed' twice",
    ),
    "before": (before, "has data outside its files"),
    "link": (linked, "is a link"),
}


@pytest.mark.parametrize("verb", [["report", "verify"], ["dev", "registry", "add", "--registry", "."]])
@pytest.mark.parametrize("name", HOSTILE)
def test_verify_and_add_refuse_the_same_archives(
    name: str, verb: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "registry").mkdir()
    monkeypatch.chdir(tmp_path / "registry")
    make, message = HOSTILE[name]
    assert main([*verb[:3], str(make(tmp_path / "b.zip")), *verb[3:]]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04" + bytes(100)])
def test_invalid_archive_is_a_one_line_error(
    tmp_path: Path, content: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "b.zip").write_bytes(content)
    assert main(["report", "verify", str(tmp_path / "b.zip")]) == 2
    assert "b.zip: is not a bundle, or damaged" in capsys.readouterr().err
