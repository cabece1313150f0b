"""Ground truth of the rooms: classes, sizes, spatial relations, everyday names."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from su3d_bench.datasets.procedural.materials import COLOURS, MATERIALS
from su3d_bench.datasets.procedural.truth import SceneObject, SceneTruth
from su3d_bench.datasets.rooms.classes import CLASS_ID, CLASSES
from su3d_bench.datasets.rooms.dataset import Rooms
from su3d_bench.datasets.rooms.objects.catalog import BUILDERS, make
from su3d_bench.datasets.rooms.objects.items import USUAL_VOLUME_L, size_word
from su3d_bench.datasets.rooms.plan import FLAT
from su3d_bench.datasets.rooms.recipes import KINDS

SCENES = ("living3", "bedroom3", "kitchen3", "office3", "bathroom3", "studio3")


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


def test_every_class_except_the_bare_room_has_a_builder() -> None:
    assert set(CLASS_ID) - set(BUILDERS) == {"wall", "floor", "ceiling"}
    assert set(BUILDERS) <= set(CLASS_ID)
    for one in CLASSES:
        assert set(one.materials) <= set(MATERIALS)
        assert set(one.colours) <= set(COLOURS)


def test_all_kinds_together_show_most_classes(truths: list[SceneTruth]) -> None:
    seen = Counter(one.class_name for truth in truths for one in truth.objects)
    assert len(seen) >= 55
    assert {truth.kind for truth in truths} == set(KINDS)
    repeated = [
        (truth, name) for truth in truths for name, n in Counter(o.class_name for o in truth.objects).items() if n > 1
    ]
    differ = [len({(o.colour, o.size_m) for o in t.objects if o.class_name == name}) > 1 for t, name in repeated]
    assert np.mean(differ) > 0.8


def test_typical_volumes_are_the_stated_medians() -> None:
    class_name, model = "lamp", "table_lamp"
    sizes = [make(class_name, np.random.default_rng([7, seed]), model).size for seed in range(200)]
    assert 1000 * np.median([np.prod(size) for size in sizes]) == pytest.approx(USUAL_VOLUME_L[model], rel=0.01)
    words = Counter(size_word(model, size) for size in sizes)
    assert min(words[word] for word in ("small", "medium", "large")) > 20


@pytest.mark.parametrize("class_name", sorted(BUILDERS))
def test_shapes_are_valid(class_name: str) -> None:
    for builder in BUILDERS[class_name]:
        item = make(class_name, np.random.default_rng(3), builder.__name__)
        for part in item.parts:
            lengths = np.linalg.norm(part.shape.normals, axis=-1)
            assert np.allclose(lengths, 1.0, atol=1e-6)
            assert np.isfinite(part.shape.quads).all()
        corners = np.concatenate([part.shape.quads.reshape(-1, 3) for part in item.parts])
        assert np.allclose(corners.min(axis=0), [-item.size[0] / 2, -item.size[1] / 2, 0.0], atol=1e-9)


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


def test_standing_furniture_does_not_collide(truths: list[SceneTruth]) -> None:
    for truth in truths:
        standing = [o for o in truth.objects if o.support == "floor" and o.class_name not in FLAT]
        for i, a in enumerate(standing):
            for b in standing[i + 1 :]:
                overlap = np.minimum(_high(a), _high(b)) - np.maximum(_low(a), _low(b))
                assert not (overlap > 1e-6).all(), (truth.scene, a.class_name, b.class_name)


def test_everything_is_inside_the_room(truths: list[SceneTruth]) -> None:
    for truth in truths:
        floor, ceiling = truth.by_id(1), truth.by_id(2)
        for one in truth.objects:
            assert (_low(one)[:2] >= _low(floor)[:2] - 1e-6).all()
            assert (_high(one)[:2] <= _high(floor)[:2] + 1e-6).all()
            assert one.box_min[2] >= -1e-9 and one.box_max[2] <= ceiling.box_max[2] + 1e-9


def test_material_is_stated_if_a_picture_shows_it(truths: list[SceneTruth]) -> None:
    shown = {(known.class_name, known.material) for t in truths for known in t.objects if known.shows_material}
    assert {("table", "wooden"), ("basket", "wicker")} <= shown
    assert {material for _, material in shown} == {"wooden", "wicker"}
    assert not any(known.whole().adjectives for t in truths for known in t.objects if not known.shows_material)
