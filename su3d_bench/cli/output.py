"""Output of commands: results on stdout and in files, warnings and progress on stderr."""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from su3d_bench.core.errors import counted, printable
from su3d_bench.core.safe_output import SafeStream, answer_stream, escaped_json, one_line, stream_behind, terminal_width

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from su3d_bench.formats.tables.table import Prose, Table
    from su3d_bench.runs.executors import Event, Report

MAX_UNSEEN = 8  # listed words
WIDE, BAR, NARROW_BAR = 100, 24, 12  # characters: wide enough for a long bar, and for both bars
MAX_BAR_LABEL = 80  # characters of the label
LINE_EVERY_S = 10.0  # between lines of progress where there is no terminal
MAPS_EVERY_S = 60.0  # the same for a run
MEGABYTE, GIGABYTE = 10**6, 10**9


def formatted(parts: Sequence[Table | Prose], arguments: argparse.Namespace, *, is_file: bool = False) -> str:
    """The tables in the format of ``--format``; ``is_file`` if they are written to a file."""
    from su3d_bench.reports.tables.formats import FORMATS, plain

    form = arguments.table_format or ("markdown" if is_file else "text")
    return plain(parts, terminal_width()) if form == "text" and not is_file else FORMATS[form](parts)


def answer(*lines: str) -> None:
    """Print lines to stdout, with control characters escaped."""
    print("\n".join(map(one_line, lines)), file=answer_stream())


def answer_document(text: str) -> None:
    """Print a multi-line document, such as a table, to stdout."""
    answer(*text.rstrip("\n").split("\n"))


def answer_json(arguments: argparse.Namespace, value: Any) -> bool:
    """Print or write ``value`` as JSON if ``--json`` is set; returns whether it replaces the text."""
    text = escaped_json(_defined(value), indent=2, allow_nan=False)
    if arguments.json_file is not None:
        path = written(arguments.json_file, f"{text}\n")
        remark(f"written: {path}", quiet=arguments.quiet)
    if arguments.json:
        print(text, file=answer_stream())
    return bool(arguments.json)


