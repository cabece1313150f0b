"""Where a run loses its points: causes of wrong points, the evaluator's own arrays, and the verb on painted scenes."""

from __future__ import annotations

import doctest
import json
import shutil
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import WordEncoder, colour_perception
from places import SCENES
from scored_room import ENCODER, NAMES, instances, noisy, room, truth_as_prediction

import su3d_bench.reports.tables.attribution
from su3d_bench.analysis.attribution import attribute
from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, Su3dError
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.attribution import masks as attribution_semantic
from su3d_bench.metrics.attribution.arrays import EXPLAINED as EXPLAINED_KINDS
from su3d_bench.metrics.attribution.arrays import scored_masks, scored_points
from su3d_bench.metrics.attribution.masks import (
    CAUSES,
    LabelledPoints,
    causes_of,
    count_masks,
    mend_points,
    object_of_mask,
)
from su3d_bench.metrics.protocols.loading import load_protocol, protocol_names
from su3d_bench.metrics.scoring import score_scene
from su3d_bench.metrics.semantic import confusion as semantic
from su3d_bench.reports.tables.attribution import MEANINGS
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
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


# the arrays are those that the evaluator has


def predictions(truth: GroundTruth, labelled: Instances) -> dict[str, Prediction]:
    """One prediction of every sort, on other points than the truth's."""
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
def test_the_counts_as_they_are_are_those_of_scoring(name: str, sort: str) -> None:
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
        formed = mend_points(found.points, found.is_counted, has_masks=found.has_masks).as_is
    for each in fields(formed):
        np.testing.assert_array_equal(getattr(scored, each.name), getattr(formed, each.name))


# wrong points and their causes


def causes(prediction: Prediction) -> dict[str, int]:
    """Points of each cause that has any, after the checks that hold always."""
    found = scored_points(ROOM_RULES, room(), prediction, ENCODER)
    mended = mend_points(found.points, found.is_counted, has_masks=found.has_masks)
    cause = causes_of(found.points, has_masks=found.has_masks)
    n_right = int((cause == attribution_semantic.RIGHT).sum())
    assert n_right + sum(mended.n.values()) == mended.n_scored == found.points.is_scored.sum()
    perfect = semantic.per_scene(found.points.true_class, found.points.true_class, found.is_counted)
    np.testing.assert_array_equal(mended.all.confusion, perfect.confusion)
    for name in CAUSES:
        gained = int(np.trace(mended.alone[name].confusion) - np.trace(mended.as_is.confusion))
        assert gained == mended.n[name]
    return {name: n for name, n in mended.n.items() if n}


def whole() -> tuple[list[np.ndarray], list[str]]:
    truth = truth_as_prediction(room(), with_labels=True)
    return [truth.mask(k) for k in range(len(truth))], list(NAMES)


def test_the_truth_has_no_wrong_point() -> None:
    assert causes(instances(room().points, *whole())) == {}


def test_an_object_that_the_map_lacks_is_missing_geometry() -> None:
    masks, names = whole()
    kept = np.setdiff1d(np.arange(len(room().points)), masks[4])
    place = np.full(len(room().points), -1)
    place[kept] = np.arange(len(kept))
    del masks[4], names[4]
    assert causes(instances(room().points[kept], [place[mask] for mask in masks], names)) == {"geometry": 150}


def test_an_object_in_the_map_but_in_no_mask_is_background() -> None:
    masks, names = whole()
    del masks[4], names[4]
    assert causes(instances(room().points, masks, names)) == {"background": 150}


def test_points_in_another_object_s_mask_are_lost_to_association() -> None:
    masks, names = whole()
    masks[3], masks[4] = np.sort(np.concatenate([masks[3], masks[4][:40]])), masks[4][40:]
    assert causes(instances(room().points, masks, names)) == {"association": 40}


