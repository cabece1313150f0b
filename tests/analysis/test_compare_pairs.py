"""Comparisons are paired over scenes: differences between scenes do not widen the interval."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from painted_runs import COLLECTOR, painted_run

from su3d_bench.analysis.comparison import Comparison, compare
from su3d_bench.analysis.sides import Side, SideNumbers
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.semantic.confusion import SemanticCounts
from su3d_bench.numerics.statistics import MAX_EXACT_PAIRS, SignFlipTest, sign_flip_test

RULES = load_protocol("rooms-semantic")
CLASS = next(index for index, entry in enumerate(RULES.classes) if not RULES.is_ignored(entry.name))
LEFT = {"painted/a": 100, "painted/b": 500, "painted/c": 900}  # correct points out of 1000
GAIN = {"painted/a": 50, "painted/b": 60, "painted/c": 70}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three scenes and two methods; its numbers are not used."""
    methods = (COLLECTOR, f"{COLLECTOR}@drop=2")
    return painted_run(tmp_path_factory.mktemp("pairs") / "run", "--quiet", methods=methods, scenes="abc")


class MadeNumbers(SideNumbers):
    """Both sides with synthetic counts instead of those of their runs."""

    def __init__(self, left: Mapping[str, SceneScore], right: Mapping[str, SceneScore]) -> None:
        super().__init__()
        self._made = {"collector": left, "collector@drop=2": right}

    def scores(self, side: Side) -> dict[str, dict[str, SceneScore]]:
        return {RULES.name: dict(self._made[side.method])}


def scored(n_right: Mapping[str, int]) -> dict[str, SceneScore]:
    """One class with 1000 points per scene, ``n_right`` of which are correct."""
    found = {}
    for scene, n in n_right.items():
        table = np.zeros((len(RULES.classes), len(RULES.classes) + 1), np.int64)
        table[CLASS, [CLASS, -1]] = n, 1000 - n
        counts = SemanticCounts(table, table.sum(axis=1) > 0)
        found[scene] = SceneScore(RULES.name, RULES.version, counts, 1, 1000, np.zeros(3, np.int64), ())
    return found


def compared(folder: Path, left: Mapping[str, SceneScore], right: Mapping[str, SceneScore]) -> Comparison:
    numbers = MadeNumbers(left, right)
    sides = (f"{folder}:collector", f"{folder}:collector@drop=2")
    return compare(*sides, protocols=[RULES.name], numbers=numbers, per_class=True)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_interval_of_a_difference_uses_paired_scenes(folder: Path, order: tuple[int, ...]) -> None:
    names = list(LEFT)
    right = scored({names[k]: LEFT[names[k]] + GAIN[names[k]] for k in order})
    found = compared(folder, scored(LEFT), right).protocols[0].metrics["mAcc"]
    assert found.difference == pytest.approx(0.06)
    assert found.per_scene == pytest.approx({scene: gain / 1000 for scene, gain in GAIN.items()})
    # scenes differ by up to 80 points, their differences by two: an unpaired interval would be ten times as wide
    assert found.interval is not None
    low, high = found.interval
    assert low < 0.06 < high
    assert high - low < 0.06


def test_differences_between_scenes_do_not_widen_the_interval(folder: Path) -> None:
    alike = {scene: 400 + gain for scene, gain in GAIN.items()}
    narrow = compared(folder, scored(dict.fromkeys(LEFT, 400)), scored(alike)).protocols[0].metrics["mAcc"]
    wide = compared(folder, scored(LEFT), scored({s: LEFT[s] + GAIN[s] for s in LEFT})).protocols[0].metrics["mAcc"]
    assert narrow.interval == pytest.approx(wide.interval)
    swapped = compared(folder, scored({s: LEFT[s] + GAIN[s] for s in LEFT}), scored(LEFT)).protocols[0].metrics["mAcc"]
    assert swapped.interval is not None
    assert wide.interval == pytest.approx((-swapped.interval[1], -swapped.interval[0]))


def test_metric_counts_in_the_correction_if_any_scene_differs(folder: Path) -> None:
    two_differ = scored(LEFT | {"painted/a": 150, "painted/c": 970})
    found = compared(folder, scored(LEFT), two_differ).protocols[0].metrics
    # two scenes differ: half of their four sign patterns are as far from 0, and there are two metrics
    assert {value.test.p for value in found.values() if value.test is not None} == {0.5}
    assert {value.p_of_all for value in found.values()} == {1.0}
    alike = compared(folder, scored(LEFT), scored(LEFT)).protocols[0].metrics
    assert {value.p_of_all for value in alike.values()} == {None}


def by_enumeration(differences: list[float]) -> float:
    """The fraction of all sign patterns whose sum is at least as far from 0, by enumeration."""
    observed = abs(sum(differences))
    patterns = itertools.product((-1, 1), repeat=len(differences))
    sums = [abs(sum(s * d for s, d in zip(signs, differences, strict=True))) for signs in patterns]
    return sum(total >= observed - 1e-12 for total in sums) / len(sums)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(-8, 8), min_size=1, max_size=11))
def test_sign_flip_test_counts_every_pattern(values: list[int]) -> None:
    differences = [value / 16 for value in values]  # exact in binary, with many ties
    found = sign_flip_test(np.array(differences))
    assert found == SignFlipTest(by_enumeration(differences), 2.0 ** (1 - len(values)), len(values), True)


def test_rounding_does_not_separate_equal_sums() -> None:
    found = sign_flip_test(np.array([0.1, 0.2, 0.3, -0.3]))  # 0.1 + 0.2 is not 0.3 in binary
    assert found is not None
    assert found.p == by_enumeration([0.1, 0.2, 0.3, -0.3]) == 0.75


def test_sign_flip_test_is_exact_up_to_a_limit_and_sampled_beyond() -> None:
    same_sign = sign_flip_test(np.ones(MAX_EXACT_PAIRS))
    assert same_sign == SignFlipTest(2.0 ** (1 - MAX_EXACT_PAIRS), 2.0 ** (1 - MAX_EXACT_PAIRS), MAX_EXACT_PAIRS, True)
    rng = np.random.default_rng(0)
    differences = rng.normal(0.1, 1, MAX_EXACT_PAIRS + 20)
    drawn = sign_flip_test(differences)
    assert drawn is not None
    assert not drawn.is_exact
    assert drawn == sign_flip_test(differences)
    # the sum is nearly normal: the tail probability agrees within a few standard errors of 100,000 draws
    from math import erfc, sqrt

    expected = erfc(abs(differences.sum()) / sqrt(2 * (differences**2).sum()))
    assert abs(drawn.p - expected) < 0.02
