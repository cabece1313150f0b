"""What pictures show of objects: how much of an image they fill, and their colours."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from su3d_bench.core.types import Frame, GroundTruth, LabelSet, WholeObject
from su3d_bench.questions.scene_map import known_objects
from su3d_bench.questions.sight import LEAST_SHARE, colour_word, sights

HEIGHT, WIDTH, FOCAL = 60, 80, 80.0
LABELS = LabelSet("replica", (20, 80), ("chair", "table"))


def wall_of_dots(instance: int, x: float, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a square 2 m before the camera, and the instance of each."""
    line = np.linspace(-side / 2, side / 2, 60)
    points = np.stack([*np.meshgrid(line + x, line), np.full((60, 60), 2.0)], axis=-1).reshape(-1, 3)
    return points, np.full(len(points), instance)


def seen_by_one_camera(depth_m: float = 2.0) -> tuple[Any, GroundTruth]:
    """A large red square and a small green one, on an image that is red on its left and green on its right."""
    parts = [wall_of_dots(1, -0.5, 0.8), wall_of_dots(2, 0.5, 0.05)]
    points, instance = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    semantic = np.where(instance == 1, 20, 80)
    truth = GroundTruth(
        points.astype(np.float32), semantic.astype(np.int32), instance.astype(np.int32), LABELS, "v", "t"
    )
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rgb[:, : WIDTH // 2], rgb[:, WIDTH // 2 :] = (200, 40, 40), (60, 140, 60)
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    frame = Frame(0, 0.0, rgb, np.full((HEIGHT, WIDTH), depth_m, np.float32), np.eye(4), intrinsics)
    dataset = SimpleNamespace(
        info=lambda scene, stride: SimpleNamespace(n_frames=1), frames=lambda scene, stride: [frame]
    )
    return dataset, truth


def test_the_share_of_the_image_is_that_of_the_projected_square() -> None:
    dataset, truth = seen_by_one_camera()
    seen = sights(dataset, "s", truth, 1)
    assert seen[1].share == pytest.approx((0.8 * FOCAL / 2) ** 2 / (HEIGHT * WIDTH), rel=0.1)  # 32 pixels a side
    assert (seen[1].colour, seen[2].colour) == ("red", "green")
    assert seen[1].is_plain
    assert seen[2].share < LEAST_SHARE * 2  # 2 pixels a side
    assert pytest.approx(25**2, rel=0.02) == LEAST_SHARE * 640 * 480


def test_what_stands_behind_something_is_not_seen() -> None:
    dataset, truth = seen_by_one_camera(depth_m=1.5)
    assert sights(dataset, "s", truth, 1) == {}
    objects = known_objects(truth, 1, None, {})
    assert [thing.is_asked for thing in objects.objects] == [False, False]


def test_a_colour_is_told_where_frames_show_the_one_that_a_thing_was_made_in() -> None:
    dataset, truth = seen_by_one_camera()
    seen, box = sights(dataset, "s", truth, 1), np.array([[0, 0, 0], [1, 1, 1]], float)
    whole = [WholeObject(1, "chair", box, ("wicker",), "red"), WholeObject(2, "table", box, (), "blue")]
    captions = [thing.caption for thing in known_objects(truth, 1, whole, seen).objects]
    assert captions == ["red wicker", ""]
    assert known_objects(truth, 1, [WholeObject(1, "picture", box)], seen).objects[0].caption == ""


def test_a_colour_that_nobody_vouches_for_is_the_same_in_other_light() -> None:
    dataset, truth = seen_by_one_camera()
    box = np.array([[0, 0, 0], [1, 1, 1]], float)
    seen = sights(dataset, "s", truth, 1)
    assert seen[1].is_sure_colour and known_objects(truth, 1, None, seen).objects[0].caption == "red"
    dataset.frames("s", 1)[0].rgb[:] = 190  # grey; white in more light
    greyish = sights(dataset, "s", truth, 1)
    assert (greyish[1].colour, greyish[1].is_sure_colour) == ("white", False)
    assert known_objects(truth, 1, None, greyish).objects[0].caption == ""
    assert known_objects(truth, 1, [WholeObject(1, "chair", box, (), "white")], greyish).objects[0].caption == "white"


@pytest.mark.parametrize(("aside", "is_cut"), [(0.0, False), (-0.15, True)])
def test_what_ends_where_the_image_ends_is_cut(aside: float, is_cut: bool) -> None:
    dataset, truth = seen_by_one_camera()
    moved = truth.points + np.array([aside, 0, 0], np.float32) * (truth.instance == 1)[:, None]
    truth = replace(truth, points=moved)
    seen = sights(dataset, "s", truth, 1)
    assert (seen[1].is_cut, seen[2].is_cut) == (is_cut, False)
    assert [thing.is_cut for thing in known_objects(truth, 1, None, seen).objects] == [is_cut, False]
    box = np.array([[0, 0, 0], [1, 1, 1]], float)
    assert not known_objects(truth, 1, [WholeObject(1, "chair", box)], seen).objects[0].is_cut  # its box is known


@pytest.mark.parametrize(
    ("rgb", "word"),
    [
        ((200, 40, 40), "red"), ((60, 140, 60), "green"), ((50, 90, 180), "blue"), ((30, 30, 32), "black"),
        ((235, 235, 230), "white"), ((130, 131, 133), "grey"), ((118, 74, 42), "brown"), ((214, 192, 156), "beige"),
        ((228, 192, 48), "yellow"), ((228, 118, 36), "orange"), ((122, 62, 152), "purple"), ((232, 138, 166), "pink"),
    ],
)  # fmt: skip
def test_the_colours_of_the_rooms_have_their_words(rgb: tuple[int, int, int], word: str) -> None:
    assert colour_word(np.tile(np.array(rgb, np.float64), (100, 1))) == word
