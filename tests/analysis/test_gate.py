"""The gate: twenty planted regressions are caught, fifty unchanged repeats pass."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.analysis.gate import HIGHER_IS_BETTER, Reference, Value, check, learn, read_reference
from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols import load_protocol
from su3d_bench.reports.gate import Finding, Verdict, github_lines, junit_xml, markdown, plain_lines
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.finished import read_run

PAINTED = f"{SCENES}/painted.py"
WORDS = ["run", "--scenes", f"{PAINTED}:Painted/a", f"{PAINTED}:Painted/b", "--methods", f"{PAINTED}:Collector"]
WORDS += ["--protocols", "rooms-semantic", "rooms-instance", "--no-pictures", "--jobs", "1"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gate") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        assert main([*WORDS, "--out", str(folder)]) == 0
    for updates in folder.rglob("updates.csv"):
        _steady(updates)
    return folder


def _steady(updates: Path) -> None:
    """Put times of 4 ms in place of the measured ones, so that the tests do not depend on the machine's mood."""
    rows = list(csv.reader(updates.open()))
    if len(rows) < 2:
        return
    header = rows[0]
    with updates.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*header[:-1], "match_ms", "total_ms"])
        writer.writerows([*row[:-1], "4.0", "9.0"] for row in rows[1:])


@pytest.fixture(scope="module")
def reference(made: Path) -> Reference:
    return learn([read_run(made)])


