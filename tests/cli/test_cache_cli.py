from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from su3d_bench.cli.dev import KIND_NAMES
from su3d_bench.cli.main import main
from su3d_bench.core.files.atomic import write_bytes
from su3d_bench.perception.cache import FrameCache, content_key
from su3d_bench.perception.language.chat import ChatRequest, Reply, ReplyStore
from su3d_bench.perception.models.files import file_sha256
from su3d_bench.perception.profiles import REPLIES
from su3d_bench.store import caches

FOREIGN = ("perception/notes.txt", "perception/ab/mine.npz", "mine/0.npz", "replies/mine.txt")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder with one real entry of each kind and foreign files."""
    root = tmp_path / "cache"
    monkeypatch.setenv("SU3D_CACHE", str(root))
    FrameCache(root).save(content_key("a frame"), {"x": np.zeros(9)})
    weights = tmp_path / "weights.bin"
    weights.write_bytes(bytes(2**20))
    file_sha256(weights)
    request = ChatRequest("ask", "m", "", "x")
    ReplyStore(root / REPLIES).save(request, Reply("y"), "nowhere")
    for name in FOREIGN:
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("mine")
    return root


def contents(capsys: pytest.CaptureFixture[str]) -> dict[str, int]:
    capsys.readouterr()
    assert main(["dev", "cache", "list", "--json"]) == 0
    return {row["kind"]: row["n_files"] for row in json.loads(capsys.readouterr().out)["kinds"]}


def test_cache_list_counts_every_kind_of_entry(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tuple(caches.KINDS) == KIND_NAMES
    assert contents(capsys) == {"perception": 1, "model-digests": 1, "replies": 1}
    assert main(["dev", "cache", "list"]) == 0
    text = capsys.readouterr().out
    assert str(cache) in text
    assert "1 file  written 0 hours to 0 hours ago" in text
    assert main(["dev", "cache", "list", "--json"]) == 0
    n_bytes = json.loads(capsys.readouterr().out)["n_bytes"]
    files = [path for path in cache.rglob("*") if path.is_file()]
    assert n_bytes == sum(path.stat().st_size for path in files) - len(FOREIGN) * len("mine")


def test_clear_removes_cache_files_and_replies_only_by_name(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(capsys)
    assert main(["dev", "cache", "clear", "all", "--dry-run"]) == 0
    assert "perception: 1 file, 0.0 MB would be removed" in capsys.readouterr().out
    assert contents(capsys) == before
    assert main(["dev", "cache", "clear", "all"]) == 0
    assert "to remove them: su3d-bench dev cache clear replies" in capsys.readouterr().err
    assert contents(capsys) == {"perception": 0, "model-digests": 0, "replies": 1}
    assert main(["dev", "cache", "clear", "replies"]) == 0
    assert sum(contents(capsys).values()) == 0
    assert sorted(path.relative_to(cache).as_posix() for path in cache.rglob("*") if path.is_file()) == sorted(FOREIGN)


def test_clear_never_follows_symlinks(cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    elsewhere = tmp_path / "elsewhere" / "ab"
    elsewhere.mkdir(parents=True)
    name = f"{'a' * 64}.npz"
    (elsewhere / name).write_text("precious")
    (cache / "perception" / "cd").symlink_to(elsewhere)
    (cache / "perception" / "ef").mkdir(exist_ok=True)
    (cache / "perception" / "ef" / name).symlink_to(elsewhere / name)
    assert main(["dev", "cache", "clear", "all"]) == 0
    assert (elsewhere / name).read_text() == "precious"
    assert (cache / "perception" / "ef" / name).is_symlink()
    (cache / "perception").rename(cache / "was")
    (cache / "perception").symlink_to(elsewhere.parent)
    assert main(["dev", "cache", "clear", "perception"]) == 0
    assert (elsewhere / name).read_text() == "precious"


def test_older_than_removes_only_old_files(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = FrameCache(cache).path(content_key("old"))
    assert old is not None
    old.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(old, b"x")
    os.utime(old, (time.time() - 40 * 86400,) * 2)
    assert main(["dev", "cache", "clear", "perception", "--older-than", "30"]) == 0
    assert capsys.readouterr().out == "perception: 1 file, 0.0 MB removed\n"
    assert not old.exists()
    assert contents(capsys)["perception"] == 1
    assert main(["dev", "cache", "clear", "perception", "--older-than", "-1"]) == 2
    assert "--older-than -1: expected a number of days" in capsys.readouterr().err
