"""A map that is asked the queries of the OpenSUN3D challenge has the answer of its script over what is exported."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from places import CASES

from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.core.maps import DenseFeatures, Instances
from su3d_bench.core.types import Float32Array, GroundTruth
from su3d_bench.datasets.arkitscenes.challenge import TRUTH_FOLDER, Challenge, answered
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.predictions.base import VertexMasks
from su3d_bench.predictions.export import answer_to, masks_as_predicted, write_opensun3d
from su3d_bench.predictions.formats import recognise
from su3d_bench.questions.ground_truths import question_truth

PROBLEMS = json.loads((CASES / "opensun3d02_queries.json").read_text())["problems"]
RULES = load_protocol("opensun3d-queries")
NAMES = ("AP", "AP50", "AP25")


class Axes:
    """Encodes the texts a and b as the first two axes."""

    name, dim, digest = "axes", 3, "axes"

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.eye(3, dtype=np.float32)[["ab".index(text) for text in texts]]


ENCODER: Any = Axes()


def scenes_of(problem: Any, folder: Path) -> Iterator[tuple[str, str, GroundTruth, Instances]]:
    """Name, query, truth, as read from a file below ``folder``, and map of each scene."""
    (folder / TRUTH_FOLDER).mkdir(parents=True)
    for number, scene in enumerate(problem["scenes"]):
        name = f"{number:08d}"
        (folder / TRUTH_FOLDER / f"{name}.txt").write_text("".join(f"{value}\n" for value in scene["truth"]))
        points = np.zeros((len(scene["truth"]), 3), np.float32)
        points[:, 0] = np.arange(len(points))
        features = np.array(scene["features"], np.float32).reshape(-1, 3)
        found = Instances.of(points, [np.array(mask, np.int64) for mask in scene["masks"]], None, features)
        yield name, scene["query"], Challenge(folder).ground_truth(name, points), found


def asked(truth: GroundTruth, *texts: str) -> Any:
    dataset = SimpleNamespace(name="made", queries=lambda scene: [answered(truth, text) for text in texts])
    return question_truth(RULES, dataset, "a", truth)


def values_of(rules: ProtocolRules, problem: Any, folder: Path) -> list[float | None]:
    scores = {
        name: score_scene(rules, asked(truth, text), found, ENCODER)
        for name, text, truth, found in scenes_of(problem, folder)
    }
    found = combine(rules, scores).metrics
    return [None if np.isnan(found[name]) else found[name] for name in NAMES]


@pytest.mark.parametrize("index", range(len(PROBLEMS)))
def test_a_map_that_is_asked_has_the_answer_of_the_challenges_script(index: int, tmp_path: Path) -> None:
    found, expected = values_of(RULES, PROBLEMS[index], tmp_path), PROBLEMS[index]["answer"]
    assert [value is None for value in found] == [value is None for value in expected]
    pairs = [(a, b) for a, b in zip(found, expected, strict=True) if a is not None]
    assert all(abs(a - b) <= 2.3e-16 for a, b in pairs)


def test_a_scene_may_be_asked_several_texts_and_each_has_its_own_masks(tmp_path: Path) -> None:
    (_, _, truth, found), *_ = scenes_of(PROBLEMS[0], tmp_path)
    both = combine(RULES, {"a": score_scene(RULES, asked(truth, "a", "b"), found, ENCODER)}).metrics
    apart = {text: score_scene(RULES, asked(truth, text), found, ENCODER) for text in "ab"}
    assert both == combine(RULES, apart).metrics


def test_an_exported_map_is_scored_as_the_map_and_comes_back_byte_for_byte(tmp_path: Path) -> None:
    whole = [one for one in PROBLEMS if all(len(scene["masks"]) > 1 for scene in one["scenes"])]
    problem = next(one for one in whole if one["answer"][2])
    first, second = tmp_path / "first", tmp_path / "second"
    for name, text, truth, found in scenes_of(problem, tmp_path):
        write_opensun3d(answer_to(text, found, RULES, truth.points, ENCODER), name, first)
    reader = recognise(first)
    assert reader.name == "opensun3d-challenge"
    for name in reader.scenes(first):
        content = reader.read(first, name).content
        assert isinstance(content, VertexMasks)
        write_opensun3d(masks_as_predicted(content), name, second)
    files = {str(path.relative_to(first)): path.read_bytes() for path in first.rglob("*.txt")}
    assert files == {str(path.relative_to(second)): path.read_bytes() for path in second.rglob("*.txt")}
    request = Request((first,), ground_truth=tmp_path / TRUTH_FOLDER, protocols=("opensun3d-challenge",))
    scored = evaluate(request).to_json()["protocols"]["opensun3d-challenge"]["metrics"]
    expected = problem["answer"]
    assert [scored[name] for name in ("ap", "ap50", "ap25")] == pytest.approx(expected, abs=2.3e-16)


def test_a_list_that_the_challenges_own_script_cannot_read_is_told(tmp_path: Path) -> None:
    points = np.zeros((3, 3), np.float32)
    one = Instances.of(points, [np.array([0]), np.array([], int)], None, np.eye(3, dtype=np.float32)[:2])
    remarks = write_opensun3d(answer_to("a", one, RULES, points, ENCODER), "a", tmp_path)
    assert remarks == (
        "1 of 2 masks have no point of the ground truth and were left out",
        "has 1 mask: the challenge's own script stops at a list of fewer than 2",
    )
    assert (tmp_path / "a.txt").read_text() == "predicted_masks/a_000.txt 1.0\n"
    assert (tmp_path / "predicted_masks/a_000.txt").read_text() == "1\n0\n0\n"


def test_what_cannot_answer_a_text_is_refused_in_one_line() -> None:
    points = np.zeros((3, 3), np.float32)
    dense = DenseFeatures(points, np.zeros((3, 3), np.float16))
    for content, message in (
        (dense, "has no masks"),
        (Instances.of(points, [np.array([0])]), "needs features to compare with texts, and the prediction has none"),
    ):
        with pytest.raises(PredictionError, match=message):
            answer_to("a", content, RULES, points, ENCODER)


def test_questions_of_a_dataset_are_what_the_rules_must_say(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\nextends = "opensun3d-queries"\ntop_k = 3\n')
    with pytest.raises(ConfigError, match="top_k: metric 'opensun3d' counts every mask of a scene"):
        load_protocol(str(path))
    path.write_text('name = "mine"\nextends = "opensun3d-queries"\nquestions = "generated"\n')
    with pytest.raises(ConfigError, match="synonyms: is missing"):
        load_protocol(str(path))