@pytest.fixture(scope="module")
def learnt(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The reference as the command writes it."""
    path = tmp_path_factory.mktemp("gate") / "reference.json"
    assert main(["check", "--learn", str(made), "--out", str(path)]) == 0
    return path


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "run")
    return tmp_path / "run"


def edit(path: Path, change: Callable[[Any], None]) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def in_metrics(change: Callable[[Any], None]) -> Callable[[Path], None]:
    return lambda run: edit(run / "metrics.json", change)


def in_record(change: Callable[[Any], None]) -> Callable[[Path], None]:
    return lambda run: edit(run / "run.json", change)


def lowered(table: str, *keys: str, by: float = 0.001) -> Callable[[Path], None]:
    def change(metrics: Any) -> None:
        row = metrics["results"][0]["result"][table]
        for key in keys[:-1]:
            row = row[key]
        row[keys[-1]] -= by

    return in_metrics(change)


def slower(factor: float) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        for updates in run.rglob("updates.csv"):
            updates.write_text(updates.read_text().replace("4.0,9.0", f"{4 * factor},{5 + 4 * factor}"))

    return change


def setting(old: str, new: str) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        text = (run / "run.toml").read_text()
        assert old in text
        (run / "run.toml").write_text(text.replace(old, new, 1))

    return change


def without_calibration(run: Path) -> None:
    for done in run.rglob("collector/done.json"):
        edit(done, lambda value: value["steps"]["predict"]["remarks"]["costs"].update(calibration_ms=None))


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
    "an update slower by half": (slower(1.5), "cost of an update: costs 1.4"),
    "an update that nobody timed": (without_calibration, "cost of an update: the run did not measure it"),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_regression_is_caught(name: str, run: Path, learnt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant, said = PLANTED[name]
    plant(run)
    assert main(["check", str(run), "--against", str(learnt)]) == 1
    assert said in capsys.readouterr().out


def test_a_value_that_is_no_number_never_passes(run: Path, learnt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    in_metrics(lambda m: results_of(m)["metrics"].update(mAcc=float("nan")))(run)
    assert main(["check", str(run), "--against", str(learnt)]) == 2
    assert "metrics.json is not as a run writes it" in capsys.readouterr().err


def test_fifty_unchanged_repeats_pass(run: Path, learnt: Path) -> None:
    generator = np.random.default_rng(0)
    originals = {path: path.read_text() for path in run.rglob("updates.csv")}
    for _ in range(50):
        # Time is the one thing that unchanged repeats differ in: by a twentieth, now and then by a tenth.
        factor = float(np.exp(generator.normal(0, 0.05)))
        for path, text in originals.items():
            path.write_text(text.replace("4.0,9.0", f"{4 * factor},{5 + 4 * factor}"))
        assert main(["check", str(run), "--against", str(learnt)]) == 0


def test_real_repeats_with_real_times_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    for name in "ab":
        assert main([*WORDS, "--out", str(tmp_path / name)]) == 0
    taught = learn([read_run(tmp_path / "a")], cost_limit=50.0)  # this method's updates take microseconds
    assert check(read_run(tmp_path / "b"), taught).is_passed


def test_what_is_better_is_said_and_passes(run: Path, reference: Reference) -> None:
    edit(run / "metrics.json", lambda m: results_of(m)["metrics"].update(mAcc=results_of(m)["metrics"]["mAcc"] + 0.01))
    verdict = check(read_run(run), reference)
    assert verdict.is_passed
    assert [one.kind for one in verdict.findings] == ["better"]
    assert "1 better" in plain_lines(verdict)[0]


def test_the_tolerance_is_twice_the_spread_of_the_taught_runs(run: Path, made: Path, tmp_path: Path) -> None:
    value = json.loads((made / "metrics.json").read_text())["results"][0]["result"]["metrics"]["mAcc"]
    lowered("metrics", "mAcc", by=0.004)(run)
    taught = learn([read_run(made), read_run(run)])
    learnt = taught.results[0].metrics["mAcc"]
    assert learnt.value == pytest.approx(value - 0.002)
    assert learnt.tolerance == pytest.approx(0.008)
    assert taught.results[0].metrics["F-mIoU"].tolerance == 0
    shutil.copytree(made, tmp_path / "third")
    lowered("metrics", "mAcc", by=0.0099)(tmp_path / "third")
    assert check(read_run(tmp_path / "third"), taught).is_passed
    lowered("metrics", "mAcc", by=0.0002)(tmp_path / "third")
    assert not check(read_run(tmp_path / "third"), taught).is_passed


def one_metric(reference: Reference, name: str, value: Value, across_machines: float = 0.0) -> Reference:
    """A reference that knows a single headline value of the first result, and no scenes, classes and costs."""
    first, *others = reference.results
    first = first.model_copy(update={"metrics": {name: value}, "scenes": {}, "classes": {}})
    update = {"results": (first, *others), "costs": {}, "across_machines": across_machines}
    return reference.model_copy(update=update)


def measured(run: Path, name: str, value: float) -> Path:
    edit(run / "metrics.json", lambda m: results_of(m)["metrics"].update({name: value}))
    return run


def test_a_value_that_differs_by_just_the_tolerance_passes_and_by_a_bit_more_fails(
    run: Path, reference: Reference
) -> None:
    taught = one_metric(reference, "mAcc", Value(value=0.75, tolerance=0.25))
    for value, is_passed in ((0.5, True), (1.0, True), (np.nextafter(0.5, 0), False)):
        verdict = check(read_run(measured(run, "mAcc", float(value))), taught)
        assert verdict.is_passed == is_passed
        assert len(verdict.findings) == (not is_passed)


@pytest.mark.parametrize(("own", "across"), [(0.25, 0.125), (0.125, 0.25)])
def test_on_another_processor_the_larger_of_the_two_tolerances_counts(
    own: float, across: float, run: Path, reference: Reference
) -> None:
    edit(run / "run.json", lambda r: r.update(processor="other"))
    taught = one_metric(reference, "mAcc", Value(value=0.75, tolerance=own), across)
    assert check(read_run(measured(run, "mAcc", 0.5)), taught).is_passed
    assert not check(read_run(measured(run, "mAcc", 0.4375)), taught).is_passed


def test_on_the_same_processor_the_tolerance_of_other_machines_does_not_count(run: Path, reference: Reference) -> None:
    taught = one_metric(reference, "mAcc", Value(value=0.75, tolerance=0.125), 0.25)
    assert not check(read_run(measured(run, "mAcc", 0.5)), taught).is_passed


@pytest.mark.parametrize("value", [0.25, 0.75])
def test_a_value_without_a_better_direction_may_move_in_neither(value: float, run: Path, reference: Reference) -> None:
    assert "over-merged" not in HIGHER_IS_BETTER
    taught = one_metric(reference, "over-merged", Value(value=0.5))
    verdict = check(read_run(measured(run, "over-merged", value)), taught)
    assert [(one.kind, one.text) for one in verdict.findings] == [("regression", "differs from the reference")]
    assert not verdict.is_passed
    taught = one_metric(reference, "mAcc", Value(value=0.5))
    verdict = check(read_run(measured(run, "mAcc", value)), taught)
    assert [one.kind for one in verdict.findings] == ["better" if value > 0.5 else "regression"]


@pytest.mark.parametrize("protocol", ["rooms-retrieval", "rooms-reasoning", "rooms-annotation", "rooms-instance"])
def test_a_headline_value_that_rises_passes_unless_it_is_a_share_of_what_is_wrong(
    protocol: str, run: Path, reference: Reference
) -> None:
    for name in load_protocol(protocol).headline:
        verdict = check(read_run(measured(run, name, 0.75)), one_metric(reference, name, Value(value=0.5)))
        assert verdict.is_passed == (name not in {"under-merged", "over-merged"}), name


def busier(costs: Any, factor: float) -> None:
    if costs["calibration_ms"] is not None:
        costs["calibration_ms"] *= factor


def test_on_a_busy_machine_costs_are_not_judged_and_it_says_so(
    run: Path, learnt: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    slower(3.0)(run)
    assert main(["check", str(run), "--against", str(learnt)]) == 1
    for done in run.rglob("collector/done.json"):
        edit(done, lambda value: busier(value["steps"]["predict"]["remarks"]["costs"], 2.0))
    capsys.readouterr()
    assert main(["check", str(run), "--against", str(learnt)]) == 0
    assert "the machine was busy: the calibrating work took" in capsys.readouterr().err
    lowered("metrics", "mAcc")(run)
    assert main(["check", str(run), "--against", str(learnt)]) == 1


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("jobs = 1", "jobs = 2"), ("cache = true", "cache = false"), ("/b", "/[b]"), (":Collector", ":Collectors"),
        ('"rooms-semantic", ', ""),
    ],
)  # fmt: skip
def test_how_a_run_was_asked_for_and_what_moves_no_number_may_differ(
    old: str, new: str, run: Path, reference: Reference
) -> None:
    setting(old, new)(run)
    assert check(read_run(run), reference).findings == ()
    assert learn([read_run(run)]).settings == reference.settings


def test_on_another_processor_headline_values_have_a_stated_tolerance(run: Path, reference: Reference) -> None:
    edit(run / "run.json", lambda r: r.update(processor="other"))
    lowered("metrics", "mAcc", by=0.019)(run)
    lowered("per_class", "chair", "IoU", by=0.2)(run)
    slower(3.0)(run)
    verdict = check(read_run(run), reference)
    assert verdict.is_passed
    assert "another processor" in verdict.remarks[0] and "within 2 points" in verdict.remarks[0]
    lowered("metrics", "mAcc", by=0.002)(run)
    assert not check(read_run(run), reference).is_passed


def test_a_run_without_numbers_teaches_nothing(run: Path, made: Path) -> None:
    in_metrics(lambda m: m["results"][1].update(result=None))(run)
    with pytest.raises(ConfigError, match="collector under rooms-instance: was not scored; learn from runs with num"):
        learn([read_run(made), read_run(run)])


def test_a_run_that_timed_nothing_teaches_no_cost(run: Path, made: Path, reference: Reference) -> None:
    without_calibration(run)
    taught = learn([read_run(made), read_run(run)])
    assert taught.costs == reference.costs != {}
    assert taught.calibration_ms == reference.calibration_ms


def test_the_headline_values_that_were_compared_are_counted(run: Path, reference: Reference) -> None:
    n = sum(len(load_protocol(name).headline) for name in ("rooms-semantic", "rooms-instance"))
    assert check(read_run(run), reference).n_compared == n


def test_runs_that_hold_other_results_teach_nothing(run: Path, made: Path) -> None:
    in_metrics(lambda m: m["results"].pop())(run)
    with pytest.raises(ConfigError, match="the runs hold different methods or protocols"):
        learn([read_run(made), read_run(run)])


@pytest.mark.parametrize(("long", "shown"), [("x" * 40, "x" * 40), ("x" * 41, "x" * 12 + "...")])
def test_what_has_more_than_forty_characters_is_shown_by_its_first(
    long: str, shown: str, run: Path, reference: Reference
) -> None:
    in_metrics(lambda m: m["results"][0].update(profile=long))(run)
    (finding,) = check(read_run(run), reference).findings
    assert finding.text.endswith(f", now {shown}")


def test_runs_of_different_requests_teach_nothing(run: Path, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    setting("seed = 0", "seed = 1")(run)
    assert main(["check", "--learn", str(made), str(run), "--out", str(run / "r.json")]) == 2
    assert "differs from" in capsys.readouterr().err
    assert not (run / "r.json").exists()


def test_the_command_fails_with_one_and_writes_what_a_pull_request_needs(
    run: Path, learnt: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(run), "--against", str(learnt)]) == 0
    lowered("metrics", "mAcc")(run)
    capsys.readouterr()
    words = ["check", str(run), "--against", str(learnt), "--github"]
    assert main([*words, "--markdown", str(tmp_path / "c.md"), "--junit", str(tmp_path / "j.xml")]) == 1
    shown = capsys.readouterr().out
    assert shown.startswith("failed: 1 difference from") and "::error title=su3d-bench::" in shown
    assert "| FAIL | collector / rooms-semantic / mAcc |" in (tmp_path / "c.md").read_text()
    suite = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert suite.get("failures") == "1" and len(suite.findall("testcase/failure")) == 1
    assert main([*words, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["passed"] is False


HOSTILE = "<script>|`$(x)`\n::error::\x00" + "é" * 400


def test_a_hostile_name_does_no_harm() -> None:
    verdict = Verdict("run", (Finding("changed", HOSTILE, HOSTILE),), 1, (HOSTILE,))
    assert "<script>" not in markdown(verdict).replace("\\<script\\>", "")
    ElementTree.fromstring(junit_xml(verdict))
    lines = "\n".join(github_lines(verdict)).split("\n")
    assert len(lines) == 2 and all(line.startswith("::") and " title=su3d-bench::" in line for line in lines)


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
        ("cost_limit", 1.0, False), ("calibration_ms", 0.01, True), ("calibration_ms", 0.0, False),
        ("calibration_ms", None, True), ("results", [], False), ("costs", {}, True), ("schema_version", 2, False),
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


@pytest.mark.parametrize(
    "words", [[], ["a"], ["a", "b", "--against", "r"], ["--learn", "a"], ["a", "--against", "r", "--cost-limit", "2"]]
)
def test_a_request_that_is_neither_check_nor_learn_is_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", *words]) == 2
    assert capsys.readouterr().err.startswith("su3d-bench: check: ")