def test_the_right_mask_under_a_wrong_name_is_a_wrong_label() -> None:
    masks, names = whole()
    names[4] = "sofa"
    assert causes(instances(room().points, masks, names)) == {"label": 150}


def test_two_objects_of_one_class_in_one_mask_lose_no_point() -> None:
    masks, names = whole()  # 1 and 2 are both chairs
    masks[1:3], names[1:3] = [np.concatenate([masks[1], masks[2]])], ["chair"]
    assert causes(instances(room().points, masks, names)) == {}


def test_dense_features_have_wrong_labels_or_no_geometry() -> None:
    truth, labelled = room(), truth_as_prediction(room(), with_labels=False)
    assert labelled.features is not None
    rows = labelled.features[np.maximum(truth.instance - 1, 0)]
    rows[truth.instance == 5] = labelled.features[0]
    assert causes(DenseFeatures(truth.points, rows.astype(np.float16))) == {"label": 150}


def test_true_labels_name_every_mask_by_its_own_points() -> None:
    masks, names = whole()
    masks[3], masks[4] = np.sort(np.concatenate([masks[3], masks[4][:40]])), masks[4][40:]
    names[3] = names[0] = "sofa"
    found = scored_points(ROOM_RULES, room(), instances(room().points, masks, names), ENCODER)
    mended = mend_points(found.points, found.is_counted)
    assert mended.with_true_labels is not None
    confusion = mended.with_true_labels.confusion
    assert confusion.sum() - np.trace(confusion) == 40


def row_of_points(*rows: tuple[int, int, int, float, bool]) -> LabelledPoints:
    """Points by true class, object, mask, distance to the mask and whether they are scored; all are called 0."""
    true_class, objects, mask, distance_m, is_scored = (np.array(column) for column in zip(*rows, strict=True))
    near = np.zeros(len(rows))
    return LabelledPoints(true_class, np.zeros(len(rows), np.int64), is_scored, objects, mask, near, distance_m)


def test_a_mask_is_that_of_the_scored_points_near_it_alone() -> None:
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
    mended = mend_points(found, np.ones(4, bool)).with_true_labels
    assert mended is not None
    assert mended.confusion[:3, :3].tolist() == [
        [0, 0, 0],
        [0, 1, 0],
        [1, 2, 0],
    ]  # mask 0 is called 1 throughout


def test_of_objects_with_equally_many_points_a_mask_belongs_to_the_one_with_the_lowest_number() -> None:
    found = row_of_points(*((1, one, 0, 0.0, True) for one in (9, 4, 4, 9, 6)))
    assert object_of_mask(found).tolist() == [4]
    none, no_metres = np.zeros(0, np.int64), np.zeros(0)
    nothing = LabelledPoints(none, none, np.zeros(0, bool), none, none, no_metres, no_metres)
    assert object_of_mask(nothing).tolist() == []
    assert mend_points(nothing, np.ones(2, bool)).n == dict.fromkeys(CAUSES, 0)


def test_geometry_is_missing_beyond_five_centimetres_and_goes_before_all_else() -> None:
    wrong = row_of_points(*[(1, 7, 0, 0.0, True)] * 2, (1, 7, -1, np.inf, True), (1, 7, -1, np.inf, True))
    found = replace(wrong, map_distance_m=np.array([0.05, 0.051, 0.05, 0.051]))
    names = [CAUSES[cause] for cause in causes_of(found).tolist()]
    assert names == ["label", "geometry", "background", "geometry"]


def test_the_first_mask_counts_as_any_other() -> None:
    own, other = (0, 7, 0, 0.0, True), (1, 8, 0, 0.0, True)
    assert causes_of(row_of_points(own, own, other)).tolist() == [-1, -1, CAUSES.index("association")]
    mended = mend_points(row_of_points(own, other, other), np.ones(2, bool)).with_true_labels
    assert mended is not None
    assert mended.confusion[:2, :2].tolist() == [[0, 1], [0, 2]]
    called_other = replace(row_of_points(own, own, other), predicted=np.ones(3, np.int64))
    renamed = mend_points(called_other, np.ones(2, bool)).with_true_labels  # the first mask is of the first class
    assert renamed is not None
    assert renamed.confusion[:2, :2].tolist() == [[2, 0], [1, 0]]


