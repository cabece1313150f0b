"""The gate: planted regressions are caught, unchanged repeats pass."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gated_runs import (
    counted_otherwise,
    in_metrics,
    in_record,
    lowered,
    sealed,
    setting,
    slower,
    timed,
    with_times,
    without_calibration,
)

from su3d_bench.cli.main import main


def file_of(gated_copy: Path, name: str) -> Path:
    return gated_copy / "scenes/painted.a/collector" / name


def garbage(name: str) -> Callable[[Path], None]:
    """A file that is none, and a seal that says that it is."""

    def change(gated_copy: Path) -> None:
        file_of(gated_copy, name).write_bytes(b"no archive")
        sealed(gated_copy)

    return change


def counts_alone(gated_copy: Path) -> None:
    """Other counts than those from which the metrics were formed."""
    text = (gated_copy / "metrics.json").read_text()
    counted_otherwise(gated_copy)
    (gated_copy / "metrics.json").write_text(text)


def without(name: str) -> Callable[[Path], None]:
    return lambda gated_copy: file_of(gated_copy, name).unlink()


def results_of(metrics: Any) -> Any:
    return metrics["results"][0]["result"]


PLANTED: dict[str, tuple[Callable[[Path], None], str]] = {
    "a metric off by the last bit": (lowered("metrics", "F-mIoU", by=1e-15), "F-mIoU: is worse"),
    "an undefined metric": (in_metrics(lambda m: results_of(m)["metrics"].update(mAcc=None)), "is undefined in one"),
    "a class worse": (lowered("per_class", "chair", "IoU"), "class chair / IoU: is worse"),
    "a scene missing in the run": (in_record(lambda r: r["scenes"].remove("painted/b")), "painted/b: the run does not"),
    "a result missing": (in_metrics(lambda m: m["results"].pop()), "rooms-instance: the run has no score of it"),
    "another protocol version": (
        in_record(lambda r: r["protocols"][0].update(version=9)),
        "rooms-semantic: protocol version was",
    ),
    "another protocol digest": (in_record(lambda r: r["protocols"][0].update(digest="f" * 64)), "protocol digest was"),
    "other data": (in_record(lambda r: r["data_digests"].update({"painted/a": "x"})), "painted/a: data digest was"),
    "another option of the dataset": (setting("n_frames = 6", "n_frames = 5"), "dataset.painted.n_frames was 6, now 5"),
    "an update slower by half": (slower(1.5), "cost of the updates after 3: costs 1.50 times"),
    "an update that nobody timed": (without_calibration, "collector / cost: the run did not measure it"),
    "a map that is gone": (without("prediction.npz"), "collector / scene painted/a: prediction.npz is missing"),
    "a map that is none": (garbage("prediction.npz"), "collector / scene painted/a: holds no map"),
    "other counts": (counts_alone, "metrics.json does not follow from the counts: metrics.mAcc is 1, the counts give"),
    "no seal": (without("done.json"), "done.json does not vouch for prediction.npz"),
    "a scene more": (
        in_record(lambda r: r["scenes"].append("painted/c")),
        "run / scene painted/c: the reference does not have this scene",
    ),
    "a class more": (
        in_metrics(lambda m: results_of(m)["per_class"].update(x=results_of(m)["per_class"]["chair"])),
        "rooms-semantic / class x: the reference does not have this class",
    ),
}


NONE_WHATEVER: dict[str, tuple[Callable[[Path], None], str]] = {
    "a metric beyond 1": (
        in_metrics(lambda m: results_of(m)["metrics"].update(mAcc=1.01)), "'mAcc' is 1.01, a fraction"
    ),
    "a metric that is no number": (
        in_metrics(lambda m: results_of(m)["metrics"].update(mAcc=float("nan"))), "is not as a run writes it"
    ),
    "a protocol named twice": (
        in_record(lambda r: r["protocols"].append(r["protocols"][0] | {"digest": "f" * 64})),
        "run.json: names the protocol 'rooms-semantic' twice",
    ),
    "a result twice": (in_metrics(lambda m: m["results"].append(m["results"][0])), "collector / rooms-semantic' twice"),
    "a time below 0": (with_times([-1.0] * 6), "updates.csv: holds -1 and"),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_regression_is_caught(
    name: str, gated_copy: Path, gate_reference_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, said = PLANTED[name]
    plant(gated_copy)
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 1
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("name", NONE_WHATEVER)
def test_what_no_run_can_have_written_is_refused(
    name: str, gated_copy: Path, gate_reference_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, said = NONE_WHATEVER[name]
    plant(gated_copy)
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert main(["check", "--learn", str(gated_copy), "--out", str(gated_copy / "r.json")]) == 2


def test_unchanged_repeats_pass(gated_copy: Path, gate_reference_file: Path) -> None:
    generator = np.random.default_rng(0)
    for _ in range(10):
        # Time is the one thing that unchanged repeats differ in: by a twentieth, now and then by a tenth.
        noise = np.exp(generator.normal(0, 0.05, 8))
        timed(gated_copy, (40 * noise[:6]).tolist(), 60 * noise[6], start_ms=10 * noise[7])
        assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 0


@pytest.mark.parametrize("factor", [2.0, 1e9])
def test_a_slowed_calibration_hides_no_tenfold_cost(
    factor: float, gated_copy: Path, gate_reference_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timed(gated_copy, [400.0] * 6, calibration_ms=5.0 * factor)
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 1
    shown = capsys.readouterr()
    assert "cost of the updates after 3: costs 5.00 times the reference" in shown.out
    assert "others used the processor, or what is checked slows it" in shown.err


def test_a_busy_machine_excuses_a_cost_up_to_twice_and_it_is_said(
    gated_copy: Path, gate_reference_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timed(gated_copy, [100.0] * 6, 150.0, calibration_ms=15.0)
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 0
    assert "the calibrating work took 15 ms, 3.0 times the reference's" in capsys.readouterr().err
    timed(gated_copy, [106.0] * 6, 150.0, calibration_ms=15.0)
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 1
