"""Options of the command line: its parser, the shape of every verb, and the options that several verbs have."""

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

Verbs = Any  # argparse._SubParsersAction of a parser's verbs
Call = Callable[[argparse.Namespace], int | None]  # what a verb does; its exit code, none for done
PATHS = ("FILE", "DIR", "RUN", "PNG", "BUNDLE")
TABLE_FORMATS = ("text", "markdown", "latex", "csv", "html")
LANGUAGE = ("perception", "language")


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are ``ConfigError``, with a suggestion for a misspelt verb or option."""

    def error(self, message: str) -> None:  # type: ignore[override]
        verb = self.prog.partition(" ")[2]
        raise ConfigError(f"{verb}{': ' if verb else ''}{message}; see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """As the base class, but each verb itself refuses what it does not know: it can suggest one of its options."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unknown argument '{unknown[0]}'{nearest(unknown[0], self._option_string_actions)}")
        return parsed, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """As the base class, with a suggestion for a choice that does not exist."""
        if action.choices is not None and value not in action.choices:
            name = action.option_strings[0] if action.option_strings else str(action.metavar or action.dest)
            if isinstance(action, argparse._SubParsersAction):
                name = action.dest
            self.error(f"unknown {name} '{value}'{suggest(str(value), map(str, action.choices))}")

    def option(self, form: str, text: str, group: Any = None, **more: Any) -> None:
        """Add the option or argument that ``form`` writes as help shows it; ``more`` as ``add_argument`` takes it.

        ``group``: of options that exclude each other.
        """
        name, settings = option(form, text, **more)
        (group or self).add_argument(name, **settings)

    def shared(self, *names: str, **changes: Any) -> None:
        """Add options of ``SHARED``; ``changes`` are for a verb in which they cannot be the same."""
        for name in names:
            self.add_argument(name, **SHARED[name] | changes)


class JsonFlag(argparse.Action):
    """``--json``: ``json`` is true where the answer is printed as JSON, ``json_file`` is where it is written."""

    def __init__(self, option_strings: Sequence[str], dest: str, **form: Any) -> None:
        super().__init__(option_strings, dest, nargs="?", default=False, metavar="FILE.json", **form)

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option_string: Any = None
    ) -> None:
        if values is not None and not values.endswith(".json"):
            parser.error(f"--json {values}: a file for JSON ends in .json; to print JSON, write --json last")
        namespace.json, namespace.json_file = values is None, values and Path(values)


def option(form: str, text: str, **more: Any) -> tuple[str, dict[str, Any]]:
    """The name of an option or argument and what ``add_argument`` takes of it, from the form that help shows.

    ``--out FILE`` takes a value, ``RUN...`` one or more, ``[RUN...]`` none or more, ``[DIR]`` none or one. What is
    called FILE, DIR, RUN, PNG or BUNDLE is a path; an option without a value is a switch.

    >>> option("--scenes SCENE...", "these alone")
    ('--scenes', {'help': 'these alone', 'metavar': 'SCENE', 'nargs': '+'})
    >>> option("--per-class", "each class too")
    ('--per-class', {'help': 'each class too', 'action': 'store_true'})
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
    if name.startswith("--") and not value and not {"action", "choices", "nargs"} & more.keys():
        settings["action"] = "store_true"
    return name, settings | more


def add_verb(
    verbs: Verbs, name: str, call: Call, about: str = "", *, uses_all_cores: bool = False, takes_up: bool = False
) -> Parser:
    """A verb's parser, whose help is the docstring of ``call`` or ``about``; with ``--json``, ``--quiet``, ``--debug``.

    Numerical libraries use one thread unless the verb ``uses_all_cores``. One that ``takes_up`` resumes what was
    interrupted; others start again.
    """
    parser = _parser(verbs, name, about or call.__doc__)
    parser.set_defaults(call=call, uses_all_cores=uses_all_cores, takes_up=takes_up, json_file=None)
    parser.add_argument("--json", action=JsonFlag, help="print the answer as JSON; with a file, write it there")
    parser.option("--quiet", "no progress and no remarks on stderr")
    parser.option("--debug", "show the traceback of an error")
    return parser


def add_group(verbs: Verbs, name: str, add: Callable[[Verbs], None], *, lists: bool = False) -> Verbs:
    """The sub-verbs of a verb such as ``datasets``, whose help is the docstring of ``add``, the function that adds it.

    Given alone it does its ``list`` if it ``lists``.
    """
    return _parser(verbs, name, add.__doc__).add_subparsers(dest="action", metavar="VERB", required=not lists)


def _parser(verbs: Verbs, name: str, about: str | None) -> Parser:
    """A parser whose help is ``about``: a summary, an empty line, and examples, a line each."""
    summary, _, examples = (about or "").strip().partition("\n\n")
    summary = " ".join(summary.split())
    parser: Parser = verbs.add_parser(
        name,
        help=summary[:1].lower() + summary[1:].rstrip("."),
        description=summary,
        epilog="\n  ".join(["examples:", *map(str.strip, examples.splitlines())]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return parser


def count(text: str) -> int:
    """The type of an option that is a number from 1 on."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: expected an integer of 1 or more")
    return value


