"""The real-time clock: hand-worked schedules, those of streaming perception, and the files of schedules and costs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import TESTS

from su3d_bench.core.errors import DataError
from su3d_bench.online.clock import FrameTimes, Queue, Schedule, Stream, frame_times, read_costs, read_schedule

SAP = json.loads((TESTS / "cases" / "sap01_schedules.json").read_text())
STREAM = Stream(
    scene="rooms/living0", method="mine", rate_hz=10.0, stride=1, queue="newest", queue_size=1, device="a robot",
    is_simulated=False,
)  # fmt: skip


def started(times: Sequence[FrameTimes]) -> list[int]:
    return [frame for frame, one in enumerate(times) if one.started_ns is not None]


def fixed(n_frames: int, rate_hz: float, queue: Queue = "newest", size: int = 1, ms: float = 250.0) -> list[int]:
    """The frames that a method of fixed duration starts."""
    return started(frame_times(n_frames, rate_hz, queue, size, lambda frame: ms))


def schedule(n_frames: int = 8, ms: float = 250.0) -> Schedule:
    return Schedule(STREAM, frame_times(n_frames, 10.0, "newest", 1, lambda frame: ms))


def test_a_method_of_250_ms_processes_the_frames_worked_out_by_hand() -> None:
    assert fixed(4, 1) == [0, 1, 2, 3]  # frames come every 1,000 ms: it is always free
    # Every 200 ms: free at 250, 500 (frame 2 came at 400), 750 (3 at 600), 1000 (4 at 800, 5 comes now), 1250.
    assert fixed(10, 5) == [0, 1, 2, 3, 5, 6, 7, 8]
    # Every 100 ms: free at 250 (frame 2), 500 (5 comes now), 750 (7), 1000 (10): frames 1, 3, 4, 6, 8, 9 are dropped.
    assert fixed(12, 10) == [0, 2, 5, 7, 10]
    # Every 33.3 ms: free at 250 (frame 7 at 233.3), 500 (15 comes now), 750 (22 at 733.3), 1000 (30 comes now).
    assert fixed(30, 30) == [0, 7, 15, 22]


def test_each_queue_drops_the_frames_worked_out_by_hand() -> None:
    # At 10 Hz the method starts at 0, 250, 500, 750, 1000; two frames may wait.
    # drop-new: 1 and 2 wait; 1 starts at 250; 3 (300) waits, 4 is dropped, 5 (500) finds 2, 3 waiting and is dropped.
    assert fixed(10, 10, "drop-new", 2) == [0, 1, 2, 3]
    assert fixed(11, 10, "drop-new", 2) == [0, 1, 2, 3, 6]
    # drop-old: 1 starts at 250; at 500, 5 arrives and 2 and 3 were pushed out: 4 starts; at 750, 6 of (6, 7).
    assert fixed(10, 10, "drop-old", 2) == [0, 1, 4, 6]
    assert fixed(5, 10, "drop-new", 9, ms=100.0) == [0, 1, 2, 3, 4]


def test_an_update_that_ends_after_the_recording_does_not_count() -> None:
    assert started(schedule().times) == [0, 2, 5, 7]  # the last starts at 750 ms and ends at 1000, after 800
    assert schedule().fed == (0, 2, 5)
    assert schedule(ms=100.0).fed == tuple(range(7))  # an update that ends exactly at the end is late, as in sAP
    assert schedule(ms=1e6).fed == ()
    numbers = schedule().numbers()
    assert (numbers["n_frames"], numbers["n_processed"], numbers["n_dropped"]) == (8, 3, 4)
    assert numbers["latency_ms"] == round((250 + (500 - 200) + (750 - 500)) / 3, 3)


def test_a_map_counts_from_the_moment_it_is_finished() -> None:
    assert [schedule(10).n_fed_by(share) for share in (0.2, 0.25, 0.49, 0.5, 0.99)] == [0, 1, 1, 2, 3]


@pytest.mark.parametrize("case", SAP, ids=range(len(SAP)))
def test_the_newest_frame_is_processed_as_in_streaming_perception(case: dict[str, Any]) -> None:
    durations = iter(case["durations_us"])
    rate_hz, n_frames = float(case["rate_hz"]), int(case["n_frames"])
    times = frame_times(n_frames, rate_hz, "newest", 1, lambda frame: next(durations) / 1e3)
    assert next(durations, None) is None
    found = Schedule(STREAM.model_copy(update={"rate_hz": rate_hz}), times)
    assert list(found.fed) == case["frames"]
    finished_s = [(times[frame].finished_ns or 0) / 1e9 for frame in found.fed]
    np.testing.assert_allclose(finished_s, case["finished_s"], atol=2e-6)


def test_streaming_perception_has_200_cases_with_and_without_drops() -> None:
    assert len(SAP) == 200
    dropped = [case["n_frames"] - len(case["frames"]) for case in SAP]
    assert sum(n > 1 for n in dropped) > 50 < sum(n <= 1 for n in dropped)


def test_a_schedule_survives_its_file(tmp_path: Path) -> None:
    file = tmp_path / "schedule.csv"
    file.write_text(schedule().text())
    assert read_schedule(file) == schedule()
    assert file.read_text().splitlines()[2:4] == ["0,0.000000000,0.000000000,0.250000000,0", "1,0.100000000,,,1"]


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (1, "# {}", ":1: is not a schedule"),
        (1, "# [", ":1: is not a schedule"),
        (1, STREAM.model_dump_json().replace("a robot", "a" * 301), ":1: is not a schedule"),
        (2, "frame,dropped", ":2: expected the columns"),
        (4, "1,0.1", ":4: expected frame 1"),
        (4, "3,0.1,,,1", ":4: expected frame 1"),
        (4, "1,x,,,1", ":4: could not convert"),
        (4, "1,nan,,,1", ":4: 'nan' is not a number"),
        (4, "1,0.1,,,0", ":4: expected started_s"),
        (4, "1,0.1,0.2,,1", ":4: expected started_s"),
        (4, "1,0.1,0.2,0.3,0", ":4: times are not in order"),
        (5, "2,0.2,0.2,0.5,0", ":5: times are not in order"),
        (6, "3,0.1,,,1", ":6: times are not in order"),
        (4, "1,,,,1", ":4: times are not in order"),
        (4, "1,0.1,0.2,0.3,2", ":4: expected started_s"),
    ],
)
def test_a_damaged_schedule_is_refused_with_its_line(tmp_path: Path, line: int, text: str, message: str) -> None:
    lines = schedule().text().splitlines()
    lines[line - 1] = text
    file = tmp_path / "schedule.csv"
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError) as error:
        read_schedule(file)
    assert message in str(error.value)
    assert str(error.value).isprintable()


def test_costs_are_drawn_with_the_seed(tmp_path: Path) -> None:
    file = tmp_path / "costs.csv"
    file.write_text("device,method,mean_ms,sd_ms\nH200,mine,80,20\nH200,other,5,0\n")
    (device, draw), (_, again), (_, other_seed) = (read_costs(file, "mine@top_m=1", [n, 1]) for n in (0, 0, 1))
    assert device == "H200"
    drawn = np.array([draw(k) for k in range(20_000)])
    assert (drawn[:9] == [again(k) for k in range(9)]).all()
    assert drawn[0] != other_seed(0)
    assert drawn.min() > 0
    np.testing.assert_allclose([drawn.mean(), drawn.std()], [80, 20], rtol=0.03)
    assert read_costs(file, "other", [0])[1](0) == 5
    file.write_text("duration_ms,device\n10,H200\n30,H200\n")
    _, draw = read_costs(file, "mine", [0])
    assert {draw(k) for k in range(50)} == {10.0, 30.0}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected rows of one device"),
        ("mean_ms,sd_ms\n1,2\n", "('device')"),
        ("device,mean_ms\nx,2\n", "('sd_ms')"),
        ("device,mean_ms,sd_ms\nx,2,-1\n", "'-1' is not a number"),
        ("device,mean_ms,sd_ms\nx,2\n", "not 'NoneType'"),
        ("device,mean_ms,sd_ms\n,2,1\n", "device is empty"),
        ("device,mean_ms,sd_ms\nx,2,1\nx,3,1\n", "or one row with mean_ms"),
        ("device,duration_ms\nx,2\ny,3\n", "expected rows of one device"),
        ("device,method,duration_ms\nx,other,2\n", "for mine"),
        ("device,duration_ms\nx,\x1b[31m\n", "could not convert"),
    ],
)
def test_a_cost_file_that_names_no_cost_is_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "costs.csv"
    file.write_text(text)
    with pytest.raises(DataError, match=r"costs\.csv") as error:
        read_costs(file, "mine", [0])
    assert message in str(error.value)
    assert str(error.value).isprintable()
