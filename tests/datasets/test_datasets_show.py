"""``datasets show``: what is looked at, the picture that comes out, and each fault of a request in one line."""

from __future__ import annotations

import json
import shlex
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from box_room import COLOURS, write_box_room
from painted import LABELS, Painted

from su3d_bench.cli.main import build_parser, main
from su3d_bench.core.errors import DataError
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.datasets.replica.dataset import Replica
from su3d_bench.reports.pictures.canvas import Canvas, class_colours
from su3d_bench.reports.pictures.scene import (
    CAMERAS,
    CAPTION,
    HEADER,
    MARGIN,
    PANEL_HEIGHT,
    PANEL_WIDTH,
    WIDTH,
    SceneLook,
    draw_scene_picture,
    facts_line,
    look_at,
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("shown")
    write_box_room(root, 12)
    write_box_room(root, 7, "room1", with_truth=False)
    return root


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, whole: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_DATA", str(whole))


def pixels(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return np.asarray(picture[..., ::-1])


def n_near(picture: np.ndarray, rgb: tuple[int, int, int] | np.ndarray) -> int:
    return int((np.abs(picture.astype(int) - rgb).max(axis=-1) < 14).sum())


def test_a_look_holds_frames_walk_points_and_truth(whole: Path) -> None:
    steps: list[tuple[int, int]] = []
    look = look_at(Replica(whole), "room0", progress=lambda n_done, n: steps.append((n_done, n)))
    assert (look.scene, look.n_frames, look.poses.shape) == ("replica/room0", 12, (12, 4, 4))
    assert [frame.index for frame in look.shown] == [0, 2, 4, 6, 8, 11]
    assert steps == [(n, 12) for n in range(13)]
    assert look.seen.shape == look.seen_rgb.shape == (12 * 48 * 36, 3)
    assert (np.abs(look.seen - np.clip(look.seen, 0, [4, 3, 2.5])) < 1e-3).all()
    assert look.counts == {"n_points": 23_600, "n_objects": 6, "n_classes": 3}
    assert 0.3 < look.depth_m[0] < look.depth_m[1] < 5


def test_a_stride_chooses_the_cameras_and_long_scenes_are_sampled(whole: Path, tmp_path: Path) -> None:
    assert len(look_at(Replica(whole), "room0", 5).poses) == 3
    long = look_at(Painted(tmp_path, Painted.Options(n_frames=3 * CAMERAS)), "a")
    assert (len(long.poses), long.n_frames) == (CAMERAS, 3 * CAMERAS)


def test_a_damaged_frame_is_an_error_and_no_truth_is_none(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="class id 777"):
        look_at(Painted(tmp_path, Painted.Options(fault="unknown-class")), "b")
    with pytest.raises(DataError, match="frame 2 is missing"):
        look_at(Painted(tmp_path, Painted.Options(fault="missing-frame")), "b")
    look = look_at(Replica(whole), "room1")
    assert look.truth is None and look.counts == {}
    assert "room_1" in look.no_truth


def test_the_picture_shows_frames_classes_and_walk(whole: Path, tmp_path: Path) -> None:
    draw_scene_picture(look_at(Replica(whole), "room0"), tmp_path / "new" / "room0.png")
    picture = pixels(tmp_path / "new" / "room0.png")
    height, width = picture.shape[:2]
    assert width == WIDTH and 900 < height < 1400
    assert n_near(picture, (0xD6, 0x24, 0x6E)) > 300  # the walk
    assert n_near(picture, (0x1A, 0x98, 0x50)) > 30  # its start
    assert sum(n_near(picture, rgb) > 1000 for rgb in COLOURS) >= 4  # the frames
    assert n_near(picture, (208, 203, 196)) > 20_000  # the floor by class and by instance
    assert (picture == 255).all(axis=-1).mean() < 0.5


def test_nothing_reaches_over_the_margins(whole: Path, tmp_path: Path) -> None:
    look = look_at(Replica(whole), "room0")
    assert look.truth is not None
    names = tuple(f"a thing with the long name number {k}" for k in range(60))
    rows = np.arange(len(look.truth.points), dtype=np.int32) % 60 + 1
    truth = GroundTruth(
        look.truth.points, rows, rows, LabelSet("x", tuple(range(1, 61)), names), "mesh-vertices", "test"
    )
    draw_scene_picture(replace(look, scene="replica/" + "long" * 200, truth=truth), tmp_path / "a.png")
    draw_scene_picture(replace(look, truth=None, no_truth="no truth in /a" + "/long" * 200), tmp_path / "b.png")
    for name in ("a.png", "b.png"):
        picture = pixels(tmp_path / name)
        assert (picture[:, :10] > 240).all() and (picture[:, -10:] > 240).all() and (picture[:8] > 240).all()
        # The gaps between the three views are empty from the views' top to their bottom.
        step = PANEL_WIDTH + MARGIN
        panels = slice(HEADER + CAPTION, HEADER + CAPTION + PANEL_HEIGHT)
        assert all((picture[panels, k * step + 2 : k * step + 14] > 240).all() for k in (1, 2, 3))


def test_every_class_is_in_the_legend_in_the_colour_that_it_has_in_a_map(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = look_at(Replica(whole), "room0")
    assert look.truth is not None
    names = ("book", "lamp", *(f"rare {k}" for k in range(58)))
    rows = np.arange(len(look.truth.points), dtype=np.int32) % 60 + 1
    truth = replace(look.truth, semantic=rows, instance=rows, labels=LabelSet("x", tuple(range(1, 61)), names))
    written: list[str] = []

    def text(page: Canvas, x: float, y: float, words: str, *more: Any, **style: Any) -> None:
        written.append(words)

    monkeypatch.setattr(Canvas, "text", text)
    draw_scene_picture(replace(look, truth=truth), tmp_path / "a.png")
    assert set(names) <= set(written) and not any("more" in text for text in written)
    assert n_near(pixels(tmp_path / "a.png"), class_colours(["book"])["book"]) > 50  # in the panel by class


def test_the_same_scene_gives_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        draw_scene_picture(look_at(Replica(whole), "room0"), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    "changes",
    [
        {"scene": "a/$x^{$ \x1b[31m \u202e _{ \u65e5\u672c"},
        {"poses": np.eye(4)[None]},
        {"poses": np.array([np.eye(4), np.diag([1.0, 1, 1, 1]) + 1e6 * np.eye(4, k=3)])},
        {"seen": np.zeros((0, 3), np.float32), "seen_rgb": np.zeros((0, 3), np.uint8)},
        {"truth": None, "seen": np.zeros((0, 3), np.float32), "seen_rgb": np.zeros((0, 3), np.uint8)},
        {
            "truth": GroundTruth(
                np.zeros((1, 3), np.float32), np.zeros(1, np.int32), np.zeros(1, np.int32), LABELS, "x", "x"
            )
        },
        {"depth_m": (0.0, 0.0)},
    ],
)
def test_odd_scenes_are_drawn_without_a_word(whole: Path, tmp_path: Path, changes: dict[str, Any]) -> None:
    look: SceneLook = replace(look_at(Replica(whole), "room0"), **changes)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_scene_picture(look, tmp_path / "odd.png")
    assert pixels(tmp_path / "odd.png").shape[1] == WIDTH


def test_the_command_writes_the_picture_and_tells_counts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", "show", "replica/room0"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("replica/room0: 12 frames of 48x36 · depth 1.")
    assert lines[0].endswith("6 objects of 3 classes · 23,600 points of ground truth (mesh-vertices)")
    assert lines[1] == "picture: replica-room0.png"
    assert pixels(Path("replica-room0.png")).shape[1] == WIDTH


def test_a_scene_without_truth_is_shown_and_said_so(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", "show", "replica/room1", "--out", "p/x.png", "--stride", "3", "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["ground_truth"] is None and "room_1" in table["no_ground_truth"]
    assert (table["n_frames"], table["size"], table["picture"]) == (7, [48, 36], "p/x.png")
    assert facts_line(look_at(Replica(whole), "room1")).endswith("no ground truth")
    assert max(n_near(pixels(Path("p/x.png"))[100:600], rgb) for rgb in COLOURS) > 3000  # the points' own colours


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["replica/*"], "datasets show replica/*: 2 scenes match (replica/room0, replica/room1, ...); name one"),
        (["replica/rom0"], "no scene matches 'replica/rom0'; did you mean 'replica/room0'?"),
        (["replica/room0", "--stride", "0"], "--stride 0: expected 1 or more"),
        (["replica/room0", "--out", "x.jpg"], "--out x.jpg: the picture is a PNG; expected a file name that ends in"),
        (["replica/room0", "--out", "file/x.png"], "cannot write file: a file stands where a folder should be"),
    ],
)
def test_each_wrong_request_is_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("file").write_text("")
    assert main(["datasets", "show", *words]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith(f"su3d-bench: {message}") and said.err.count("\n") == 1, said.err


@pytest.mark.parametrize("action", ["check", "show"])
def test_the_help_ends_with_two_examples_that_run(action: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", action, "--help"]) == 0
    for example in capsys.readouterr().out.rstrip().splitlines()[-2:]:
        words = shlex.split(example)
        assert words[:3] == ["su3d-bench", "datasets", action]
        assert build_parser().parse_args(words[1:]).action == action
        small = [word.replace("n_frames=40", "n_frames=2 width=64 height=48 mesh_spacing_m=0.2") for word in words[1:]]
        small = [part if part.startswith("rooms.") or "=" not in part else f"rooms.{part}"
                 for word in small for part in word.split()]  # fmt: skip
        assert main(small) == 0
        assert capsys.readouterr().out
