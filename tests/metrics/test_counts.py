"""Counts: those of each kind that no scene gives are refused, and what scenes are joined and drawn to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from su3d_bench.core.errors import DataError
from su3d_bench.metrics.metric import Counts
from su3d_bench.metrics.scoring import METRICS

KINDS = {metric.counts.stored_as: metric.counts for metric in METRICS.values()}
NAN = np.nan
# Of each kind the arrays of a scene, and changes that make them impossible, each with the array that is named.
POSSIBLE: dict[str, dict[str, Any]] = {
    "instance": {
        "class_index": [0, 0], "threshold_index": [0, 1], "score": [0.5, 0.25], "is_true": [True, False],
        "n_missed": [[0, 1]], "n_truth": [1], "n_small_truth": [1], "n_predictions": [1],
    },
    "objects": {"n_points": [4], "totals": [[4.0, NAN]]},
    "shares": {"n_judged": [4, 0], "n_right": [4, 0], "by_chance": [1.5, NAN], "by_name": [1.5, NAN]},
    "semantic": {"confusion": [[5, 1, 0], [0, 0, 0]], "is_present": [True, False]},
    "top-k": {"best": [[1, 1, 0], [0, 0, 0]], "any": [[2, 0, 0], [0, 0, 0]], "is_present": [True, False]},
    "panoptic": {"n_matched": [1], "n_false": [0], "n_missed": [0], "iou": [0.75]},
    "boxes": {
        "class_index": [0], "score": [1.0], "is_true": [[True, True]], "n_truth": [1, 0], "n_centred": [1, 0],
        "n_located": [1, 0], "n_named": [1, 0],
    },
    "presence": {"sampling": [0], "is_there": [True], "is_yes": [True], "similarity": [1.0]},
    "relations": {
        "n_objects": [1], "n_objects_found": [1], "n_relations": [1], "n_predicates_found": [1],
        "n_triplets_found": [1],
    },
    "matched-objects": {"n_objects": [2, 3], "n_found": [2, 1], "n_ranked": [1, 0, 1]},
    "places": {
        "n_scenes": [1, 1], "n_bounds": [2, 2], "n_bounds_found": [1], "n_rooms": [2, 3], "n_rooms_found": [2, 1],
        "room_shares": [2.0, 2.5],
    },
}  # fmt: skip
IMPOSSIBLE: list[tuple[str, dict[str, Any], str]] = [
    ("instance", {"class_index": [0, 1]}, "'class_index' counts beyond"),
    ("instance", {"threshold_index": [0, 2]}, "'threshold_index' counts beyond"),
    ("instance", {"score": [0.5, NAN]}, "'score'"),
    ("instance", {"score": [1, 0]}, "'score' is int64"),
    ("instance", {"is_true": [True]}, "'is_true'"),
    ("instance", {"n_missed": [0, 1]}, "'n_missed'"),
    ("instance", {"n_small_truth": [1 << 60]}, "'n_small_truth' counts from"),
    ("instance", {"n_truth": [2]}, "'n_truth' of class 0"),
    ("instance", {"is_true": [False, False]}, "'n_truth' of class 0"),
    ("objects", {"n_points": [0]}, "'n_points'"),
    ("objects", {"totals": [[4.5, NAN]]}, "'totals'"),
    ("objects", {"totals": [[-1.0, NAN]]}, "'totals'"),
    ("objects", {"totals": [[np.inf, NAN]]}, "'totals'"),
    ("shares", {"n_right": [5, 0]}, "'n_right' has 5 of 4"),
    ("shares", {"n_right": [-1, 0]}, "'n_right' counts from -1"),
    ("shares", {"by_chance": [1.5, 0.5]}, "'by_chance'"),
    ("shares", {"by_name": [-0.5, NAN]}, "'by_name'"),
    ("semantic", {"confusion": [[5, -1, 0], [0, 0, 0]]}, "'confusion' counts from -1"),
    ("semantic", {"confusion": [[5, 0, 0], [0, 1, 0]]}, "'confusion' has points of class 1"),
    ("top-k", {"best": [[0, 0, 0], [2, 0, 0]]}, "class 1"),
    ("top-k", {"any": [[3, 0, 0], [0, 0, 0]]}, "'any'"),
    ("top-k", {"best": [[2, 0, 0], [0, 0, 0]], "any": [[1, 1, 0], [0, 0, 0]]}, "fewer hits"),
    ("panoptic", {"iou": [9.0]}, "'iou' of class 0"),
    ("panoptic", {"iou": [NAN]}, "'iou' of class 0"),
    ("boxes", {"n_truth": [0, 0]}, "'is_true' of class"),
    ("boxes", {"n_centred": [9, 0]}, "'n_centred' of class 0"),
    ("boxes", {"n_named": [9, 0]}, "'n_named' of class 0"),
    ("boxes", {"n_located": [9, 0]}, "'n_located' of class 0"),
    ("boxes", {"class_index": [2]}, "'class_index' counts beyond"),
    ("boxes", {"score": [NAN]}, "'score'"),
    ("boxes", {"is_true": [[False, True]]}, "'is_true' of class"),
    ("boxes", {"is_true": [[True]]}, "'is_true' has 1 thresholds"),
    ("presence", {"sampling": [3]}, "'sampling'"),
    ("presence", {"similarity": [NAN]}, "'similarity'"),
    ("presence", {"similarity": [1.1]}, "'similarity'"),
    ("relations", {"n_objects_found": [2]}, "'n_objects_found'"),
    ("relations", {"n_predicates_found": [0]}, "'n_triplets_found'"),
    ("matched-objects", {"n_found": [1, 2]}, "'n_found'"),
    ("matched-objects", {"n_ranked": [2, 0, 1]}, "'n_ranked'"),
    ("matched-objects", {"n_objects": [1, 3]}, "'n_found'"),
    ("matched-objects", {"n_objects": [9]}, "'n_objects'"),
    ("places", {"n_scenes": [2, 1]}, "floors"),
    ("places", {"n_bounds_found": [3]}, "floors"),
    ("places", {"n_bounds_found": [1, 1]}, "'n_bounds_found'"),
    ("places", {"n_rooms_found": [3, 1]}, "'n_rooms_found'"),
    ("places", {"room_shares": [2.5, 0.0]}, "'room_shares'"),
    ("places", {"room_shares": [-1.0, 0.0]}, "'room_shares'"),
]


def checked(kind: str, **changed: Any) -> Counts:
    return KINDS[kind].checked({name: np.array(values) for name, values in (POSSIBLE[kind] | changed).items()})


@pytest.mark.parametrize(("kind", "changed", "named"), IMPOSSIBLE)
def test_counts_that_no_scene_gives_are_refused(kind: str, changed: dict[str, Any], named: str) -> None:
    with pytest.raises(DataError, match=r"counts: .*; score the scene again") as caught:
        checked(kind, **changed)
    assert named in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_scenes_are_joined_row_after_row_and_added_up_and_drawn_with_weights(kind: str) -> None:
    one = checked(kind)
    twice = type(one).joined([one, one])
    for name, (number_kind, axes) in one.arrays().items():
        array = getattr(one, name)
        if axes[0] == "rows":
            np.testing.assert_array_equal(getattr(twice, name), np.concatenate([array, array]))
        elif number_kind == "b":
            np.testing.assert_array_equal(getattr(twice, name), array)
        else:
            np.testing.assert_array_equal(getattr(twice, name), 2 * array)
        if axes[0] != "rows" and array.ndim == 1:
            drawn = type(one).drawn([one, one], np.array([[1, 1], [0, 3]]), name)
            np.testing.assert_array_equal(drawn[name], [2.0 * array, 3.0 * array])
