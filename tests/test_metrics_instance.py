"""The instance AP answers what the original evaluators answer, to the last bit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from su3d_bench.metrics.instance_ap import (
    THRESHOLDS,
    InstanceAP,
    InstanceCounts,
    combine,
    last_line_of_each_mask_file,
    per_scene,
)

CASES = Path(__file__).parent / "cases"
INSTANCE_CASES = sorted(p.stem for p in CASES.glob("inst*.json")) + sorted(p.stem for p in CASES.glob("replica*.json"))


def load(case: str) -> tuple[dict[str, Any], dict[str, Any]]:
    with np.load(CASES / f"{case}.npz") as archive:
        arrays = {key: archive[key] for key in archive.files}
    return arrays, json.loads((CASES / f"{case}.json").read_text())


def scene_counts(arrays: dict[str, Any], scene: int, class_ids: list[int]) -> InstanceCounts:
    truth = arrays[f"gt_{scene}"]
    masks = np.unpackbits(arrays[f"masks_packed_{scene}"], axis=1)[:, : len(truth)].astype(bool)
    labels, scores = arrays[f"labels_{scene}"], arrays[f"scores_{scene}"]
    if f"mask_files_{scene}" in arrays:
        lines = last_line_of_each_mask_file([str(f) for f in arrays[f"mask_files_{scene}"]])
        masks = masks[[first for first, _ in lines]]
        labels, scores = labels[[last for _, last in lines]], scores[[last for _, last in lines]]
    indptr = np.concatenate([[0], np.cumsum(masks.sum(axis=1))])
    return per_scene(truth, indptr, np.nonzero(masks)[1], labels, scores, class_ids)


def evaluate(case: str, oracle: str) -> tuple[InstanceAP, dict[str, Any]]:
    arrays, expected = load(case)
    answer = expected[oracle]
    counts = [scene_counts(arrays, s, answer["class_ids"]) for s in range(len(arrays["scene_names"]))]
    return combine(counts), answer


def as_table(answer: dict[str, Any]) -> Any:
    return np.array([[np.nan if v is None else v for v in row] for row in answer["ap"]])


def is_same(value: float, expected: float | None) -> bool:
    return np.isnan(value) if expected is None else value == expected


def test_the_thresholds_are_the_original_doubles() -> None:
    _, expected = load("inst01_basic")
    assert list(THRESHOLDS) == expected["official_py3_pr26"]["overlaps"]


@pytest.mark.parametrize("case", INSTANCE_CASES)
def test_every_ap_of_a_reference_case_is_equal_in_every_bit(case: str) -> None:
    ours, answer = evaluate(case, "official_py3_pr26")
    assert np.array_equal(ours.table, as_table(answer), equal_nan=True)


@pytest.mark.parametrize("case", INSTANCE_CASES)
def test_the_averages_of_a_reference_case_are_equal_in_every_bit(case: str) -> None:
    ours, answer = evaluate(case, "official_py3_pr26")
    assert (ours.ap, ours.ap50, ours.ap25) == (answer["all_ap"], answer["all_ap50"], answer["all_ap25"])
    for index, label in enumerate(answer["class_labels"]):
        of_class = answer["classes"][label]
        for value, key in zip(ours.of_class(index), ("ap", "ap50", "ap25"), strict=True):
            assert is_same(value, of_class[key])


def test_openmask3ds_own_replica_script_gives_the_same_bits() -> None:
    for case in ("replica01_all_ones", "replica02_scores"):
        ours, answer = evaluate(case, "replica_script")
        assert np.array_equal(ours.table, as_table(answer), equal_nan=True)


def test_the_scannet200_case_is_equal_in_every_bit() -> None:
    ours, answer = evaluate("scannet200_01", "openmask3d")
    averages = answer["avgs"]
    assert np.array_equal(ours.table, as_table(answer), equal_nan=True)
    assert ours.ap == averages["all_ap"]
    assert ours.ap50 == averages["all_ap_50%"]
    assert ours.ap25 == averages["all_ap_25%"]
