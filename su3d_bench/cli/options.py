"""The argument parser, how commands are added to it, and the options that several commands share.

An option has one name and one meaning in all commands, its help up to the parentheses; the name is plural if it takes
several values (``--methods METHOD...``), otherwise singular (``--method METHOD``).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.core.errors import ConfigError, nearest, suggest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from su3d_bench.core.maps import Prediction
    from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig
    from su3d_bench.perception.language.client import ChatClient
    from su3d_bench.perception.profiles import PerceptionConfig
    from su3d_bench.store.run_folder import JobFolder, RunFolder

Verbs = Any  # argparse._SubParsersAction
Call = Callable[[argparse.Namespace], int | None]  # runs a command; returns its exit code or None
PATHS = ("FILE", "DIR", "RUN", "BUNDLE")
TABLE_FORMATS = ("text", "markdown", "latex", "csv", "html")
LANGUAGE = ("perception", "language")


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Shows help texts as they are written, with any percent sign."""

    def _expand_help(self, action: argparse.Action) -> str:
        return action.help or ""


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are ``ConfigError``, with a suggestion for a misspelt command or option."""

    def __init__(self, **form: Any) -> None:
        super().__init__(allow_abbrev=False, **form)

    def error(self, message: str) -> None:  # type: ignore[override]
        verb = self.prog.partition(" ")[2]
        raise ConfigError(f"{verb}{': ' if verb else ''}{message}; see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """As the base class, but each command rejects unknown arguments itself, with a suggestion."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unknown argument '{unknown[0]}'{nearest(unknown[0], self._option_string_actions)}")
        return parsed, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """As the base class, with a suggestion for an invalid choice."""
        if action.choices is not None and value not in action.choices:
            name = action.option_strings[0] if action.option_strings else str(action.metavar or action.dest)
            if isinstance(action, argparse._SubParsersAction):
                name = "command"
                if value == "help":
                    self.print_help()
                    self.exit()
            self.error(f"unknown {name} '{value}'{suggest(str(value), map(str, action.choices))}")

    def option(self, form: str, text: str, group: Any = None, **more: Any) -> None:
        """Add an option or argument in the form that help shows; ``more`` as for ``add_argument``.

        ``group``: a mutually exclusive group.
        """
        name, settings = option(form, text, **more)
        (group or self).add_argument(name, **settings)

    def shared(self, *names: str, **changes: Any) -> None:
        """Add options of ``SHARED``, with ``changes`` to their settings."""
        for name in names:
            self.add_argument(name, **SHARED[name] | changes)


class JsonFlag(argparse.Action):
    """``--json``: ``json`` is true if JSON is printed, ``json_file`` is the file to write it to."""

    def __init__(self, option_strings: Sequence[str], dest: str, **form: Any) -> None:
        super().__init__(option_strings, dest, nargs="?", default=False, metavar="FILE.json", **form)

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option_string: Any = None
    ) -> None:
        if values is not None and not values.endswith(".json"):
            parser.error(f"--json {values}: expected a file that ends in .json; to print JSON, put --json last")
        namespace.json, namespace.json_file = values is None, values and Path(values)


def option(form: str, text: str, **more: Any) -> tuple[str, dict[str, Any]]:
    """The name and the ``add_argument`` settings of an option or argument, from the form that help shows.

    ``--out FILE`` takes one value, ``RUN...`` one or more, ``[RUN...]`` any number, ``[DIR]`` at most one. FILE, DIR,
    RUN and BUNDLE are paths, FIGURE one that ends in .pdf, .png or .svg; an option without a value is a flag.

    >>> option("--scenes SCENE...", "scenes to use")
    ('--scenes', {'help': 'scenes to use', 'metavar': 'SCENE', 'nargs': '+'})
    >>> option("--per-class", "show each class")
    ('--per-class', {'help': 'show each class', 'action': 'store_true'})
    """
    name, _, value = form.partition(" ")
    is_optional = value.startswith("[")
    several = value[1:-1] if is_optional else value
    metavar = several.removesuffix("...")
    settings: dict[str, Any] = {"help": text}
    if metavar:
        settings["metavar"] = metavar
    if is_optional or several != metavar:
        settings["nargs"] = "?" if several == metavar else "*" if is_optional else "+"
    if metavar in PATHS:
        settings["type"] = Path
    if metavar == "FIGURE":
        settings["type"] = figure_path
    if name.startswith("--") and not value and not {"action", "choices", "nargs"} & more.keys():
        settings["action"] = "store_true"
    return name, settings | more


