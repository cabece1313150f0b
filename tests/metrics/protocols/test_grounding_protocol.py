"""The object that a sentence describes: ScanRefer's IoU and accuracies to the last bit, sentence files, and rules."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from places import CASES
from scannet_scan import SCAN, write_scan
from scored_room import ENCODER, instances, nothing, room, truth_as_prediction

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.scannet.dataset import ScanNet
from su3d_bench.datasets.scannet.truth import TABLE_NAME
from su3d_bench.metrics.open_vocabulary.score import QueryTruth, TextQuery
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.questions.grounding import aligned, box_iou, choose, in_group
from su3d_bench.metrics.scoring import combine, pack_scores, plain_json, score_scene, unpack_scores
from su3d_bench.questions.query_files import query_truth, scanrefer_groups
from su3d_bench.questions.question_files import read_external_queries

RULES = load_protocol("grounding")
PROBLEMS = json.loads((CASES / "grounding01_scanrefer.json").read_text())["problems"]
TRUTH = room()
PERFECT = truth_as_prediction(TRUTH, with_labels=False)
# Objects 2 and 3 are chairs, 4 the table, 5 the lamp; on ties the first mask is ranked first.
ASKED = (TextQuery("the chair", (2,)), TextQuery("a lamp", (5,)), TextQuery("chair on the right", (3,)))


def asking(*queries: TextQuery) -> QueryTruth:
    return query_truth(TRUTH, queries, "here")


def values(prediction: object, truth: QueryTruth) -> dict[str, float | None]:
    score = score_scene(RULES, truth, prediction, ENCODER)  # type: ignore[arg-type]
    kept = unpack_scores(pack_scores({RULES.name: score}))[RULES.name]
    found: dict[str, float | None] = plain_json(combine(RULES, {"a": kept}).metrics)
    return found


@pytest.mark.parametrize("index", range(len(PROBLEMS)))
def test_scanrefer_iou_is_equal_in_every_bit(index: int) -> None:
    problem = PROBLEMS[index]
    pairs = zip(np.array(problem["predicted"]), np.array(problem["true"]), strict=True)
    iou = np.array([box_iou(*pair) for pair in pairs])
    assert iou.tolist() == problem["iou"]
    assert [float((iou >= threshold).mean()) for threshold in (0.25, 0.5)] == problem["answer"]


def test_first_instance_must_be_at_the_object() -> None:
    found = values(PERFECT, asking(*ASKED))
    assert (found["Acc@0.25"], found["Acc@0.5"], found["n_Acc@0.5"]) == (2 / 3, 2 / 3, 3)
    either = values(PERFECT, asking(TextQuery("chair", (3, 2))))
    assert either["Acc@0.5"] == 1.0  # any of several described objects


def test_a_part_of_an_object_has_a_smaller_box() -> None:
    rows = np.flatnonzero(TRUTH.instance == 5)
    low = rows[TRUTH.points[rows, 2] < 0.8 * 0.45]  # the lower part: between a quarter and a half of the box
    assert PERFECT.features is not None
    part = instances(TRUTH.points, [low], None, PERFECT.features[4:5])
    assert [values(part, asking(ASKED[1]))[f"Acc@{name}"] for name in ("0.25", "0.5")] == [1.0, 0.0]


def test_empty_map_finds_nothing_and_no_queries_give_no_value() -> None:
    assert values(nothing(TRUTH), asking(*ASKED))["Acc@0.25"] == 0.0
    assert values(PERFECT, asking())["Acc@0.25"] is None


def test_sentences_are_read_from_scanrefer_and_nr3d_files(tmp_path: Path) -> None:
    row = {"scene_id": "scene0011_00", "object_id": "4", "description": "the brown chair"}
    (tmp_path / "ScanRefer_filtered_val.json").write_text(json.dumps([row, row]))
    (tmp_path / "nr3d.csv").write_text('scan_id,target_id,utterance\nscene0011_00,4,"the chair, brown"\n')
    chair = TextQuery("the brown chair", (5,))  # ScanNet's ids are one less
    assert read_external_queries(tmp_path / "ScanRefer_filtered_val.json") == {"scene0011_00": (chair, chair)}
    assert read_external_queries(tmp_path / "nr3d.csv") == {"scene0011_00": (TextQuery("the chair, brown", (5,)),)}
    asked = {"scene_id": "scene0011_00", "situation": "", "question": "Is it red?", "question_id": 1}
    (tmp_path / "v1_questions_val.json").write_text(json.dumps({"questions": [asked]}))
    with pytest.raises(DataError, match="SQA3D has no answer objects"):
        read_external_queries(tmp_path / "v1_questions_val.json")


# ---- groups


GROUPED = json.loads((CASES / "grounding02_groups.json").read_text())["problems"]
CHOSEN = json.loads((CASES / "grounding03_nr3d.json").read_text())["problems"]
GIVEN = load_protocol("grounding-given")


def share(rows: np.ndarray, right: np.ndarray) -> float | None:
    return float((rows & right).sum() / rows.sum()) if rows.any() else None


@pytest.mark.parametrize("index", range(len(GROUPED)))
def test_scanrefer_unique_and_accuracies_are_equal_in_every_bit(index: int, tmp_path: Path) -> None:
    problem = GROUPED[index]
    path = tmp_path / "ScanRefer_filtered_val.json"
    path.write_text(json.dumps(problem["rows"]))
    of_scene = {
        scene: iter(scanrefer_groups(queries, problem["classes"].get))
        for scene, queries in read_external_queries(path).items()
    }
    groups = [next(of_scene[row["scene_id"]]).groups for row in problem["rows"]]
    assert [int(one == ("multiple",)) for one in groups] == problem["multiple"]
    iou = np.array([box_iou(np.array(row["predicted"]), np.array(row["true"])) for row in problem["rows"]])
    for name, answer in zip(RULES.value_names, problem["answer"], strict=True):
        group, _, measure = name.rpartition(" ")
        found = share(in_group(groups, group or "all", "scanrefer"), iou >= float(measure.removeprefix("Acc@")))
        assert (found or 0.0) == answer  # it returns 0 without sentences


@pytest.mark.parametrize("index", range(len(CHOSEN)))
def test_nr3d_scored_sentences_and_accuracies_are_equal_in_every_bit(index: int, tmp_path: Path) -> None:
    problem, path = CHOSEN[index], tmp_path / "nr3d.csv"
    names = ("scan_id", "target_id", "utterance", "stimulus_id", "tokens", "mentions_target_class")
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, names, extrasaction="ignore")
        table.writeheader()
        table.writerows(problem["rows"])
    groups = [query.groups for query in read_external_queries(path)["scene0011_00"]]
    right = np.array([choose(np.array(row["logits"])) == row["target"] for row in problem["rows"]])
    counted = in_group(groups, "accuracy", "referit3d")
    assert counted.sum() == problem["counted"]
    found = [share(in_group(groups, name, "referit3d"), right) for name in GIVEN.value_names]
    assert [None if one is None else one * 100 for one in found] == (problem["answer"] or [None] * 5)


def test_queries_of_other_files_are_grouped_by_ground_truth_classes() -> None:
    found = values(PERFECT, asking(*ASKED))
    # the lamp is unique; the first of two chairs is found
    assert (found["unique Acc@0.5"], found["multiple Acc@0.5"], found["n_multiple Acc@0.5"]) == (1.0, 0.5, 2)
    groups = [query.groups for query in asking(*ASKED).queries]
    assert groups[2] == ("multiple", "easy", "view-dependent") and groups[1][0] == "unique"
    own = asking(TextQuery("the chair", (2,), ("hard", "view-independent")))
    assert own.queries[0].groups == ("hard", "view-independent", "multiple")


def test_choice_is_among_the_given_boxes() -> None:
    def chosen(prediction: object, *queries: TextQuery) -> dict[str, float | None]:
        score = score_scene(GIVEN, asking(*queries), prediction, ENCODER)  # type: ignore[arg-type]
        found: dict[str, float | None] = plain_json(combine(GIVEN, {"a": score}).metrics)
        return found

    found = chosen(PERFECT, *ASKED)
    assert (found["accuracy"], found["easy"], found["hard"], found["view-dependent"]) == (2 / 3, 2 / 3, None, 0.0)
    assert PERFECT.features is not None
    lamp = np.flatnonzero(TRUTH.instance == 5)
    part = lamp[TRUTH.points[lamp, 2] < 0.1]  # too small for any IoU: only the position counts
    assert chosen(instances(TRUTH.points, [part], None, PERFECT.features[4:5]), ASKED[1])["accuracy"] == 1.0
    beyond = np.vstack([TRUTH.points, TRUTH.points[lamp] + 50]).astype(np.float32)
    far = np.arange(len(TRUTH.points), len(beyond))
    both = instances(beyond, [far, lamp], None, PERFECT.features[[4, 4]])
    assert chosen(both, ASKED[1])["accuracy"] == 1.0  # the first overlaps none of the given boxes
    left_out = TextQuery("a lamp", (5,), ("left out",))
    assert chosen(PERFECT, left_out)["accuracy"] is None
    assert chosen(nothing(TRUTH), ASKED[1])["accuracy"] == 0.0


def test_boxes_are_aligned_with_the_dataset_walls() -> None:
    rows = TRUTH.instance == 4
    turn: Float64Array = np.eye(4)
    turn[:2, :2] = [[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]]
    turn[:3, 3] = 3, -2, 0.5
    low = np.flatnonzero(rows & (TRUTH.points[:, 0] < 3.39))  # an IoU of 0.47, along the rotated axes 0.51
    assert PERFECT.features is not None
    part = instances(TRUTH.points, [low], None, PERFECT.features[3:4])
    for alignment, right in ((None, 0.0), (turn, 1.0)):
        truth = query_truth(TRUTH, (TextQuery("table", (4,)),), "here", alignment=alignment)
        assert values(part, truth)["Acc@0.5"] == right
    backward = np.asarray(np.linalg.inv(turn), np.float64)
    back = aligned(aligned(TRUTH.points, turn), backward)
    assert np.abs(back - TRUTH.points).max() < 1e-5


def test_scannet_has_axis_alignment_and_classes_of_names(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    dataset = ScanNet(tmp_path)
    assert dataset.axis_alignment(SCAN)[:3, 3].tolist() == [5, 6, 7]
    turned = ScanNet(tmp_path, ScanNet.Options(axis_align=True))
    assert np.array_equal(turned.axis_alignment(SCAN), np.eye(4))
    assert dataset.nyu40_class("chair") == "chair" and dataset.nyu40_class("nonsense") is None
    (folder / f"{SCAN}.txt").unlink()
    with pytest.raises(DataError, match=r"\.txt is missing; it is needed for wall alignment"):
        ScanNet(tmp_path).axis_alignment(SCAN)
    (tmp_path / TABLE_NAME).unlink()
    with pytest.raises(DataError, match="is missing, which maps object names to classes"):
        ScanNet(tmp_path).nyu40_class("chair")


@pytest.mark.parametrize(
    ("stimulus", "tokens", "message"),
    [
        ("scene0011_00-chair-two-4-5", "['a']", "'stimulus_id' must be scan-class-n-target-others"),
        ("scene0011_00-chair--4-5", "['a']", "'stimulus_id' must be scan-class-n-target-others"),
        ("scene0011_00-chair-3-4-5", "['a']", "'stimulus_id' must be scan-class-n-target-others"),
        ("scene0011_00-chair-2-4-5", "['a'", "'tokens' must be a list of words"),
        ("scene0011_00-chair-2-4-5", "__import__('os').getcwd()", "'tokens' must be a list of words"),
        ("scene0011_00-chair-2-4-5", "(" * 9000, "'tokens' must be a list of words"),
    ],
)
def test_each_invalid_nr3d_row_is_one_line(tmp_path: Path, stimulus: str, tokens: str, message: str) -> None:
    path = tmp_path / "nr3d.csv"
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("scan_id", "target_id", "utterance", "stimulus_id", "tokens"))
        table.writerow(("scene0011_00", "4", "the chair", stimulus, tokens))
    with pytest.raises(DataError, match=message) as caught:
        read_external_queries(path)
    assert "nr3d.csv: row 2" in str(caught.value) and "\n" not in str(caught.value)
