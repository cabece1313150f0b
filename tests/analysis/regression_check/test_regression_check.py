"""Regression check: planted regressions are caught, unchanged repeats pass."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from painted_runs import painted_run, see_painted
from reference_runs import (
    counted_otherwise,
    edit,
    in_metrics,
    in_record,
    lowered,
    record,
    results_in,
    slower,
    timed,
    without_calibration,
)

from su3d_bench.analysis.regression_check import HIGHER_IS_BETTER, Reference, Value, check, compared, learn
from su3d_bench.cli.main import main
from su3d_bench.reports.regression_check import Finding, Verdict, github_lines, junit_xml, markdown, plain_lines
from su3d_bench.runs.finished import read_run


@pytest.fixture(scope="module")
def gated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return timed(painted_run(tmp_path_factory.mktemp("gate") / "run"))


@pytest.fixture(scope="module")
def reference(gated: Path) -> Reference:
    return learn([read_run(gated)], cost_limit=1.3)


@pytest.fixture(scope="module")
def reference_file(gated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The reference as written by the command."""
    path = tmp_path_factory.mktemp("gate") / "reference.json"
    assert main(["check", "--build-from", str(gated), "--cost-limit", "1.3", "--out", str(path)]) == 0
    return path


@pytest.fixture
def run(gated: Path, tmp_path: Path) -> Path:
    """A copy that may be damaged."""
    return Path(shutil.copytree(gated, tmp_path / "run"))


def counts_alone(run: Path) -> None:
    """Change the counts, but not the metrics computed from them."""
    text = (run / "metrics.json").read_text()
    counted_otherwise(run)
    (run / "metrics.json").write_text(text)


def other_option(run: Path) -> None:
    text = (run / "run.toml").read_text()
    (run / "run.toml").write_text(text.replace("n_frames = 6", "n_frames = 5", 1))


