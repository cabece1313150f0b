"""Progress bars of a run: activities are shown even without frames, and narrow terminals keep a bar."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from su3d_bench.cli.output import NARROW_BAR, _Board, drawn_bars, progress
from su3d_bench.runs.executors import SCENE_DONE, Event

LONG = "rooms/a-scene-with-a-long-name-that-no-terminal-has-room-for"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@contextmanager
def bars_on(width: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", Terminal())
    with drawn_bars(is_quiet=False) as bars:
        assert bars is not None
        yield bars


def plain_lines(bars: Any) -> list[str]:
    from rich.console import Console

    paper = Console(file=io.StringIO(), width=bars.console.width, color_system=None, legacy_windows=False)
    paper.print(bars.make_tasks_table(bars.tasks), no_wrap=True)
    assert isinstance(paper.file, io.StringIO)
    return [line.rstrip() for line in paper.file.getvalue().splitlines()]


@pytest.mark.parametrize("scene", ["rooms/living0", LONG])
def test_bar_and_activity_are_visible_on_80_columns(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with bars_on(80, monkeypatch) as bars:
        board = _Board(bars, 4, "")
        assert "starting" in plain_lines(bars)[0]
        board.report(Event(scene, "opensu3d", activity="generating the scene"))
        assert "generating the scene" in plain_lines(bars)[1] and "0/?" in plain_lines(bars)[1]
        board.report(Event(scene, "opensu3d", 0, 160))
        assert "generating the scene" in plain_lines(bars)[1] and "0/160" in plain_lines(bars)[1]
        board.report(Event(scene, "opensu3d", 160, 160, 12))
        first, second = plain_lines(bars)
        assert "12 instances" in second and "making" not in second and "starting" not in first
        assert max(map(len, (first, second))) <= 80 and second.count("━") == NARROW_BAR
        board.report(Event(scene, "opensu3d", activity="scoring 2 of 4 protocols"))
        assert "scoring 2 of 4 protocols" in plain_lines(bars)[1] and "160/160" in plain_lines(bars)[1]


def test_scene_has_one_bar_for_its_current_method(monkeypatch: pytest.MonkeyPatch) -> None:
    with bars_on(120, monkeypatch) as bars:
        board = _Board(bars, 2, "drawing")
        board.report(Event("rooms/a", "one", 3, 3, 1))
        assert "drawing" in plain_lines(bars)[1]
        board.report(Event("rooms/a", "two", 1, 3, 1))
        assert len(bars.tasks) == 2 and "rooms/a two" in plain_lines(bars)[1] and "1 instance " in plain_lines(bars)[1]
        board.report(Event("rooms/a", SCENE_DONE, 1, 2))
        board.report(Event("", SCENE_DONE, activity="adding up"))
        (line,) = plain_lines(bars)
        assert "1/2" in line and "adding up" in line


def test_log_gets_a_line_a_minute_with_the_number_of_maps(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with progress(1, is_quiet=False, n_maps=10) as report:
        for k in range(10):
            now = 50.0 * k
            report(Event("rooms/living0", f"m{k}", activity="opening"))
        report(Event("rooms/living0", SCENE_DONE))
    assert capsys.readouterr().err.splitlines() == [
        "rooms/living0 m2: 2 of 10 maps done, about 7 minutes left",
        "rooms/living0 m4: 4 of 10 maps done, about 5 minutes left",
        "rooms/living0 m6: 6 of 10 maps done, about 3 minutes left",
        "rooms/living0 m8: 8 of 10 maps done, about 100 s left",
        "rooms/living0 finished, 1 of 1 scene",
    ]
