"""ConceptGraphs' map of objects: what joins what, when it is cleaned up, what it tells, how it differs from others."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conceptgraphs_scene import (
    QUIET,
    SCENE,
    Plate,
    at_cosine,
    axis,
    contents,
    look,
    mapped,
)
from painted import colour_perception
from places import SCENES

from su3d_bench.baselines.conceptgraphs.method import ConceptGraphs
from su3d_bench.baselines.conceptgraphs.objects import MappingConfig
from su3d_bench.cli.main import main
from su3d_bench.core.system.timing import Timer
from su3d_bench.opensu3d.config import Density, OpenSU3DConfig
from su3d_bench.opensu3d.pipeline import OpenSU3D
from su3d_bench.runs import scene as scene_run

LEFT, RIGHT = Plate((-0.5, 0.0)), Plate((0.0, 0.5))
BARE = QUIET.model_copy(update={"obj_min_detections": 0})


def found_by(views: list[list[Plate]], config: MappingConfig = BARE) -> int:
    return len(mapped(ConceptGraphs(config), views).finish())


def test_in_the_first_frame_every_region_becomes_an_object_however_alike_they_are() -> None:
    method = mapped(ConceptGraphs(BARE), [[LEFT, LEFT]])
    assert method.n_instances == 2


def test_in_the_next_frame_several_regions_may_join_one_object() -> None:
    method = mapped(ConceptGraphs(BARE), [[Plate((-0.5, 0.5))], [LEFT, RIGHT]])
    found = method.finish()
    assert len(found) == 1
    assert found.views.tolist() == [[0, 0], [1, 0], [1, 1]]


def test_the_feature_is_the_average_weighted_by_detections() -> None:
    views = [
        [replace(LEFT, feature=axis(0))],
        [replace(LEFT, feature=axis(0))],
        [replace(LEFT, feature=at_cosine(0.6))],
    ]
    found = mapped(ConceptGraphs(BARE), views).finish()
    mean = np.array([(2 * 1 + 0.6) / 3, 0.8 / 3, 0, 0])
    assert np.asarray(found.features)[0] == pytest.approx(mean / np.linalg.norm(mean), abs=1e-6)


def test_objects_of_fewer_than_three_detections_are_left_out_at_the_end() -> None:
    far = Plate((0.6, 0.9))
    assert found_by([[LEFT, far], [LEFT, far], [LEFT]], QUIET) == 1
    assert found_by([[LEFT, far], [LEFT, far], [LEFT, far]], QUIET) == 2
    assert found_by([[LEFT]], QUIET) == 0


def stages(method: ConceptGraphs, plates: list[Plate], index: int) -> set[str]:
    timer = Timer()
    method.update(*look(plates, index), timer)
    return set(timer.take())


def test_every_twentieth_frame_objects_are_denoised_and_overlapping_ones_merged() -> None:
    method = ConceptGraphs(QUIET)
    method.start(SCENE)
    told = [stages(method, [LEFT], index) for index in range(40)]
    assert [k for k, names in enumerate(told) if "denoise" in names] == [19, 39]
    assert [k for k, names in enumerate(told) if "overlap" in names] == [19, 39]
    assert told[1] == {"filter", "backproject", "match", "merge"}


def test_a_frame_without_regions_is_counted_but_not_followed_by_cleaning_up() -> None:
    method = ConceptGraphs(QUIET.model_copy(update={"denoise_interval": 2, "merge_interval": 3}))
    method.start(SCENE)
    told = [stages(method, [LEFT] if shown else [], k) for k, shown in enumerate((1, 0, 1, 1, 1, 0))]
    assert [k for k, names in enumerate(told) if "denoise" in names] == [3]
    assert [k for k, names in enumerate(told) if "overlap" in names] == [2]


def test_the_first_frame_with_regions_is_not_followed_by_cleaning_up() -> None:
    method = ConceptGraphs(QUIET.model_copy(update={"denoise_interval": 1}))
    method.start(SCENE)
    assert "denoise" not in stages(method, [], 0) | stages(method, [LEFT], 1)
    assert "denoise" in stages(method, [LEFT], 2)


def test_filtering_midway_drops_what_was_seen_too_rarely() -> None:
    config = QUIET.model_copy(update={"filter_interval": 3})
    far = Plate((0.6, 0.9))
    assert mapped(ConceptGraphs(QUIET), [[LEFT, far], [LEFT], [LEFT]]).n_instances == 2
    assert mapped(ConceptGraphs(config), [[LEFT, far], [LEFT], [LEFT]]).n_instances == 1


def test_finish_midway_changes_nothing() -> None:
    config = MappingConfig(max_bbox_area_ratio=1.0, denoise_interval=3, merge_interval=4, obj_min_detections=2)
    views = [[LEFT, RIGHT], [RIGHT], [Plate((-0.3, 0.3)), LEFT], [LEFT, RIGHT], [Plate((-0.5, 0.5))]]
    straight = mapped(ConceptGraphs(config), views)
    asked = ConceptGraphs(config)
    asked.start(SCENE)
    for index, plates in enumerate(views):
        asked.update(*look(plates, index), Timer())
        assert contents(asked.finish()) == contents(asked.finish())
    assert contents(asked.finish()) == contents(straight.finish())
    assert len(straight.finish()) > 0


def test_start_forgets_the_scene_before() -> None:
    method = mapped(ConceptGraphs(BARE), [[LEFT], [RIGHT]])
    once = contents(method.finish())
    assert contents(mapped(method, [[LEFT], [RIGHT]]).finish()) == once


def test_each_object_has_points_of_its_own_and_tells_its_views() -> None:
    near = [replace(LEFT, name="desk", score=0.96), replace(RIGHT, name="lamp")]
    again = [replace(LEFT, name="table", score=0.99), replace(RIGHT, name="lamp")]
    found = mapped(ConceptGraphs(BARE), [near, again, [replace(LEFT, name="table", score=0.97)]]).finish()
    assert found.labels is None
    assert found.names == ("table", "lamp")
    assert found.captions == ("a table", "a lamp")
    assert found.view_names == ("desk", "table", "table", "lamp", "lamp")
    assert found.view_scores is not None
    assert found.view_scores.tolist() == pytest.approx([0.96, 0.99, 0.97, 1, 1])
    assert found.views.tolist() == [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1]]
    assert found.indices.tolist() == list(range(len(found.points)))
    assert found.points[found.mask(0)][:, 0].max() < 0.05 < found.points[found.mask(1)][:, 0].max()


@pytest.mark.parametrize(("rule", "score"), [("ones", 1.0), ("num-detections", 2.0), ("max-confidence", 0.98)])
def test_scores_are_ones_or_what_is_configured_and_the_caveat_says_so(rule: str, score: float) -> None:
    config = BARE.model_copy(update={"instance_score": rule})
    views = [[replace(LEFT, score=0.96)], [replace(LEFT, score=0.98)]]
    method = mapped(ConceptGraphs(config), views)
    assert method.finish().scores.tolist() == pytest.approx([score])
    assert method.caveat.startswith("the original has no scores")
    assert ("1 for every object" in method.caveat) == (rule == "ones")


def test_nothing_seen_is_an_empty_map() -> None:
    method = mapped(ConceptGraphs(), [[], []])
    assert (len(method.finish()), method.n_points, method.n_instances, method.map_bytes) == (0, 0, 0, 0)
    seen = mapped(ConceptGraphs(BARE), [[LEFT]])
    assert seen.map_bytes > seen.n_points * 3 * 8 > 0


def test_class_agnostic_means_that_names_decide_nothing() -> None:
    walls = [[replace(LEFT, name="wall", text=axis(1))], [replace(LEFT, name="floor", text=axis(2))]]
    found = mapped(ConceptGraphs(BARE), walls).finish()
    assert len(found) == 1
    assert found.labels is None


def test_the_defaults_are_those_of_the_commands_of_the_readme() -> None:
    config = ConceptGraphs().config
    expected = {
        "stride": 5, "spatial_sim_type": "overlap", "phys_bias": 0, "mask_area_threshold": 25,
        "mask_conf_threshold": 0.95, "max_bbox_area_ratio": 0.5, "min_points_threshold": 16,
        "downsample_voxel_size": 0.025, "dbscan_eps": 0.1, "dbscan_min_points": 10, "denoise_interval": 20,
        "filter_interval": -1, "merge_interval": 20, "obj_min_points": 0, "obj_min_detections": 3,
        "merge_overlap_thresh": 0.7, "merge_visual_sim": 0.8, "merge_text_sim": 0.8, "noise_m": 0.004,
    }  # fmt: skip
    assert {key: getattr(config, key) for key in expected} == expected
    assert config.association_threshold == 1.2
    needs = ConceptGraphs().needs
    assert (needs.masks, needs.crop_ratios, needs.crop_padding_px) == ("class-agnostic", (1.0,), 20)


# What it does unlike others


def opensu3d_finds(views: list[list[Plate]], density: Density = "scene") -> int:
    """Objects of OpenSU3D on the same frames."""
    config = OpenSU3DConfig(border_px=1, border_reference_width=0, crop_ratios=(1.0,), density=density)
    method = OpenSU3D(config)
    return len(mapped(method, views).finish())


def test_two_touching_objects_of_one_class_stay_apart() -> None:
    # features are alike, so geometry decides: each plate lies in itself (1 + 1), hardly in its neighbour (0.1 + 1)
    assert found_by([[LEFT, RIGHT]] * 3, QUIET) == 2


def test_two_similar_objects_apart_stay_apart() -> None:
    # 0 + 1 is below 1.2, however alike they are
    assert found_by([[Plate((-0.5, -0.2))], [Plate((0.2, 0.5))]]) == 2


def test_features_that_disagree_keep_apart_what_lies_in_one_place() -> None:
    # 1 + 0.1 is below 1.2; OpenSU3D looks at geometry alone
    views = [[LEFT], [replace(LEFT, feature=at_cosine(0.1))]]
    assert found_by(views) == 2
    assert opensu3d_finds(views) == 1
    assert found_by([[LEFT], [replace(LEFT, feature=at_cosine(0.3))]]) == 1


def test_halves_of_an_object_stay_two_until_the_overlap_merge() -> None:
    whole = Plate((-0.5, 0.5))
    views = [[LEFT], [RIGHT], [whole]]
    late = BARE.model_copy(update={"merge_interval": 4})
    early = BARE.model_copy(update={"merge_interval": 3})
    assert mapped(ConceptGraphs(late), views).n_instances == 2
    assert mapped(ConceptGraphs(early), views).n_instances == 1
    assert found_by(views, late) == 1  # the last overlap merge joins them anyhow
    assert found_by(views, late.model_copy(update={"merge_overlap_thresh": 0.0})) == 2
    assert opensu3d_finds(views, density="frame") == 2
    assert opensu3d_finds(views) == 1  # the whole takes the places of both halves


def test_a_run_maps_painted_scenes_and_times_the_stages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    painted = f"{SCENES}/painted.py:Painted/a"
    settings = ["conceptgraphs.stride=1", "conceptgraphs.max_bbox_area_ratio=1.0", "conceptgraphs.denoise_interval=2"]
    protocols = ["--protocols", "rooms-semantic", "rooms-instance"]
    out = [*protocols, "--no-pictures", "--jobs", "1", "--out", str(tmp_path / "out")]
    assert main(["run", "--scenes", painted, "--methods", "conceptgraphs", "--set", *settings, *out]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    values = {name: value for one in metrics["results"] for name, value in one["result"]["metrics"].items()}
    assert values["mAcc"] > 0.9
    assert values["AP50"] == 1.0
    (table,) = (tmp_path / "out").rglob("conceptgraphs/updates.csv")
    columns = set(next(csv.reader(table.open())))
    assert columns >= {f"{name}_ms" for name in ("filter", "backproject", "match", "merge", "denoise")}
    assert columns >= {"n_points", "n_instances"}
