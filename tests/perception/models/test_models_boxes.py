"""Boxes and images on their way into and out of foundation models, on cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from su3d_bench.core.types import Float32Array
from su3d_bench.perception.models.encoders.images import (
    size_with_longest_side,
    size_with_shortest_side,
)
from su3d_bench.perception.models.masks.grounding_dino import box_overlaps, corners_of, suppress


def boxes_of(*rows: tuple[float, ...]) -> Float32Array:
    return np.array(rows, np.float32).reshape(-1, 4)


def test_boxes_become_pixels_before_corners_as_in_the_original() -> None:
    """Boxes of 1200x680 by ``Model.post_process_result``; the other order has other last bits."""
    told = corners_of(boxes_of((0.34, 0.43, 0.97, 0.56)), 680, 1200)
    np.testing.assert_array_equal(told, boxes_of((-174.0, 102.0, 990.0, 482.79998779296875)))


def test_overlap_is_intersection_over_union() -> None:
    others = boxes_of((0, 0, 10, 10), (5, 0, 15, 10), (0, 0, 5, 10), (10, 0, 20, 10), (3, 3, 3, 3))
    np.testing.assert_allclose(box_overlaps(boxes_of((0, 0, 10, 10))[0], others), [1, 50 / 150, 0.5, 0, 0])
    assert np.isnan(box_overlaps(boxes_of((1, 1, 1, 4))[0], boxes_of((1, 1, 1, 4)))[0])


def test_an_overlap_of_exactly_the_threshold_is_no_reason_to_go() -> None:
    boxes = boxes_of((0, 0, 10, 10), (0, 0, 5, 10))
    scores = np.array([0.9, 0.8], np.float32)
    assert suppress(boxes, scores, 0.5).tolist() == [0, 1]
    assert suppress(boxes, scores, 0.49).tolist() == [0]
    # Unless float32 has it a little above, as of 0.4, the paper's threshold.
    assert suppress(boxes_of((0, 0, 10, 10), (0, 0, 4, 10)), scores, 0.4).tolist() == [0]


def test_suppression_equals_its_definition_on_random_boxes() -> None:
    random = np.random.default_rng(3)
    corners = random.uniform(0, 60, (200, 2))
    boxes = np.concatenate([corners, corners + random.uniform(1, 40, (200, 2))], axis=1).astype(np.float32)
    scores = random.integers(0, 20, 200).astype(np.float32)
    kept: list[int] = []
    for index in sorted(range(200), key=lambda k: (-scores[k], k)):
        if not kept or box_overlaps(boxes[index], boxes[kept]).max() <= 0.4:
            kept.append(index)
    assert suppress(boxes, scores, 0.4).tolist() == kept
    assert 20 < len(kept) < 150


@pytest.mark.parametrize(
    ("size", "longest", "shortest"),
    [
        ((680, 1200), (580, 1024), (755, 1332)),  # 1333 * 680 / 1200 = 755.37: rounded, and 755 * 1200 / 680 = 1332.35
        ((480, 640), (768, 1024), (800, 1066)),
        ((640, 480), (1024, 768), (1066, 800)),
        ((100, 100), (1024, 1024), (800, 800)),
        ((800, 900), (910, 1024), (800, 900)),
    ],
)
def test_sizes_follow_the_originals_rules(
    size: tuple[int, int], longest: tuple[int, int], shortest: tuple[int, int]
) -> None:
    assert size_with_longest_side(*size, 1024) == longest
    assert size_with_shortest_side(*size, 800, 1333) == shortest
