"""Corruptions of time, on values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import recording
from severity_measures import PLACES, apply_to_frame, apply_to_order

from su3d_bench.core.types import Int64Array
from su3d_bench.corruptions.model import generator
from su3d_bench.corruptions.time import ROWS

LOST_BURSTS, DUPLICATES, REORDERED, DEPTH_LAG, COLOUR_LAG = ROWS
MANY = np.arange(1000)


def order(row: int, value: float) -> Int64Array:
    found = ROWS[row].function(MANY, value, generator(ROWS[row], 0, "scene"))
    assert isinstance(found, np.ndarray)
    return found


def test_a_share_of_updates_is_lost_in_bursts() -> None:
    found = order(0, 0.4)
    n_bursts = np.count_nonzero(np.diff(np.isin(MANY, found).astype(int)) == -1)
    assert len(found) == 600 and (np.diff(found) > 0).all()
    assert 50 < n_bursts < 120  # of about 5 updates; 240 bursts if each update were lost independently


def test_one_update_remains_if_all_are_lost() -> None:
    assert len(apply_to_order(LOST_BURSTS, 1.0)) == 1


def test_a_share_of_frames_is_fed_twice_in_a_row() -> None:
    found = apply_to_order(DUPLICATES, 0.5)
    assert len(found) == 24 + 12 and (np.diff(found) >= 0).all() and (np.unique(found) == PLACES).all()
    assert apply_to_order(DUPLICATES, 1.0).tolist() == np.repeat(PLACES, 2).tolist()


@pytest.mark.parametrize("window", [2, 8, 32])
def test_frames_move_by_less_than_the_window(window: int) -> None:
    found = order(2, float(window))
    distance = np.abs(np.argsort(found) - MANY)
    assert (np.sort(found) == MANY).all()
    assert window / 2 < distance.max() + 1 <= window and distance.mean() > 0.1 * window


def test_a_later_frame_arrives_first_where_the_delays_differ_enough() -> None:
    class Delays(np.random.Generator):
        def random(self, *size: object, **options: object) -> object:  # type: ignore[override]
            return np.array([0.9, 0.3, 0.8, 0.1])

    # at a window of 2: 0 + 1.8, 1 + 0.6, 2 + 1.6 and 3 + 0.2
    found = REORDERED.function(np.array([10, 20, 30, 40]), 2.0, Delays(np.random.PCG64(0)))
    assert isinstance(found, np.ndarray) and found.tolist() == [20, 10, 40, 30]


@pytest.mark.parametrize(("index", "source"), [(7, 2), (3, 0), (0, 0)])
def test_an_image_is_that_of_5_frames_before_or_the_first(index: int, source: int) -> None:
    frames = recording().frames
    late_depth, late_colour = (apply_to_frame(row, 5.0, index=index) for row in (DEPTH_LAG, COLOUR_LAG))
    assert late_depth.depth_m is frames[source].depth_m and late_depth.rgb is frames[index].rgb
    assert late_colour.rgb is frames[source].rgb and late_colour.depth_m is frames[index].depth_m
    assert late_depth.camera_to_world is late_colour.camera_to_world is frames[index].camera_to_world