def add_verb(
    verbs: Verbs, name: str, call: Call, about: str = "", *, data: bool = False, resumes: bool = False
) -> Parser:
    """Add a command with ``--json``, ``--quiet`` and ``--debug``; its help is ``about`` or the docstring of ``call``.

    ``resumes``: the command continues after an interruption; others start again. ``data``: it reads datasets, and has
    ``--data``, which replaces ``SU3D_DATA``. Numerical libraries use one thread unless its default ``uses_all_cores``.
    """
    parser = _parser(verbs, name, about or call.__doc__)
    parser.set_defaults(call=call, parser=parser, uses_all_cores=False, resumes=resumes, json_file=None)
    parser.add_argument("--json", action=JsonFlag, help="print JSON, or write it to FILE.json")
    parser.option("--quiet", "show no progress and no warnings")
    parser.option("--debug", "show the traceback of an error")
    if data:
        parser.option("--data DIR", "data root (default: $SU3D_DATA)", type=str)
    return parser


def add_group(verbs: Verbs, name: str, add: Callable[[Verbs], None], *, lists: bool = False) -> Verbs:
    """Add a group of commands such as ``datasets``, whose help is the docstring of ``add``.

    Without a command it runs ``list`` if it ``lists``, otherwise it shows its help.
    """
    parser = _parser(verbs, name, add.__doc__)
    parser.set_defaults(without_command="list" if lists else "--help")
    return parser.add_subparsers(dest="action", metavar="COMMAND", required=False)


def _parser(verbs: Verbs, name: str, about: str | None) -> Parser:
    """A parser whose help is ``about``: a summary, an empty line, and one example per line."""
    summary, _, examples = (about or "").strip().partition("\n\n")
    summary = " ".join(summary.split())
    parser: Parser = verbs.add_parser(
        name,
        help=summary[:1].lower() + summary[1:].rstrip("."),
        description=summary,
        epilog="\n  ".join(["examples:", *map(str.strip, examples.splitlines())]),
        formatter_class=HelpFormatter,
    )
    return parser


def count(text: str) -> int:
    """Option type: an integer of at least 1."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: expected an integer of 1 or more")
    return value


def index(text: str) -> int:
    """Option type: an integer of at least 0."""
    if text.isdecimal():
        return int(text)
    raise argparse.ArgumentTypeError(f"{text}: expected an integer of 0 or more")


def output_path(text: str) -> Path:
    """Option type: a file or folder that the command writes."""
    return Path(text)


def run_folder(text: str) -> Path:
    """Option type: a run folder that the command writes, which may exist."""
    return Path(text)


def figure_path(text: str) -> Path:
    """Option type: a figure that the command writes, in a format that its suffix names."""
    from su3d_bench.reports.pictures.canvas import figure_format

    figure_format(Path(text))
    return Path(text)


def searched_folder(text: str) -> Path:
    """Option type: a folder to search, which may contain the outputs."""
    return Path(text)


def positive(text: str) -> float:
    """Option type: a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: expected a number above 0")
    return value


# Options of several commands, each with one help text.
SHARED: dict[str, dict[str, Any]] = dict(
    [
        option("run RUN", "run folder"),
        option("runs RUN...", "folders of finished runs"),
        option("--jobs N", "number of parallel jobs (default: number of CPU cores)", type=count),
        option("--device DEVICE", "computing device: cpu, cuda or cuda:N (default: cpu)"),
        option("--methods METHOD...", "methods to use (default: all)", default=[]),
        option("--scenes SCENE...", "scenes or patterns to use (default: all)", default=[]),
        option("--protocols PROTOCOL...", "protocols to use (default: all that fit)", action="extend", default=[]),
        option("--all-protocols", "score under all that fit", action="append_const", const="all", dest="protocols"),
        option(
            "--set KEY=VALUE...",
            "settings, such as opensu3d.top_m=10, rooms.n_frames=40 or perception.models.folder=/data",
            action="extend",
            default=[],
        ),
        option("--config FILE", "TOML file of settings, such as the run.toml of a run"),
        option("--run RUN", "run folder (default: the latest in runs/ that has the scene)"),
        option("--method METHOD", "method to use (default: opensu3d)", default="opensu3d"),
        option(
            "--format",
            "table format (default: text; in files markdown)",
            dest="table_format",
            choices=TABLE_FORMATS,
        ),
        option(
            "--width",
            "printed width of the figure, with 8 pt type: one or two columns of a paper (default: 17cm)",
            choices=("8cm", "17cm"),
            default="17cm",
        ),
        option("--seed N", "random seed (default: 0)", type=index, default=0),
        option("--limit N", "process only the first N frames of each scene (results are marked partial)", type=int),
        option(
            "--profile PROFILE",
            "perception profile (embedded: built-in models, paper, stored, oracle; default: auto)",
        ),
        option(
            "--question-solver",
            "how to answer questions: built-in (geometry) or llm (default: built-in)",
            choices=("built-in", "llm"),
        ),
        option(
            "--refiner",
            "labels n' by vote (sum of scores) or model (language model, as in the paper; default: vote)",
            choices=("vote", "model"),
        ),
        option(
            "--text-features FILE",
            ".npz file with features of the class names, for predictions without labels",
        ),
        option(
            "--queries FILE",
            "queries for protocols without classes (.toml, .csv, .txt, ScanRefer, Nr3D, OpenLex3D)",
        ),
        option("--executor WHERE", "where jobs run: inline, processes or slurm (default: processes)"),
        option("--gpus-per-job N", "GPUs per Slurm job (default: 0)", type=int),
        option("--retries N", "number of retries (of a scene whose Slurm job died; default: 2)", type=int),
        option("--slurm KEY=VALUE...", "submitit options, such as slurm_partition=gpu timeout_min=60"),
        option("--offline", "use only stored replies of language models", action=argparse.BooleanOptionalAction),
        option("--dry-run", "show what would be done and what it needs, and exit"),
    ]
)
# Of commands that run methods.
JOBS = "number of parallel jobs (default: one per CPU core, with foundation models on GPUs at most 2 per GPU)"
# Where scenes run; see docs/running/clusters.md.
EXECUTOR = ("--executor", "--gpus-per-job", "--retries", "--slurm")


