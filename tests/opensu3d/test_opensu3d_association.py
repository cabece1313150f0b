"""Association, worked by hand for each rule."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.opensu3d.config import OverlapRule
from su3d_bench.opensu3d.tracking import Overlaps, assign_ids, count_overlaps, overlap_ratios


def overlaps_of(best: list[int], shared: list[int], n_frame: list[int]) -> Overlaps:
    return Overlaps(np.arange(len(best), dtype=np.int32), np.array(n_frame), np.array(best, np.int32), np.array(shared))


def test_the_best_scene_segment_is_the_one_with_most_matched_pairs() -> None:
    segment = np.array([2, 2, 2, 2, 2, 5, 5, 9], np.int32)
    matched_id = np.array([7, 7, 3, 0, 7, 3, 3, 0], np.int32)
    overlaps = count_overlaps(segment, matched_id)
    assert overlaps.segments.tolist() == [2, 5, 9]
    assert overlaps.n_frame.tolist() == [5, 2, 1]
    assert overlaps.best.tolist() == [7, 3, 0]
    assert overlaps.shared.tolist() == [3, 2, 0]


def test_of_scene_segments_with_equally_many_pairs_the_lower_id_is_best() -> None:
    overlaps = count_overlaps(np.zeros(5, np.int32), np.array([8, 4, 8, 4, 11], np.int32))
    assert (overlaps.best.tolist(), overlaps.shared.tolist()) == ([4], [2])


def test_matches_with_points_of_no_instance_do_not_count() -> None:
    overlaps = count_overlaps(np.zeros(4, np.int32), np.zeros(4, np.int32))
    assert (overlaps.best.tolist(), overlaps.shared.tolist(), overlaps.n_frame.tolist()) == ([0], [0], [4])


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("smaller-segment", [30 / 40, 30 / 60, 0.0]),  # over min(100, 40) and min(60, 500)
        ("frame-segment", [30 / 100, 30 / 60, 0.0]),
        ("as-printed", [1.0, 1.0, 0.0]),  # max(c) / min(c_f, max(c)), with c_f never below the matched pairs
    ],
)
def test_each_rule_gives_its_ratio(rule: OverlapRule, expected: list[float]) -> None:
    overlaps = overlaps_of([4, 6, 0], [30, 30, 0], [100, 60, 50])
    np.testing.assert_allclose(overlap_ratios(overlaps, np.array([40, 500, 0]), rule), expected)


def test_a_ratio_of_exactly_the_threshold_joins_and_one_below_does_not() -> None:
    overlaps = overlaps_of([4, 6, 0], [3, 3, 0], [10, 11, 5])
    ratios = overlap_ratios(overlaps, np.array([10, 11, 0]), "smaller-segment")
    ids, next_id = assign_ids(overlaps, ratios, 0.3, 20)
    assert ids.tolist() == [4, 20, 21]
    assert next_id == 22


def test_two_frame_segments_may_take_one_scene_segment() -> None:
    ids, next_id = assign_ids(overlaps_of([4, 4], [9, 8], [10, 10]), np.array([0.9, 0.8]), 0.3, 5)
    assert (ids.tolist(), next_id) == ([4, 4], 5)
