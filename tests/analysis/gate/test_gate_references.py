"""What teaches the gate, and what is no reference."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from gated_runs import in_metrics, setting, without_calibration

from su3d_bench.analysis.gate.reference import Reference, Value, learn, read_reference
from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.runs.finished import read_run


def test_a_run_without_numbers_teaches_nothing(run: Path, made: Path) -> None:
    in_metrics(lambda m: m["results"][1].update(result=None))(run)
    with pytest.raises(ConfigError, match="collector under rooms-instance: was not scored; learn from runs with num"):
        learn([read_run(made), read_run(run)])


def test_a_run_that_timed_nothing_teaches_no_cost(run: Path, made: Path, reference: Reference) -> None:
    without_calibration(run)
    taught = learn([read_run(made), read_run(run)])
    assert taught.costs == reference.costs != {}
    assert taught.calibration_ms == reference.calibration_ms


def test_runs_that_hold_other_results_teach_nothing(run: Path, made: Path) -> None:
    in_metrics(lambda m: m["results"].pop())(run)
    with pytest.raises(ConfigError, match="the runs hold different methods or protocols"):
        learn([read_run(made), read_run(run)])


def test_runs_of_different_requests_teach_nothing(run: Path, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    setting("seed = 0", "seed = 1")(run)
    assert main(["check", "--learn", str(made), str(run), "--out", str(run / "r.json")]) == 2
    assert "differs from" in capsys.readouterr().err
    assert not (run / "r.json").exists()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"results": []}', "[" * 100_000, '{"hardware": NaN}'])
def test_a_damaged_reference_is_one_line(
    text: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.json").write_text(text)
    assert main(["check", str(run), "--against", str(tmp_path / "bad.json")]) == 2
    error = capsys.readouterr().err
    assert "check --learn" in error and error.count("\n") == 1


def test_a_reference_survives_its_file(reference: Reference, tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(json.dumps(reference.model_dump(mode="json", exclude_defaults=True)))
    assert read_reference(tmp_path / "r.json") == reference


@pytest.mark.parametrize(
    ("key", "value", "is_read"),
    [
        ("n_runs", 1, True), ("n_runs", 0, False), ("across_machines", 0.0, True), ("across_machines", 1.0, True),
        ("across_machines", -0.01, False), ("across_machines", 1.01, False), ("cost_limit", 1.01, True),
        ("cost_limit", 1.0, False), ("cost_limit", 1001.0, False), ("calibration_ms", 0.01, True),
        ("calibration_ms", 0.0, False), ("calibration_ms", None, False), ("results", [], False), ("costs", {}, True),
        ("schema_version", 3, False), ("limit", -1, False), ("data_digests", {}, False),
        ("data_digests", {"painted/a": "x"}, False), ("protocols", {}, False),
    ],
)  # fmt: skip
def test_a_reference_outside_its_limits_is_none(
    key: str, value: object, is_read: bool, reference: Reference, tmp_path: Path
) -> None:
    made = reference.model_dump(mode="json")
    made["results"] = made["results"][:1]
    (tmp_path / "r.json").write_text(json.dumps(made | {key: value}))
    if is_read:
        assert getattr(read_reference(tmp_path / "r.json"), key) == value
    else:
        with pytest.raises(ConfigError, match="is no reference of this version"):
            read_reference(tmp_path / "r.json")


@pytest.mark.parametrize(
    ("value", "is_read"),
    [
        ({"value": 0.5}, True), ({"value": 0.5, "tolerance": -0.1}, False), ({"value": float("nan")}, False),
        ({"value": 0.5, "tolerance": float("inf")}, False),
    ],
)  # fmt: skip
def test_a_value_without_a_tolerance_has_none(value: dict[str, float], is_read: bool) -> None:
    if is_read:
        assert Value.model_validate(value).tolerance == 0.0
    else:
        with pytest.raises(ValueError, match=r"greater than or equal to 0|finite number"):
            Value.model_validate(value)