def index(text: str) -> int:
    """The type of an option that is a number from 0 on."""
    if text.isdecimal():
        return int(text)
    raise argparse.ArgumentTypeError(f"{text}: expected an integer of 0 or more")


def positive(text: str) -> float:
    """The type of an option that is a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: expected a number above 0")
    return value


# The options that several verbs have, each with its one help text.
SHARED: dict[str, dict[str, Any]] = dict(
    [
        option("run RUN", "the folder of a run"),
        option("runs RUN...", "folders of finished runs"),
        option("--jobs N", "processes side by side (default: the CPU cores)", type=count),
        option("--device DEVICE", "of models: cpu, cuda (all GPUs, by job) or cuda:1 (default: cpu)"),
        option("--methods METHOD...", "these alone (default: all)", default=[]),
        option("--scenes SCENE...", "these alone, or patterns (default: all)", default=[]),
        option("--protocols PROTOCOL...", "these alone (default: all that fit)", action="extend", default=[]),
        option(
            "--set KEY=VALUE...",
            "settings, such as opensu3d.top_m=10, rooms.n_frames=40 or perception.models.folder=/data/models",
            action="extend",
            default=[],
        ),
        option("--config FILE", "a TOML file of settings, such as the run.toml of a run"),
        option("--run DIR", "run folder (default: the latest in runs/ with the scene)"),
        option("--method METHOD", "whose maps (default: opensu3d)", default="opensu3d"),
        option(
            "--format",
            "of tables (default: text where they are printed, markdown in a file)",
            dest="table_format",
            choices=TABLE_FORMATS,
        ),
        option("--seed N", "of everything random (default: 0)", type=index, default=0),
        option("--limit N", "only the first N updates of each scene; marks it partial", type=int),
        option(
            "--profile PROFILE",
            "who supplies perception: auto, embedded, oracle, stored, paper (default: auto; of a recipe its own)",
        ),
        option(
            "--solver",
            "who answers questions: built-in (geometry alone, the default), or llm, a language model",
            choices=("built-in", "llm"),
        ),
        option("--leave-out FILE", "without the questions that a CSV file lists by their id"),
        option(
            "--text-features FILE",
            "features of class names, for predictions that have features: .npz with names and features",
        ),
        option(
            "--queries FILE",
            "texts and their objects, for protocols without classes: .toml or .csv with scene, text and objects, files "
            "of ScanRefer, Nr3D or OpenLex3D, or .txt with one text per line",
        ),
        option("--executor WHERE", "inline, processes, ray or slurm (default: processes, inline for one job)"),
        option(
            "--ray-address ADDRESS",
            "of a Ray cluster, or local to start one here (default: RAY_ADDRESS, or the one that runs here)",
        ),
        option("--gpus-per-job N", "that ray or slurm gives a scene, such as 0.5", type=float),
        option("--retries N", "of a scene whose machine was lost (default: 2)", type=int),
        option("--slurm KEY=VALUE...", "submitit's, such as slurm_partition=gpu timeout_min=60"),
        option("--offline", "use stored replies of language models, ask nobody", action=argparse.BooleanOptionalAction),
        option("--dry-run", "say what would be done and what it takes, and do nothing"),
    ]
)
SHARED["--table-format"] = SHARED["--format"]  # where --format is of what is read
# Where scenes run; docs/running/clusters.md has more on them.
EXECUTOR = ("--executor", "--ray-address", "--gpus-per-job", "--retries", "--slurm")


def open_map(arguments: argparse.Namespace, verb: str, text: str) -> tuple[RunFolder, JobFolder, Prediction]:
    """The map of ``scene`` by ``--method`` in ``--run``; a ``ConfigError`` where scene and text are swapped."""
    import shlex

    from su3d_bench.runs.finished import map_of_scene
    from su3d_bench.runs.scenes import looks_like_scene

    scene = arguments.scene
    if not looks_like_scene(scene) and looks_like_scene(text):
        command = shlex.join(["su3d-bench", "query", verb, text, scene])
        raise ConfigError(f"'{scene}' is no scene: the scene comes first, then the text; {command}")
    return map_of_scene(scene, arguments.method, arguments.run)


def perception_config(arguments: argparse.Namespace) -> PerceptionConfig:
    """What ``--set`` says of perception, and ``--device`` where the verb has it."""
    from su3d_bench.core.config import Setting, Settings, read_assignments, resolve
    from su3d_bench.perception.profiles import PerceptionConfig

    settings = read_assignments(arguments.set, (), ())
    if getattr(arguments, "device", None) is not None:
        settings += Settings((Setting(("perception", "models", "device"), arguments.device, "--device"),))
    return resolve(settings, ("perception",), PerceptionConfig)


def add_language_options(parser: Parser, default: str = "the paper's gpt-4-1106-preview") -> None:
    """The options of verbs that ask a language model: which, where, at what price."""
    parser.option("--model NAME", f"language model (default: {default})")
    parser.option("--base-url URL", "OpenAI-compatible server (default: $OPENAI_BASE_URL, else OpenAI's)")
    parser.shared("--config", "--set", "--dry-run")
    parser.option("--offline", SHARED["--offline"]["help"])
    parser.option("--ask-failed-again", "ask again what an earlier command failed to get")


def given_language_option(arguments: argparse.Namespace) -> str | None:
    """The first option of ``add_language_options`` that was given."""
    names = ("model", "base_url", "config", "set", "offline", "ask_failed_again", "dry_run")
    return next((f"--{name.replace('_', '-')}" for name in names if getattr(arguments, name)), None)


def chat_client(
    arguments: argparse.Namespace, run: RunFolder, text_model: str | None = None
) -> tuple[ChatClient, LanguageConfig]:
    """The client whose replies are kept in the folder ``language`` of the run, and its settings.

    Those of the file, then ``--set``, then the options; keys of other sections are left to other verbs. ``text_model``
    is asked where none of them names a model.
    """
    from su3d_bench.core.config import Setting, Settings, read_assignments, read_file, resolve
    from su3d_bench.perception.language.chat import LanguageConfig, ReplyStore
    from su3d_bench.perception.language.client import ChatClient

    settings = Settings() if arguments.config is None else read_file(arguments.config)
    assigned = read_assignments(arguments.set, (), ())
    for entry in assigned.entries:
        if entry.path[:2] != LANGUAGE:
            raise ConfigError(f"{entry.source}: only perception.language.KEY=VALUE is of use here")
    flags = [("text_model", "--model", arguments.model), ("base_url", "--base-url", arguments.base_url)]
    given = tuple(Setting((*LANGUAGE, key), value, flag) for key, flag, value in flags if value is not None)
    usual = () if text_model is None else (Setting((*LANGUAGE, "text_model"), text_model, "default"),)
    config = resolve(Settings(usual) + settings + assigned + Settings(given), LANGUAGE, LanguageConfig)
    store = ReplyStore(run.path / "language")
    arguments.takes_up = True  # with every reply that is there
    return ChatClient(config, store, offline=arguments.offline, ask_failed_again=arguments.ask_failed_again), config


def answer_estimate(arguments: argparse.Namespace, client: ChatClient | None, requests: Sequence[ChatRequest]) -> None:
    """Print what asking a language model all ``requests`` would cost, nothing without a client; the exit code."""
    from su3d_bench.cli.output import answer_either
    from su3d_bench.perception.language.client import Estimate

    if client is None:
        nothing = Estimate(n_requests=0, n_stored=0, input_tokens=0, output_tokens=0, usd=0.0, models=())
        answer_either(arguments, nothing.to_json(), "no model is asked: nothing to pay")
    else:
        estimate = client.estimate(requests)
        answer_either(arguments, estimate.to_json(), estimate.line())
