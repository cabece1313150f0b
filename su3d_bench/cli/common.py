"""What verbs share: their parser's shape, common flags, answers on stdout."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from su3d_bench.cli.parser import JSON, JsonFlag
from su3d_bench.core.errors import EXIT_DONE, StoreError, counted, printable, shown
from su3d_bench.core.printing import Door, escaped_json, one_line, stream_behind, terminal_width
from su3d_bench.core.system.files import file_text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from su3d_bench.perception.language.chat import ChatRequest
    from su3d_bench.perception.language.client import ChatClient
    from su3d_bench.perception.language.config import LanguageConfig
    from su3d_bench.reports.tables.model import Prose, Table
    from su3d_bench.runs.executors.local import Event, Report
    from su3d_bench.store.run_folder import RunFolder

MOST_UNSEEN = 8  # words that are named
MOST_OF_A_BAR = 80  # characters of its words
WIDE, BAR, NARROW_BAR = 100, 24, 12  # characters: a terminal with room for a long bar, and both bars
MOST_OF_AN_ANSWER = 1 << 28  # bytes of a file that is looked at before it is replaced
TABLE_FORMATS = ("text", "markdown", "latex", "csv", "html")


def add_verb(
    verbs: Any,
    name: str,
    summary: str,
    examples: tuple[str, str],
    call: Callable[[argparse.Namespace], int],
    *,
    uses_all_cores: bool = False,
    takes_up: bool = False,
) -> argparse.ArgumentParser:
    """A verb's parser: help that ends with two examples, ``--json``, ``--quiet`` and ``--debug``.

    Numerical libraries are held to one thread unless the verb ``uses_all_cores``. One that ``takes_up`` goes on where
    it was interrupted; others begin anew.
    """
    parser = _parser(verbs, name, summary, examples)
    parser.set_defaults(call=call, uses_all_cores=uses_all_cores, takes_up=takes_up, json_file=None)
    parser.add_argument(JSON, action=JsonFlag, help="answer in JSON; with a file, write that there")
    parser.add_argument("--quiet", action="store_true", help="no progress and no remarks on stderr")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def add_modules(verbs: Any, name: str, summary: str, modules: Sequence[ModuleType], examples: tuple[str, str]) -> None:
    """A verb whose sub-verbs are ``modules`` with ``NAME`` and ``add_parser(actions)``."""
    actions = add_group(verbs, name, summary, "|".join(module.NAME for module in modules), examples)
    for module in modules:
        module.add_parser(actions)


def add_group(
    verbs: Any, name: str, summary: str, actions: str, examples: tuple[str, str]
) -> argparse._SubParsersAction[argparse.ArgumentParser]:
    """The sub-verbs' parsers of a verb such as ``datasets``; ``actions`` names them, ``list|check``."""
    parser = _parser(verbs, name, summary, examples)
    return parser.add_subparsers(dest="action", metavar=actions, required=True)


def _parser(verbs: Any, name: str, summary: str, examples: tuple[str, str]) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(
        name,
        help=summary[:1].lower() + summary[1:].rstrip("."),
        description=summary,
        epilog="examples:\n" + "\n".join(f"  {example}" for example in examples),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return parser


def add_settings(parser: argparse.ArgumentParser, description: str) -> None:
    """``--set KEY=VALUE...``, which may be given several times; ``description`` says whose settings."""
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help=description)


def add_protocols(parser: argparse.ArgumentParser, description: str, metavar: str = "P") -> None:
    """``--protocols NAME...``, which may be given several times; ``description`` says what is done under them."""
    parser.add_argument("--protocols", nargs="+", action="extend", default=[], metavar=metavar, help=description)


def add_whose_map(parser: argparse.ArgumentParser) -> None:
    """``--run`` and ``--method``: the map that is asked."""
    parser.add_argument(
        "--run", type=Path, metavar="DIR", help="run folder (default: the latest in runs/ with the scene)"
    )
    parser.add_argument("--method", default="opensu3d", help="whose map (default: opensu3d)")


def check_scene_first(verb: str, scene: str, text: str) -> None:
    """A ``ConfigError`` where what stands in the scene's place of ``verb`` is none, and what stands behind it is."""
    import shlex

    from su3d_bench.core.errors import ConfigError
    from su3d_bench.runs.planning.scenes import looks_like_scene

    if not looks_like_scene(scene) and looks_like_scene(text):
        command = shlex.join(["su3d-bench", verb, text, scene])
        raise ConfigError(f"'{scene}' is no scene: the scene comes first, then the text; {command}")


def add_table_format(parser: argparse.ArgumentParser, flag: str = "--format") -> None:
    """The form in which a verb gives its tables; the flag has another name where ``--format`` means the input's."""
    parser.add_argument(
        flag,
        dest="table_format",
        choices=TABLE_FORMATS,
        help="of tables (default: text where they are printed, markdown in a file)",
    )