def _defined(value: Any) -> Any:
    """``value`` with null for NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {name: _defined(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_defined(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def answer_either(arguments: argparse.Namespace, value: Any, *lines: str) -> None:
    """Print ``value`` with ``--json``, otherwise ``lines``."""
    if not answer_json(arguments, value):
        answer(*lines)


def answer_tables(arguments: argparse.Namespace, value: Any, parts: Sequence[Table | Prose]) -> None:
    """Print ``value`` with ``--json``, otherwise the tables."""
    if not answer_json(arguments, value):
        answer_document(formatted(parts, arguments))


def size_text(n_bytes: int) -> str:
    """A size in MB or GB.

    >>> size_text(1_234_567_890), size_text(56_700_000), size_text(1200)
    ('1.2 GB', '56.7 MB', '0.0 MB')
    """
    return f"{n_bytes / GIGABYTE:.1f} GB" if n_bytes >= GIGABYTE else f"{n_bytes / MEGABYTE:.1f} MB"


def show() -> None:
    """Flush stdout before something slow."""
    answer_stream().flush()


def answer_commands(lines: Sequence[str]) -> None:
    """Print workflow commands, whose text is already escaped."""
    stream = answer_stream()
    for line in lines:
        stream.write_command(line) if isinstance(stream, SafeStream) else print(line)


def written(path: Path, text: str) -> Path:
    """Write ``text`` to the file of an option, creating its folder; returns the path."""
    from su3d_bench.core.files.atomic import make_folder, write_text

    make_folder(path.parent)
    write_text(path, text)
    return path


def answer_or_write(arguments: argparse.Namespace, value: Any, parts: Sequence[Table | Prose]) -> None:
    """Write the tables to the file of ``--out``, or print them as ``answer_tables`` does."""
    if arguments.out is None:
        answer_tables(arguments, value, parts)
    else:
        path = written(arguments.out, formatted(parts, arguments, is_file=True))
        remark(f"written: {path}", quiet=arguments.quiet)
        answer_json(arguments, value)


def file_name_of(text: str, kind: Literal["text", "question"]) -> str:
    """The file name for a picture of the answer to ``text``; unique per text and kind.

    >>> file_name_of("plant on shelf", "text"), file_name_of("Where is it?", "question")
    ('plant-on-shelf', 'where-is-it')
    >>> file_name_of("Plant on shelf", "text"), file_name_of("?", "question")
    ('plant-on-shelf-c4a4222c', 'question-8a8de823')
    """
    name = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:60]
    words = name.replace("-", " ")
    is_plain = bool(name) and text == (words if kind == "text" else f"{words.capitalize()}?")
    return name if is_plain else f"{name or kind}-{_few_digits(text)}"


def file_name_of_scene(address: str) -> str:
    """The file name for a picture of a scene; unique per address.

    >>> file_name_of_scene("replica/room0"), file_name_of_scene("mine/hall/left")
    ('replica-room0', 'mine-hall-left-f6ee616f')
    """
    if re.fullmatch(r"[A-Za-z0-9_]+/[A-Za-z0-9_.-]+", address):
        return address.replace("/", "-")
    return f"{re.sub(r'[^A-Za-z0-9_.-]+', '-', address).lstrip('-.')[:120]}-{_few_digits(address)}"


def _few_digits(text: str) -> str:
    from su3d_bench.core.digests import digest_bytes

    return digest_bytes(text.encode("utf-8", "surrogatepass"))[:8]


def remark(*lines: str, quiet: bool = False) -> None:
    """Print lines to stderr."""
    for line in () if quiet else lines:
        print(one_line(line), file=sys.stderr)


def remark_unseen(encoder: object, text: str, *, quiet: bool) -> None:
    """Warn about words of ``text`` that the encoder was not trained on, if it can tell."""
    from su3d_bench.core.interfaces import HasTrainingVocabulary

    if isinstance(encoder, HasTrainingVocabulary) and (words := encoder.unseen_words(text)):
        named = ", ".join(f"'{printable(word, 40)}'" for word in words[:MAX_UNSEEN])
        more = f" and {len(words) - MAX_UNSEEN} more" if len(words) > MAX_UNSEEN else ""
        remark(f"encoder {encoder.name} was not trained on {named}{more}; results are unreliable", quiet=quiet)


@contextmanager
def progress(n_scenes: int, *, is_quiet: bool, n_maps: int = 0, last_step: str = "") -> Iterator[Report]:
    """A ``Report`` that shows progress while the block runs: bars on a terminal, elsewhere a line per finished scene,
    and one a minute if the number of maps is known.

    ``last_step`` labels what happens after the last frame of a scene.
    """
    from su3d_bench.runs.executors import SCENE_DONE

    n_done, started, begun = 0, time.monotonic(), set[tuple[str, str]]()
    last = started

    def print_line(event: Event) -> None:
        nonlocal n_done, last
        now = time.monotonic()
        if event.label != SCENE_DONE:
            begun.add((event.unit, event.label))
            if n_maps and now - last >= MAPS_EVERY_S:
                last, n = now, len(begun) - 1
                left = _time_left(started, n, n_maps)
                remark(f"{event.unit} {event.label}: {n} of {n_maps} maps done{left}", quiet=is_quiet)
        elif not event.activity:
            n_done, last = n_done + 1, now
            left = _time_left(started, n_done, n_scenes)
            remark(f"{event.unit} finished, {n_done} of {counted(n_scenes, 'scene')}{left}", quiet=is_quiet)

    with drawn_bars(is_quiet=is_quiet) as bars:
        yield print_line if bars is None else _Board(bars, n_scenes, last_step).report


def _time_left(started: float, n: int, n_all: int) -> str:
    """The estimated time left after ``n`` of ``n_all`` equal steps since ``started``, empty after the last."""
    if not 0 < n < n_all:
        return ""
    left_s = (time.monotonic() - started) * (n_all / n - 1)
    return f", about {left_s:.0f} s left" if left_s < 120 else f", about {left_s / 60:.0f} minutes left"


@contextmanager
def drawn_bars(*, is_quiet: bool) -> Iterator[Progress | None]:
    """Progress bars on stderr, each with a field ``remark``; None if stderr is not a terminal."""
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
        TimeRemainingColumn,
    )
    from rich.table import Column
    from rich.text import Text

    class Description(ProgressColumn):
        """The label of a bar, without markup or control characters."""

        def render(self, task: Task) -> Text:
            return Text(one_line(task.description)[:MAX_BAR_LABEL], no_wrap=True, overflow="ellipsis")

    console = Console(file=stream_behind(sys.stderr))
    remarks = TextColumn("{task.fields[remark]}", markup=False)
    # In a narrow terminal only the column of names may be folded.
    left = TimeRemainingColumn(elapsed_when_finished=True, table_column=Column(no_wrap=True))
    width = BAR if console.width >= WIDE else NARROW_BAR
    bar = BarColumn(bar_width=width, table_column=Column(width=width))
    columns = (Description(), bar, MofNCompleteColumn(table_column=Column(no_wrap=True)), remarks, left)
    bars = Progress(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False)
    with bars, _above(bars):
        yield bars


def _above(bars: Progress) -> AbstractContextManager[None]:
    """Print lines to stderr above the bars."""
    from rich.text import Text

    def show(text: str) -> None:
        bars.console.print(Text(text.removesuffix("\n")), soft_wrap=True)

    return sys.stderr.through(show) if isinstance(sys.stderr, SafeStream) else nullcontext()


@contextmanager
def overall_progress(
    what: str, *, is_quiet: bool, every_s: float = 0.0
) -> Iterator[tuple[Callable[[int], None], Report]]:
    """Progress over the steps of all units: a function to set their number, and a ``Report``.

    On a terminal it is one bar with the time left, elsewhere one line per unit that is done, or every ``every_s``.
    """
    n_done: dict[str, int] = {}
    n_all, started = 0, time.monotonic()
    last = started
    with drawn_bars(is_quiet=is_quiet) as bars:
        task = None if bars is None else bars.add_task(what, total=None, remark="")

        def begin(n_steps: int) -> None:
            nonlocal n_all
            n_all = n_steps
            if bars is not None and task is not None:
                bars.update(task, total=n_steps)

        def report(event: Event) -> None:
            nonlocal last
            n_done[event.unit] = event.done
            n = sum(n_done.values())
            if bars is not None and task is not None:
                bars.update(task, completed=n, description=f"{event.unit}: {event.label}")
            elif n and (time.monotonic() - last >= every_s if every_s else event.done == event.total):
                last, left = time.monotonic(), _time_left(started, n, n_all)
                done = event.label if every_s else event.unit
                remark(f"{what}: {done} done, {n} of {n_all} steps{left}", quiet=is_quiet)

        yield begin, report


@contextmanager
def steps(what: str, *, is_quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Progress of steps that are usually fast: a function of the step's name, the number done and the number of all.

    On a terminal it is one bar with the time left, elsewhere a line every 10 s.
    """
    from su3d_bench.runs.executors import Event

    with overall_progress(what, is_quiet=is_quiet, every_s=LINE_EVERY_S) as (begin, report):

        def step(name: str, n_done: int, n_all: int) -> None:
            begin(n_all)
            report(Event(what, name, n_done, n_all))

        yield step


