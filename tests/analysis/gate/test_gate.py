"""The gate: planted regressions are caught, fifty unchanged repeats pass."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gated_runs import (
    WORDS,
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
from painted import colour_perception

from su3d_bench.analysis.gate.check import check
from su3d_bench.analysis.gate.reference import learn
from su3d_bench.cli.main import main
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.finished import read_run


def file_of(gated_copy: Path, name: str) -> Path:
    return gated_copy / "scenes/painted.a/collector" / name


def cut(name: str) -> Callable[[Path], None]:
    """What a disk that was full leaves of a file."""

    def change(gated_copy: Path) -> None:
        file_of(gated_copy, name).write_bytes(file_of(gated_copy, name).read_bytes()[:-20])

    return change


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
    "a metric off by 0.1 point": (lowered("metrics", "mAcc"), "collector / rooms-semantic / mAcc: is worse"),
    "a metric off by the last bit": (lowered("metrics", "F-mIoU", by=1e-15), "F-mIoU: is worse"),
    "an undefined metric": (in_metrics(lambda m: results_of(m)["metrics"].update(mAcc=None)), "is undefined in one"),
    "a scene worse": (lowered("per_scene", "painted/a", "mAcc"), "scene painted/a / mAcc: is worse"),
    "a class worse": (lowered("per_class", "chair", "IoU"), "class chair / IoU: is worse"),
    "a class missing": (in_metrics(lambda m: results_of(m)["per_class"].pop("sofa")), "class sofa: the run does not"),
    "a scene missing in a result": (
        in_metrics(lambda m: results_of(m)["per_scene"].pop("painted/b")),
        "scene painted/b: the run does not have this scene",
    ),
    "a scene missing in the run": (in_record(lambda r: r["scenes"].remove("painted/b")), "painted/b: the run does not"),
    "a result missing": (in_metrics(lambda m: m["results"].pop()), "rooms-instance: the run has no score of it"),
    "a result without numbers": (in_metrics(lambda m: m["results"][1].update(result=None)), "has no score of it"),
    "a protocol missing": (in_record(lambda r: r["protocols"].pop()), "rooms-instance: the run does not have this"),
    "another protocol version": (
        in_record(lambda r: r["protocols"][0].update(version=9)),
        "rooms-semantic: protocol version was",
    ),
    "another protocol digest": (in_record(lambda r: r["protocols"][0].update(digest="f" * 64)), "protocol digest was"),
    "other data": (in_record(lambda r: r["data_digests"].update({"painted/a": "x"})), "painted/a: data digest was"),
    "another encoder": (in_metrics(lambda m: m["results"][0].update(encoder_digest="x")), "encoder digest was"),
    "another profile": (in_metrics(lambda m: m["results"][0].update(profile="oracle")), "profile was"),
    "another seed": (setting("seed = 0", "seed = 1"), "settings: seed was 0, now 1"),
    "another option of the dataset": (setting("n_frames = 6", "n_frames = 5"), "dataset.painted.n_frames was 6, now 5"),
    "an incomplete run": (in_record(lambda r: r.update(status="incomplete")), "run: is incomplete"),
    "a partial run": (in_metrics(lambda m: m.update(limit=3)), "run: limit was 0, now 3"),
    "an update slower by half": (slower(1.5), "cost of the updates after 3: costs 1.50 times"),
    "an update that nobody timed": (without_calibration, "collector / cost: the run did not measure it"),
    "a map that is gone": (without("prediction.npz"), "collector / scene painted/a: prediction.npz is missing"),
    "a map cut off": (cut("prediction.npz"), "prediction.npz is not the file that the run wrote"),
    "a map that is none": (garbage("prediction.npz"), "collector / scene painted/a: holds no map"),
    "counts that are gone": (without("counts.npz"), "counts.npz is missing"),
    "counts cut off": (cut("counts.npz"), "counts.npz is not the file that the run wrote"),
    "counts that are none": (garbage("counts.npz"), "collector: painted/a: collector: counts: are damaged"),
    "other counts": (counts_alone, "metrics.json does not follow from the counts: metrics.mAcc is 1, the counts give"),
    "no seal": (without("done.json"), "done.json does not vouch for prediction.npz"),
    "a scene more": (
        in_record(lambda r: r["scenes"].append("painted/c")),
        "run / scene painted/c: the reference does not have this scene",
    ),
    "a scene more in a result": (
        in_metrics(lambda m: results_of(m)["per_scene"].update(x=results_of(m)["per_scene"]["painted/a"])),
        "rooms-semantic / scene x: the reference does not have this scene",
    ),
    "a class more": (
        in_metrics(lambda m: results_of(m)["per_class"].update(x=results_of(m)["per_class"]["chair"])),
        "rooms-semantic / class x: the reference does not have this class",
    ),
}


NONE_WHATEVER: dict[str, tuple[Callable[[Path], None], str]] = {
    f"a metric of {value}": (
        in_metrics(lambda m, value=value: results_of(m)["metrics"].update(mAcc=value)),  # type: ignore[misc]
        f"metrics.json is not as a run writes it: results.0.result.metrics: 'mAcc' is {value:g}, a fraction lies",
    )
    for value in (7e300, -0.25, 1.01, 100.0)
} | {
    "a negative number of classes": (
        in_metrics(lambda m: results_of(m)["metrics"].update(n_classes=-1)), "'n_classes' is -1"
    ),
    "a class beyond 1": (
        in_metrics(lambda m: results_of(m)["per_class"]["chair"].update(IoU=2.0)), "'IoU' is 2, a fraction"
    ),
    "a protocol named twice": (
        in_record(lambda r: r["protocols"].append(r["protocols"][0] | {"digest": "f" * 64})),
        "run.json: names the protocol 'rooms-semantic' twice",
    ),
    "a scene named twice": (in_record(lambda r: r["scenes"].append("painted/a")), "names the scene 'painted/a' twice"),
    "a method named twice": (in_record(lambda r: r["methods"].append("collector")), "the method 'collector' twice"),
    "a result twice": (in_metrics(lambda m: m["results"].append(m["results"][0])), "collector / rooms-semantic' twice"),
    "a time below 0": (with_times([-1.0] * 6), "updates.csv: holds -1 and"),
    "an endless time": (with_times([7e300] * 6), "times and sizes lie from 0 to 1e+18"),
    "a finish below 0": (with_times(finish_ms=-1.0), "the costs in done.json are not as"),
    "no time at all for the calibrating work": (
        with_times(calibration_ms=-1.0), "the costs in done.json are not as a run"
    ),
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


def test_a_value_that_is_no_number_never_passes(
    gated_copy: Path, gate_reference_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    in_metrics(lambda m: results_of(m)["metrics"].update(mAcc=float("nan")))(gated_copy)
    assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 2
    assert "metrics.json is not as a run writes it" in capsys.readouterr().err


def test_fifty_unchanged_repeats_pass(gated_copy: Path, gate_reference_file: Path) -> None:
    generator = np.random.default_rng(0)
    for _ in range(50):
        # Time is the one thing that unchanged repeats differ in: by a twentieth, now and then by a tenth.
        noise = np.exp(generator.normal(0, 0.05, 8))
        timed(gated_copy, (40 * noise[:6]).tolist(), 60 * noise[6], start_ms=10 * noise[7])
        assert main(["check", str(gated_copy), "--against", str(gate_reference_file)]) == 0


def test_real_repeats_with_real_times_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    for name in "ab":
        assert main([*WORDS, "--out", str(tmp_path / name)]) == 0
    taught = learn([read_run(tmp_path / "a")], cost_limit=50.0)  # this method's updates take microseconds
    assert check(read_run(tmp_path / "b"), taught).is_passed


@pytest.mark.parametrize("factor", [2.0, 10.0, 1e9])
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
