"""Runs in real time: measured with a fake clock, replayed to the same bytes, simulated, and what is refused."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from painted import ColourPerception
from painted_runs import COLLECTOR, PAINTED, job, run, words

from su3d_bench.analysis.costs import cost_rows
from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.perception.profiles import PerceptionConfig
from su3d_bench.runs import frame_loop
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.clock import read_schedule
from su3d_bench.runs.finished import read_run
from su3d_bench.store.records import CostsRecord, checked
from su3d_bench.store.run_folder import JobFolder

TEN_HZ = ("--realtime", "10", "--set", "painted.n_frames=12", "--anytime", "0.1", "0.5")
MAPS = ("prediction.npz", "anytime-0.1.npz", "anytime-0.5.npz", "counts.npz", "anytime-0.5-counts.npz", "schedule.csv")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Every update takes 150 ms and perception 100 ms, without waiting; reading a frame takes a second."""
    fake: Any = SimpleNamespace(now=0.0)
    fake.perf_counter = lambda: fake.now

    def lasting(seconds: float, call: Any) -> Any:
        def slow(*words: Any) -> Any:
            fake.now += seconds
            return call(*words)

        return slow

    monkeypatch.setattr(frame_loop, "time", fake)
    collector = registry.load("method", COLLECTOR)
    monkeypatch.setattr(collector, "update", lasting(0.15, collector.update))
    monkeypatch.setattr(ColourPerception, "detect", lasting(0.1, ColourPerception.detect))
    return fake


def costs(folder: Path) -> CostsRecord:
    return checked(CostsRecord, JobFolder(folder).remarks("predict")["costs"])


def error_of(command: list[str]) -> str:
    """The only line of the error of a request that is refused."""
    with redirect_stderr(io.StringIO()) as errors:
        assert main(command) == 2
    (line,) = errors.getvalue().splitlines()
    return line


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in MAPS}


@pytest.mark.usefixtures("painted_place", "clock")
def test_a_measured_run_feeds_the_frames_worked_out_by_hand(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*TEN_HZ, scenes="a") == 0
    times = read_schedule(job() / "schedule.csv").times
    assert [frame for frame, one in enumerate(times) if one.started_ns is not None] == [0, 2, 5, 7, 10]
    lines = (job() / "updates.csv").read_text().splitlines()
    assert [line.split(",")[:2] for line in lines[1:]] == [["0", "0"], ["1", "2"], ["2", "5"], ["3", "7"]]
    clock = costs(job()).realtime
    assert clock is not None and (clock.n_frames, clock.n_processed, clock.n_dropped) == (12, 4, 7)
    assert clock.latency_ms == (250 + 300 + 250 + 300) / 4
    assert [one.n_updates for one in costs(job()).maps] == [0, 2, 4]
    assert "real time at 10 Hz (the newest frame waits; measured on" in capsys.readouterr().out
    assert main(["report", "timing", "out"]) == 0
    out = capsys.readouterr().out
    row = next(line for line in out.splitlines() if "measured:" in line)
    assert [cell.strip() for cell in row.strip("| ").split("|")][2:9] == [
        "10",
        "newest 1",
        "12",
        "4",
        "7",
        "275",
        "3.33",
    ]
    assert main(["report", "timing", "out", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["real_time"][0]["n_dropped"] == 7
    assert {(one["rate_hz"], one["frame_s"]) for one in value["cost_quality"]} == {(10.0, 0.25)}


@pytest.mark.usefixtures("painted_place", "clock")
def test_the_time_of_a_measured_run_is_never_that_of_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[bool] = []

    def build(profile: str, config: PerceptionConfig, **_: Any) -> ColourPerception:
        built.append(config.cache)
        return ColourPerception()

    monkeypatch.setattr(scene_run, "build_perception", build)
    measured: list[bool] = []
    whole = frame_loop.MethodFeed.measured_ms

    def watched(self: frame_loop.MethodFeed, *words: Any) -> float:
        measured.append(built[-1])  # the perception built last is the one that is timed
        return whole(self, *words)

    monkeypatch.setattr(frame_loop.MethodFeed, "measured_ms", watched)
    assert run(*TEN_HZ, scenes="a") == 0
    assert measured == [False] * 5
    for refused in (("--profile", "stored"), ("--profile", "oracle")):
        assert "so it cannot be timed; add --cost FILE" in error_of(words(*TEN_HZ, *refused, out="other"))


@pytest.mark.usefixtures("painted_place", "clock")
def test_a_replayed_schedule_gives_the_same_bytes_under_any_number_of_jobs() -> None:
    assert run(*TEN_HZ, scenes="[ab]") == 0
    more = ("--set", "painted.n_frames=12", "--anytime", "0.1", "0.5", "--schedule", "out")
    assert run(*more, scenes="[ab]", out="one") == 0
    program = Path(__file__).resolve().parents[1] / "support/scenes/painted_cli.py"
    assert program.is_file()
    two = words(*more, scenes="[ab]", out="two")
    two[two.index("--jobs") + 1] = "2"
    two = [word.replace("painted.py", "painted_cli.py") for word in two]
    assert main(two) == 0
    for scene in "ab":
        first = bytes_of(job(scene))
        assert bytes_of(job(scene, out="one")) == first
        assert bytes_of(job(scene, out="two")) == first
    assert Path("one/metrics.json").read_bytes() == Path("out/metrics.json").read_bytes()
    assert run(*more, scenes="[ab]", out="one") == 0  # resumes


@pytest.mark.usefixtures("painted_place")
def test_simulated_costs_are_marked_and_repeat(capsys: pytest.CaptureFixture[str]) -> None:
    Path("costs.csv").write_text("device,mean_ms,sd_ms\nH200 SXM,250,60\n")
    simulated = (*TEN_HZ, "--cost", "costs.csv", "--queue", "drop-old", "--queue-size", "3")
    assert run(*simulated, scenes="a") == run(*simulated, scenes="a", out="again") == 0
    assert bytes_of(job()) == bytes_of(job(out="again"))
    assert "(drop-old, queue of 3; simulated costs of H200 SXM)" in capsys.readouterr().out
    clock = costs(job()).realtime
    assert clock is not None and clock.is_simulated and clock.device == "H200 SXM"
    assert run(*simulated, "--seed", "1", scenes="a", out="seed") == 0
    assert (job() / "schedule.csv").read_bytes() != (job(out="seed") / "schedule.csv").read_bytes()
    Path("costs.csv").write_text("device,mean_ms,sd_ms\nH200 SXM,251,60\n")
    assert "schedule was simulated" in error_of(words(*simulated, scenes="a"))


@pytest.mark.usefixtures("painted_place")
def test_a_method_that_finishes_no_update_has_an_empty_map() -> None:
    Path("costs.csv").write_text("device,duration_ms\nslow,60000\n")
    assert run(*TEN_HZ, "--cost", "costs.csv", scenes="a") == 0
    assert [one.n_updates for one in costs(job()).maps] == [0, 0, 0]
    assert {
        (one.costs["rate_hz"], one.costs["frame_s"])
        for one in cost_rows([read_run(Path("out"))], {("out", "collector"): []})
    } == {(10.0, None)}


@pytest.mark.usefixtures("painted_place", "clock")
def test_a_schedule_that_does_not_fit_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*TEN_HZ, scenes="a") == 0
    file = str(job() / "schedule.csv")
    of_other = words("--schedule", file, "--set", "painted.n_frames=12", scenes="b", out="new")
    assert "is the schedule of painted/a at 10 Hz, stride 1, not of painted/b at 10 Hz" in error_of(of_other)
    assert "cannot be read" in error_of(words("--schedule", "out", scenes="b", out="new"))
    for conflict in (("--realtime", "5"), ("--stride", "2"), ("--queue", "drop-new")):
        assert "differs from the schedule" in error_of(words("--schedule", "out", *conflict, scenes="a", out="new"))
    assert not Path("new").exists()
    capsys.readouterr()
    assert run("--schedule", file, scenes="a", out="new") == 3
    assert "has 12 frames, but 6 arrive" in capsys.readouterr().err


@pytest.mark.usefixtures("painted_place")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--queue", "drop-new"), "has no effect without --realtime"),
        (("--queue-size", "4"), "has no effect without --realtime"),
        (("--cost", "costs.csv"), "has no effect without --realtime"),
        (("--realtime", "5", "--queue-size", "4"), "'newest' has one place"),
        (("--realtime", "5", "--cost", "missing.csv"), "missing.csv: cannot be read"),
        (("--schedule", "."), "has no schedules"),
        (("--memory", "8 apples"), "string should match pattern"),
        (("--memory", "8G", "--executor", "inline"), "needs Linux and --executor processes"),
    ],
)
def test_options_that_contradict_each_other_are_refused(options: tuple[str, ...], message: str) -> None:
    assert message in error_of(words(*options, scenes="a"))


