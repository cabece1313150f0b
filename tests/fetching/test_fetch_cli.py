"""``models fetch`` and ``datasets fetch`` with loopback servers that serve tiny files in the real layouts."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from box_room import write_box_room
from file_server import FileServer, Served, entry, serve_file, serve_model, serve_replica, write_table
from huggingface_hub import constants
from scannet_scan import write_scan

from su3d_bench.cli.main import main
from su3d_bench.core.files.locks import hold_folder
from su3d_bench.fetching.scannet import SUFFIXES

SAM = "sam_vit_h_4b8939.pth"
SCAN = "scene0000_00"
NOTHING_LEFT = {"record.json"}


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    for variable, name in (("SU3D_DATA", "data"), ("SU3D_MODELS", "models"), ("SU3D_CACHE", "cache")):
        monkeypatch.setenv(variable, str(tmp_path / name))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "no-hub"))
    for variable in ("HF_ENDPOINT", "http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.delenv(variable, raising=False)
    with FileServer() as running:
        yield running


def called(words: Sequence[object], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main([str(word) for word in words])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def sam(server: FileServer, tmp_path: Path, content: bytes = b"weights" * 500) -> Path:
    facts = serve_file(server, SAM, content)
    return write_table(tmp_path / "own.toml", [entry("sam-vit-h", "models", {SAM: facts})])


def left(root: Path) -> set[str]:
    return {path.relative_to(root / ".fetched").as_posix() for path in (root / ".fetched").rglob("*")}


def test_dry_run_lists_all_facts_without_network_access(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = called(["models", "fetch", "sam-vit-h", "--dry-run", "--sources", sam(server, tmp_path)], capsys)
    assert code == 0 and not server.asked and not (tmp_path / "models").exists()
    assert f"{server.url}/{SAM}" in out and "licence MIT: https://example.org/licence" in out
    code, out, _ = called(["models", "fetch", "--profile", "paper", "--dry-run", "--json"], capsys)
    rows = {row["name"]: row for row in json.loads(out)}
    assert list(rows) == ["clip-vit-h-14", "sam-vit-h", "grounding-dino", "ram-plus", "clip-vit-l-14-336"]
    assert all(row["licence"]["read_at"] and row["n_bytes"] and row["addresses"] for row in rows.values())
    assert called(["datasets", "fetch", "replica", "--dry-run"], capsys)[0] == 0
    assert called(["datasets", "fetch", "scannet", "--dry-run"], capsys)[0] == 0


def test_fetch_requires_accepting_the_licence(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["models", "fetch", "sam-vit-h", "--sources", sam(server, tmp_path)]
    code, _, err = called(words, capsys)
    assert code == 2 and not server.asked
    assert err.splitlines()[-1].endswith("of sam-vit-h not accepted; read it, then add --accept sam-vit-h")
    assert "MIT: https://example.org/licence" in err.splitlines()[0]  # size and licence are shown first
    assert called([*words, "--accept", "GPL"], capsys)[0] == 2
    for accepted in ("sam-vit-h", "mit", "models"):
        shutil.rmtree(tmp_path / "models", ignore_errors=True)
        assert called([*words, "--accept", accepted], capsys)[0] == 0


def test_checkpoint_is_stored_where_models_are_searched_and_fetched_once(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["models", "fetch", "sam-vit-h", "--accept", "MIT", "--sources", sam(server, tmp_path)]
    code, out, _ = called(words, capsys)
    assert code == 0 and "(verified against: published SHA-256)" in out
    assert (tmp_path / "models/sam-vit-h" / SAM).is_file() and left(tmp_path / "models") == NOTHING_LEFT
    n_asked = len(server.asked)
    code, out, _ = called(words, capsys)
    assert code == 0 and "already present" in out and len(server.asked) == n_asked


def test_damaged_download_is_never_used_as_a_model_and_is_resumed(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content, place = b"weights" * 500, tmp_path / "models/.fetched/sam-vit-h" / SAM
    words = ["models", "fetch", "sam-vit-h", "--accept", "MIT", "--retries", "0", "--sources", sam(server, tmp_path)]
    cases = [
        (Served(content, breaks_after=[1000]), "1,000 bytes were downloaded; rerun to resume"),
        (Served(content[:1000] + b"x" * (len(content) - 1000)), "it was deleted"),
        (Served(content, redirect=f"{server.other_host}/store"), "host 'localhost' is not allowed for it"),
        (Served(content + b"grown"), "the file has changed"),
    ]
    for served, printed in cases:
        server.files[f"/{SAM}"] = served
        code, out, err = called([*words, "--quiet"], capsys)
        assert (code, out, len(err.splitlines())) == (2, "", 1) and printed in err
        assert not place.exists() and not (tmp_path / "models/sam-vit-h").exists()
    server.files[f"/{SAM}"] = Served(content)
    contents = hold_folder(place.parent)
    assert "another process is fetching it" in called(words, capsys)[2]
    os.close(contents)
    assert called(words, capsys)[0] == 0
    assert (tmp_path / "models/sam-vit-h" / SAM).read_bytes() == content


def test_download_fails_early_when_disk_is_full(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = serve_file(server, SAM, b"x") | {"n_bytes": 1 << 43}
    table = write_table(tmp_path / "own.toml", [entry("sam-vit-h", "models", {SAM: facts})])
    code, _, err = called(["models", "fetch", "sam-vit-h", "--accept", "MIT", "--sources", table, "--quiet"], capsys)
    assert code == 2 and not server.asked
    assert err.startswith("su3d-bench: sam-vit-h: needs 8,796,093,022,208 more bytes in") and "free some space" in err


def test_mirror_must_serve_stated_files(server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    server.files[f"/mirror/{SAM}"] = Served(b"another file")
    words = ["models", "fetch", "sam-vit-h", "--accept", "sam-vit-h", "--retries", "0", "--quiet"]
    code, _, err = called([*words, "--mirror", f"sam-vit-h={server.url}/mirror/"], capsys)
    assert code == 2 and "has 12 bytes, expected 2,564,550,879" in err
    for mirror in ("sam-vit-h", "sam=https://example.org", "sam-vit-h=http://example.org"):
        code, _, err = called([*words, "--mirror", mirror], capsys)
        assert code == 2 and len(err.splitlines()) == 1, err


def test_hub_model_is_fetched_and_verified_by_published_checksums(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    made = tmp_path / "made"
    made.mkdir()
    for name in ("config.json", "preprocessor_config.json", "tokenizer.json"):
        (made / name).write_text("{}")
    (made / "model.safetensors").write_bytes(b"weights" * 800)
    row = serve_model(server, "clip-vit-h-14", "laion/tiny", made)
    table = write_table(tmp_path / "own.toml", [row])
    words = ["models", "fetch", "clip-vit-h-14", "--accept", "MIT", "--retries", "0", "--sources", table, "--quiet"]
    store = f"/store/{hashlib.sha256(b'weights' * 800).hexdigest()}"
    server.files[store].breaks_after = [2000]
    code, _, err = called(words, capsys)
    assert code == 2 and "2,000 bytes were downloaded" in err
    assert "found: " not in called(["models", "list"], capsys)[1]
    code, out, _ = called(words, capsys)
    assert code == 0 and out.count("published SHA-256") == 1 and out.count("published git blob") == 3
    assert [asked.range for asked in server.asked if asked.path == store] == [None, "bytes=2000-"]
    assert f"found: {tmp_path}/models/clip-vit-h-14" in called(["models", "list"], capsys)[1]
    assert not any("authorization" in asked.headers for asked in server.asked)


def test_each_hub_failure_is_a_one_line_error(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    (tmp_path / "made").mkdir()
    (tmp_path / "made/config.json").write_text("{}")
    row = serve_model(server, "clip-vit-h-14", "laion/tiny", tmp_path / "made")
    words = ["models", "fetch", "clip-vit-h-14", "--accept", "MIT", "--quiet"]
    table = write_table(tmp_path / "own.toml", [row])
    code, _, err = called([*words, "--sources", table], capsys)
    assert code == 2 and "hub repository laion/tiny: has no model.safetensors or pytorch_model.bin" in err
    row["hub"]["weights"] = [{"name": "config.json", "n_bytes": 2, "sha256": "0" * 64, "read_at": "here"}]
    server.files["/api/models/laion/tiny"] = Served(b"", status=404)
    code, _, err = called([*words, "--sources", table], capsys)
    assert code == 2 and "the hub does not list its files" in err and len(err.splitlines()) == 1
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    code, _, err = called([*words, "--sources", table], capsys)
    assert code == 2 and "HF_HUB_OFFLINE is set; unset it to fetch" in err


@pytest.fixture
def replica(server: FileServer, tmp_path: Path) -> list[str]:
    """The arguments that fetch a tiny Replica of one scene, served in the published layouts."""
    write_box_room(tmp_path / "made")
    table = write_table(tmp_path / "own.toml", serve_replica(server, tmp_path / "made"))
    return ["datasets", "fetch", "replica", "--accept", "MIT", "--retries", "0", "--sources", str(table)]


def test_fetched_replica_is_found_and_passes_its_check(
    server: FileServer, replica: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    code, out, err = called(replica, capsys)
    assert code == 0 and out.count("(no published checksum; recorded)") == 4
    assert f"that of this first download is recorded in {data}/.fetched/record.json" in err
    assert called(["datasets", "check", "replica/*"], capsys)[0] == 0
    assert left(data) == NOTHING_LEFT
    found = {path.relative_to(data).as_posix() for path in data.rglob("*") if path.is_file()}
    meshes = {f"replica_v1/room_0/habitat/{name}" for name in ("mesh_semantic.ply", "info_semantic.json")}
    assert {name for name in found if name.startswith("replica_v1")} == meshes
    n_asked = len(server.asked)
    assert "already present" in called(replica, capsys)[1] and len(server.asked) == n_asked


def test_unpublished_checksums_are_compared_with_the_first_download(
    server: FileServer, replica: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(replica, capsys)[0] == 0
    shutil.rmtree(tmp_path / "data/replica_v1")
    part = server.files["/replica_v1_0.tar.gz.partab"]
    server.files["/replica_v1_0.tar.gz.partab"] = Served(b"x" * len(part.content))
    code, _, err = called([*replica, "--quiet"], capsys)
    first = hashlib.sha256(part.content).hexdigest()
    assert code == 2 and f"first download: {first}" in err and "record.json" in err
    server.files["/replica_v1_0.tar.gz.partab"] = part
    code, out, _ = called(replica, capsys)
    assert code == 0 and "verified against: SHA-256 of the first download" in out
    assert called(["datasets", "check", "replica/*", "--quick"], capsys)[0] == 0


def test_scene_is_visible_only_when_complete(
    server: FileServer, replica: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    served = server.files["/Replica.zip"]
    damaged = bytearray(served.content)
    damaged[len(damaged) // 2] ^= 0xFF
    server.files["/Replica.zip"] = Served(bytes(damaged))
    code, _, err = called([*replica, "--quiet"], capsys)
    assert code == 2 and "delete it and fetch it again" in err
    assert (
        not (tmp_path / "data/Replica").exists() and "no scene" in called(["datasets", "check", "replica/*"], capsys)[2]
    )
    (tmp_path / "data/.fetched/replica-frames/Replica.zip").unlink()
    (tmp_path / "data/.fetched/record.json").unlink()  # of the damaged one
    server.files["/Replica.zip"] = served
    assert called(replica, capsys)[0] == 0


SCRIPT = """
import argparse, os, shutil
parser = argparse.ArgumentParser()
parser.add_argument("-o", "--out_dir", required=True)
parser.add_argument("--label_map", action="store_true")
parser.add_argument("--id")
parser.add_argument("--type")
args = parser.parse_args()
print("By pressing any key to continue you confirm that you have agreed to the terms")
input("")
made = {made!r}
if args.label_map:
    shutil.copy(os.path.join(made, "scannetv2-labels.combined.tsv"), args.out_dir)