def test_where_neighbours_vote_the_mask_is_that_of_most_of_them() -> None:
    rules = load_protocol("replica-hovsg")
    assert rules.transfer.neighbours > 1
    truth = replace(room(), variant=rules.ground_truth)
    found = scored_points(rules, truth, truth_as_prediction(truth, with_labels=True), ENCODER).points
    scored = found.is_scored & (truth.instance > 0)
    assert scored.any()
    assert (found.mask[scored] == truth.instance[scored] - 1).all()


def test_what_has_no_instance_is_one_object_a_class_and_none_of_the_others() -> None:
    truth = room()
    without = np.isin(truth.instance, [1, 4, 8])  # the wall, the table, here of the fifth class, and the backpack
    classes = np.where(truth.instance == 4, truth.labels.ids[4], truth.semantic).astype(np.int32)
    truth = replace(truth, instance=np.where(without, 0, truth.instance).astype(np.int32), semantic=classes)
    found = scored_points(ROOM_RULES, truth, truth_as_prediction(truth, with_labels=True), ENCODER).points
    of_object = found.object_id[: 150 * len(NAMES)].reshape(len(NAMES), 150)  # the room's objects one after another
    assert (of_object == of_object[:, :1]).all()
    assert len(np.unique(of_object)) == len(NAMES)


# the run


# the run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``whole``: all found; ``dropped``: one object of each scene is not; ``oracle``: what the truth gives."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.chdir(folder)
        for out, more in (("whole", []), ("dropped", ["--set", "collector.drop=1"]), ("part", ["--limit", "3"])):
            words = ["run", "--scenes", f"{PAINTED}/[ab]", "--methods", COLLECTOR, "--no-pictures", "--jobs", "1"]
            protocols = ["--protocols", "rooms-semantic", "rooms-instance", "replica-mesh-ex6"]
            assert main([*words, *protocols, "--quiet", "--out", out, *more]) == 0
        shutil.copytree("whole", "oracle")
        text = Path("oracle/run.json").read_text()
        Path("oracle/run.json").write_text(text.replace('"profile": "embedded"', '"profile": "oracle"'))
    return folder


@pytest.fixture(autouse=True)
def _in_folder(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)
    monkeypatch.setattr(finished_run, "encoder_of", lambda run, device: WordEncoder())


def attributed(run: str, **more: Any) -> dict[str, Any]:
    found = attribute(Path(run), **more)
    return {one["protocol"]: one for one in found.to_json()["protocols"]}


def test_a_run_without_errors_loses_nothing() -> None:
    for one in attributed("whole").values():
        assert {cause["n"] for cause in one["causes"].values()} == {0}
        for name, value in one["values"].items():
            assert value == 1.0
            assert one["rest"][name] == one["overlap"][name] == 0.0


def test_an_object_that_a_method_drops_is_missed() -> None:
    found = attributed("dropped")["rooms-instance"]
    counted = {name: cause["n"] for name, cause in found["causes"].items() if cause["n"]}
    assert counted == {"missed": 2}  # one a scene
    assert found["causes"]["missed"]["gains"]["AP"] == pytest.approx(1 - found["values"]["AP"])


def test_values_gains_overlap_and_rest_add_up_to_one() -> None:
    for one in attributed("dropped").values():
        for name, value in one["values"].items():
            gains = sum(cause["gains"][name] for cause in one["causes"].values())
            assert value + gains + one["overlap"][name] + one["rest"][name] == pytest.approx(1, abs=1e-12)


