"""Beacon3D: its files, its two evaluations to the last bit, chains made from a truth, and what is wrong with a file."""

from __future__ import annotations

import copy
import doctest
import json
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import damages, outcomes, truncations
from places import CASES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import DataError
from su3d_bench.metrics.questions import chains as counting
from su3d_bench.metrics.questions.chains import ChainedText, Place
from su3d_bench.questions.chains import answer_matching, answered, beacon3d_files, made
from su3d_bench.questions.chains.answered import Number
from su3d_bench.questions.chains.report import answered_file
from su3d_bench.questions.files.datasets import read_foreign_queries
from su3d_bench.questions.files.files import read_questions

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
def test_a_made_problem_of_grounding_has_every_number_of_the_original(index: int, tmp_path: Path) -> None:
    problem = PROBLEMS["grounding"][index]
    found = numbers(tmp_path, problem["metadata"], [{"correct": one} for one in problem["correct"]])
    assert {name: 100 * one.least for name, one in found.items()} == problem["answer"]


@pytest.mark.parametrize("index", range(len(PROBLEMS["qa"])))
def test_a_made_problem_of_answers_has_every_number_of_the_original(index: int, tmp_path: Path) -> None:
    problem = PROBLEMS["qa"][index]
    found = numbers(tmp_path, problem["metadata"], problem["answers"])
    assert found.pop("settled").least == 1.0
    assert {name: 100 * one.least for name, one in found.items()} == problem["answer"]
    assert all(one.least == one.most for one in found.values())


def test_thirty_problems_of_each_have_different_answers() -> None:
    for kind in ("grounding", "qa"):
        assert len({json.dumps(one["answer"]) for one in PROBLEMS[kind]}) > 25


def test_an_object_counts_where_its_finest_texts_are_right_and_a_spelling_is_one_case(tmp_path: Path) -> None:
    shouted = copy.deepcopy(GROUNDING)
    shouted["scene0025_00"]["box"]["27"]["chain_3"][1] = COARSE | {"text": "BOX", "obj_id": ["29"]}
    answers = [{"object_id": 27}, {"object_id": 27}, {"object_id": 27}, {"object_id": 27}, {"object_id": 27}]
    found = numbers(tmp_path, shouted, answers)
    assert (found["case"].n, found["case"].least, found["object"].least) == (4, 0.75, 1.0)  # the last spelling counts
    assert (found["chain"].least, found["fine alone"].least) == (0.0, 1.0)


def test_without_a_judge_scores_have_a_least_and_a_most_and_say_how_to_bring_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = [{"pred": "white"}, {"pred": "white."}, {"pred": "blue"}]
    found = numbers(tmp_path, QA, said)
    assert (found["EM"].least, found["settled"].least) == (2 / 3, 2 / 3)
    assert [(one.least, one.most) for one in (found["case"], found["object"])] == [(2 / 3, 1.0), (0.0, 1.0)]
    paths = written(tmp_path, QA, said)
    assert main(["query", "score", str(paths[0]), "--answers", str(paths[1])]) == 0
    shown = capsys.readouterr().out
    assert "66.7 to 100.0" in shown and "give each answer its 'score'" in shown
    judged = numbers(tmp_path, QA, [*said[:2], {"pred": "blue", "score": 4}])
    assert judged["case"].least == pytest.approx(11 / 12) and judged["object"].least == 1.0


def test_the_texts_of_a_file_ask_a_map_in_their_chains_and_are_questions_too(tmp_path: Path) -> None:
    asked, _ = written(tmp_path, GROUNDING, [])
    (scene, cases), *rest = read_foreign_queries(asked).items()
    assert scene == "scene0025_00" and not rest and len(cases) == 4
    assert isinstance(cases[1], ChainedText) and cases[1].object_ids == (30, 28)  # one more than in the file
    assert cases[1].places == tuple(Place(0, k, 1) for k in range(3))
    assert {(one.kind, one.answers) for one in read_questions(asked)} == {("relative", (28,)), ("relative", (28, 30))}
    asked, _ = written(tmp_path, QA, [])
    assert [one.reply for one in read_questions(asked)] == ["White"] * 3