else:
    folder = os.path.join(args.out_dir, "scans", args.id)
    os.makedirs(folder, exist_ok=True)
    if args.type == {lacks!r}:
        raise SystemExit("the server does not answer")
    shutil.copy(os.path.join(made, "scans", args.id, args.id + args.type), folder)
"""


def assert_is_read(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The fetched files equal the served ones byte by byte, and contain frames and ground truth for datasets."""
    for path in (folder / "made/scans" / SCAN).iterdir():
        assert (folder / "data/scans" / SCAN / path.name).read_bytes() == path.read_bytes()
    out = called(["datasets", "check", f"scannet/{SCAN}"], capsys)[1]
    assert "5 (all read)" in out and "nyu40-vertices: 861 points" in out


def test_scans_are_fetched_by_the_users_script_and_read(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scan(tmp_path / "made", SCAN)
    script = tmp_path / "download-scannet.py"
    script.write_text(SCRIPT.format(made=str(tmp_path / "made"), lacks=".sens"))
    words = ["datasets", "fetch", "scannet", SCAN, "--script", script]
    assert called(words, capsys)[0] == 2  # the terms
    code, _, err = called([*words, "--accept", "scannet", "--quiet"], capsys)
    assert code == 2 and f"did not download {SCAN}.sens (exit code 1): the server" in err
    assert not (tmp_path / "data/scans").exists()
    script.write_text(SCRIPT.format(made=str(tmp_path / "made"), lacks="none"))
    code, out, _ = called([*words, "--accept", "scannet"], capsys)
    assert code == 0 and out.count("recorded") == len(SUFFIXES) + 1
    assert_is_read(tmp_path, capsys)
    assert "already present" in called(words, capsys)[1]
    assert not server.asked


def test_scans_are_fetched_from_the_users_link(
    server: FileServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_scan(tmp_path / "made", SCAN)
    for path in folder.iterdir():
        release = "v1" if path.suffix == ".sens" else "v2"
        server.files[f"/given/{release}/scans/{SCAN}/{path.name}"] = Served(path.read_bytes())
    table = tmp_path / "made/scannetv2-labels.combined.tsv"
    server.files[f"/given/v2/tasks/{table.name}"] = Served(table.read_bytes())
    recording = server.files[f"/given/v1/scans/{SCAN}/{SCAN}.sens"]
    recording.breaks_after = [500]
    words = ["datasets", "fetch", "scannet", SCAN, "--from", f"{server.url}/given/", "--accept", "scannet"]
    words += ["--retries", "0"]
    code, _, err = called([*words, "--quiet"], capsys)
    assert code == 2 and "500 bytes were downloaded" in err and not (tmp_path / "data/scans").exists()
    assert called(words, capsys)[0] == 0
    assert_is_read(tmp_path, capsys)
    assert left(tmp_path / "data") <= {*NOTHING_LEFT, "scannet"}


def test_error_without_script_or_link_explains_terms(server: FileServer, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = called(["datasets", "fetch", "scannet"], capsys)
    assert code == 2 and "ScanNet_TOS.pdf and send it to scannet@googlegroups.com" in err
    assert len(err.splitlines()) == 1
    for words, printed in [
        (["datasets", "fetch", "scannet", "scene0"], "unknown scan 'scene0'"),
        (["datasets", "fetch", "scannet", "--script", "none.py", "--accept", "scannet"], "no such file; give"),
        (
            ["datasets", "fetch", "scannet", "--from", "http://kaldir.vc.in.tum.de", "--accept", "scannet"],
            "is not encrypted",
        ),
    ]:
        code, _, err = called(words, capsys)
        assert code == 2 and printed in err, err


def test_damaged_table_or_record_is_a_one_line_error(
    server: FileServer, replica: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, record = tmp_path / "wrong.toml", tmp_path / "data/.fetched/record.json"
    for text in ("sources = []", "sources = 1", "[", "[[sources]]\nname = 'a'\nsecret = 1"):
        table.write_text(text)
        code, _, err = called(["models", "fetch", "sam-vit-h", "--dry-run", "--sources", table], capsys)
        assert code == 2 and str(table) in err and len(err.splitlines()) == 1
    record.parent.mkdir(parents=True)
    for text in ("{", "[]", '{"files": 1, "unpacked": {}}'):
        record.write_text(text)
        code, _, err = called([*replica, "--quiet"], capsys)
        assert code == 2 and str(record) in err and len(err.splitlines()) == 1