def test_values_are_those_of_the_run() -> None:
    results = json.loads(Path("dropped/metrics.json").read_text())["results"]
    found = attributed("dropped")
    for one in results:
        values = {name: one["result"]["metrics"][name] for name in one["headline"]}
        assert found[one["protocol"]]["values"] == pytest.approx(values, abs=1e-12)


def test_perfect_2d_masks_come_from_the_oracle_s_run() -> None:
    found = attributed("dropped", oracle=Path("oracle"))["rooms-instance"]
    assert found["stages"]["2D masks"] == {"AP": 1.0, "AP50": 1.0, "AP25": 1.0}
    assert found["stages"]["labels"] == found["values"]
    with pytest.raises(ConfigError, match="whole: has the profile 'embedded'; --oracle takes a run made with"):
        attributed("dropped", oracle=Path("whole"))


def test_a_partial_run_is_marked() -> None:
    found = attribute(Path("part"))
    assert found.remarks == ("PARTIAL: only the first 3 frames of each scene",)


def changed(name: str, source: str, file: str, old: str, new: str) -> Path:
    shutil.copytree(source, name)
    text = Path(name, file).read_text()
    assert old in text
    Path(name, file).write_text(text.replace(old, new))
    return Path(name)


def test_other_counts_than_the_run_s_are_refused() -> None:
    shutil.copytree("dropped", "mixed")
    for scene in "ab":
        here = f"scenes/painted.{scene}/collector/prediction.npz"
        shutil.copy(Path("whole", here), Path("mixed", here))
    with pytest.raises(PredictionError, match="the counts of the run are not those that its prediction gives here"):
        attributed("mixed")


def test_other_data_than_the_run_s_are_refused() -> None:
    moved = changed("moved", "whole", "run.toml", "n_frames = 6", "n_frames = 5")
    with pytest.raises(DataError, match="painted/a: its data are not those of the run; run it again"):
        attributed(str(moved))


ERRORS = [
    ({"method": "colector"}, "whole: holds no scores of the method 'colector'; did you mean 'collector'?"),
    ({"method": "x"}, "whole: holds no scores of the method 'x'; it has collector, oracle"),
    ({"protocols": ["rooms-instanse"]}, "whole: was not scored under 'rooms-instanse'; did you mean 'rooms-instance'?"),
]


@pytest.mark.parametrize(("more", "message"), ERRORS)
def test_wrong_requests_are_one_line(more: dict[str, Any], message: str) -> None:
    with pytest.raises(Su3dError) as caught:
        attributed("whole", **more)
    assert str(caught.value).startswith(message)


def test_the_oracle_of_a_run_can_be_explained_too() -> None:
    assert attributed("dropped", method="oracle")["rooms-semantic"]["values"] == {"mAcc": 1.0, "F-mIoU": 1.0}


def test_the_command_prints_a_table_and_draws_the_plot(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "attribution", "dropped", "--oracle", "oracle", "--out", "plots/errors.png"]) == 0
    text = capsys.readouterr().out
    row = next(line for line in text.splitlines() if line.startswith("| missed "))
    assert [cell.strip() for cell in row.strip("|").split("|")][:2] == ["missed", "2"]
    assert "| with true 2D masks |" in text
    picture = Path("plots/errors.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert main(["report", "attribution", "dropped", "--oracle", "oracle", "--out", "again.png", "--quiet"]) == 0
    assert Path("again.png").read_bytes() == picture
    capsys.readouterr()
    assert main(["report", "attribution", "dropped", "--protocol", "rooms-instance", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["protocol"] for one in found["protocols"]] == ["rooms-instance"]


def test_the_table_says_what_every_kind_of_error_is() -> None:
    assert {kind: tuple(names) for kind, names in MEANINGS.items()} == {
        kind: causes for kind, (causes, _) in EXPLAINED_KINDS.items()
    }


def test_the_examples_in_the_docstrings_run() -> None:
    assert doctest.testmod(attribution_semantic).failed == 0
    assert doctest.testmod(su3d_bench.reports.tables.attribution).failed == 0
