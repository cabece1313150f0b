"""What teaches the gate, and what is no reference."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from gated_runs import in_metrics, setting, without_calibration

from su3d_bench.analysis.gate.reference import Reference, learn, read_reference
from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.runs.finished import read_run


def test_a_run_without_numbers_teaches_nothing(gated_copy: Path, gated: Path) -> None:
    in_metrics(lambda m: m["results"][1].update(result=None))(gated_copy)
    with pytest.raises(ConfigError, match="collector under rooms-instance: was not scored; learn from runs with num"):
        learn([read_run(gated), read_run(gated_copy)])


def test_a_run_that_timed_nothing_teaches_no_cost(gated_copy: Path, gated: Path, gate_reference: Reference) -> None:
    without_calibration(gated_copy)
    taught = learn([read_run(gated), read_run(gated_copy)])
    assert taught.costs == gate_reference.costs != {}
    assert taught.calibration_ms == gate_reference.calibration_ms


def test_runs_of_different_requests_teach_nothing(
    gated_copy: Path, gated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    setting("seed = 0", "seed = 1")(gated_copy)
    assert main(["check", "--learn", str(gated), str(gated_copy), "--out", str(gated_copy / "r.json")]) == 2
    assert "differs from" in capsys.readouterr().err
    assert not (gated_copy / "r.json").exists()


@pytest.mark.parametrize("text", ["", "{}", "[" * 100_000])
def test_a_damaged_reference_is_one_line(
    text: str, gated_copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.json").write_text(text)
    assert main(["check", str(gated_copy), "--against", str(tmp_path / "bad.json")]) == 2
    error = capsys.readouterr().err
    assert "check --learn" in error and error.count("\n") == 1


def test_a_reference_survives_its_file(gate_reference: Reference, tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(
        json.dumps(
            gate_reference.model_dump(
                mode="json",
            )
        )
    )
    assert read_reference(tmp_path / "r.json") == gate_reference


@pytest.mark.parametrize(
    ("key", "value", "is_read"),
    [
        ("n_runs", 0, False), ("across_machines", 1.0, True), ("across_machines", 1.01, False),
        ("cost_limit", 1.0, False), ("results", [], False), ("schema_version", 3, False),
    ],
)  # fmt: skip
def test_a_reference_outside_its_limits_is_none(
    key: str, value: object, is_read: bool, gate_reference: Reference, tmp_path: Path
) -> None:
    gated = gate_reference.model_dump(mode="json")
    gated["results"] = gated["results"][:1]
    (tmp_path / "r.json").write_text(json.dumps(gated | {key: value}))
    if is_read:
        assert getattr(read_reference(tmp_path / "r.json"), key) == value
    else:
        with pytest.raises(ConfigError, match="is no reference of this version"):
            read_reference(tmp_path / "r.json")
