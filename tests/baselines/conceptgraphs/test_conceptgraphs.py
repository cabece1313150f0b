"""ConceptGraphs' map of objects: association, clean-ups, reported values, differences from other methods."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from painted_runs import see_painted
from places import SCENES
from plates import QUIET, SCENE, Plate, at_cosine, axis, contents, look, mapped

from su3d_bench.baselines.conceptgraphs.method import ConceptGraphs
from su3d_bench.baselines.conceptgraphs.objects import MappingConfig
from su3d_bench.cli.main import main
from su3d_bench.core.system.timing import Timer

LEFT, RIGHT = Plate((-0.5, 0.0)), Plate((0.0, 0.5))
BARE = QUIET.model_copy(update={"obj_min_detections": 0})


def test_in_the_first_frame_every_region_becomes_an_object() -> None:
    method = mapped(ConceptGraphs(BARE), [[LEFT, LEFT]])
    assert method.n_instances == 2


def test_in_the_next_frame_several_regions_may_join_one_object() -> None:
    method = mapped(ConceptGraphs(BARE), [[Plate((-0.5, 0.5))], [LEFT, RIGHT]])
    found = method.finish()
    assert len(found) == 1
    assert found.views.tolist() == [[0, 0], [1, 0], [1, 1]]


def test_feature_is_the_average_weighted_by_detections() -> None:
    views = [
        [replace(LEFT, feature=axis(0))],
        [replace(LEFT, feature=axis(0))],
        [replace(LEFT, feature=at_cosine(0.6))],
    ]
    found = mapped(ConceptGraphs(BARE), views).finish()
    mean = np.array([(2 * 1 + 0.6) / 3, 0.8 / 3, 0, 0])
    assert np.asarray(found.features)[0] == pytest.approx(mean / np.linalg.norm(mean), abs=1e-6)


def stages(method: ConceptGraphs, plates: list[Plate], index: int) -> set[str]:
    timer = Timer()
    method.update(*look(plates, index), timer)
    return set(timer.take())


def test_objects_are_denoised_and_merged_every_twentieth_frame() -> None:
    method = ConceptGraphs(QUIET)
    method.start(SCENE)
    answer = [stages(method, [LEFT], index) for index in range(40)]
    assert [k for k, names in enumerate(answer) if "denoise" in names] == [19, 39]
    assert [k for k, names in enumerate(answer) if "overlap" in names] == [19, 39]
    assert answer[1] == {"filter", "backproject", "match", "merge"}


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


# Differences from other methods


def test_run_maps_painted_scenes_and_times_the_stages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    see_painted(monkeypatch)
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
