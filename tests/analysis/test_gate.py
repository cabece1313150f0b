"""The gate: twenty planted regressions are caught, fifty unchanged repeats pass."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.analysis.gate.check import HIGHER_IS_BETTER, check, compared
from su3d_bench.analysis.gate.reference import Reference, Value, learn, read_reference
from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, pack_scores, unpack_scores
from su3d_bench.metrics.semantic.confusion import SemanticCounts
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
    timed(folder)
    return folder


COSTS = {"calibration_ms": 5.0, "start_ms": 10.0, "close_ms": 0.0}


def timed(run: Path, method_ms: Sequence[float] = (40.0,) * 6, finish_ms: float = 60.0, **costs: float) -> Path:
    """Put such times in place of the measured ones, so that the tests do not depend on the machine's mood."""
    for updates in run.rglob("collector/updates.csv"):
        rows = list(csv.DictReader(updates.open()))
        for row, ms in zip(rows, method_ms, strict=True):
            row |= {"method_ms": str(ms), "total_ms": str(ms + 50)}
        with updates.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    for done in run.rglob("collector/done.json"):
        edit(done, lambda value: of_costs(value).update(COSTS | costs))
        edit(done, lambda value: of_costs(value)["maps"][0].update(finish_ms=finish_ms, perception_ms=0.0))
    return sealed(run)


def of_costs(done: Any) -> Any:
    return done["steps"]["predict"]["remarks"]["costs"]


def sealed(run: Path) -> Path:
    """The run with seals that fit its files, as one has that was written so."""
    for done in run.rglob("done.json"):

        def seal(value: Any, folder: Path = done.parent) -> None:
            for step in value["steps"].values():
                step["files"] = {name: digest_file(folder / name) for name in step["files"] if (folder / name).exists()}

        edit(done, seal)
    return run


def counted_otherwise(run: Path, n_points: int = 5) -> Path:
    """The run with ``n_points`` of the chairs called sofas, in counts and metrics alike."""
    scores: dict[str, dict[str, Any]] = {}
    for file in run.rglob("collector/counts.npz"):
        of_scene = unpack_scores(file.read_bytes())
        counts = of_scene["rooms-semantic"].counts
        assert isinstance(counts, SemanticCounts)
        chair, other = np.flatnonzero(counts.confusion.any(axis=1))[:2]
        counts.confusion[chair, [chair, other]] += (-n_points, n_points)
        file.write_bytes(pack_scores(of_scene))
        scene = file.parent.parent.name.replace(".", "/")
        scores |= {name: {**scores.get(name, {}), scene: score} for name, score in of_scene.items()}

    def change(metrics: Any) -> None:
        for result in metrics["results"]:
            result["result"] = combine(load_protocol(result["protocol"]), scores[result["protocol"]]).to_json()

    edit(run / "metrics.json", change)
    return sealed(run)


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
    return with_times([40.0 * factor] * 6)


def with_times(method_ms: Sequence[float] = (40.0,) * 6, **costs: float) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        timed(run, method_ms, **costs)

    return change


def setting(old: str, new: str) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        text = (run / "run.toml").read_text()
        assert old in text
        (run / "run.toml").write_text(text.replace(old, new, 1))

    return change


def without_calibration(run: Path) -> None:
    for done in run.rglob("collector/done.json"):
        edit(done, lambda value: of_costs(value).update(calibration_ms=None))


def file_of(run: Path, name: str) -> Path:
    return run / "scenes/painted.a/collector" / name


def cut(name: str) -> Callable[[Path], None]:
    """What a disk that was full leaves of a file."""

    def change(run: Path) -> None:
        file_of(run, name).write_bytes(file_of(run, name).read_bytes()[:-20])

    return change


def garbage(name: str) -> Callable[[Path], None]:
    """A file that is none, and a seal that says that it is."""

    def change(run: Path) -> None:
        file_of(run, name).write_bytes(b"no archive")
        sealed(run)

    return change


def counts_alone(run: Path) -> None:
    """Other counts than those from which the metrics were formed."""
    text = (run / "metrics.json").read_text()
    counted_otherwise(run)
    (run / "metrics.json").write_text(text)