def open_map(arguments: argparse.Namespace, verb: str, text: str) -> tuple[RunFolder, JobFolder, Prediction]:
    """The map of ``scene`` by ``--method`` in ``--run``; ``ConfigError`` if scene and text are swapped."""
    import shlex

    from su3d_bench.runs.finished import map_of_scene
    from su3d_bench.runs.scenes import looks_like_scene

    scene = arguments.scene
    if not looks_like_scene(scene) and looks_like_scene(text):
        command = shlex.join(["su3d-bench", "query", verb, text, scene])
        raise ConfigError(f"'{scene}' is not a scene; give the scene first, then the text: {command}")
    return map_of_scene(scene, arguments.method, arguments.run)


def perception_config(arguments: argparse.Namespace) -> PerceptionConfig:
    """The perception settings of ``--set`` and ``--device``."""
    from su3d_bench.core.config import Setting, Settings, read_assignments, resolve
    from su3d_bench.perception.profiles import PerceptionConfig

    settings = read_assignments(arguments.set, (), ())
    if getattr(arguments, "device", None) is not None:
        settings += Settings((Setting(("perception", "models", "device"), arguments.device, "--device"),))
    return resolve(settings, ("perception",), PerceptionConfig)


def add_language_options(parser: Parser, default: str = "perception.language.text_model") -> None:
    """Add the options of commands that use a language model."""
    parser.option("--model NAME", f"language model (default: {default})")
    parser.option("--base-url URL", "OpenAI-compatible server (default: $OPENAI_BASE_URL, else OpenAI)")
    parser.shared("--config", "--set", "--dry-run")
    parser.option("--offline", SHARED["--offline"]["help"])
    parser.option("--retry-failed", "repeat requests that failed in an earlier command")


def given_language_option(arguments: argparse.Namespace) -> str | None:
    """The first option of ``add_language_options`` that was set, or None."""
    names = ("model", "base_url", "config", "set", "offline", "retry_failed", "dry_run")
    return next((f"--{name.replace('_', '-')}" for name in names if getattr(arguments, name)), None)


def chat_client(
    arguments: argparse.Namespace, run: RunFolder, text_model: str | None = None
) -> tuple[ChatClient, LanguageConfig]:
    """The client, which stores replies in the folder ``language`` of the run, and its settings.

    Options override ``--set``, which overrides the file. ``text_model`` is the default model.
    """
    from su3d_bench.core.config import Setting, Settings, read_assignments, read_file, resolve
    from su3d_bench.perception.language.chat import LanguageConfig, ReplyStore
    from su3d_bench.perception.language.client import ChatClient

    settings = Settings() if arguments.config is None else read_file(arguments.config)
    assigned = read_assignments(arguments.set, (), ())
    for entry in assigned.entries:
        if entry.path[:2] != LANGUAGE:
            raise ConfigError(f"{entry.source}: only perception.language.KEY=VALUE can be set here")
    flags = [("text_model", "--model", arguments.model), ("base_url", "--base-url", arguments.base_url)]
    given = tuple(Setting((*LANGUAGE, key), value, flag) for key, flag, value in flags if value is not None)
    usual = () if text_model is None else (Setting((*LANGUAGE, "text_model"), text_model, "default"),)
    config = resolve(Settings(usual) + settings + assigned + Settings(given), LANGUAGE, LanguageConfig)
    store = ReplyStore(run.path / "language")
    arguments.resumes = True  # from the stored replies
    return ChatClient(config, store, offline=arguments.offline, retry_failed=arguments.retry_failed), config


def answer_estimate(arguments: argparse.Namespace, client: ChatClient | None, requests: Sequence[ChatRequest]) -> None:
    """Print the cost of sending all ``requests`` to a language model; zero without a client."""
    from su3d_bench.cli.output import answer_either
    from su3d_bench.perception.language.client import Estimate

    if client is None:
        nothing = Estimate(n_requests=0, n_stored=0, input_tokens=0, output_tokens=0, usd=0.0, models=())
        answer_either(arguments, nothing.to_json(), "no language model is used: no cost")
    else:
        estimate = client.estimate(requests)
        answer_either(arguments, estimate.to_json(), estimate.line())
