"""The filter of large background objects that labels n' make possible: what it leaves out, and what stays."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.core.maps import Instances
from su3d_bench.questions.refining import FilterConfig, undesired


def plan_of(*sides_m: tuple[float, float]) -> Instances:
    """Instances whose boxes have these sides from above, in a map of 10 m by 10 m with points of no instance."""
    clouds = [np.array([[0, 0, 0], [x, y, 1]], np.float32) for x, y in sides_m]
    corners = np.array([[0, 0, 0], [10, 10, 2]], np.float32)
    masks = [np.array([2 * k, 2 * k + 1]) for k in range(len(clouds))]
    return Instances.of(np.concatenate([*clouds, corners]), masks)


@pytest.mark.parametrize("name", ["wall", "walls", "Wall", "hardwood floor", "the ground", "false ceiling", "roof"])
def test_names_of_background_are_left_out(name: str) -> None:
    assert undesired(plan_of((1, 1)), (name,), FilterConfig()) == (f"'{name}' is background",)
    assert undesired(plan_of((1, 1)), (name,), FilterConfig(background_names=())) == ("",)


@pytest.mark.parametrize("name", ["wall lamp", "floor mat", "ceiling fan", "wall-mounted shelf", "sofa", "", "<wall>x"])
def test_things_on_walls_and_floors_stay(name: str) -> None:
    assert undesired(plan_of((1, 1)), (name,), FilterConfig()) == ("",)


def test_a_box_that_covers_the_map_from_above_is_left_out() -> None:
    made = plan_of((9.8, 9.8), (9.7, 9.7), (1, 10))  # 96 %, 94 %, 10 %
    assert undesired(made, ("rug", "rug", "rug"), FilterConfig()) == (
        "its box has 96 % of the map's area from above",
        "",
        "",
    )
    assert undesired(made, ("rug",) * 3, FilterConfig(max_map_fraction=1.0)) == ("", "", "")
    assert undesired(made, ("rug",) * 3, FilterConfig(max_map_fraction=0.05))[2] != ""
