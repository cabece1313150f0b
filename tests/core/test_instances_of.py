"""``Instances.of`` accepts masks in all common forms, and its errors name the invalid argument."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.maps import Instances

POINTS = np.arange(18, dtype=np.float32).reshape(6, 3)
SETS = [[0, 1, 4], [3]]

FORMS: dict[str, Any] = {
    "indices": [np.array([0, 1, 4]), np.array([3])],
    "plain lists": SETS,
    "in any order, some twice": [np.array([4, 0, 1, 0]), np.array([3, 3])],
    "bools": [np.isin(np.arange(6), members) for members in SETS],
    "a table of bools": np.array([np.isin(np.arange(6), members) for members in SETS]),
    "numbers of instances": np.array([0, 0, -1, 1, 0, -1]),
    "small numbers of instances": np.array([0, 0, -1, 1, 0, -1], np.int8),
}


@pytest.mark.parametrize("form", FORMS)
def test_all_forms_of_masks_give_the_same_map(form: str) -> None:
    found = Instances.of(POINTS, FORMS[form], [1, 2], np.eye(2))
    assert [mask.tolist() for mask in found.sets()] == SETS
    assert found.scores.tolist() == [1.0, 2.0] and found.scores.dtype == np.float64
    assert found.boxes[0].tolist() == [[0, 1, 2], [12, 13, 14]]


@pytest.mark.parametrize("masks", [[], np.zeros((0, 6), bool), np.full(6, -1)])
def test_map_may_have_no_instances(masks: Any) -> None:
    assert len(Instances.of(POINTS, masks, [], np.array([]))) == 0


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "flat points": ({"points": POINTS[:, :2]}, "points is float32 (6, 2)"),
    "whole points": ({"points": POINTS.astype(int)}, "points is int64 (6, 3)"),
    "no masks": ({"masks": None}, "masks is None"),
    "one mask": ({"masks": np.ones(6, bool)}, "masks is bool (6,)"),
    "numbers of too few": ({"masks": np.zeros(5, int)}, "masks is int64 (5,)"),
    "numbers below": ({"masks": np.array([0, 1, -2, 0, 0, 0])}, "masks has numbers -2 to 1"),
    "numbers with gaps": ({"masks": np.array([0, 0, 2, 2, 2, 0])}, "masks has no point of instance 1"),
    "too few bools": ({"masks": [np.ones(5, bool)] * 2}, "the mask of instance 0 is bool (5,)"),
    "shares": ({"masks": [[0], [0.5, 0.7]]}, "the mask of instance 1 is float64 (2,)"),
    "masks of images": ({"masks": np.ones((2, 4, 5), bool)}, "the mask of instance 0 is bool (4, 5)"),
    "beyond": ({"masks": [[0], [6]]}, "instance 1: mask has index 6"),
    "a score too many": ({"scores": np.ones(3)}, "scores is float64 (3,)"),
    "words as scores": ({"scores": ["high", "low"]}, "scores is texts (2,)"),
    "a feature of all": ({"features": np.ones(4)}, "features is float64 (4,)"),
    "uneven features": ({"features": [[1.0], [1.0, 2.0]]}, "features: not an array"),
    "half views": ({"views": [[(0.5, 1)], []]}, "views is float64 (1, 2)"),
    "views of one": ({"views": [[(0, 1)]]}, "views of 1 instances for 2 masks"),
    "one label": ({"labels": ["chair"]}, "2 masks and 1 labels"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_invalid_values_are_reported_by_name(mistake: str) -> None:
    changed, printed = WRONG[mistake]
    words: dict[str, Any] = {"points": POINTS, "masks": SETS, **changed}
    with pytest.raises(PredictionError) as error:
        Instances.of(words.pop("points"), words.pop("masks"), **words)
    assert printed in str(error.value)