def stepped(names: Sequence[str], what: str, *, is_quiet: bool) -> Iterator[str]:
    """Iterate over ``names`` with the progress of ``steps``."""
    with steps(what, is_quiet=is_quiet) as step:
        for n_done, name in enumerate(names, 1):
            yield name
            step(name, n_done, len(names))


class _Board:
    """Turns events into bars: one for all scenes, one for the current method of each running scene."""

    def __init__(self, bars: Progress, n_scenes: int, last_step: str) -> None:
        self._bars = bars
        self._last_step = last_step
        self._scenes = bars.add_task("scenes", total=n_scenes, remark="starting")
        self._tasks: dict[tuple[str, str], TaskID] = {}

    def report(self, event: Event) -> None:
        from su3d_bench.runs.executors import SCENE_DONE

        self._bars.update(self._scenes, remark=event.activity if event.label == SCENE_DONE else "")
        if event.label == SCENE_DONE:
            if not event.activity:
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
        if event.activity or event.done:
            is_last = event.done == event.total > 0
            self._bars.update(task, remark=event.activity or (is_last and self._last_step) or self._remark(event))

    def _remove(self, unit: str) -> None:
        """Remove the bars of a scene that is done or starts its next method."""
        for key in [key for key in self._tasks if key[0] == unit]:
            self._bars.remove_task(self._tasks.pop(key))

    def _remark(self, event: Event) -> str:
        own = self._tasks[event.unit, event.label]
        speed = next(task.speed for task in self._bars.tasks if task.id == own)
        words = [f"{speed:.1f}/s"] if speed else []
        return ", ".join(words if event.n_instances is None else [*words, counted(event.n_instances, "instance")])
