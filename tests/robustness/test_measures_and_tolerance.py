"""Measures of sweeps and the search for tolerances, on synthetic numbers with known answers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest
from scored_room import ENCODER, ROOM

from su3d_bench.analysis.sides import Numbers
from su3d_bench.core.errors import ConfigError
from su3d_bench.core.maps import Instances
from su3d_bench.corruptions.apply import CORRUPTIONS, Cell, cell_of, parse_conditions
from su3d_bench.metrics.matching.labelling import classes_of_prediction
from su3d_bench.robustness import measures
from su3d_bench.robustness.sweep import conditions_of, methods_of
from su3d_bench.robustness.tolerance import find_tolerances

HOLES = CORRUPTIONS["depth/holes"]


def numbers(of_scenes: Sequence[float]) -> Numbers:
    values = np.array(of_scenes)
    without_each = np.array([values.mean(), *((values.sum() - value) / (len(values) - 1) for value in values)])
    return Numbers(float(values.mean()), values, without_each, None)


def evaluator(
    score: Callable[[float, int], float], n_scenes: int
) -> Callable[[Sequence[Cell]], Mapping[Cell, Numbers]]:
    """``score`` is that of a scene at a severity."""

    def evaluate(cells: Sequence[Cell]) -> Mapping[Cell, Numbers]:
        assert cells
        severity = {cell: cell.conditions[0].severity if cell.conditions else 0.0 for cell in cells}
        return {cell: numbers([score(severity[cell], k) for k in range(n_scenes)]) for cell in cells}

    return evaluate


def test_planted_tolerance_is_within_its_interval_in_19_of_20_seeds() -> None:
    hits = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        limits = rng.normal(2.5, 0.5, 8)  # where a scene's score begins to fall; the mean score reaches 95 % near 2.9

        def score(severity: float, scene: int, limits: np.ndarray = limits) -> float:
            return 0.8 - 0.1 * max(0.0, severity - float(limits[scene]))

        (found,) = find_tolerances(evaluator(score, 8), ["method"], [HOLES])
        truth = HOLES.value_at(_expected_crossing())
        assert found.interval is not None
        hits += found.interval[0] <= truth <= found.interval[1]
    assert hits >= 19


def _expected_crossing() -> float:
    """Where E[max(0, s - L)], L normal with mean 2.5 and deviation 0.5, is 5 % of 0.8 over the slope 0.1."""
    low, high = 0.0, 5.0
    for _ in range(50):
        middle = (low + high) / 2
        z = (middle - 2.5) / 0.5
        mean = 0.5 * (z * 0.5 * math.erfc(-z / math.sqrt(2)) + math.exp(-z * z / 2) / math.sqrt(2 * math.pi))
        low, high = (middle, high) if mean < 0.4 else (low, middle)
    return low


def test_tolerance_beyond_the_highest_severity_is_a_lower_bound() -> None:
    (found,) = find_tolerances(evaluator(lambda severity, scene: 0.8 + 0.01 * scene, 3), ["method"], [HOLES])
    assert found.is_beyond
    assert found.value == HOLES.values[-1]


def test_tolerance_of_a_linear_fall_is_exact() -> None:
    (found,) = find_tolerances(evaluator(lambda severity, scene: 1.0 - 0.02 * severity, 3), ["method"], [HOLES])
    assert found.severity == pytest.approx(2.5)
    assert found.value == pytest.approx(HOLES.value_at(2.5))


@pytest.mark.parametrize(
    ("name", "last_kept"),
    [
        ("depth/edge-loss", range(8)),
        ("time/depth-lag", range(20)),
        ("image/zoom-blur", range(5)),
        ("image/jpeg", range(8, 26)),  # a lower quality is worse
    ],
)
def test_whole_tolerance_is_the_last_value_that_is_kept(name: str, last_kept: range) -> None:
    row = CORRUPTIONS[name]
    for last in last_kept:

        def score(severity: float, scene: int, last: int = last) -> float:
            value = row.value_at(severity)
            return 0.8 if (value >= last if name == "image/jpeg" else value <= last) else 0.5

        (found,) = find_tolerances(evaluator(score, 2), ["method"], [row])
        assert found.value == last


def test_name_of_a_cell_is_read_back() -> None:
    for text in ("depth/holes/4", "pose/jitter-rotation/2.5", "depth/edge-loss/1+names/typos/3"):
        cell = Cell("opensu3d@top_m=1", parse_conditions(text))
        assert cell_of(cell.name) == cell
    assert cell_of("opensu3d") is None
    for text in ("opensu3d~mine", "opensu3d~depth-holes-9", "opensu3d~depth-holes-4.0", "~depth-holes-4"):
        assert cell_of(text) is None


def test_conditions_of_families_corruptions_and_pairs() -> None:
    of_family = conditions_of(["calibration"], [1, 5], [])
    assert len(of_family) == 2 * len([row for row in CORRUPTIONS.values() if row.family == "calibration"])
    assert [one[0].severity for one in conditions_of(["depth/holes"], [0, 3], [])] == [0, 3]
    pairs = conditions_of(["depth/holes+pose/jumps"], [2], [])
    assert [[one.address for one in pair] for pair in pairs] == [["depth/holes/2", "pose/jumps/2"]]
    assert methods_of(["a", "b"], conditions_of([], [], ["depth/holes/4"])) == [
        "a",
        "b",
        "a~depth/holes/4",
        "b~depth/holes/4",
    ]


@pytest.mark.parametrize(
    "text", ["depth/hole/1", "depth/holes", "depth/holes/6", "depth/holes/x", "depth/holes/1+depth/holes/2"]
)
def test_wrong_conditions_are_rejected(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_conditions(text)


def test_family_means_weight_corruptions_equally_and_mce_is_relative_to_the_baseline() -> None:
    cells = [Cell("m", parse_conditions(text)) for text in ("depth/holes/1", "depth/holes/5", "depth/scale/1")]
    of_scenes = {"m": [0.8, 0.6], cells[0].name: [0.7, 0.5], cells[1].name: [0.5, 0.3], cells[2].name: [0.8, 0.6]}
    found = {name: numbers(values) for name, values in of_scenes.items()}
    result = measures._method_result("m", cells, found, ["a", "b"])
    assert result.clean == pytest.approx(0.7)
    assert result.families["depth"].difference == pytest.approx((-0.2 + 0.0) / 2)
    assert result.resilience == pytest.approx((0.5 / 0.7 + 1.0) / 2)
    errors = {cell.name.removeprefix("m"): 0.5 for cell in cells}
    # holes: errors of 0.4 and 0.6 against 0.5 and 0.5; scale: 0.3 against 0.5
    assert measures._mce(result, errors) == pytest.approx((1.0 / 1.0 + 0.3 / 0.5) / 2)


def test_what_is_most_similar_to_a_distractor_has_no_class() -> None:
    names = [entry.name for entry in ROOM.classes]
    rules = ROOM.with_names([*names, "violin"])
    features = ENCODER.encode_texts([names[3], "violin"])
    masks = Instances.of(np.zeros((1, 3), np.float32), [[0], [0]], features=features)
    is_present = np.ones(len(names), bool)
    assert classes_of_prediction(rules, masks, ENCODER, is_present).tolist() == [3, -1]
    assert -1 not in classes_of_prediction(ROOM, masks, ENCODER, is_present)
