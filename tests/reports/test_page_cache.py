"""The cache of the HTML report: used if nothing changed, rebuilt if anything did, and ignored if corrupted."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import WordEncoder
from painted_runs import painted_run, see_painted
from places import SCENES

from su3d_bench.analysis.attribution import Explained, attribution_of, explained_of
from su3d_bench.analysis.page import contents
from su3d_bench.analysis.page.maps import PageScene, page_scene
from su3d_bench.analysis.page.page_cache import FOLDER, packed, unpacked
from su3d_bench.analysis.page.scene import SceneData
from su3d_bench.cli.main import main
from su3d_bench.core.errors import PredictionError
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs.finished import read_run
from su3d_bench.store.predictions import read_prediction, write_prediction

WORDS = ["--texts", "chair", "table"]


@pytest.fixture(scope="module")
def made_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return painted_run(tmp_path_factory.mktemp("kept") / "run")


@pytest.fixture
def run(made_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the run in the working directory."""
    shutil.copytree(made_run, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    see_painted(monkeypatch)
    return Path("run")


def page(*words: str, runs: tuple[str, ...] = ("run",), out: str = "page.html") -> bytes:
    assert main(["report", "html", *runs, "--out", out, "--jobs", "1", *(words or WORDS)]) == 0
    return without_date(Path(out))


def without_date(path: Path) -> bytes:
    """The page without its date and command."""
    content, n_found = re.subn(rb'<p class="made">.*</p>', b"", path.read_bytes())
    assert n_found == 1
    return content


def pieces(run: Path) -> list[Path]:
    return sorted((run / FOLDER).glob("*")) if (run / FOLDER).is_dir() else []


def refuse(*_: Any, **__: Any) -> Any:
    raise AssertionError("built again")


def noting(made: list[str]) -> Callable[..., PageScene]:
    """A ``page_scene`` that records the scenes it builds."""

    def make(scene: str, *rest: Any) -> PageScene:
        made.append(scene)
        return page_scene(scene, *rest)

    return make


def nothing_is_made(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(contents, "page_scene", refuse)
    patch.setattr(Explained, "matched", refuse)


def test_second_page_uses_the_cache_and_has_the_same_bytes(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = page()
    assert len(pieces(run)) == 2  # one per scene
    assert "painted/b done" in capsys.readouterr().err
    nothing_is_made(monkeypatch)
    assert page() == first
    assert capsys.readouterr().err == ""


def test_corrupted_cache_entry_is_ignored(run: Path) -> None:
    first = page()
    for piece, place in zip(pieces(run), (0, 70), strict=True):
        content = bytearray(piece.read_bytes())
        content[place] ^= 1
        piece.write_bytes(content)
    assert page() == first
    for piece, other in zip(pieces(run), (b"", b"{}"), strict=True):
        piece.write_bytes(other)
    assert page() == first


def test_only_the_scene_with_a_changed_map_is_rebuilt(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page("--no-errors", *WORDS)
    place = run / "scenes" / "painted.a" / "collector" / "prediction.npz"
    prediction = read_prediction(place)
    prediction.points[:] += np.float32(0.5)
    write_prediction(place, prediction)
    made: list[str] = []
    monkeypatch.setattr(contents, "page_scene", noting(made))
    page("--no-errors", *WORDS)
    assert made == ["painted/a"]


def test_missing_encoder_is_not_cached(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = page()
    shutil.rmtree(run / FOLDER)

    def no_encoder(folder: Any, device: str = "cpu") -> Any:
        raise PredictionError("the encoder is not here")

    monkeypatch.setattr(finished_run, "encoder_of", no_encoder)
    assert b"the encoder is not here" in page()
    see_painted(monkeypatch)
    assert page() == first


@pytest.mark.proof
def test_parallel_processes_give_the_same_bytes(run: Path) -> None:
    first = page()
    shutil.rmtree(run / FOLDER)
    command = [sys.executable, str(SCENES / "painted_cli.py"), "report", "html", "run", "--out", "two.html"]
    subprocess.run([*command, "--jobs", "2", *WORDS], check=True, timeout=300)
    assert without_date(Path("two.html")) == first
    assert len(pieces(run)) == 2


def test_packed_counts_unpack_unchanged(run: Path) -> None:
    finished = read_run(run)
    explained = explained_of(finished, "collector")
    data = SceneData("painted/a")
    found = explained.matched("painted/a", lambda variant: data.truth_of_run(finished, variant), WordEncoder)
    corrected = explained.corrected("painted/a", {one.rules.name: one.evaluated for one in found})
    back = unpacked(packed(corrected, finished.rules), finished.rules)
    assert attribution_of(explained, {"painted/a": back}) == attribution_of(explained, {"painted/a": corrected})
