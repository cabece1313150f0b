"""ConceptGraphs-Detect: background of one object a class, names that keep objects apart, its own parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conceptgraphs_scene import SCENE, Plate, at_cosine, axis, contents, look, mapped

from su3d_bench.baselines.conceptgraphs.method import ConceptGraphs, ConceptGraphsDetector, DetectorConfig
from su3d_bench.baselines.conceptgraphs.objects import MappingConfig
from su3d_bench.core import registry
from su3d_bench.core.system.timing import Timer

QUIET = DetectorConfig(noise_m=0.0, max_bbox_area_ratio=1.0)
LEFT, RIGHT = Plate((-0.5, 0.0), name="desk"), Plate((0.0, 0.5), name="lamp", feature=axis(1), text=axis(1))
WHOLE = replace(LEFT, x=(-0.5, 0.5))
ALL_STAY = QUIET.model_copy(update={"obj_min_detections": 0})
WALL = Plate((-0.9, -0.6), name="wall", feature=axis(2))
OTHER_WALL = Plate((0.6, 0.9), name="wall", feature=axis(3))


def test_all_regions_of_a_background_class_are_one_object_however_apart_and_unlike() -> None:
    method = mapped(ConceptGraphsDetector(QUIET), [[WALL], [OTHER_WALL]])
    assert method.n_instances == 1
    found = method.finish()
    assert found.views.tolist() == [[0, 0], [1, 0]]
    assert np.asarray(found.features)[0] == pytest.approx(np.array([0, 0, 1, 1]) / np.sqrt(2))


def test_at_the_end_background_is_denoised_to_its_largest_part() -> None:
    method = mapped(ConceptGraphsDetector(QUIET), [[WALL, replace(OTHER_WALL, x=(0.6, 0.8))]])
    found = method.finish()
    assert found.points[:, 0].max() < 0
    assert len(found.points) < method.n_points


def test_background_classes_are_apart_from_each_other_and_from_the_foreground() -> None:
    floor = replace(WALL, name="floor")
    chair = replace(WALL, name="chair")
    method = mapped(ConceptGraphsDetector(QUIET), [[WALL, floor, chair]] * 3)
    found = method.finish()
    assert found.names == ("chair", "wall", "floor")
    assert found.labels == ("", "wall", "floor")


def test_the_feature_decides_the_class_of_what_is_no_background() -> None:
    found = mapped(ConceptGraphsDetector(QUIET), [[LEFT]] * 3).finish()
    assert found.labels is None
    assert found.names == ("desk",)


def test_background_may_fill_the_image_and_be_seen_once() -> None:
    config = DetectorConfig(noise_m=0.0)
    wide = Plate((-0.9, 0.9), (-0.7, 0.7))
    found = mapped(ConceptGraphsDetector(config), [[replace(wide, name="wall")]]).finish()
    assert found.labels == ("wall",)
    assert mapped(ConceptGraphsDetector(config), [[replace(wide, name="desk")]] * 3).n_instances == 0


def test_background_without_foreground_starts_no_map_and_calls_for_no_cleaning_up() -> None:
    method = ConceptGraphsDetector(QUIET.model_copy(update={"denoise_interval": 1}))
    method.start(SCENE)
    seen = []
    for index, plates in enumerate([[WALL], [WALL, LEFT], [WALL], [WALL, LEFT]]):
        timer = Timer()
        method.update(*look(plates, index), timer)
        seen.append("denoise" in timer.take())
    assert seen == [False, False, False, True]


def test_background_may_be_skipped_and_is_then_not_asked_for() -> None:
    assert ConceptGraphsDetector(QUIET).needs.background_names == ()
    skipping = ConceptGraphsDetector(QUIET.model_copy(update={"skip_bg": True}))
    assert skipping.needs.background_names == ("wall", "floor", "ceiling")


def in_parts(cosine: float) -> list[list[Plate]]:
    """The larger part of a plate, the rest under a name of that ``cosine`` to its own, then the whole."""
    return [[replace(LEFT, x=(-0.5, 0.1))], [replace(LEFT, x=(0.1, 0.5), text=at_cosine(cosine))], [WHOLE]]


@pytest.mark.parametrize(("cosine", "n_left"), [(0.69, 2), (0.71, 1)])
def test_the_overlap_merge_needs_names_that_are_alike(cosine: float, n_left: int) -> None:
    method = mapped(ConceptGraphsDetector(ALL_STAY), in_parts(cosine))
    assert method.n_instances == 2
    assert len(method.finish()) == n_left


def test_class_agnostic_masks_merge_what_names_keep_apart() -> None:
    shared = ALL_STAY.model_dump(exclude={"skip_bg", "background_names", "grounding"})
    assert len(mapped(ConceptGraphs(MappingConfig(**shared)), in_parts(0.0)).finish()) == 1
    assert len(mapped(ConceptGraphsDetector(ALL_STAY), in_parts(0.0)).finish()) == 2


def test_objects_are_merged_at_the_end_only() -> None:
    method = mapped(ConceptGraphsDetector(ALL_STAY), [*in_parts(1.0), *[[WHOLE]] * 17])
    assert method.n_instances == 2
    assert len(method.finish()) == 1


def test_finish_midway_changes_nothing() -> None:
    views = [[LEFT, WALL], [RIGHT, OTHER_WALL], [LEFT, RIGHT, WALL], [LEFT, RIGHT, OTHER_WALL]]
    config = DetectorConfig(max_bbox_area_ratio=1.0, denoise_interval=2)
    straight, asked = mapped(ConceptGraphsDetector(config), views), ConceptGraphsDetector(config)
    asked.start(SCENE)
    for index, plates in enumerate(views):
        asked.update(*look(plates, index), Timer())
        asked.finish()
    assert contents(asked.finish()) == contents(straight.finish())


def test_the_defaults_are_those_of_the_readmes_command_for_detect() -> None:
    detect, agnostic = ConceptGraphsDetector().config, ConceptGraphs().config
    differing = {
        "mask_conf_threshold": (0.25, 0.95),
        "merge_interval": (-1, 20),
        "merge_visual_sim": (0.7, 0.8),
        "merge_text_sim": (0.7, 0.8),
    }
    for key in type(agnostic).model_fields:
        assert (getattr(detect, key), getattr(agnostic, key)) == differing.get(key, (getattr(agnostic, key),) * 2)
    assert detect.skip_bg is False
    needs = ConceptGraphsDetector().needs
    assert (needs.masks, needs.crop_padding_px, needs.name_features) == ("grounded", 20, True)


@pytest.mark.parametrize("method", [ConceptGraphs, ConceptGraphsDetector])
def test_both_are_registered_and_say_where_they_come_from(method: type[ConceptGraphs | ConceptGraphsDetector]) -> None:
    assert registry.load("method", method.name) is method
    assert "5c4da70" in method.about.source
    assert method.about.licence == "MIT"
