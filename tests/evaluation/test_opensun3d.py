"""The OpenSUN3D challenge: its submissions and its truth in files give what its own script answers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CASES
from scored_room import instances

from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request, ValuesForm
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.predictions.formats import recognise

CASE = "opensun3d01_numbers"
PROTOCOL = "opensun3d-challenge"
PROBLEMS = json.loads((CASES / f"{CASE}.json").read_text())["problems"]
NAMES = ("ap", "ap50", "ap25")


def scenes_of(index: int) -> Iterator[tuple[str, np.ndarray, np.ndarray, list[float], list[int]]]:
    """Name, truth, masks (K, N), scores and the file of each mask, of each scene of a problem."""
    with np.load(CASES / f"{CASE}.npz") as archive:
        for s in range(PROBLEMS[index]["n_scenes"]):
            values = archive[f"gt_{index}_{s}"].astype(int)
            masks = np.unpackbits(archive[f"masks_packed_{index}_{s}"], axis=1)[:, : len(values)]
            of_masks = archive[f"scores_{index}_{s}"].tolist(), archive[f"file_{index}_{s}"].tolist()
            yield f"4206{s}_{index}", values, masks, *of_masks


def write_problem(folder: Path, index: int) -> None:
    for name in ("gt", "pred/predicted_masks"):
        (folder / name).mkdir(parents=True)
    for name, values, masks, scores, files in scenes_of(index):
        (folder / f"gt/{name}.txt").write_text("".join(f"{value}\n" for value in values))
        paths = [f"predicted_masks/{name}_{file}.txt" for file in files]
        for path, mask in zip(paths, masks, strict=True):
            (folder / "pred" / path).write_text("".join(f"{value}\n" for value in mask))
        lines = [f"{path} {score!r}\n" for path, score in zip(paths, scores, strict=True)]
        (folder / f"pred/{name}.txt").write_text("".join(lines))


def numbers(folder: Path, **more: Any) -> dict[str, Any]:
    request = Request((folder / "pred",), ground_truth=folder / "gt", protocols=(PROTOCOL,))
    found: dict[str, Any] = json.loads(json.dumps(evaluate(replace(request, **more)).to_json()))["protocols"][PROTOCOL]
    return found


@pytest.mark.parametrize("index", range(len(PROBLEMS)))
def test_a_submission_on_disk_has_the_answer_of_the_script_of_the_challenge(index: int, tmp_path: Path) -> None:
    write_problem(tmp_path, index)
    assert recognise(tmp_path / "pred").name == PROTOCOL
    metrics = numbers(tmp_path)["metrics"]
    assert [metrics[name] for name in NAMES] == [PROBLEMS[index][name] for name in NAMES]


def test_the_cases_tell_the_rule_for_void_from_none() -> None:
    rules = load_protocol(PROTOCOL)
    labels = LabelSet("scannet", (1,), ("object",))
    n_other = n_same = 0
    for index in range(len(PROBLEMS)):
        scores: dict[str, dict[str, Any]] = {"without": {}, "with": {}}
        for name, values, masks, confidences, _ in scenes_of(index):
            number = np.where(values // 1000 < 2, values % 1000, 0).astype(np.int32)
            points = np.random.default_rng(0).random((len(values), 3)).astype(np.float32)
            truth = GroundTruth(points, np.minimum(number, 1), number, labels, "scannet200-vertices", "made for a test")
            prediction = instances(points, [np.flatnonzero(row) for row in masks], None, scores=confidences)
            for key, used in (("without", rules), ("with", rules.model_copy(update={"void": None}))):
                scores[key][name] = score_scene(used, truth, prediction, None)
        found = {key: combine(rules, each).metrics for key, each in scores.items()}
        n_other += found["with"]["AP25"] != found["without"]["AP25"]
        n_same += found["without"]["AP25"] == PROBLEMS[index]["ap25"]
    assert n_other >= 20
    assert n_same >= 28  # of truth in arrays, where a number 0 is none: as text 1000 is one


def test_a_scene_without_a_submission_counts_as_missed(tmp_path: Path) -> None:
    write_problem(tmp_path, 0)
    whole = numbers(tmp_path)
    name = next(scenes_of(0))[0]
    (tmp_path / f"pred/{name}.txt").unlink()
    found = numbers(tmp_path)
    assert found["metrics"] != whole["metrics"]
    assert any("have no prediction and count as missed" in line for line in found["warnings"])


def test_the_truth_may_be_said_to_hold_class_and_instance(tmp_path: Path) -> None:
    write_problem(tmp_path, 0)
    for file in (tmp_path / "gt").iterdir():
        values = np.loadtxt(file, dtype=int)
        file.write_text("".join(f"{5000 + value if value else 0}\n" for value in values % 1000))
    assert numbers(tmp_path)["metrics"]["ap"] is None  # as the script: no object from 2000 up
    metrics = numbers(tmp_path, truth_values="instances")["metrics"]
    assert [metrics[name] for name in NAMES] == [PROBLEMS[0][name] for name in NAMES]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("masks/a.txt 1 0.5", "pred/a.txt:1: 3 fields in 'masks/a.txt 1 0.5'; expected 'mask file, confidence'"),
        ("../a.txt 0.5", "pred/a.txt:1: '../a.txt' is no path inside the folder of the list"),
        ("masks/b.txt 0.5", "pred/a.txt:1: mask 'masks/b.txt' does not exist"),
    ],
)
def test_a_line_that_is_no_mask_is_named(
    line: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pred").mkdir()
    Path("pred/a.txt").write_text(line + "\n")
    Path("gt").mkdir()
    Path("gt/a.txt").write_text("1\n" * 5)
    request = Request((Path("pred"),), ground_truth=Path("gt"), protocols=(PROTOCOL,), format=PROTOCOL)
    with pytest.raises(PredictionError) as raised:
        evaluate(request)
    assert message in str(raised.value)


# ---- what values of the truth are


def write_values(folder: Path, values: np.ndarray, members: slice) -> None:
    for name in ("gt", "pred/masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "gt/scene0001_00.txt").write_text("".join(f"{value}\n" for value in values))
    mask = np.zeros(len(values), int)
    mask[members] = 1
    (folder / "pred/masks/0.txt").write_text("".join(f"{value}\n" for value in mask))
    (folder / "pred/scene0001_00.txt").write_text("masks/0.txt 3 0.9\n")


def test_values_that_may_be_classes_or_instances_are_not_guessed(tmp_path: Path) -> None:
    write_values(tmp_path, np.repeat([1000, 1001, 1067], 200), slice(200, 400))
    request = Request((tmp_path / "pred",), ground_truth=tmp_path / "gt", protocols=("class-agnostic-segment3d",))
    with pytest.raises(ConfigError, match=r"1000 to 1067, may be class ids alone, .* say which with --truth-values"):
        evaluate(request)
    with pytest.raises(ConfigError, match=r"1000 to 1067, are said to be class ids alone: .* --truth-values numbers"):
        evaluate(replace(request, truth_values="classes"))
    forms: tuple[tuple[ValuesForm, float], ...] = (("instances", 1 / 2), ("numbers", 1 / 3))  # there 1000 is an object
    for form, recall in forms:
        found = evaluate(replace(request, truth_values=form)).to_json()["protocols"]["class-agnostic-segment3d"]
        assert found["metrics"]["ap50"] == recall