PLANTED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a point of a class": (lambda run: counted_otherwise(run, 1), "rooms-semantic / F-mIoU: is worse"),
    "a metric edited": (lowered("metrics", "F-mIoU", by=1e-6), "metrics.json does not follow from the counts"),
    "a scene missing in the run": (in_record(lambda r: r["scenes"].remove("painted/b")), "painted/b: the run does not"),
    "another protocol version": (
        in_record(lambda r: r["protocols"][0].update(version=9)),
        "rooms-semantic: protocol version was",
    ),
    "other data": (in_record(lambda r: r["data_digests"].update({"painted/a": "x"})), "painted/a: data digest was"),
    "another option of the dataset": (other_option, "dataset.painted.n_frames was 6, now 5"),
    "an update slower by half": (
        slower(1.5),
        "cost of updates after the first 3: takes 1.50 times as long as the reference; at most 1.3 times",
    ),
    "an untimed update": (without_calibration, "collector / cost: the run did not measure it"),
    "a missing map": (
        lambda run: (run / "scenes/painted.a/collector/prediction.npz").unlink(),
        "collector / scene painted/a: prediction.npz is missing",
    ),
    "other counts": (counts_alone, "metrics.json does not follow from the counts: metrics.mAcc is 1, the counts give"),
    "other weights": (
        in_record(lambda r: r["models"].update(sam={"w.pt": "0" * 64})),
        "run: sam/w.pt was not set, now 000000000000...",
    ),
    "more scenes claimed": (
        in_metrics(lambda m: m["results"][0]["result"].update(n_scenes=9)),
        "it has 9 scenes of version 2, the counts 2",
    ),
    "a partial run": (in_record(lambda r: r.update(is_partial=True)), "run.json: is_partial is True and False"),
    "an additional scene": (
        in_record(lambda r: r["scenes"].append("painted/c")),
        "run / scene painted/c: the reference does not have this scene",
    ),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_regression_is_caught(
    name: str, run: Path, reference_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, printed = PLANTED[name]
    plant(run)
    assert main(["check", str(run), "--against", str(reference_file)]) == 1
    assert printed in capsys.readouterr().out


def test_maps_are_scored_again_on_request(
    run: Path, reference_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    see_painted(monkeypatch)
    words = ["check", str(run), "--against", str(reference_file)]
    assert main([*words, "--recompute"]) == 0
    shutil.copy(run / "scenes/painted.b/collector/prediction.npz", run / "scenes/painted.a/collector/prediction.npz")
    record(run)
    assert main(words) == 0
    assert main([*words, "--recompute"]) == 1
    assert "painted/a by collector: its counts do not match its map" in capsys.readouterr().out


def test_duplicate_protocols_or_results_are_an_error(
    run: Path, reference_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = (run / "run.json").read_text()
    edit(run / "run.json", lambda r: r["protocols"].append(r["protocols"][0] | {"digest": "f" * 64}))
    for printed in ("run.json: names the protocol 'rooms-semantic' twice", "collector / rooms-semantic' twice"):
        assert main(["check", str(run), "--against", str(reference_file)]) == 2
        error = capsys.readouterr().err
        assert printed in error and error.count("\n") == 1
        assert main(["check", "--build-from", str(run), "--out", str(run / "r.json")]) == 2
        capsys.readouterr()
        (run / "run.json").write_text(record)
        edit(run / "metrics.json", lambda m: m["results"].append(m["results"][0]))


def test_unchanged_repeats_pass(run: Path, reference_file: Path) -> None:
    generator = np.random.default_rng(0)
    for _ in range(10):
        # Unchanged repeats only differ in time: usually by 5 %, sometimes by 10 %.
        noise = np.exp(generator.normal(0, 0.05, 8))
        timed(run, (40 * noise[:6]).tolist(), 60 * noise[6], start_ms=10 * noise[7])
        assert main(["check", str(run), "--against", str(reference_file)]) == 0


def test_busy_machine_allows_up_to_twice_the_cost_with_a_remark(
    run: Path, reference_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timed(run, [100.0] * 6, 150.0, calibration_ms=15.0)
    assert main(["check", str(run), "--against", str(reference_file)]) == 0
    assert "the calibration workload took 15 ms, 3.0 times the reference's" in capsys.readouterr().err
    timed(run, [106.0] * 6, 150.0, calibration_ms=15.0)
    assert main(["check", str(run), "--against", str(reference_file)]) == 1


def test_without_a_limit_a_slower_run_passes_with_a_remark(run: Path, reference: Reference) -> None:
    timed(run, [106.0] * 6, 150.0)
    assert not check(read_run(run), reference).is_passed
    verdict = check(read_run(run), reference.model_copy(update={"cost_limit": None}))
    assert verdict.is_passed and any("passes because no --cost-limit is set" in line for line in verdict.remarks)


def test_command_exits_with_1_and_writes_reports_for_pull_requests(
    run: Path, reference_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(run), "--against", str(reference_file)]) == 0
    counted_otherwise(run)
    capsys.readouterr()
    words = ["check", str(run), "--against", str(reference_file), "--github"]
    assert main([*words, "--markdown", str(tmp_path / "c.md"), "--junit", str(tmp_path / "j.xml")]) == 1
    shown = capsys.readouterr().out
    assert shown.startswith("failed: ") and "::error title=su3d-bench::" in shown
    assert "| FAIL | collector / rooms-semantic / mAcc |" in (tmp_path / "c.md").read_text()
    suite = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert int(suite.get("failures", 0)) == len(suite.findall("testcase/failure")) > 2
    assert main([*words, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["passed"] is False


HOSTILE = "<script>|`$(x)`\n::error::\x00" + "é" * 400


def test_hostile_names_are_escaped_in_reports() -> None:
    verdict = Verdict("run", (Finding("changed", HOSTILE, HOSTILE),), 1, (HOSTILE,))
    assert "<script>" not in markdown(verdict).replace("\\<script\\>", "")
    ElementTree.fromstring(junit_xml(verdict))
    lines = "\n".join(github_lines(verdict)).split("\n")
    assert len(lines) == 2 and all(line.startswith("::") and " title=su3d-bench::" in line for line in lines)


def test_missing_scenes_are_listed_first_and_values_over_all_scenes_are_not_compared(
    run: Path, reference: Reference
) -> None:
    (gone,) = list(reference.data_digests)[:1]
    edit(run / "run.json", lambda r: r.update(scenes=[s for s in r["scenes"] if s != gone]))
    edit(run / "run.json", lambda r: r["data_digests"].pop(gone))

    def without(metrics: Any) -> None:
        metrics["scenes"].remove(gone)
        for result in metrics["results"]:
            result["n_planned"] -= 1
            result["result"]["scenes"].remove(gone)
            result["result"]["per_scene"].pop(gone)
            result["result"]["n_scenes"] -= 1
            for row in (result["result"]["metrics"], *result["result"]["per_class"].values()):
                row.update({name: 0.25 for name, value in row.items() if isinstance(value, float)})

    edit(run / "metrics.json", without)
    lines = plain_lines(check(read_run(run), reference))
    assert lines[1] == f"FAIL {gone}: the run does not have this scene"
    assert len(lines) < 12 and not any(" / mAcc:" in line for line in lines), "values over other scenes"


@pytest.mark.parametrize("text", ["", "{}", "[" * 100_000])
def test_damaged_reference_is_a_one_line_error(
    text: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.json").write_text(text)
    assert main(["check", str(run), "--against", str(tmp_path / "bad.json")]) == 2
    error = capsys.readouterr().err
    assert "check --build-from" in error and error.count("\n") == 1


def test_improvements_are_reported_and_pass(run: Path, gated: Path) -> None:
    verdict = check(read_run(gated), learn([read_run(counted_otherwise(run))]))
    assert verdict.is_passed
    assert {one.kind for one in verdict.findings} == {"better"}
    assert f"{len(verdict.findings)} better" in plain_lines(verdict)[0]


def test_tolerance_is_twice_the_spread_of_the_learned_runs(run: Path, gated: Path, tmp_path: Path) -> None:
    first, second = (read_run(path) for path in (gated, counted_otherwise(run, 4)))
    values = [results_in(one).metrics["mAcc"] for one in (first, second)]
    taught = learn([first, second])
    expected = taught.results[0].metrics["mAcc"]
    assert expected.value == pytest.approx(np.mean(values))
    assert expected.tolerance == pytest.approx(2 * (values[0] - values[1]))
    for n_points, is_passed in ((9, True), (11, False)):  # the mean of the two runs is 2, the tolerance 8
        shutil.copytree(gated, tmp_path / str(n_points))
        verdict = check(read_run(counted_otherwise(tmp_path / str(n_points), n_points)), taught)
        assert verdict.is_passed == is_passed, verdict.findings


def findings_of(run: Path, name: str, measured: float, value: Value, across: float | None = None) -> list[Finding]:
    """The findings for this measured headline value, without values of scenes and classes."""
    numbers = replace(results_in(read_run(run)), metrics={name: measured}, per_scene={}, per_class={})
    first = learn([read_run(run)]).results[0]
    expected = first.model_copy(update={"metrics": {name: value}, "scenes": {}, "classes": {}})
    return list(compared("m / p", expected, numbers, across))


@pytest.mark.parametrize("value", [0.25, 0.75])
def test_value_without_a_direction_fails_both_ways(value: float, gated: Path) -> None:
    assert "over-merged" not in HIGHER_IS_BETTER
    found = findings_of(gated, "over-merged", value, Value(value=0.5))
    assert [(one.kind, one.text, one.is_failure) for one in found] == [
        ("regression", "differs from the reference", True)
    ]
    found = findings_of(gated, "mAcc", value, Value(value=0.5))
    assert [one.kind for one in found] == ["better" if value > 0.5 else "regression"]


def test_headline_values_have_a_tolerance_on_another_processor(run: Path, reference: Reference) -> None:
    slower(3.0)(counted_otherwise(run, 4))
    assert not check(read_run(run), reference).is_passed
    edit(run / "run.json", lambda r: r.update(processor="other"))
    verdict = check(read_run(run), reference)
    assert verdict.is_passed, verdict.findings
    assert "the processor has the same name" in verdict.remarks[0] and "within 2 points" in verdict.remarks[0]
    counted_otherwise(run, 40)
    assert not check(read_run(run), reference).is_passed
