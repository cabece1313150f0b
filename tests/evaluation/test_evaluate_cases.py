"""Predictions in the original formats on disk score as in the original evaluators, by library and command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CASES
from prediction_files import scenes_of, write_scannet_text

from su3d_bench.cli.main import main
from su3d_bench.evaluation.evaluate import evaluate
from su3d_bench.evaluation.result import Confidences, Request

PROTOCOLS = {"inst": "scannet-instance", "replica": "replica-openmask3d", "scannet200": "scannet200-instance"}
INSTANCE_CASES = sorted(path.stem for name in PROTOCOLS for path in CASES.glob(f"{name}*.json") if name != "scannet200")
SEMANTIC_CASES = sorted(path.stem for path in CASES.glob("sem*.json"))
KEYS = ("ap", "ap50", "ap25")


def protocol_of(case: str) -> str:
    return next(
        protocol for name, protocol in PROTOCOLS.items() if case.startswith(name) and "200" not in case[len(name) :]
    )


def arrays_of(case: str) -> dict[str, Any]:
    with np.load(CASES / f"{case}.npz") as archive:
        return {key: archive[key] for key in archive.files}


def answer_of(case: str) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads((CASES / f"{case}.json").read_text())
    return answer


def write_truth(folder: Path, case: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    arrays = arrays_of(case)
    for s, name in enumerate(arrays["scene_names"]):
        (folder / f"{name}.txt").write_text("".join(f"{value}\n" for value in arrays[f"gt_{s}"]))


def write_case(folder: Path, case: str) -> None:
    """The arrays of an instance case as the files of the benchmark: ``pred/`` and ``gt/``."""
    write_truth(folder / "gt", case)
    for scene in scenes_of(case):
        write_scannet_text(folder / "pred", scene)


def write_semantic_case(folder: Path, case: str) -> None:
    write_truth(folder / "gt", case)
    arrays = arrays_of(case)
    (folder / "pred").mkdir()
    for s, name in enumerate(arrays["scene_names"]):
        (folder / "pred" / f"{name}.txt").write_text("".join(f"{value}\n" for value in arrays[f"pred_{s}"]))


def by_library(folder: Path, protocol: str, confidences: Confidences | None = None) -> dict[str, Any]:
    request = Request((folder / "pred",), ground_truth=folder / "gt", protocols=(protocol,), confidences=confidences)
    document = json.loads(json.dumps(evaluate(request).to_json(), allow_nan=False))
    found: dict[str, Any] = document["protocols"][protocol]
    return found


def by_command(folder: Path, protocol: str, *more: str) -> dict[str, Any]:
    words = ["evaluate", str(folder / "pred"), "--ground-truth", str(folder / "gt"), "--protocols", protocol]
    assert main([*words, "--json", str(folder / "out.json"), "--quiet", *more]) == 0
    document = json.loads((folder / "out.json").read_text())
    assert document["schema"] == 1
    assert list(document["protocols"]) == [protocol]
    found: dict[str, Any] = document["protocols"][protocol]
    return found


@pytest.mark.parametrize("case", INSTANCE_CASES)
def test_instance_case_on_disk_equals_the_official_script(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_case(tmp_path, case)
    answer = answer_of(case)["official_py3_pr26"]
    protocol = protocol_of(case)
    for found in (by_library(tmp_path, protocol), by_command(tmp_path, protocol)):
        assert tuple(found["metrics"][key] for key in KEYS) == tuple(answer[f"all_{key}"] for key in KEYS)
        assert found["per_class"] == answer["classes"]
        assert found["n_scenes"] == len(scenes_of(case))
    assert protocol in capsys.readouterr().out


def test_scannet200_case_on_disk_equals_openmask3d(tmp_path: Path) -> None:
    write_case(tmp_path, "scannet200_01")
    averages = answer_of("scannet200_01")["openmask3d"]["avgs"]
    for found in (by_library(tmp_path, "scannet200-instance"), by_command(tmp_path, "scannet200-instance")):
        shown = {"ap": "ap", "ap50": "ap50%", "ap25": "ap25%"}
        assert found["metrics"] == {
            key: averages[f"all_{name.replace('ap5', 'ap_5').replace('ap2', 'ap_2')}"] for key, name in shown.items()
        }
        for group in ("head", "common", "tail"):
            assert found["groups"][group] == {key: averages[f"{group}_{name}"] for key, name in shown.items()}


@pytest.mark.parametrize("case", SEMANTIC_CASES)
def test_semantic_case_on_disk_equals_the_official_script(case: str, tmp_path: Path) -> None:
    write_semantic_case(tmp_path, case)
    answer = answer_of(case)
    official = answer["official_py3"]
    for found in (by_library(tmp_path, "scannet-semantic"), by_command(tmp_path, "scannet-semantic")):
        assert [one["iou"] for one in found["per_class"].values()] == list(
            official["iou"].values() if isinstance(official["iou"], dict) else official["iou"]
        )
        assert found["metrics"]["miou"] == answer["mean_iou_nanmean"]
        assert found["metrics"]["macc"] == answer["derived_mean_acc_over_classes_with_gt"]


def test_every_mask_under_every_class_scores_as_measured_with_the_original(tmp_path: Path) -> None:
    write_case(tmp_path, "replica01_all_ones")
    found = by_library(tmp_path, "replica-openmask3d")
    assert found["every_mask_every_class"]["ap"] == pytest.approx(0.212, abs=5e-4)
    assert found["metrics"]["ap"] == pytest.approx(0.202, abs=5e-4)


def test_both_values_are_reported_if_the_protocol_sets_confidences_to_1(tmp_path: Path) -> None:
    write_case(tmp_path, "replica02_scores")
    as_in_files = by_library(tmp_path, "replica-openmask3d")
    by_rule = by_library(tmp_path, "replica-openmask3d", "protocol")
    assert as_in_files["every_confidence_1"] == by_rule["metrics"] != as_in_files["metrics"]
    assert by_rule["every_confidence_1"] is None
    assert by_command(tmp_path, "replica-openmask3d", "--confidences", "protocol") == by_rule
    assert as_in_files["warnings"][0].startswith("the confidences in the files are used")
    assert by_rule["warnings"][0].startswith("the protocol sets all confidences to 1; those in the files (0.001")
