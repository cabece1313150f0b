"""Progress on stderr: a bar for the scenes and one for each scene under way, with rate and instance count."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from su3d_bench.runs.executors.local import SCENE_DONE, Event, Report


@contextmanager
def progress(n_scenes: int, *, is_quiet: bool, last_step: str = "scoring") -> Iterator[Report]:
    """A ``Report`` that draws bars while the block runs; it draws nothing where stderr is no terminal.

    ``last_step`` is what a scene does after its last frame.
    """
    if is_quiet or not sys.stderr.isatty():
        yield lambda event: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[remark]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        board = _Board(bars, n_scenes, last_step)
        yield board.report


class _Board:
    """Turns events into bars: one for all scenes, one for the current method of each scene under way."""

    def __init__(self, bars: object, n_scenes: int, last_step: str) -> None:
        from rich.progress import Progress, TaskID

        assert isinstance(bars, Progress)
        self._bars = bars
        self._last_step = last_step
        self._scenes = bars.add_task("scenes", total=n_scenes, remark="")
        self._tasks: dict[tuple[str, str], TaskID] = {}

    def report(self, event: Event) -> None:
        if event.label == SCENE_DONE:
            self._bars.update(self._scenes, advance=1)
            for key in [key for key in self._tasks if key[0] == event.unit]:
                self._bars.remove_task(self._tasks.pop(key))
            return
        key = (event.unit, event.label)
        if key not in self._tasks:
            name = f"  {event.unit} {event.label}"
            self._tasks[key] = self._bars.add_task(name, total=event.total, remark="")
        task = self._tasks[key]
        self._bars.update(task, completed=event.done, remark=self._remark(event))
        if event.done == event.total:
            self._bars.update(task, description=f"  {event.unit} {event.label}: {self._last_step}")

    def _remark(self, event: Event) -> str:
        speed = self._bars.tasks[0].speed
        for task in self._bars.tasks:
            if task.id == self._tasks[event.unit, event.label]:
                speed = task.speed
        rate = f"{speed:.1f} frames/s" if speed else ""
        return rate if event.n_instances is None else f"{rate} {event.n_instances} instances"
