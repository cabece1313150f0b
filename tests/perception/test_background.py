"""Names of walls, floors and ceilings as taggers and vision models give them, and of what hangs or stands there.

Tags are those of RAM's list (ram/data/ram_tag_list.txt of recognize-anything) that hold one of the words, all of them;
phrases are of the kind that GroundingDINO joins and vision models write.
"""

from __future__ import annotations

import pytest

from su3d_bench.opensu3d.config import OpenSU3DConfig
from su3d_bench.perception.detections import is_background

NAMES = OpenSU3DConfig().background_names


@pytest.mark.parametrize(
    "name",
    [
        # RAM's tags
        "wall", "city wall", "glass wall", "tile wall", "wood wall", "floor", "dance floor", "forest floor",
        "glass floor",
        "hardwood floor", "kitchen floor", "wood floor", "tile flooring", "ceiling", "roof", "tile roof",
        "training ground",
        # and what else is said
        "walls", "brick wall", "the floor", "false ceiling", "flooring", "White Wall", "the brick walls", "floors",
        "a wall", "ground", "roofing", "laminate flooring", "dropped ceiling", "wall of bricks", "ceiling with beams",
        "part of a wall", "wall section", "Floor surface", "wall and floor", "floor, wall", "wall (white)", "wall 2",
        "floor near the door",
    ],
)  # fmt: skip
def test_names_of_walls_floors_and_ceilings_are_background(name: str) -> None:
    assert is_background(name, NAMES)


@pytest.mark.parametrize(
    "name",
    [
        # RAM's tags
        "wall clock", "wall lamp", "wallpaper", "floor fan", "floor mat", "floor plan", "floor window", "ceiling fan",
        "roof garden", "ground squirrel", "playground", "fairground", "seawall", "brickwork",
        # and what else is said
        "floor lamp", "wall-cabinet", "wall plug", "wall art", "ceiling light", "picture on wall",
        "painting on the wall",
        "rug on the floor", "floor to ceiling window", "floor-to-ceiling curtains", "wall-to-wall carpet",
        "wall mounted tv",
        "floor and rug", "coffee grounds", "video wall", "wallet", "background", "corner of the room",
        "wall hanging", "",
    ],
)  # fmt: skip
def test_what_hangs_or_stands_there_stays(name: str) -> None:
    assert not is_background(name, NAMES)


def test_a_name_of_several_words_is_matched_as_a_whole() -> None:
    assert is_background("white base cabinets", ("base-cabinet",))
    assert not is_background("cabinet", ("base-cabinet",))
    assert not is_background("wall", ("",))
