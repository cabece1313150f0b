"""The looks of an object in a scan from vertices and frames: its sides, and words for its shape, colour and size."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from su3d_bench.core.types import Frame, GroundTruth, LabelSet, WholeObject
from su3d_bench.questions.appearance import (
    BUILDS,
    COLOURS,
    MIN_PART_SHARE,
    SHAPES,
    Appearance,
    Sight,
    appearance_of,
    colour_word,
    measure_of,
    possible_colours,
    sights,
)
from su3d_bench.questions.generator import generate
from su3d_bench.questions.scene_map import MapObject, SceneMap, known_objects

GENERATOR = np.random.default_rng(0)


def slab(length: float, width: float, height: float, degrees: float = 0.0) -> np.ndarray:
    """Points (4000, 3) of a block, rotated about the vertical axis."""
    points = GENERATOR.uniform(-0.5, 0.5, (4000, 3)) * (length, width, height)
    turn = np.deg2rad(degrees)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return np.asarray(points @ rotation.T)


def polygon(n_corners: int, height: float = 0.5) -> np.ndarray:
    """Points of an upright prism with a regular footprint, 1 m across."""
    turns = 2 * np.pi * np.arange(n_corners) / n_corners
    corners = np.stack([np.cos(turns), np.sin(turns)], axis=1) / 2
    shares = GENERATOR.dirichlet(np.full(n_corners, 0.5), 6000)
    flat = np.concatenate([shares @ corners, corners])
    return np.column_stack([flat, np.linspace(0, height, len(flat))])


def words_of(name: str, points: np.ndarray, *, is_cut: bool = False) -> Any:
    """The certain words for its shape, and the possible ones."""
    looks = appearance_of(name, points, None, is_cut=is_cut)
    return looks.words & SHAPES, looks.maybe & SHAPES


@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0])
def test_object_dimensions_are_rotation_invariant(degrees: float) -> None:
    sides = appearance_of("desk", slab(1.6, 0.8, 0.7, degrees), None, is_cut=False).sides
    assert sides == pytest.approx([1.6, 0.8, 0.7], abs=0.03)


def test_faces_are_round_square_or_rectangular() -> None:
    assert words_of("table", polygon(40)) == ({"round"}, {"round"})
    assert words_of("table", slab(1, 1, 0.7, 20)) == ({"square"}, {"square"})
    assert words_of("table", slab(1.4, 0.8, 0.7, 20)) == ({"rectangular"}, {"rectangular"})


def test_intermediate_shapes_are_ambiguous() -> None:
    assert words_of("table", polygon(8)) == (frozenset(), {"round"})  # an octagon
    assert words_of("table", slab(1.18, 1, 0.7)) == (frozenset(), {"square", "rectangular"})
    assert words_of("table", polygon(3)) == (frozenset(), frozenset())  # a triangle has none of these shapes


def test_cut_small_or_unsuitable_objects_have_no_shape() -> None:
    assert words_of("table", polygon(40), is_cut=True) == (frozenset(), SHAPES)
    assert words_of("table", slab(0.15, 0.15, 0.1)) == (frozenset(), SHAPES)
    assert words_of("chair", slab(0.5, 0.5, 0.9)) == (frozenset(), SHAPES)
    assert words_of("cushion", slab(0.5, 0.2, 0.5)) == (frozenset(), SHAPES)  # a leaning square one


def test_colour_is_sure_only_under_all_lighting() -> None:
    red, blue = np.tile([200.0, 40.0, 40.0], (70, 1)), np.tile([50.0, 90.0, 180.0], (30, 1))
    assert possible_colours([np.concatenate([red, blue])]) == {"red", "blue"}
    assert possible_colours([np.concatenate([red, blue[:15]])]) == {"red"}
    assert possible_colours([red[:3]]) == COLOURS  # too few pixels for any word
    sight = Sight(0.1, "red", True, False, frozenset(("red", "pink")))
    looks = appearance_of("chair", slab(0.5, 0.5, 0.9), sight, is_cut=False)
    assert looks.words & COLOURS == {"red"} and looks.maybe & COLOURS == {"red", "pink"}
    assert appearance_of("picture", slab(0.8, 0.02, 0.5), sight, is_cut=False).maybe >= COLOURS
    assert appearance_of("chair", slab(0.5, 0.5, 0.9), None, is_cut=False).maybe >= COLOURS  # never seen


def test_clearly_long_and_tall_objects_are_recognized() -> None:
    def build(name: str, *sides: float, is_cut: bool = False) -> Any:
        looks = appearance_of(name, slab(*sides), None, is_cut=is_cut)
        return looks.words & BUILDS, looks.maybe & BUILDS

    assert build("shelf", 0.8, 0.3, 1.6) == ({"tall"}, {"tall"})
    assert build("bench", 1.2, 0.4, 0.4) == ({"long"}, {"long"})
    assert build("shelf", 0.8, 0.5, 1.2) == (frozenset(), {"tall"})
    assert build("box", 0.4, 0.4, 0.4) == (frozenset(), frozenset())
    assert build("blanket", 0.2, 0.2, 0.9) == build("door", 0.9, 0.1, 2.0) == (frozenset(), frozenset())
    assert build("shelf", 0.8, 0.3, 1.6, is_cut=True) == (frozenset(), BUILDS)
    assert build("lamp", 0.2, 0.2, 0.5) == (frozenset(), {"tall"})  # it may be short for a lamp
    assert build("keyboard", 0.5, 0.15, 0.03) == (frozenset(), {"long"})


def thing(one: int, name: str, sides: tuple[float, float, float], words: str = "", maybe: str = "") -> MapObject:
    low = np.array([4.0 * one, 0, 0])
    box = np.array([low, low + sides])
    sure = frozenset(words.split())
    looks = Appearance(np.array(sides), sure, sure | frozenset(maybe.split()))
    return MapObject(one, name, "", box.mean(axis=0), box, is_whole=False, looks=looks)


def asked(*things: MapObject) -> dict[str, tuple[str, tuple[int, ...] | None]]:
    others = [thing(100 + k, f"thing{k}", (0.5, 0.5, 0.5)) for k in range(12)]
    questions = generate("a/b", SceneMap((*things, *others)))
    return {one.text: (one.kind, one.answers) for one in questions if one.kind.startswith("property")}


def test_word_is_asked_only_if_unambiguous() -> None:
    table = (1.0, 1.0, 0.7)
    pair = thing(1, "table", table, "round red"), thing(2, "table", table, "rectangular", "brown")
    assert asked(*pair) == {
        "round table": ("property", (1,)), "red table": ("property", (1,)), "rectangular table": ("property", (2,)),
    }  # fmt: skip
    doubtful = thing(2, "table", table, "rectangular", "round red")
    assert set(asked(pair[0], doubtful)) == {"rectangular table"}
    assert asked(pair[0])["round table"] == ("property by name", (1,))
    three = asked(*pair, thing(3, "table", table, "round"))
    assert three["round table"] == ("property", (1, 3))  # all for which it is certain


def test_scan_sizes_ignore_objects_cut_by_images() -> None:
    small, large = thing(1, "box", (0.3, 0.3, 0.3)), thing(2, "box", (0.4, 0.4, 0.4))
    assert asked(small, large) == {"large box": ("property", (2,)), "small box": ("property", (1,))}
    assert asked(small, replace(large, is_cut=True)) == {}
    assert asked(small, thing(2, "box", (0.37, 0.37, 0.37))) == {}  # 1.9 times the volume
    assert (
        asked(thing(1, "lamp", (0.25, 0.25, 0.48)), thing(2, "lamp", (0.44, 0.44, 0.33))) == {}
    )  # the other is longer
    assert (
        asked(thing(1, "bottle", (0.06, 0.06, 0.23)), thing(2, "bottle", (0.08, 0.08, 0.27))) == {}
    )  # a finger longer
    assert asked(thing(1, "shelf", (0.8, 0.3, 0.9)), thing(2, "shelf", (0.8, 0.3, 1.6)))["tall shelf"][1] == (2,)
    assert asked(thing(1, "bench", (1.0, 0.4, 0.4)), thing(2, "bench", (1.6, 0.4, 0.4)))["long bench"][1] == (2,)
    doors = asked(thing(1, "door", (0.8, 0.1, 2.0)), thing(2, "door", (1.3, 0.1, 2.0)))
    assert (doors["wide door"][1], doors["narrow door"][1]) == ((2,), (1,)) and "long door" not in doors
    assert asked(thing(1, "book", (0.3, 0.3, 0.3)), thing(2, "book", (0.4, 0.4, 0.4))) == {}  # a row, perhaps


def test_flat_objects_use_face_area_and_soft_objects_have_no_length() -> None:
    flat = appearance_of("picture", slab(0.8, 0.02, 0.5), None, is_cut=False)
    assert measure_of("picture", flat, "large") == pytest.approx(0.4, abs=0.02)
    block = appearance_of("box", slab(0.8, 0.5, 0.5), None, is_cut=False)
    assert measure_of("box", block, "large") == pytest.approx(0.2, abs=0.01)
    assert measure_of("box", block, "tall") is not None and measure_of("blanket", block, "tall") is None
    leaning = appearance_of("cushion", slab(0.5, 0.2, 0.5), None, is_cut=False)
    assert measure_of("cushion", leaning, "large") == pytest.approx(0.25, abs=0.02)
    rug = appearance_of("rug", slab(2, 1, 0.02), None, is_cut=False)
    assert measure_of("rug", rug, "tall") is None and measure_of("rug", rug, "long") == pytest.approx(2, abs=0.03)


HEIGHT, WIDTH, FOCAL = 60, 80, 80.0
LABELS = LabelSet("replica", (20, 80), ("chair", "table"))


def wall_of_dots(instance: int, x: float, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a square 2 m in front of the camera, and the instance of each."""
    line = np.linspace(-side / 2, side / 2, 60)
    points = np.stack([*np.meshgrid(line + x, line), np.full((60, 60), 2.0)], axis=-1).reshape(-1, 3)
    return points, np.full(len(points), instance)


