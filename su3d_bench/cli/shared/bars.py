"""Bars on stderr while a verb works."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING

from su3d_bench.core.errors import counted
from su3d_bench.core.printing import Door, one_line, stream_behind

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from su3d_bench.runs.executors import Event, Report

MOST_OF_A_BAR = 80  # characters of its words


WIDE, BAR, NARROW_BAR = 100, 24, 12  # characters: a terminal with room for a long bar, and both bars


@contextmanager
def progress(n_scenes: int, *, is_quiet: bool, last_step: str = "") -> Iterator[Report]:
    """A ``Report`` that draws bars while the block runs; it draws nothing where stderr is no terminal.

    ``last_step`` is what a scene does after its last frame, where no event says it.
    """
    with drawn_bars(is_quiet=is_quiet) as bars:
        yield _Board(bars, n_scenes, last_step).report if bars is not None else lambda event: None


@contextmanager
def drawn_bars(*, is_quiet: bool, tells_time_left: bool = False) -> Iterator[Progress | None]:
    """Bars on stderr while the block runs, each with a field ``remark``; None where stderr is no terminal."""
    if is_quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column
    from rich.text import Text

    class Description(ProgressColumn):
        """The words of a bar, which hold names of scenes and methods: no markup, nothing that acts on a terminal."""

        def render(self, task: Task) -> Text:
            return Text(one_line(task.description)[:MOST_OF_A_BAR], no_wrap=True, overflow="ellipsis")

    console = Console(file=stream_behind(sys.stderr))
    remarks = TextColumn("{task.fields[remark]}", markup=False)
    # Where the terminal is narrow, names give way alone: only their column may be folded.
    time = (TimeRemainingColumn if tells_time_left else TimeElapsedColumn)(table_column=Column(no_wrap=True))
    width = BAR if console.width >= WIDE else NARROW_BAR
    bar = BarColumn(bar_width=width, table_column=Column(width=width))
    columns = (Description(), bar, MofNCompleteColumn(table_column=Column(no_wrap=True)), remarks, time)
    bars = Progress(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False)
    with bars, _above(bars):
        yield bars


def _above(bars: Progress) -> AbstractContextManager[None]:
    """What is printed to stderr in the block stands above the bars."""
    from rich.text import Text

    def show(text: str) -> None:
        bars.console.print(Text(text.removesuffix("\n")), soft_wrap=True)

    return sys.stderr.through(show) if isinstance(sys.stderr, Door) else nullcontext()


class _Board:
    """Turns events into bars: one for all scenes, one for the current method of each scene under way."""

    def __init__(self, bars: Progress, n_scenes: int, last_step: str) -> None:
        self._bars = bars
        self._last_step = last_step
        self._scenes = bars.add_task("scenes", total=n_scenes, remark="starting")
        self._tasks: dict[tuple[str, str], TaskID] = {}

    def report(self, event: Event) -> None:
        from su3d_bench.runs.executors import SCENE_DONE

        self._bars.update(self._scenes, remark=event.doing if event.label == SCENE_DONE else "")
        if event.label == SCENE_DONE:
            if not event.doing:
                self._bars.update(self._scenes, advance=1)
                self._remove(event.unit)
            return
        key = (event.unit, event.label)
        if key not in self._tasks:
            self._remove(event.unit)
            name = f"  {event.unit} {event.label}"
            self._tasks[key] = self._bars.add_task(name, total=event.total or None, remark="")
        task = self._tasks[key]
        if event.total:
            self._bars.update(task, total=event.total, completed=event.done)
        if event.doing or event.done:
            is_last = event.done == event.total > 0
            self._bars.update(task, remark=event.doing or (is_last and self._last_step) or self._remark(event))

    def _remove(self, unit: str) -> None:
        """The bars of a scene that is done, or whose next method begins."""
        for key in [key for key in self._tasks if key[0] == unit]:
            self._bars.remove_task(self._tasks.pop(key))

    def _remark(self, event: Event) -> str:
        own = self._tasks[event.unit, event.label]
        speed = next(task.speed for task in self._bars.tasks if task.id == own)
        words = [f"{speed:.1f}/s"] if speed else []
        return ", ".join(words if event.n_instances is None else [*words, counted(event.n_instances, "instance")])
