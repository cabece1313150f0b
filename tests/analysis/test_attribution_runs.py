"""Error attribution of runs: causes of wrong points, the evaluator's own arrays, and the command on painted scenes."""

from __future__ import annotations

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted_runs import consistent, painted_run, see_painted
from scored_room import ENCODER, NAMES, instances, noisy, room, truth_as_prediction

from su3d_bench.analysis.attribution import attribute
from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.attribution import masks as attribution_semantic
from su3d_bench.metrics.attribution.arrays import scored_masks, scored_points
from su3d_bench.metrics.attribution.masks import (
    CAUSES,
    LabelledPoints,
    causes_of,
    correct_points,
    count_masks,
    object_of_mask,
)
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.metrics.scoring import score_scene
from su3d_bench.metrics.semantic import confusion as semantic

ROOM_RULES = load_protocol("rooms-semantic")
EXPLAINED = [
    name
    for name in protocol_names()
    if load_protocol(name).kind in ("instance", "semantic") and load_protocol(name).label_space == "replica"
]
CASES = [
    (name, sort)
    for name in EXPLAINED
    for sort in ("labels", "features", "partition", "dense")
    if sort != "dense" or load_protocol(name).kind == "semantic"  # dense features have no instances
]


# arrays equal those of the evaluator


def predictions(truth: GroundTruth, labelled: Instances) -> dict[str, Prediction]:
    """One prediction of every sort, on other points than the ground truth's."""
    rng = np.random.default_rng(3)
    named = truth_as_prediction(truth, with_labels=False)
    assert named.features is not None
    moved = (truth.points + rng.normal(0, 0.02, truth.points.shape)).astype(np.float32)
    shared = instances(moved, [named.mask(k) for k in range(len(named))], None, np.roll(named.features, 1, axis=0))
    owner = np.full(len(moved), -1, np.int32)
    for k in range(len(labelled)):
        owner[labelled.mask(k)] = k
    rows = np.where((owner >= 0)[:, None], named.features[owner], 0).astype(np.float16)
    return {
        "labels": labelled,
        "features": shared,
        "partition": Partition(moved, owner, named.features),
        "dense": DenseFeatures(moved, rows),
    }


@pytest.mark.parametrize(("name", "sort"), CASES)
def test_uncorrected_counts_equal_those_of_scoring(name: str, sort: str) -> None:
    rules = load_protocol(name)
    truth, labelled = noisy(1)
    truth = replace(truth, variant=rules.ground_truth)
    if rules.kind == "semantic" and "conceptgraphs" in rules.ground_truth:
        truth = replace(truth, evaluation_points=truth.points[::2] + np.float32(0.01))
    prediction = predictions(truth, labelled)[sort]
    scored = score_scene(rules, truth, prediction, ENCODER).counts
    if rules.kind == "instance":
        assert not isinstance(prediction, DenseFeatures)
        formed: Any = count_masks(*scored_masks(rules, truth, prediction, ENCODER))
    else:
        found = scored_points(rules, truth, prediction, ENCODER)
        formed = correct_points(found.points, found.is_counted, has_masks=found.has_masks).as_is
    for each in fields(formed):
        np.testing.assert_array_equal(getattr(scored, each.name), getattr(formed, each.name))


# wrong points and their causes


def causes(prediction: Prediction) -> dict[str, int]:
    """Number of points of each non-empty cause, after checks that always hold."""
    found = scored_points(ROOM_RULES, room(), prediction, ENCODER)
    corrected = correct_points(found.points, found.is_counted, has_masks=found.has_masks)
    cause = causes_of(found.points, has_masks=found.has_masks)
    n_right = int((cause == attribution_semantic.RIGHT).sum())
    assert n_right + sum(corrected.n.values()) == corrected.n_scored == found.points.is_scored.sum()
    perfect = semantic.per_scene(found.points.true_class, found.points.true_class, found.is_counted)
    np.testing.assert_array_equal(corrected.all.confusion, perfect.confusion)
    for name in CAUSES:
        gained = int(np.trace(corrected.alone[name].confusion) - np.trace(corrected.as_is.confusion))
        assert gained == corrected.n[name]
    return {name: n for name, n in corrected.n.items() if n}


def test_causes_of_wrong_points_are_found() -> None:
    truth, names, points = truth_as_prediction(room(), with_labels=True), list(NAMES), room().points
    masks = [truth.mask(k) for k in range(len(truth))]
    fewer, called = [*masks[:4], *masks[5:]], [*names[:4], *names[5:]]
    assert causes(instances(points, fewer, called)) == {"background": 150}, "in the map but in no mask"
    kept = np.setdiff1d(np.arange(len(points)), masks[4])
    place = np.full(len(points), -1)
    place[kept] = np.arange(len(kept))
    assert causes(instances(points[kept], [place[mask] for mask in fewer], called)) == {"geometry": 150}
    mixed = [*masks[:3], np.sort(np.concatenate([masks[3], masks[4][:40]])), masks[4][40:], *masks[5:]]
    assert causes(instances(points, mixed, names)) == {"association": 40}, "in the mask of another object"
    assert causes(instances(points, masks, [*names[:4], "sofa", *names[5:]])) == {"label": 150}


def row_of_points(*rows: tuple[int, int, int, float, bool]) -> LabelledPoints:
    """Points by true class, object, mask, distance to the mask and whether they are scored; all predicted as 0."""
    true_class, objects, mask, distance_m, is_scored = (np.array(column) for column in zip(*rows, strict=True))
    near = np.zeros(len(rows))
    return LabelledPoints(true_class, np.zeros(len(rows), np.int64), is_scored, objects, mask, near, distance_m)


