"""One row per instance of a run: agreement with attribution and evaluator, and the command with its output files."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted_runs import COLLECTOR, painted_run, see_painted
from scored_room import ENCODER, noisy

from su3d_bench.analysis.attribution import attribute
from su3d_bench.analysis.instances import _OfPoints, instance_rows
from su3d_bench.cli.main import main
from su3d_bench.core.maps import DenseFeatures, Instances
from su3d_bench.metrics.attribution.arrays import ScoredPoints, scored_masks
from su3d_bench.metrics.attribution.masks import KINDS, LabelledPoints, correct_scene, count_masks, errors_of
from su3d_bench.metrics.attribution.overlaps import measure_overlaps, true_instances
from su3d_bench.metrics.instance.scene_counts import hits
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.semantic.confusion import SemanticCounts
from su3d_bench.reports.tables.instances import InstanceRow
from su3d_bench.runs import finished as finished_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two methods over two painted scenes; one misses an object in each."""
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        folder, methods = tmp_path_factory.mktemp("samples") / "run", (COLLECTOR, "oracle")
        yield painted_run(folder, "--quiet", "--set", "collector.drop=1", methods=methods)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["rooms-instance", "replica-openmask3d"])
def test_hits_and_errors_match_evaluator_and_attribution(name: str, seed: int) -> None:
    rules = load_protocol(name)
    truth, prediction = noisy(seed)
    values, masks, scoring = scored_masks(rules, truth, prediction, ENCODER)
    counts = count_masks(values, masks, scoring)
    found = hits(
        values, masks.masks, masks.class_ids, masks.scores, scoring.class_ids, scoring.min_region_size,
        scoring.thresholds,
    )  # fmt: skip
    for t, at in enumerate(found):
        is_true = counts.is_true & (counts.threshold_index == t)
        assert len(at.values) == is_true.sum() == (counts.n_truth - counts.n_missed[:, t]).sum()
        if scoring.thresholds[t] >= 0.5:  # below, a mask may match two instances
            assert sorted(masks.scores[at.is_hit]) == sorted(counts.score[is_true])
    errors = errors_of(measure_overlaps(true_instances(values, scoring), masks, scoring))
    named = Counter(errors.of_mask) + Counter(errors.of_instance)
    corrected = correct_scene(values, masks, scoring)
    assert {kind: named[kind] for kind in KINDS} == dict(corrected.n)


def test_rows_of_points_add_up_to_the_confusion_matrix_and_the_causes_of_the_run(run: Path) -> None:
    """Number of points and correct points per true class, and number of points per predicted class."""
    rows = [row for row in instance_rows([run]).rows if row.protocol == "rooms-semantic"]
    finished = finished_run.read_run(run)
    names = [entry.name for entry in finished.rules("rooms-semantic").classes]
    for method in finished.methods:
        for scene, score in finished.scores(method)["rooms-semantic"].items():
            own = [row for row in rows if (row.method, row.scene) == (method, scene)]
            assert isinstance(score.counts, SemanticCounts)
            matrix = score.counts.confusion
            found = np.zeros((3, len(names)), np.int64)
            for row in own:
                assert row.n_right is not None
                place = names.index(row.class_name)
                found[0 if row.kind == "true" else 1, place] += row.n_points
                found[2, place] += row.n_right if row.kind == "true" else 0
            assert found[0].tolist() == matrix.sum(axis=1).tolist()
            assert found[1].tolist() == matrix[:, :-1].sum(axis=0).tolist()
            assert found[2].tolist() == np.diag(matrix[:, :-1]).tolist()
        explained = attribute(run, method=method, protocols=["rooms-semantic"]).protocols[0]
        true = [row for row in rows if (row.method, row.kind) == (method, "true")]
        n_wrong = sum(row.n_points - (row.n_right or 0) for row in true)
        assert n_wrong == sum(cause.n for cause in explained.causes.values())
        assert {row.error for row in true} - {""} <= {cause for cause, result in explained.causes.items() if result.n}
    lost = [row for row in rows if row.method == "collector" and row.kind == "true" and not row.n_right]
    assert lost and all(row.error and not row.is_hit_25 for row in lost)
    perfect = [row for row in rows if row.method == "oracle"]
    assert perfect and all(row.best_iou == 1 and row.is_hit_50 and row.n_right == row.n_points for row in perfect)
    assert {(row.instance, row.class_name) for row in perfect if row.kind == "true"} == {
        (row.matched, row.matched_class) for row in perfect if row.kind == "predicted"
    }


