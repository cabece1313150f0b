"""The object that a sentence means: ScanRefer's IoU and shares to the last bit, files of sentences, and rules."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from places import CASES
from scored_room import ENCODER, instances, nothing, room, truth_as_prediction

from su3d_bench.core.errors import ConfigError, DataError
from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth, TextQuery
from su3d_bench.metrics.protocols.loading import load_protocol, read_protocol
from su3d_bench.metrics.questions.grounding import box_iou
from su3d_bench.metrics.scoring import combine, pack_scores, plain_json, score_scene, unpack_scores
from su3d_bench.questions.files.datasets import read_foreign_queries
from su3d_bench.questions.files.queries import query_truth

RULES = load_protocol("grounding")
PROBLEMS = json.loads((CASES / "grounding01_scanrefer.json").read_text())["problems"]
TRUTH = room()
PERFECT = truth_as_prediction(TRUTH, with_labels=False)
# Objects 2 and 3 are chairs, 4 the table, 5 the lamp; of equal masks the first is ranked first.
ASKED = (TextQuery("the chair", (2,)), TextQuery("a lamp", (5,)), TextQuery("chair on the right", (3,)))


def asking(*queries: TextQuery) -> QueryTruth:
    return query_truth(TRUTH, queries, "here")


def values(prediction: object, truth: QueryTruth) -> dict[str, float | None]:
    score = score_scene(RULES, truth, prediction, ENCODER)  # type: ignore[arg-type]
    kept = unpack_scores(pack_scores({RULES.name: score}))[RULES.name]
    found: dict[str, float | None] = plain_json(combine(RULES, {"a": kept}).metrics)
    return found


@pytest.mark.parametrize("index", range(len(PROBLEMS)))
def test_the_iou_of_scanrefer_holds_to_the_last_bit(index: int) -> None:
    problem = PROBLEMS[index]
    pairs = zip(np.array(problem["predicted"]), np.array(problem["true"]), strict=True)
    iou = np.array([box_iou(*pair) for pair in pairs])
    assert iou.tolist() == problem["iou"]
    assert [float((iou >= threshold).mean()) for threshold in (0.25, 0.5)] == problem["answer"]


def test_the_instance_ranked_first_must_stand_in_the_place_of_the_object() -> None:
    found = values(PERFECT, asking(*ASKED))
    assert (found["Acc@0.25"], found["Acc@0.5"], found["n_Acc@0.5"]) == (2 / 3, 2 / 3, 3)
    either = values(PERFECT, asking(TextQuery("chair", (3, 2))))
    assert either["Acc@0.5"] == 1.0  # of several that are meant, any


def test_a_part_of_an_object_has_a_smaller_box() -> None:
    rows = np.flatnonzero(TRUTH.instance == 5)
    low = rows[TRUTH.points[rows, 2] < 0.8 * 0.45]  # the lower part: between a quarter and a half of the box
    assert PERFECT.features is not None
    part = instances(TRUTH.points, [low], None, PERFECT.features[4:5])
    assert [values(part, asking(ASKED[1]))[f"Acc@{name}"] for name in ("0.25", "0.5")] == [1.0, 0.0]


def test_an_empty_map_finds_nothing_and_nothing_asked_has_no_value() -> None:
    assert values(nothing(TRUTH), asking(*ASKED))["Acc@0.25"] == 0.0
    assert values(PERFECT, asking())["Acc@0.25"] is None


def test_sentences_are_read_from_the_files_of_scanrefer_and_nr3d(tmp_path: Path) -> None:
    row = {"scene_id": "scene0011_00", "object_id": "4", "description": "the brown chair"}
    (tmp_path / "ScanRefer_filtered_val.json").write_text(json.dumps([row, row]))
    (tmp_path / "nr3d.csv").write_text('scan_id,target_id,utterance\nscene0011_00,4,"the chair, brown"\n')
    chair = TextQuery("the brown chair", (5,))  # ScanNet's ids are one less
    assert read_foreign_queries(tmp_path / "ScanRefer_filtered_val.json") == {"scene0011_00": (chair, chair)}
    assert read_foreign_queries(tmp_path / "nr3d.csv") == {"scene0011_00": (TextQuery("the chair, brown", (5,)),)}
    asked = {"scene_id": "scene0011_00", "situation": "", "question": "Is it red?", "question_id": 1}
    (tmp_path / "v1_questions_val.json").write_text(json.dumps({"questions": [asked]}))
    with pytest.raises(DataError, match="SQA3D names no objects"):
        read_foreign_queries(tmp_path / "v1_questions_val.json")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('box_axes = "truth"', "box_axes: kind 'grounding' takes 'world'"),
        ("[transfer]\ncap_m = 0.05", "transfer.cap_m: kind 'grounding' transfers nothing"),
        ("min_region_size = 5", "min_region_size, thresholds and confidence belong to kind"),
    ],
)
def test_wrong_rules_are_told_in_one_line(line: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(f'extends = "grounding"\nname = "mine"\n{line}\n')
    with pytest.raises(ConfigError) as caught:
        read_protocol(path)
    assert message in str(caught.value)