def test_object_of_a_mask_comes_from_nearby_scored_points_only() -> None:
    near, far, void = (1, 7, 0, 0.05, True), (2, 8, 0, 0.051, True), (3, 9, 0, 0.0, False)
    far_of_another = (2, 8, 1, 0.051, True)
    found = row_of_points(near, far, far, void, void, far_of_another)
    assert object_of_mask(found).tolist() == [7, -1]
    assert [CAUSES[cause] if cause >= 0 else cause for cause in causes_of(found).tolist()] == [
        "label",
        *["background"] * 2,
        *[-2] * 2,
        "background",
    ]
    corrected = correct_points(found, np.ones(4, bool)).with_true_labels
    assert corrected is not None
    assert corrected.confusion[:3, :3].tolist() == [
        [0, 0, 0],
        [0, 1, 0],
        [1, 2, 0],
    ]  # mask 0 is class 1 everywhere


def test_geometry_is_the_first_cause_beyond_five_centimetres() -> None:
    wrong = row_of_points(*[(1, 7, 0, 0.0, True)] * 2, (1, 7, -1, np.inf, True), (1, 7, -1, np.inf, True))
    found = replace(wrong, map_distance_m=np.array([0.05, 0.051, 0.05, 0.051]))
    names = [CAUSES[cause] for cause in causes_of(found).tolist()]
    assert names == ["label", "geometry", "background", "geometry"]


# the run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``whole``: all objects found; ``dropped``: one object per scene is missing; ``oracle``: the oracle profile."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        protocols = ["--quiet", "--protocols", "rooms-semantic", "rooms-instance", "replica-mesh-ex6"]
        painted_run(Path("whole"), *protocols)
        painted_run(Path("dropped"), *protocols, "--set", "collector.drop=1")
        shutil.copytree("whole", "oracle")
        text = Path("oracle/run.json").read_text()
        Path("oracle/run.json").write_text(text.replace('"profile": "embedded"', '"profile": "oracle"'))
        toml = Path("oracle/run.toml")
        toml.write_text(toml.read_text().replace('profile = "auto"', 'profile = "oracle"', 1))
        consistent(Path("oracle"))
    return folder


@pytest.fixture(autouse=True)
def _in_folder(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)
    see_painted(monkeypatch)


def attributed(run: str, **more: Any) -> dict[str, Any]:
    found = attribute(Path(run), **more)
    return {one["protocol"]: one for one in found.to_json()["protocols"]}


def test_perfect_run_has_no_errors() -> None:
    for one in attributed("whole").values():
        assert {cause["n"] for cause in one["causes"].values()} == {0}
        for name, value in one["values"].items():
            assert value == 1.0
            assert one["rest"][name] == one["overlap"][name] == 0.0


def test_dropped_object_is_missed() -> None:
    found = attributed("dropped")["rooms-instance"]
    counted = {name: cause["n"] for name, cause in found["causes"].items() if cause["n"]}
    assert counted == {"missed": 2}  # one per scene
    assert found["causes"]["missed"]["gains"]["AP"] == pytest.approx(1 - found["values"]["AP"])


def test_values_gains_overlap_and_rest_add_up_to_one() -> None:
    for one in attributed("dropped").values():
        for name, value in one["values"].items():
            gains = sum(cause["gains"][name] for cause in one["causes"].values())
            assert value + gains + one["overlap"][name] + one["rest"][name] == pytest.approx(1, abs=1e-12)


def test_ground_truth_2d_masks_come_from_the_oracle_run() -> None:
    found = attributed("dropped", oracle=Path("oracle"))["rooms-instance"]
    assert found["stages"]["2D masks"] == {"AP": 1.0, "AP50": 1.0, "AP25": 1.0}
    assert found["stages"]["labels"] == found["values"]
    with pytest.raises(ConfigError, match="whole: has the profile 'embedded'; --oracle takes a run made with"):
        attributed("dropped", oracle=Path("whole"))


def test_counts_that_differ_from_the_run_are_an_error() -> None:
    shutil.copytree("dropped", "mixed")
    for scene in "ab":
        here = f"scenes/painted.{scene}/collector/prediction.npz"
        shutil.copy(Path("whole", here), Path("mixed", here))
    with pytest.raises(
        PredictionError, match="the run's stored counts differ from those recomputed from its prediction"
    ):
        attributed("mixed")


def test_attribution_command_prints_a_table_and_draws_the_plot(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "attribution", "dropped", "--oracle", "oracle", "--out", "plots/errors.png"]) == 0
    text = capsys.readouterr().out
    row = next(line for line in text.splitlines() if line.startswith("| missed "))
    assert [cell.strip() for cell in row.strip("|").split("|")][:2] == ["missed", "2"]
    assert "| with GT 2D masks |" in text
    picture = Path("plots/errors.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert main(["report", "attribution", "dropped", "--oracle", "oracle", "--out", "again.png", "--quiet"]) == 0
    assert Path("again.png").read_bytes() == picture
    for name, start in (("errors.pdf", b"%PDF"), ("errors.svg", b"<?xml")):
        assert main(["report", "attribution", "dropped", "--oracle", "oracle", "--out", name, "--quiet"]) == 0
        assert Path(name).read_bytes().startswith(start)
    capsys.readouterr()
    assert main(["report", "attribution", "dropped", "--oracle", "oracle", "--out", "errors.eps"]) == 2
    assert "unknown format of a figure; use a suffix of pdf, svg, png" in capsys.readouterr().err
    capsys.readouterr()
    assert main(["report", "attribution", "dropped", "--protocols", "rooms-instance", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["protocol"] for one in found["protocols"]] == ["rooms-instance"]