def formatted(parts: Sequence[Table | Prose], arguments: argparse.Namespace, *, is_file: bool = False) -> str:
    """The tables in the form of ``add_table_format``; ``is_file`` where they are not printed."""
    from su3d_bench.reports.tables.formats import FORMATS, plain

    form = arguments.table_format or ("markdown" if is_file else "text")
    return plain(parts, terminal_width()) if form == "text" and not is_file else FORMATS[form](parts)


def answer(*lines: str) -> None:
    """Print an answer to stdout, a line each, whatever stands in them."""
    print("\n".join(map(one_line, lines)))


def answer_document(text: str) -> None:
    """Print to stdout what is of several lines by its form, which lets none of a name's through, such as a table."""
    answer(*text.rstrip("\n").split("\n"))


def answer_json(arguments: argparse.Namespace, value: Any) -> bool:
    """Give ``value`` as ``--json`` asks for it: on stdout, or in its file; whether it stands in place of the words.

    A file that the flag may not have meant, and that holds something else than such an answer, stays as it is.
    """
    text = escaped_json(_defined(value), indent=2, allow_nan=False)
    file: Path | None = arguments.json_file
    if file is not None:
        try:
            _refuse_to_replace(file, value, is_guess=arguments.json_is_guess)
        except StoreError:
            print(text)  # what was computed is not lost
            raise
        path = written(file, f"{text}\n")
        remark(f"written: {path}", quiet=arguments.quiet)
    if arguments.json:
        print(text)
    return bool(arguments.json)


