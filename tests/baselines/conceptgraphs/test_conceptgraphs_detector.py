"""ConceptGraphs-Detect: one object per background class, names that keep objects apart, its own parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plates import Plate, at_cosine, axis, mapped

from su3d_bench.baselines.conceptgraphs.method import ConceptGraphsDetector, DetectorConfig

QUIET = DetectorConfig(noise_m=0.0, max_bbox_area_ratio=1.0)
LEFT, RIGHT = Plate((-0.5, 0.0), name="desk"), Plate((0.0, 0.5), name="lamp", feature=axis(1), text=axis(1))
WHOLE = replace(LEFT, x=(-0.5, 0.5))
ALL_STAY = QUIET.model_copy(update={"obj_min_detections": 0})
WALL = Plate((-0.9, -0.6), name="wall", feature=axis(2))
OTHER_WALL = Plate((0.6, 0.9), name="wall", feature=axis(3))


def test_all_regions_of_a_background_class_are_one_object() -> None:
    method = mapped(ConceptGraphsDetector(QUIET), [[WALL], [OTHER_WALL]])
    assert method.n_instances == 1
    found = method.finish()
    assert found.views.tolist() == [[0, 0], [1, 0]]
    assert np.asarray(found.features)[0] == pytest.approx(np.array([0, 0, 1, 1]) / np.sqrt(2))


def test_feature_decides_the_class_of_foreground_objects() -> None:
    found = mapped(ConceptGraphsDetector(QUIET), [[LEFT]] * 3).finish()
    assert found.labels is None
    assert found.names == ("desk",)


def in_parts(cosine: float) -> list[list[Plate]]:
    """The larger part of a plate, the rest with a name of that ``cosine`` to the first name, then the whole plate."""
    return [[replace(LEFT, x=(-0.5, 0.1))], [replace(LEFT, x=(0.1, 0.5), text=at_cosine(cosine))], [WHOLE]]


@pytest.mark.parametrize(("cosine", "n_left"), [(0.69, 2), (0.71, 1)])
def test_overlap_merge_needs_similar_names(cosine: float, n_left: int) -> None:
    method = mapped(ConceptGraphsDetector(ALL_STAY), in_parts(cosine))
    assert method.n_instances == 2
    assert len(method.finish()) == n_left