def without(name: str) -> Callable[[Path], None]:
    return lambda run: file_of(run, name).unlink()


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
def test_a_planted_regression_is_caught(name: str, run: Path, learnt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant, said = PLANTED[name]
    plant(run)
    assert main(["check", str(run), "--against", str(learnt)]) == 1
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("name", NONE_WHATEVER)
def test_what_no_run_can_have_written_is_refused(
    name: str, run: Path, learnt: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, said = NONE_WHATEVER[name]
    plant(run)
    assert main(["check", str(run), "--against", str(learnt)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert main(["check", "--learn", str(run), "--out", str(run / "r.json")]) == 2


def test_a_value_that_is_no_number_never_passes(run: Path, learnt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    in_metrics(lambda m: results_of(m)["metrics"].update(mAcc=float("nan")))(run)
    assert main(["check", str(run), "--against", str(learnt)]) == 2
    assert "metrics.json is not as a run writes it" in capsys.readouterr().err


def test_fifty_unchanged_repeats_pass(run: Path, learnt: Path) -> None:
    generator = np.random.default_rng(0)
    for _ in range(50):
        # Time is the one thing that unchanged repeats differ in: by a twentieth, now and then by a tenth.
        noise = np.exp(generator.normal(0, 0.05, 8))
        timed(run, (40 * noise[:6]).tolist(), 60 * noise[6], start_ms=10 * noise[7])
        assert main(["check", str(run), "--against", str(learnt)]) == 0


def test_real_repeats_with_real_times_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    for name in "ab":
        assert main([*WORDS, "--out", str(tmp_path / name)]) == 0
    taught = learn([read_run(tmp_path / "a")], cost_limit=50.0)  # this method's updates take microseconds
    assert check(read_run(tmp_path / "b"), taught).is_passed


def test_what_is_better_is_said_and_passes(run: Path, made: Path) -> None:
    verdict = check(read_run(made), learn([read_run(counted_otherwise(run))]))
    assert verdict.is_passed
    assert {one.kind for one in verdict.findings} == {"better"}
    assert f"{len(verdict.findings)} better" in plain_lines(verdict)[0]


def test_the_tolerance_is_twice_the_spread_of_the_taught_runs(run: Path, made: Path, tmp_path: Path) -> None:
    first, second = (read_run(path) for path in (made, counted_otherwise(run, 4)))
    values = [results_in(one).metrics["mAcc"] for one in (first, second)]
    taught = learn([first, second])
    learnt = taught.results[0].metrics["mAcc"]
    assert learnt.value == pytest.approx(np.mean(values))
    assert learnt.tolerance == pytest.approx(2 * (values[0] - values[1]))
    for n_points, is_passed in ((9, True), (11, False)):  # 2 less than the mean of the two, and 8 more at most
        shutil.copytree(made, tmp_path / str(n_points))
        verdict = check(read_run(counted_otherwise(tmp_path / str(n_points), n_points)), taught)
        assert verdict.is_passed == is_passed, verdict.findings


def results_in(run: Any) -> Any:
    return run.results["collector", "rooms-semantic"].result


def findings_of(run: Path, name: str, measured: float, value: Value, across: float | None = None) -> list[Finding]:
    """What is said where a run measured this of a headline value of which no scene and class is known."""
    numbers = replace(results_in(read_run(run)), metrics={name: measured}, per_scene={}, per_class={})
    first = learn([read_run(run)]).results[0]
    expected = first.model_copy(update={"metrics": {name: value}, "scenes": {}, "classes": {}})
    return list(compared("m / p", expected, numbers, across))


def test_a_value_that_differs_by_just_the_tolerance_passes_and_by_a_bit_more_fails(made: Path) -> None:
    taught = Value(value=0.75, tolerance=0.25)
    for value, n_findings in ((0.5, 0), (1.0, 0), (np.nextafter(0.5, 0), 1)):
        assert len(findings_of(made, "mAcc", float(value), taught)) == n_findings


@pytest.mark.parametrize(("own", "across"), [(0.25, 0.125), (0.125, 0.25)])
def test_on_another_processor_the_larger_of_the_two_tolerances_counts(own: float, across: float, made: Path) -> None:
    taught = Value(value=0.75, tolerance=own)
    assert findings_of(made, "mAcc", 0.5, taught, across) == []
    assert len(findings_of(made, "mAcc", 0.4375, taught, across)) == 1


@pytest.mark.parametrize("value", [0.25, 0.75])
def test_a_value_without_a_better_direction_may_move_in_neither(value: float, made: Path) -> None:
    assert "over-merged" not in HIGHER_IS_BETTER
    found = findings_of(made, "over-merged", value, Value(value=0.5))
    assert [(one.kind, one.text, one.is_failure) for one in found] == [
        ("regression", "differs from the reference", True)
    ]
    found = findings_of(made, "mAcc", value, Value(value=0.5))
    assert [one.kind for one in found] == ["better" if value > 0.5 else "regression"]


@pytest.mark.parametrize("protocol", ["rooms-retrieval", "rooms-reasoning", "rooms-annotation", "rooms-instance"])
def test_a_headline_value_that_rises_passes_unless_it_is_a_share_of_what_is_wrong(protocol: str, made: Path) -> None:
    for name in load_protocol(protocol).headline:
        (found,) = findings_of(made, name, 0.75, Value(value=0.5))
        assert found.is_failure == (name in {"under-merged", "over-merged"}), name


@pytest.mark.parametrize("factor", [2.0, 10.0, 1e9])
def test_a_slowed_calibration_hides_no_tenfold_cost(
    factor: float, run: Path, learnt: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timed(run, [400.0] * 6, calibration_ms=5.0 * factor)
    assert main(["check", str(run), "--against", str(learnt)]) == 1
    shown = capsys.readouterr()
    assert "cost of the updates after 3: costs 5.00 times the reference" in shown.out
    assert "others used the processor, or what is checked slows it" in shown.err


def test_a_busy_machine_excuses_a_cost_up_to_twice_and_it_is_said(
    run: Path, learnt: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timed(run, [100.0] * 6, 150.0, calibration_ms=15.0)
    assert main(["check", str(run), "--against", str(learnt)]) == 0
    assert "the calibrating work took 15 ms, 3.0 times the reference's" in capsys.readouterr().err
    timed(run, [106.0] * 6, 150.0, calibration_ms=15.0)
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
    slower(3.0)(counted_otherwise(run, 4))
    assert not check(read_run(run), reference).is_passed
    edit(run / "run.json", lambda r: r.update(processor="other"))
    verdict = check(read_run(run), reference)
    assert verdict.is_passed, verdict.findings
    assert "another processor" in verdict.remarks[0] and "within 2 points" in verdict.remarks[0]
    counted_otherwise(run, 40)
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
    assert shown.startswith("failed: 2 differences from") and "::error title=su3d-bench::" in shown
    assert "| FAIL | collector / rooms-semantic / mAcc |" in (tmp_path / "c.md").read_text()
    suite = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert suite.get("failures") == "2" and len(suite.findall("testcase/failure")) == 2
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


@pytest.mark.parametrize(
    "words", [[], ["a"], ["a", "b", "--against", "r"], ["--learn", "a"], ["a", "--against", "r", "--cost-limit", "2"]]
)
def test_a_request_that_is_neither_check_nor_learn_is_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", *words]) == 2
    assert capsys.readouterr().err.startswith("su3d-bench: check: ")


def test_a_check_that_passes_shows_each_number_beside_the_reference_s(
    run: Path, learnt: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["check", str(run), "--against", str(learnt)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("passed: ")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| collector")]
    values = {tuple(row[:2]): row[2:] for row in rows}
    shown = f"{100 * (results_in(read_run(run)).metrics['mAcc'] or 0):.1f}"
    assert values["collector / rooms-semantic", "mAcc"] == [shown, shown, "equal"]
    assert values["collector / cost", "all together"][2:] == ["1.3 times"]
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["check", str(run), "--against", str(learnt)]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 60


def test_scenes_that_are_missing_come_first_and_what_follows_from_them_is_counted(
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
    verdict = check(read_run(run), reference)
    lines = plain_lines(verdict)
    n_explained = sum(one.is_explained for one in verdict.findings)
    assert f"{n_explained} of them because of other scenes" in lines[0] and n_explained > 20
    assert lines[1] == f"FAIL {gone}: the run does not have this scene"
    assert lines[-1] == (
        f"FAIL over other scenes: {n_explained} differences follow from scenes that the run or the reference alone has"
    )
    assert len(lines) < 12


def test_many_differences_of_a_kind_are_one_line_with_their_number_and_the_farthest() -> None:
    findings = tuple(
        Finding(
            "regression",
            f"m / p / class c{n} / AP",
            "is worse than the reference",
            0.5,
            0.4 - n / 100,
            group="m / p / classes",
        )
        for n in range(6)
    )
    (line,) = plain_lines(Verdict("run", findings, 1, ()))[1:]
    assert line == (
        "FAIL m / p / classes: 6 values, each of which is worse than the reference; the farthest is class c5 / AP "
        "(50.0 -> 35.0)"
    )
    lost = tuple(Finding("missing", f"s{n}", "the run does not have this scene", group="scenes") for n in range(10))
    (line,) = plain_lines(Verdict("run", lost, 1, ()))[1:]
    assert line == "FAIL scenes: the run does not have this scene (10: s0, s1, s2, s3, s4, s5, s6, s7 and 2 more)"


def test_two_processors_of_one_name_are_not_named_twice(run: Path, reference: Reference) -> None:
    edit(run / "run.json", lambda r: r.update(processor="other"))
    (remark,) = [line for line in check(read_run(run), reference).remarks if "processor" in line]
    assert remark.count(reference.hardware) == 1 and "of the same name" in remark
