"""Pictures of sheets: what an item shows and hides, the choice of its frame, figures with words as text."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted_runs import see_painted
from PIL import Image
from synthetic_sheets import drafts_of

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Frame
from su3d_bench.human_eval.drawing import Artist, SceneDrafts, _lost, draw_all, draw_scene
from su3d_bench.human_eval.sources import RunSource
from su3d_bench.questions.question_files import figure_texts
from su3d_bench.reports.pictures.items import (
    best_view,
    jpeg_bytes,
    mask_in_frame,
    seen_in,
)
from su3d_bench.runs.executors import run_processes

TEXTS = tuple(f"thing {k}" for k in range(12))


@pytest.mark.parametrize("kind", ["retrieval", "annotation", "reasoning"])
def test_picture_of_an_item_is_small_and_shows_the_object(painted_source: RunSource, kind: Any) -> None:
    draft = replace(drafts_of(kind, ["sofa"])[0], scene="painted/a", methods=("collector",), rows=(1,), names=())
    if kind == "reasoning":
        draft = replace(draft, names=("chair", "sofa", "", ""), others=(0,))
    content = Artist(painted_source).draw(draft)
    picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)
    assert len(content) < 200_000 and picture.shape[1] == 960
    is_outline = (np.abs(picture - [255, 64, 200]).sum(axis=2) < 60).mean()
    assert is_outline > 0.001
    assert content == Artist(painted_source).draw(draft)


@pytest.mark.parametrize("colour", [(180, 150, 120), (214, 194, 170), (245, 245, 220), (255, 64, 200)])
def test_flat_areas_keep_their_colour(colour: tuple[int, int, int]) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (96, 192, 3)).astype(np.uint8)  # many other colours
    picture[16:80, 16:80] = colour
    shown = np.asarray(Image.open(io.BytesIO(jpeg_bytes(picture)))).astype(int)
    assert np.abs(shown[16:80, 16:80] - colour).max() <= 1


def frame_of(depth_m: np.ndarray, x_m: float = 0.0) -> Frame:
    pose = np.eye(4)
    pose[0, 3] = x_m
    camera = np.array([[20.0, 0, 20], [0, 20.0, 15], [0, 0, 1]])
    return Frame(0, 0.0, np.zeros((30, 40, 3), np.uint8), depth_m, pose, camera)


def test_best_view_shows_the_object_without_occlusion() -> None:
    wall, near = np.full((30, 40), 2.0, np.float32), np.full((30, 40), 0.5, np.float32)
    points = np.array([[x, y, 2.0] for x in np.linspace(-0.2, 0.2, 9) for y in np.linspace(-0.2, 0.2, 9)], np.float32)
    frames = [frame_of(near), frame_of(wall, x_m=2.1), frame_of(wall)]
    view = best_view(frames, points)
    assert view is not None and (view.frame, view.seen) == (2, 1.0)
    assert best_view(frames[:1], points) is None and best_view(frames, points[:0]) is None
    assert not seen_in(frames[0], points.astype(np.float64))[2].any()


def test_frame_mask_contains_pixels_nearest_to_the_instance() -> None:
    from scipy.spatial import KDTree

    wall = frame_of(np.full((30, 40), 2.0, np.float32))
    grid = np.array([[x, y, 2.0] for x in np.arange(-2, 2, 0.04) for y in np.arange(-1.5, 1.5, 0.04)])
    is_left = grid[:, 0] < -0.02
    bounds = np.stack([grid[is_left].min(axis=0), grid[is_left].max(axis=0)])
    mask = mask_in_frame(wall, KDTree(grid), is_left, bounds)
    assert mask.shape == (15, 20)
    assert mask[:, :9].all() and not mask[:, 11:].any()


@pytest.mark.parametrize("suffix", ["pdf", "svg"])
def test_figure_contains_its_words_as_text(
    painted_folder: Path, suffix: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(painted_folder)
    monkeypatch.setenv("SU3D_DATA", str(painted_folder / "data"))
    see_painted(monkeypatch)
    words = ["sheets", "pictures", "run", "--methods", "collector", "--photo", "--colours", "cividis"]
    wanted = [*words, "--texts", "<b>sofa</b> $x_1$", "--out", f"heat.{suffix}"]
    assert main(wanted) == 0
    content = (painted_folder / f"heat.{suffix}").read_bytes()
    assert content.startswith({"pdf": b"%PDF", "png": b"\x89PNG", "svg": b"<?xml"}[suffix])
    if suffix == "svg":
        assert b"&lt;b&gt;sofa&lt;/b&gt; $x_1$" in content
        assert main(wanted) == 0 and (painted_folder / "heat.svg").read_bytes() == content
        assert main([*words, "--draw", "labels", "--out", "labels.svg"]) == 0
        assert "collector: label n'" in (painted_folder / "labels.svg").read_text()
        question = "How many chairs are there?"
        assert main([*words, "--draw", "reasoning", "--texts", question, "--out", "answer.svg"]) == 0
        assert question in (painted_folder / "answer.svg").read_text()
        assert main([*words, "--paper-figure", "schemes", "--out", "schemes.svg"]) == 0
        assert all(text in (painted_folder / "schemes.svg").read_text() for text in figure_texts("schemes"))
        assert main([*words, "--texts", "a", "--out", "x.gif"]) == 2


def test_scenes_drawn_in_parallel_give_the_pictures_in_order(painted_source: RunSource, painted_folder: Path) -> None:
    drafts = [
        replace(one, scene="painted/a", methods=("collector",), rows=(k,))
        for k, one in enumerate(drafts_of("retrieval", TEXTS[:3]))
    ]
    result: list[tuple[int, int]] = []
    drawn = draw_all(painted_source, drafts, 1, lambda *counts: result.append(counts))
    assert result == [(1, 3), (2, 3), (3, 3)]
    assert drawn == [Artist(painted_source).draw(one) for one in drafts]
    unit = SceneDrafts(painted_source.opener, {0: drafts[0]})
    (in_process,) = run_processes(draw_scene, [unit], lambda event: None, jobs=2, lost=_lost)
    assert in_process == {0: drawn[0]}
    with pytest.raises(DataError, match="try --jobs 1"):
        _lost(unit, "died")
