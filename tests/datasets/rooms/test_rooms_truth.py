"""Ground truth of the rooms: classes, spatial relations, visible materials."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from su3d_bench.datasets.procedural.truth import SceneObject, SceneTruth
from su3d_bench.datasets.rooms.classes import CLASS_ID, CLASSES
from su3d_bench.datasets.rooms.dataset import SCENES, Rooms


@pytest.fixture(scope="module")
def truths(tmp_path_factory: pytest.TempPathFactory) -> list[SceneTruth]:
    rooms = Rooms(tmp_path_factory.mktemp("data"))
    return [rooms.truth(scene) for scene in SCENES]


def test_class_ids_match_replica() -> None:
    # info_semantic.json of the Replica release
    known = {"backpack": 1, "basket": 3, "bed": 7, "chair": 20, "ceiling": 31, "sofa": 76, "wall": 93, "rug": 98}
    assert {name: CLASS_ID[name] for name in known} == known
    assert len({one.id for one in CLASSES}) == len({one.name for one in CLASSES}) == len(CLASSES)
    assert all(1 <= one.id <= 101 for one in CLASSES)


def _low(one: SceneObject) -> np.ndarray:
    return np.asarray(one.box_min)


def _high(one: SceneObject) -> np.ndarray:
    return np.asarray(one.box_max)


def test_relations_hold_in_space(truths: list[SceneTruth]) -> None:
    counted: Counter[str] = Counter()
    for truth in truths:
        for link in truth.relations:
            a, b = truth.by_id(link.subject), truth.by_id(link.object)
            counted[link.relation] += 1
            apart = np.clip(np.maximum(_low(a) - _high(b), _low(b) - _high(a))[:2], 0, None)
            if link.relation in ("on", "in"):
                assert (apart == 0).all()
                assert b.box_min[2] <= a.box_min[2] <= b.box_max[2] + 0.04
            if link.relation == "in":
                assert a.box_min[2] < b.box_max[2] - 0.1
            if link.relation == "under":
                assert (apart <= 0.1 + 1e-9).all() and a.box_min[2] <= b.box_min[2] + 0.05
            if link.relation == "above":
                assert 0 < a.box_min[2] - b.box_max[2] <= 1.0
            if link.relation == "next to":
                assert np.hypot(*apart) <= 0.5 + 1e-9
    assert min(counted[name] for name in ("on", "in", "under", "above", "next to")) > 0


def test_material_is_stated_if_a_picture_shows_it(truths: list[SceneTruth]) -> None:
    shown = {(known.class_name, known.material) for t in truths for known in t.objects if known.shows_material}
    assert {("table", "wooden"), ("basket", "wicker")} <= shown
    assert {material for _, material in shown} == {"wooden", "wicker"}
    assert not any(known.whole().adjectives for t in truths for known in t.objects if not known.shows_material)