def changed(content: dict[str, Any], change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    copied = copy.deepcopy(content)
    change(copied["scene0025_00"]["box"])
    return copied


@pytest.mark.parametrize(
    ("asked", "answers", "line"),
    [
        ([], [], "is no metadata_*_grounding.json or metadata_*_qa.json of Beacon3D"),
        ("{", [], "not JSON"),
        (changed(GROUNDING, lambda of: of["27"].pop("chain_2")), [], "27: has 2 chains; expected 3"),
        (changed(GROUNDING, lambda of: of["27"]["chain_2"].clear()), [], "chain_2: expected a list that is not empty"),
        (changed(GROUNDING, lambda of: of.update({"3": [1]})), [], "expected scenes, classes and objects one in"),
        (changed(GROUNDING, lambda of: of["27"]["chain_1"].append({})), [], "a text must have text, obj_id, tag"),
        (changed(GROUNDING, lambda of: of["27"]["chain_1"].append(FINE | {"obj_id": ["-1"]})), [], "must hold object"),
        (
            changed(GROUNDING, lambda of: of["27"]["chain_1"].append(FINE | {"text": "\x1b"})),
            [],
            "'text' must be words",
        ),
        (
            changed(GROUNDING, lambda of: of["27"]["chain_1"].append(COARSE | {"tag": "spatial"})),
            [],
            "'Box' has other tags than where it stood before",
        ),
        (changed(QA, lambda of: of["27"]["qa"].pop()), [], "27: has 2 questions; expected 3"),
        (changed(QA, lambda of: of["27"]["qa"][0].pop("tag")), [], "a question must have question, answer, tag"),
        (GROUNDING, {}, "expected a list of answers, a table each"),
        (GROUNDING, [{"correct": True}], "has 1 answers, the file asks 4"),
        (GROUNDING, [{"correct": "yes"}] * 4, "answer 1: needs 'correct', true or false, or 'object_id'"),
        (QA, [{}] * 3, "answer 1: needs an answer in words under one of response_pred"),
        (QA, [{"pred": "red", "score": 9}] * 3, "answer 1: 'score' must be a number from 1 to 5; found 9"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line(
    asked: object, answers: object, line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = written(tmp_path, asked, answers)
    assert main(["query", "score", str(paths[0]), "--answers", str(paths[1])]) == 2
    error = capsys.readouterr().err
    assert line in error and error.count("\n") == 1


def test_a_file_that_is_not_here_says_where_to_get_it(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"is missing; get Beacon3D's files by https://github.com/beacon-3d/beacon-3d"):
        answered_file(tmp_path / "metadata_scannet_qa.json", tmp_path / "answers.json")


@pytest.mark.parametrize(
    ("asked", "answers"),
    [(GROUNDING, [{"correct": 1}, {"object_id": 3}] * 2), (QA, [{"pred": "red", "score": 2}] * 3)],
    ids=["grounding", "qa"],
)
def test_damaged_files_are_read_or_refused_in_one_line(asked: object, answers: object, tmp_path: Path) -> None:
    paths = written(tmp_path, asked, answers)
    for path in paths:
        whole = path.read_bytes()

        def read(damaged: bytes, path: Path = path) -> object:
            path.write_bytes(damaged)
            return answered_file(*paths)

        n_read, n_refused = outcomes(read, chain(truncations(whole), damages(whole, 500)), must_name=".json")
        assert n_read and n_refused > 200
        path.write_bytes(whole)


def test_texts_without_chains_are_no_truth_of_objects(tmp_path: Path) -> None:
    from su3d_bench.metrics.open_vocabulary.query_ap import QueryTruth, TextQuery

    points = np.zeros((1, 3), np.float32)
    truth = QueryTruth(points, np.ones(1, np.int64), (TextQuery("box", (1,)),), "query-objects", "here")
    with pytest.raises(DataError, match="stand in no chains of objects; give a metadata"):
        counting.chained(truth)


def test_the_examples_hold() -> None:
    for module in (counting, answer_matching, answered, beacon3d_files, made):
        assert not doctest.testmod(module).failed