GREEDY = """
import numpy as np, os, pydantic
from su3d_bench import Instances, PerceptionNeeds


class Modest:
    name = "modest"

    class Config(pydantic.BaseModel):
        pass

    def __init__(self, config):
        self.needs = PerceptionNeeds(masks="none")

    def start(self, scene):
        self.store = []

    def update(self, frame, detections, timer):
        pass

    def finish(self):
        return Instances.of(np.array([[0.0, 0.0, 3.0]]), [np.array([0])], None, None, labels=["chair"])


class Greedy(Modest):
    name = "greedy"

    def update(self, frame, detections, timer):
        while True:
            self.store.append(np.ones(1 << 22))


class Crashing(Modest):
    name = "crashing"

    def update(self, frame, detections, timer):
        os.abort()
"""


@pytest.mark.usefixtures("painted_place")
def test_a_method_that_exceeds_the_memory_limit_fails_alone(capsys: pytest.CaptureFixture[str]) -> None:
    Path("greedy.py").write_text(GREEDY)
    methods = [f"greedy.py:{name}" for name in ("Greedy", "Crashing", "Modest")]
    command = ["run", f"{PAINTED}/a", "--methods", *methods, "--protocols", "rooms-instance", "--no-pictures"]
    assert main([*command, "--memory", "1500M", "--jobs", "1", "--out", "out", "--quiet"]) == 3
    errors = [line for line in capsys.readouterr().err.splitlines() if "painted/a" in line]
    assert sorted(line.partition("painted/a: ")[2] for line in errors) == [
        "exceeded --memory 1500M; allow more, or use a smaller --limit",
        "the worker crashed (signal 6, SIGABRT); native code may have exceeded --memory 1500M",
    ]
    assert (job(method="modest") / "prediction.npz").is_file()
    assert (job(method="oracle") / "prediction.npz").is_file()
    assert main([*command, "--jobs", "1", "--memory", "2G", "--out", "out", "--quiet"]) == 3  # the limit may differ