def scored_by_hand(mask: list[int], *, has_masks: bool = True) -> list[InstanceRow]:
    """Ten points: a chair of six points (instance 4), two lamp points without an instance, two points of no class."""
    rules = load_protocol("rooms-semantic")
    chair, lamp = ([entry.name for entry in rules.classes].index(name) for name in ("chair", "lamp"))
    points = LabelledPoints(
        true_class=np.array([chair] * 6 + [lamp] * 2 + [-1] * 2),
        predicted=np.array([chair] * 4 + [lamp] * 2 + [lamp, -1] + [chair] * 2),
        is_scored=np.array([True] * 8 + [False] * 2),
        object_id=np.array([4] * 6 + [9] * 4),
        mask=np.array(mask),
        map_distance_m=np.zeros(10),
        mask_distance_m=np.zeros(10),
    )
    positions = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], axis=1)
    is_counted = np.isin(np.arange(len(rules.classes)), [chair, lamp])
    scored = ScoredPoints(points, positions, is_counted, has_masks)
    cloud = positions.astype(np.float32)
    a_map: Any = Instances.of(cloud, [np.arange(5), np.arange(5, 10)], names=["a", "b"], ids=[70, 80])
    if not has_masks:
        a_map = DenseFeatures(cloud, np.ones((10, 2), np.float16))
    made = _OfPoints(rules, a_map, scored, 4, has_places=True)
    return list(made.rows(("run", "scene", "method", "rooms-semantic")))


def test_points_have_rows_by_predicted_name_and_by_true_object() -> None:
    rows = scored_by_hand([0] * 4 + [0, 1, 1, -1, 0, 0])
    names = ("kind", "instance", "row", "class_name", "name", "n_points", "n_right", "matched", "is_hit_50")
    result = [tuple(getattr(row, name) for name in names) for row in rows]
    assert result == [
        ("predicted", 70, 0, "chair", "a", 4, 4, 4, True),
        ("predicted", 70, 0, "lamp", "a", 1, 0, 4, False),
        ("predicted", 80, 1, "lamp", "b", 2, 1, None, False),  # IoU 1/3 with the lamp points, which have no number
        ("true", None, None, "lamp", "", 2, 1, 80, False),
        ("true", 4, None, "chair", "", 6, 4, 70, True),
    ]
    assert [row.best_iou for row in rows] == pytest.approx([4 / 6, 1 / 6, 1 / 3, 1 / 3, 4 / 6])
    assert [row.error for row in rows] == ["", "label", "label", "background", "label"]
    assert (rows[0].centre_x_m, rows[0].size_x_m) == (1.5, 3.0)


def test_instances_command_has_one_row_each(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "samples.csv"
    assert main(["report", "instances", str(run), "--out", str(file), f"--json={tmp_path / 'rows.json'}"]) == 0
    rows = instance_rows([run]).rows
    n_predicted = sum(row.kind == "predicted" for row in rows)
    printed = capsys.readouterr()
    assert printed.out == f"{file}: {n_predicted} predicted instances, {len(rows) - n_predicted} ground-truth\n"
    assert {row["protocol"] for row in json.loads((tmp_path / "rows.json").read_text())} == {
        "rooms-instance", "rooms-semantic",
    }  # fmt: skip
    with file.open(newline="") as stream:
        written = list(csv.DictReader(stream))
    assert [row["best_iou"] for row in written] == [repr(row.best_iou) for row in rows]
    assert json.loads((tmp_path / "rows.json").read_text())[0]["scene"] == "painted/a"
    assert main(["report", "instances", str(run), "--methods", "oracle", "--scenes", "painted/b"]) == 0
    result = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert {(row["method"], row["scene"]) for row in result} == {("oracle", "painted/b")}
