"""Beacon3D: its files, its two evaluations to the last bit, chains from ground truth, and invalid files."""

from __future__ import annotations

import copy
import doctest
import json
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from damage import damages, outcomes, truncations
from places import CASES

from su3d_bench.metrics.questions import grounding as counting
from su3d_bench.metrics.questions.grounding import ChainedText, Place
from su3d_bench.questions import beacon3d, chains
from su3d_bench.questions.beacon3d import Number, answered_file
from su3d_bench.questions.question_files import read_external_queries, read_questions

PROBLEMS = json.loads((CASES / "beacon3d01_answers.json").read_text())
FINE = {"text": "The large box", "obj_id": ["27"], "tag": "class-geometry"}
COARSE = {"text": "Box", "obj_id": ["29", "27"], "tag": "class"}
GROUNDING: dict[str, Any] = {
    "scene0025_00": {"box": {"27": {f"chain_{k}": [FINE | {"text": f"The large box {k}"}, COARSE] for k in (1, 2, 3)}}}
}
ASKED = {"question": "What color is it?", "answer": "White", "tag": "appearance", "extra_knowledge": 0}
QA: dict[str, Any] = {
    "scene0025_00": {"box": {"27": {"grounding_text": [], "qa": [ASKED | {"question": f"Why {k}?"} for k in "abc"]}}}
}


def written(folder: Path, asked: object, answers: object) -> tuple[Path, Path]:
    paths = folder / "metadata_scannet.json", folder / "answers.json"
    for path, content in zip(paths, (asked, answers), strict=True):
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return paths


def numbers(folder: Path, asked: object, answers: object) -> dict[str, Number]:
    return {one.name: one for one in answered_file(*written(folder, asked, answers)).numbers}


@pytest.mark.parametrize("index", range(len(PROBLEMS["grounding"])))
def test_synthetic_grounding_metrics_match_original(index: int, tmp_path: Path) -> None:
    problem = PROBLEMS["grounding"][index]
    found = numbers(tmp_path, problem["metadata"], [{"correct": one} for one in problem["correct"]])
    assert {name: 100 * one.least for name, one in found.items()} == problem["answer"]


@pytest.mark.parametrize("index", range(len(PROBLEMS["qa"])))
def test_synthetic_qa_metrics_match_original(index: int, tmp_path: Path) -> None:
    problem = PROBLEMS["qa"][index]
    found = numbers(tmp_path, problem["metadata"], problem["answers"])
    assert found.pop("settled").least == 1.0
    assert {name: 100 * one.least for name, one in found.items()} == problem["answer"]
    assert all(one.least == one.most for one in found.values())


def test_object_score_uses_most_specific_texts_and_merges_spellings(tmp_path: Path) -> None:
    shouted = copy.deepcopy(GROUNDING)
    shouted["scene0025_00"]["box"]["27"]["chain_3"][1] = COARSE | {"text": "BOX", "obj_id": ["29"]}
    answers = [{"object_id": 27}, {"object_id": 27}, {"object_id": 27}, {"object_id": 27}, {"object_id": 27}]
    found = numbers(tmp_path, shouted, answers)
    assert (found["case"].n, found["case"].least, found["object"].least) == (4, 0.75, 1.0)  # the last spelling counts
    assert (found["chain"].least, found["fine alone"].least) == (0.0, 1.0)


def test_file_texts_are_chained_queries_and_questions(tmp_path: Path) -> None:
    asked, _ = written(tmp_path, GROUNDING, [])
    (scene, cases), *rest = read_external_queries(asked).items()
    assert scene == "scene0025_00" and not rest and len(cases) == 4
    assert isinstance(cases[1], ChainedText) and cases[1].object_ids == (30, 28)  # one more than in the file
    assert cases[1].places == tuple(Place(0, k, 1) for k in range(3))
    assert {(one.kind, one.answers) for one in read_questions(asked)} == {("relative", (28,)), ("relative", (28, 30))}
    asked, _ = written(tmp_path, QA, [])
    assert [one.reply for one in read_questions(asked)] == ["White"] * 3


@pytest.mark.parametrize(
    ("asked", "answers"),
    [(GROUNDING, [{"correct": 1}, {"object_id": 3}] * 2), (QA, [{"pred": "red", "score": 2}] * 3)],
    ids=["grounding", "qa"],
)
def test_damaged_files_are_read_or_give_one_line_error(asked: object, answers: object, tmp_path: Path) -> None:
    paths = written(tmp_path, asked, answers)
    for path in paths:
        whole = path.read_bytes()

        def read(damaged: bytes, path: Path = path) -> object:
            path.write_bytes(damaged)
            return answered_file(*paths)

        n_read, n_refused = outcomes(read, chain(truncations(whole), damages(whole, 500)), must_name=".json")
        assert n_read and n_refused > 200
        path.write_bytes(whole)


def test_the_examples_hold() -> None:
    for module in (counting, beacon3d, chains):
        assert not doctest.testmod(module).failed
