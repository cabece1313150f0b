"""By how much a value may differ, and in which direction."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gated_runs import counted_otherwise, edit, results_in, setting, slower

from su3d_bench.analysis.gate.check import HIGHER_IS_BETTER, check, compared
from su3d_bench.analysis.gate.reference import Reference, Value, learn
from su3d_bench.reports.gate import Finding, plain_lines
from su3d_bench.runs.finished import read_run


def test_what_is_better_is_said_and_passes(gated_copy: Path, gated: Path) -> None:
    verdict = check(read_run(gated), learn([read_run(counted_otherwise(gated_copy))]))
    assert verdict.is_passed
    assert {one.kind for one in verdict.findings} == {"better"}
    assert f"{len(verdict.findings)} better" in plain_lines(verdict)[0]


def test_the_tolerance_is_twice_the_spread_of_the_taught_runs(gated_copy: Path, gated: Path, tmp_path: Path) -> None:
    first, second = (read_run(path) for path in (gated, counted_otherwise(gated_copy, 4)))
    values = [results_in(one).metrics["mAcc"] for one in (first, second)]
    taught = learn([first, second])
    gate_reference_file = taught.results[0].metrics["mAcc"]
    assert gate_reference_file.value == pytest.approx(np.mean(values))
    assert gate_reference_file.tolerance == pytest.approx(2 * (values[0] - values[1]))
    for n_points, is_passed in ((9, True), (11, False)):  # 2 less than the mean of the two, and 8 more at most
        shutil.copytree(gated, tmp_path / str(n_points))
        verdict = check(read_run(counted_otherwise(tmp_path / str(n_points), n_points)), taught)
        assert verdict.is_passed == is_passed, verdict.findings


def findings_of(
    gated_copy: Path, name: str, measured: float, value: Value, across: float | None = None
) -> list[Finding]:
    """What is said where a run measured this of a headline value of which no scene and class is known."""
    numbers = replace(results_in(read_run(gated_copy)), metrics={name: measured}, per_scene={}, per_class={})
    first = learn([read_run(gated_copy)]).results[0]
    expected = first.model_copy(update={"metrics": {name: value}, "scenes": {}, "classes": {}})
    return list(compared("m / p", expected, numbers, across))


def test_a_value_that_differs_by_just_the_tolerance_passes_and_by_a_bit_more_fails(gated: Path) -> None:
    taught = Value(value=0.75, tolerance=0.25)
    for value, n_findings in ((0.5, 0), (1.0, 0), (np.nextafter(0.5, 0), 1)):
        assert len(findings_of(gated, "mAcc", float(value), taught)) == n_findings


@pytest.mark.parametrize("value", [0.25, 0.75])
def test_a_value_without_a_better_direction_may_move_in_neither(value: float, gated: Path) -> None:
    assert "over-merged" not in HIGHER_IS_BETTER
    found = findings_of(gated, "over-merged", value, Value(value=0.5))
    assert [(one.kind, one.text, one.is_failure) for one in found] == [
        ("regression", "differs from the reference", True)
    ]
    found = findings_of(gated, "mAcc", value, Value(value=0.5))
    assert [one.kind for one in found] == ["better" if value > 0.5 else "regression"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("jobs = 1", "jobs = 2"), ("cache = true", "cache = false"), ("/b", "/[b]"), (":Collector", ":Collectors"),
        ('"rooms-semantic", ', ""),
    ],
)  # fmt: skip
def test_how_a_run_was_asked_for_and_what_moves_no_number_may_differ(
    old: str, new: str, gated_copy: Path, gate_reference: Reference
) -> None:
    setting(old, new)(gated_copy)
    assert check(read_run(gated_copy), gate_reference).findings == ()
    assert learn([read_run(gated_copy)]).settings == gate_reference.settings


def test_on_another_processor_headline_values_have_a_stated_tolerance(
    gated_copy: Path, gate_reference: Reference
) -> None:
    slower(3.0)(counted_otherwise(gated_copy, 4))
    assert not check(read_run(gated_copy), gate_reference).is_passed
    edit(gated_copy / "run.json", lambda r: r.update(processor="other"))
    verdict = check(read_run(gated_copy), gate_reference)
    assert verdict.is_passed, verdict.findings
    assert "another processor" in verdict.remarks[0] and "within 2 points" in verdict.remarks[0]
    counted_otherwise(gated_copy, 40)
    assert not check(read_run(gated_copy), gate_reference).is_passed