def seen_by_one_camera(depth_m: float = 2.0) -> tuple[Any, GroundTruth]:
    """A large red square and a small green one, in an image that is red on the left and green on the right."""
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


def test_image_share_equals_that_of_the_projected_square() -> None:
    dataset, truth = seen_by_one_camera()
    seen = sights(dataset, "s", truth, 1)
    assert seen[1].share == pytest.approx((0.8 * FOCAL / 2) ** 2 / (HEIGHT * WIDTH), rel=0.1)  # 32 pixels a side
    assert (seen[1].colour, seen[2].colour) == ("red", "green")
    assert seen[1].is_plain
    assert seen[2].share < MIN_PART_SHARE * 2  # 2 pixels a side
    assert pytest.approx(25**2, rel=0.02) == MIN_PART_SHARE * 640 * 480


def test_occluded_objects_are_not_visible() -> None:
    dataset, truth = seen_by_one_camera(depth_m=1.5)
    assert sights(dataset, "s", truth, 1) == {}
    objects = known_objects(truth, 1, None, {})
    assert [thing.is_query_target for thing in objects.objects] == [False, False]


def test_colour_is_given_if_frames_show_the_material_colour() -> None:
    dataset, truth = seen_by_one_camera()
    seen, box = sights(dataset, "s", truth, 1), np.array([[0, 0, 0], [1, 1, 1]], float)
    whole = [WholeObject(1, "chair", box, ("wicker",), "red"), WholeObject(2, "table", box, (), "blue")]
    captions = [thing.caption for thing in known_objects(truth, 1, whole, seen).objects]
    assert captions == ["red wicker", ""]
    assert known_objects(truth, 1, [WholeObject(1, "picture", box)], seen).objects[0].caption == ""


def test_unannotated_colour_must_be_stable_under_lighting() -> None:
    dataset, truth = seen_by_one_camera()
    box = np.array([[0, 0, 0], [1, 1, 1]], float)
    seen = sights(dataset, "s", truth, 1)
    assert seen[1].is_certain_colour and known_objects(truth, 1, None, seen).objects[0].caption == "red"
    dataset.frames("s", 1)[0].rgb[:] = 190  # grey; white in more light
    greyish = sights(dataset, "s", truth, 1)
    assert (greyish[1].colour, greyish[1].is_certain_colour) == ("white", False)
    assert known_objects(truth, 1, None, greyish).objects[0].caption == ""
    assert known_objects(truth, 1, [WholeObject(1, "chair", box, (), "white")], greyish).objects[0].caption == "white"


@pytest.mark.parametrize(("aside", "is_cut"), [(0.0, False), (-0.15, True)])
def test_object_at_image_border_is_cut(aside: float, is_cut: bool) -> None:
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
def test_colours_of_the_rooms_have_the_expected_words(rgb: tuple[int, int, int], word: str) -> None:
    assert colour_word(np.tile(np.array(rgb, np.float64), (100, 1))) == word
