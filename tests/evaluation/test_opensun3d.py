"""The OpenSUN3D challenge: submissions and ground truth in files score as in its own script."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluated_text import scene, write_truth
from places import CASES
from prediction_files import write_scannet_text

from su3d_bench.core.errors import ConfigError, PredictionError
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Request, ValuesForm
from su3d_bench.predictions.formats import recognise

CASE = "opensun3d01_numbers"
PROTOCOL = "opensun3d-challenge"
PROBLEMS = json.loads((CASES / f"{CASE}.json").read_text())["problems"]
NAMES = ("ap", "ap50", "ap25")


def scenes_of(index: int) -> Iterator[tuple[str, np.ndarray, np.ndarray, list[float], list[int]]]:
    """Name, ground truth, masks (K, N), scores and mask files of each scene of a problem."""
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
def test_submission_on_disk_equals_the_challenge_script(index: int, tmp_path: Path) -> None:
    write_problem(tmp_path, index)
    assert recognise(tmp_path / "pred").name == PROTOCOL
    metrics = numbers(tmp_path)["metrics"]
    assert [metrics[name] for name in NAMES] == [PROBLEMS[index][name] for name in NAMES]


def test_a_scene_without_a_submission_counts_as_missed(tmp_path: Path) -> None:
    write_problem(tmp_path, 0)
    whole = numbers(tmp_path)
    name = next(scenes_of(0))[0]
    (tmp_path / f"pred/{name}.txt").unlink()
    found = numbers(tmp_path)
    assert found["metrics"] != whole["metrics"]
    assert any("have no prediction and count as missed" in line for line in found["warnings"])


def test_ground_truth_can_be_declared_as_class_and_instance(tmp_path: Path) -> None:
    write_problem(tmp_path, 0)
    for file in (tmp_path / "gt").iterdir():
        values = np.loadtxt(file, dtype=int)
        file.write_text("".join(f"{5000 + value if value else 0}\n" for value in values % 1000))
    assert numbers(tmp_path)["metrics"]["ap"] is None  # as in the script: no objects from 2000 on
    metrics = numbers(tmp_path, ground_truth_values="instances")["metrics"]
    assert [metrics[name] for name in NAMES] == [PROBLEMS[0][name] for name in NAMES]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("masks/a.txt 1 0.5", "pred/a.txt:1: 3 fields in 'masks/a.txt 1 0.5'; expected 'mask file, confidence'"),
        ("../a.txt 0.5", "pred/a.txt:1: '../a.txt' is not a path inside the folder of the list"),
        ("masks/b.txt 0.5", "pred/a.txt:1: mask 'masks/b.txt' does not exist"),
    ],
)
def test_invalid_mask_line_is_named(line: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pred").mkdir()
    Path("pred/a.txt").write_text(line + "\n")
    Path("gt").mkdir()
    Path("gt/a.txt").write_text("1\n" * 5)
    request = Request((Path("pred"),), ground_truth=Path("gt"), protocols=(PROTOCOL,), format=PROTOCOL)
    with pytest.raises(PredictionError) as raised:
        evaluate(request)
    assert message in str(raised.value)


def test_values_that_may_be_classes_or_instances_are_not_guessed(tmp_path: Path) -> None:
    write_truth(tmp_path / "gt", values=np.repeat([1000, 1001, 1067], 200))
    write_scannet_text(tmp_path / "pred", scene([np.arange(200, 400)], [3]))
    request = Request((tmp_path / "pred",), ground_truth=tmp_path / "gt", protocols=("class-agnostic-segment3d",))
    with pytest.raises(ConfigError, match=r"1000 to 1067, may be class ids only, .* choose with --ground-truth-values"):
        evaluate(request)
    with pytest.raises(
        ConfigError, match=r"1000 to 1067, are configured as class ids only: .* --ground-truth-values numbers"
    ):
        evaluate(replace(request, ground_truth_values="classes"))
    forms: tuple[tuple[ValuesForm, float], ...] = (("instances", 1 / 3), ("numbers", 1 / 3))  # 1000 is an object
    for form, recall in forms:
        found = evaluate(replace(request, ground_truth_values=form)).to_json()["protocols"]["class-agnostic-segment3d"]
        assert found["metrics"]["ap50"] == recall
