"""Panoptic quality from labelled points: equal to panopticapi, excluded points, stuff without instances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from painted_runs import see_painted
from places import CASES, ROOT
from scored_room import ID, room, truth_as_prediction
from synthetic_segments import our_qualities

from su3d_bench.cli.main import main
from su3d_bench.core.types import GroundTruth
from su3d_bench.evaluation.scoring import score_on_truth
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine
from su3d_bench.metrics.semantic.panoptic import PanopticCounts, count_segments, visible_truth
from su3d_bench.runs.finished import read_run

RULES = load_protocol("rooms-panoptic")
FOUND = json.loads((CASES / "panoptic03_labelled_points.json").read_text())
# A dataset whose walls have a class but no instance, as in ScanNet++.
OPEN_WALLS = """
from dataclasses import replace
import numpy as np
from painted import Painted

class OpenWalls(Painted):
    name = "open-walls"

    def ground_truth(self, scene, variant):
        truth = super().ground_truth(scene, variant)
        is_wall = truth.semantic == 93
        return replace(truth, instance=np.where(is_wall, 0, truth.instance).astype(np.int32))
"""


@pytest.mark.parametrize(("name", "number"), [(name, k) for name in FOUND for k in range(len(FOUND[name]))])
def test_generated_labelled_points_equal_panopticapi(name: str, number: int) -> None:
    problem = FOUND[name][number]
    assert our_qualities(load_protocol(name), problem["scenes"]).tolist() == problem["answer"]


def open_walls() -> GroundTruth:
    truth = room()
    return replace(truth, instance=np.where(truth.semantic == ID["wall"], 0, truth.instance).astype(np.int32))


def test_points_excluded_from_evaluation_are_in_no_predicted_segment() -> None:
    truth = open_walls()
    masks = truth_as_prediction(room(), with_labels=True)
    ids = np.array([ID[str(name)] for name in masks.labels or ()])
    whole, chair = count_segments(RULES, truth.semantic, truth.instance, masks, masks.scores, ids), ID["chair"]
    left_out = np.where((truth.semantic == chair) & (np.arange(len(truth.points)) % 3 > 0), -1, truth.semantic)
    counts = count_segments(RULES, left_out, truth.instance, masks, masks.scores, ids)
    for name in PanopticCounts.arrays():
        assert getattr(counts, name).tolist() == getattr(whole, name).tolist()
    gone = count_segments(RULES, np.where(left_out == chair, -1, left_out), truth.instance, masks, masks.scores, ids)
    assert gone.n_false.sum() == 0 and gone.n_matched.sum() == whole.n_matched.sum() - 2


def test_oracle_ground_truth_has_one_instance_per_stuff_class_only_if_stuff_counts() -> None:
    truth = open_walls()
    record = visible_truth(RULES, truth)
    assert set(record.instance[truth.semantic == ID["wall"]].tolist()) == {truth.instance.max() + 1}
    is_other = truth.semantic != ID["wall"]
    assert record.instance[is_other].tolist() == truth.instance[is_other].tolist()
    assert visible_truth(load_protocol("rooms-instance"), truth) is truth
    assert (
        visible_truth(RULES, room()) is not None
        and visible_truth(RULES, room()).instance.tolist() == room().instance.tolist()
    )


def test_stuff_without_instances_is_complete_in_the_ceiling_of_an_evaluation() -> None:
    truth = open_walls()
    outcome = score_on_truth(RULES, truth, "a", truth_as_prediction(truth, with_labels=True), None)
    assert outcome.ceiling is not None
    of_truth = combine(RULES, {"a": outcome.ceiling}).metrics
    assert (of_truth["PQ"], of_truth["PQ stuff"]) == (1.0, 1.0)
    assert combine(RULES, {"a": outcome.score}).metrics["PQ stuff"] == 0.0  # masks of things only


def test_oracle_run_has_stuff_only_if_stuff_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    see_painted(monkeypatch)
    monkeypatch.chdir(tmp_path)
    Path("open_walls.py").write_text(OPEN_WALLS)
    painted = ROOT / "tests/support/scenes/painted.py"
    for name, target in (("whole", f"{painted}:Painted"), ("open", "open_walls.py:OpenWalls")):
        words = ["run", "--scenes", f"{target}/a", "--methods", "oracle", "--out", name, "--no-pictures", "--jobs", "1"]
        protocols = ["rooms-panoptic", "replica-panoptic", "rooms-instance"]
        assert main([*words, "--protocols", *protocols, "--quiet"]) == 0, capsys.readouterr().err
    results = {name: read_run(tmp_path / name).results for name in ("whole", "open")}
    of_run = {name: {key[1]: one.result for key, one in results[name].items() if one.result} for name in results}
    for protocol in ("rooms-panoptic", "replica-panoptic"):
        assert of_run["open"][protocol].metrics == of_run["whole"][protocol].metrics
        assert of_run["open"][protocol].metrics["PQ stuff"] == 1.0
    n_predictions = {key: list(one.n_predictions.values()) for key, one in of_run["open"].items()}
    assert n_predictions == {"rooms-panoptic": [4], "replica-panoptic": [4], "rooms-instance": [3]}