def _defined(value: Any) -> Any:
    """``value`` with null for a number that is none, which JSON does not know."""
    if isinstance(value, dict):
        return {name: _defined(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_defined(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _refuse_to_replace(file: Path, value: Any, *, is_guess: bool) -> None:
    from su3d_bench.store.run_folder import refuse_records

    refuse_records(file)
    if is_guess and not _is_earlier_answer(file, value):
        raise StoreError(
            f"{shown(file)}: is there and no earlier answer of this command, so it stays as it is and the answer went "
            f"to stdout; to replace it, write --json={shown(file)}"
        )


def _is_earlier_answer(file: Path, value: Any) -> bool:
    """Whether nothing is lost where ``value`` takes the place of ``file``: there is none, or one of the same keys."""
    try:
        if file.stat().st_size > MOST_OF_AN_ANSWER:
            return False
        held = json.loads(file_text(file))
    except FileNotFoundError:
        return True
    except (OSError, ValueError, RecursionError):
        return False
    return not held or _have_one_form(held, value)


def _have_one_form(held: Any, value: Any) -> bool:
    """Whether both are tables of which one has all keys of the other, or lists of such."""
    if isinstance(held, list) and isinstance(value, list):
        return not held or not value or _have_one_form(held[0], value[0])
    if isinstance(held, dict) and isinstance(value, dict):
        return held.keys() <= value.keys() or value.keys() <= held.keys()
    return type(held) is type(value)


def answer_either(arguments: argparse.Namespace, value: Any, *lines: str) -> None:
    """Give ``value`` as ``--json`` asks for it, and ``lines`` unless it is printed."""
    if not answer_json(arguments, value):
        answer(*lines)


def answer_tables(arguments: argparse.Namespace, value: Any, parts: Sequence[Table | Prose]) -> None:
    """Give ``value`` as ``--json`` asks for it, and the tables unless it is printed."""
    if not answer_json(arguments, value):
        answer_document(formatted(parts, arguments))


def show() -> None:
    """Have what was answered so far shown, before something that takes its time."""
    sys.stdout.flush()


def answer_commands(lines: Sequence[str]) -> None:
    """Print commands to the machine that runs the job, which escape what they quote."""
    for line in lines:
        sys.stdout.write_command(line) if isinstance(sys.stdout, Door) else print(line)


def answer_estimate(arguments: argparse.Namespace, client: ChatClient, requests: Sequence[ChatRequest]) -> int:
    """Print what asking a language model all ``requests`` would cost; the exit code."""
    estimate = client.estimate(requests)
    answer_either(arguments, estimate.to_json(), estimate.line())
    return EXIT_DONE


def answer_nothing_to_pay(arguments: argparse.Namespace, who: str) -> int:
    """Say that ``who`` asks no language model; the exit code."""
    from su3d_bench.perception.language.spending import Estimate

    nothing = Estimate(n_requests=0, n_stored=0, input_tokens=0, output_tokens=0, usd=0.0, models=())
    answer_either(arguments, nothing.to_json(), f"{who} asks no model: nothing to pay")
    return EXIT_DONE


def written(path: Path, text: str) -> Path:
    """Write ``text`` to a file that a flag named, with its folder; its path."""
    from su3d_bench.store.atomic import make_folder, write_text
    from su3d_bench.store.run_folder import refuse_records

    refuse_records(path)
    make_folder(path.parent)
    write_text(path, text)
    return path


def answer_or_write(arguments: argparse.Namespace, value: Any, parts: Sequence[Table | Prose]) -> None:
    """Write the tables to the file of ``--out``, or give them as ``answer_tables`` does."""
    if arguments.out is None:
        answer_tables(arguments, value, parts)
    else:
        path = written(arguments.out, formatted(parts, arguments, is_file=True))
        remark(f"written: {path}", quiet=arguments.quiet)
        answer_json(arguments, value)


def file_name_of(text: str, kind: Literal["text", "question"]) -> str:
    """What a picture of the answer to ``text`` is called; no two texts of a kind have one name.

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
    """What a picture of a scene is called; no two addresses have one name.

    >>> file_name_of_scene("replica/room0"), file_name_of_scene("mine/hall/left")
    ('replica-room0', 'mine-hall-left-f6ee616f')
    """
    if re.fullmatch(r"[A-Za-z0-9_]+/[A-Za-z0-9_.-]+", address):
        return address.replace("/", "-")
    return f"{re.sub(r'[^A-Za-z0-9_.-]+', '-', address).lstrip('-.')[:120]}-{_few_digits(address)}"


def _few_digits(text: str) -> str:
    from su3d_bench.core.digests import digest_bytes

    return digest_bytes(text.encode("utf-8", "surrogatepass"))[:8]


def remark(text: str, *, quiet: bool = False) -> None:
    """Print a remark to stderr."""
    if not quiet:
        print(one_line(text), file=sys.stderr)


def remark_unseen(encoder: object, text: str, *, quiet: bool) -> None:
    """Say which words of ``text`` the encoder never saw, where it knows that."""
    from su3d_bench.core.interfaces import KnowsItsWords

    if isinstance(encoder, KnowsItsWords) and (words := encoder.unseen_words(text)):
        named = ", ".join(f"'{printable(word, 40)}'" for word in words[:MOST_UNSEEN])
        more = f" and {len(words) - MOST_UNSEEN} more" if len(words) > MOST_UNSEEN else ""
        remark(f"encoder {encoder.name} never saw {named}{more}; what it makes of that is a guess", quiet=quiet)


PREFIX = ("perception", "language")


def add_language_flags(parser: argparse.ArgumentParser) -> None:
    """``--model``, ``--base-url``, ``--config``, ``--set``, ``--offline``, ``--ask-failed-again``, ``--dry-run``."""
    parser.add_argument("--model", metavar="NAME", help="language model (default: the paper's gpt-4-1106-preview)")
    parser.add_argument(
        "--base-url", metavar="URL", help="OpenAI-compatible server (default: $OPENAI_BASE_URL, else OpenAI's)"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="a TOML file with [perception.language]")
    add_settings(parser, "such as perception.language.budget_usd=0.5")
    parser.add_argument("--offline", action="store_true", help="stored replies only; nobody is asked")
    parser.add_argument(
        "--ask-failed-again", action="store_true", help="ask again what an earlier command asked in vain"
    )
    parser.add_argument("--dry-run", action="store_true", help="say what asking would cost, and ask nothing")


def chat_client(arguments: argparse.Namespace, run: RunFolder) -> tuple[ChatClient, LanguageConfig]:
    """The client whose replies are kept in the folder ``language`` of the run, and its settings.

    Those of the file, then ``--set``, then the flags; keys of other sections are left to other verbs.
    """
    from su3d_bench.core.config import Setting, Settings, read_assignments, read_file, resolve
    from su3d_bench.core.errors import ConfigError
    from su3d_bench.perception.language.client import ChatClient
    from su3d_bench.perception.language.config import LanguageConfig
    from su3d_bench.perception.language.reply_store import ReplyStore

    settings = Settings() if arguments.config is None else read_file(arguments.config)
    assigned = read_assignments(arguments.set, (), ())
    for entry in assigned.entries:
        if entry.path[:2] != PREFIX:
            raise ConfigError(f"{entry.source}: only perception.language.KEY=VALUE is of use here")
    flags = [("text_model", "--model", arguments.model), ("base_url", "--base-url", arguments.base_url)]
    given = tuple(Setting((*PREFIX, key), value, flag) for key, flag, value in flags if value is not None)
    config = resolve(settings + assigned + Settings(given), PREFIX, LanguageConfig)
    store = ReplyStore(run.path / "language")
    arguments.takes_up = True  # with every reply that is there
    return ChatClient(config, store, offline=arguments.offline, ask_failed_again=arguments.ask_failed_again), config


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
        from su3d_bench.runs.executors.local import SCENE_DONE

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
