"""Options of the command line: its parser, the shape of every verb, and the options that several verbs have."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.core.errors import EXIT_DONE, ConfigError, nearest, suggest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from su3d_bench.core.maps import Prediction
    from su3d_bench.perception.language.chat import ChatRequest, LanguageConfig
    from su3d_bench.perception.language.client import ChatClient
    from su3d_bench.perception.profiles import PerceptionConfig
    from su3d_bench.store.run_folder import JobFolder, RunFolder

Verbs = Any  # argparse._SubParsersAction of a parser's verbs
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


def add_verb(
    verbs: Verbs,
    name: str,
    summary: str,
    examples: tuple[str, str],
    call: Callable[[argparse.Namespace], int],
    *,
    uses_all_cores: bool = False,
    takes_up: bool = False,
) -> argparse.ArgumentParser:
    """A verb's parser: help that ends with two examples, ``--json``, ``--quiet`` and ``--debug``.

    Numerical libraries use one thread unless the verb ``uses_all_cores``. One that ``takes_up`` resumes what was
    interrupted; others start again.
    """
    parser = _parser(verbs, name, summary, examples)
    parser.set_defaults(call=call, uses_all_cores=uses_all_cores, takes_up=takes_up, json_file=None)
    parser.add_argument("--json", action=JsonFlag, help="print the answer as JSON; with a file, write it there")
    parser.add_argument("--quiet", action="store_true", help="no progress and no remarks on stderr")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def add_group(verbs: Verbs, name: str, summary: str, examples: tuple[str, str], *, lists: bool = False) -> Verbs:
    """The sub-verbs of a verb such as ``datasets``, which given alone does its ``list`` if it ``lists``."""
    parser = _parser(verbs, name, summary, examples)
    return parser.add_subparsers(dest="action", metavar="VERB", required=not lists)


def _parser(verbs: Verbs, name: str, summary: str, examples: tuple[str, str]) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(
        name,
        help=summary[:1].lower() + summary[1:].rstrip("."),
        description=summary,
        epilog="examples:\n" + "\n".join(f"  {example}" for example in examples),
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
SHARED: dict[str, dict[str, Any]] = {
    "--jobs": {"type": count, "metavar": "N", "help": "processes side by side (default: the CPU cores)"},
    "--device": {"metavar": "DEVICE", "help": "of models: cpu, cuda (all GPUs, by job) or cuda:1 (default: cpu)"},
    "--methods": {"nargs": "+", "default": [], "metavar": "METHOD", "help": "these alone (default: all)"},
    "--scenes": {"nargs": "+", "default": [], "metavar": "SCENE", "help": "these alone, or patterns (default: all)"},
    "--protocols": {
        "nargs": "+",
        "action": "extend",
        "default": [],
        "metavar": "PROTOCOL",
        "help": "these alone (default: all that fit)",
    },
    "--set": {
        "nargs": "+",
        "action": "extend",
        "default": [],
        "metavar": "KEY=VALUE",
        "help": "settings, such as opensu3d.top_m=10, rooms.n_frames=40 or perception.models.folder=/data/models",
    },
    "--config": {"type": Path, "metavar": "FILE", "help": "a TOML file of settings, such as the run.toml of a run"},
    "--run": {"type": Path, "metavar": "DIR", "help": "run folder (default: the latest in runs/ with the scene)"},
    "--method": {"default": "opensu3d", "metavar": "METHOD", "help": "whose maps (default: opensu3d)"},
    "--format": {
        "dest": "table_format",
        "choices": TABLE_FORMATS,
        "help": "of tables (default: text where they are printed, markdown in a file)",
    },
    "--seed": {"type": index, "default": 0, "metavar": "N", "help": "of everything random (default: 0)"},
    "--limit": {"type": int, "metavar": "N", "help": "only the first N updates of each scene; marks it partial"},
    "--profile": {
        "metavar": "PROFILE",
        "help": "who supplies perception: auto, embedded, oracle, stored, paper (default: auto; of a recipe its own)",
    },
    "--solver": {
        "choices": ("built-in", "llm"),
        "help": "who answers questions: built-in (geometry alone, the default), or llm, a language model",
    },
    "--leave-out": {
        "type": Path,
        "metavar": "FILE",
        "help": "without the questions that a CSV file lists by their id",
    },
    "--text-features": {
        "type": Path,
        "metavar": "FILE",
        "help": "features of class names, for predictions that have features: .npz with names and features",
    },
    "--queries": {
        "type": Path,
        "metavar": "FILE",
        "help": "texts and their objects, for protocols without classes: .toml or .csv with scene, text and "
        "objects, files of ScanRefer, Nr3D or OpenLex3D, or .txt with one text per line",
    },
    "--executor": {
        "metavar": "WHERE",
        "help": "inline, processes, ray or slurm (default: processes, inline for one job)",
    },
    "--ray-address": {
        "metavar": "ADDRESS",
        "help": "of a Ray cluster, or local to start one here (default: RAY_ADDRESS, or the one that runs here)",
    },
    "--gpus-per-job": {"type": float, "metavar": "N", "help": "that ray or slurm gives a scene, such as 0.5"},
    "--retries": {"type": int, "metavar": "N", "help": "of a scene whose machine was lost (default: 2)"},
    "--slurm": {
        "nargs": "+",
        "metavar": "KEY=VALUE",
        "help": "submitit's, such as slurm_partition=gpu timeout_min=60",
    },
    "--offline": {
        "action": argparse.BooleanOptionalAction,
        "help": "use stored replies of language models, ask nobody",
    },
    "--dry-run": {"action": "store_true", "help": "say what would be done and what it takes, and do nothing"},
}
SHARED["--table-format"] = SHARED["--format"]  # where --format is of what is read
# Where scenes run; docs/running/clusters.md has more on them.
EXECUTOR = ("--executor", "--ray-address", "--gpus-per-job", "--retries", "--slurm")


def add_options(parser: argparse.ArgumentParser, *names: str, **changes: Any) -> None:
    """Options of ``SHARED``; ``changes`` are for a verb in which they cannot be the same, such as ``required``."""
    for name in names:
        parser.add_argument(name, **{**SHARED[name], **changes})


def add_runs(parser: argparse.ArgumentParser, nargs: str | None = "+") -> None:
    """Folders of finished runs: ``runs``, or ``run`` without ``nargs``."""
    if nargs is None:
        parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run")
    else:
        parser.add_argument("runs", nargs=nargs, type=Path, metavar="RUN", help="folders of finished runs")


def add_out(parser: argparse.ArgumentParser, metavar: str, what: str, **more: Any) -> None:
    """``--out``: where the verb writes, a FILE or a DIR."""
    parser.add_argument("--out", type=Path, metavar=metavar, help=what, **more)


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


def add_language_options(parser: argparse.ArgumentParser, default: str = "the paper's gpt-4-1106-preview") -> None:
    """The options of verbs that ask a language model: which, where, at what price."""
    parser.add_argument("--model", metavar="NAME", help=f"language model (default: {default})")
    parser.add_argument(
        "--base-url", metavar="URL", help="OpenAI-compatible server (default: $OPENAI_BASE_URL, else OpenAI's)"
    )
    add_options(parser, "--config", "--set", "--dry-run")
    parser.add_argument("--offline", action="store_true", help=SHARED["--offline"]["help"])
    parser.add_argument(
        "--ask-failed-again", action="store_true", help="ask again what an earlier command failed to get"
    )


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


def answer_estimate(arguments: argparse.Namespace, client: ChatClient | None, requests: Sequence[ChatRequest]) -> int:
    """Print what asking a language model all ``requests`` would cost, nothing without a client; the exit code."""
    from su3d_bench.cli.output import answer_either
    from su3d_bench.perception.language.client import Estimate

    if client is None:
        nothing = Estimate(n_requests=0, n_stored=0, input_tokens=0, output_tokens=0, usd=0.0, models=())
        answer_either(arguments, nothing.to_json(), "no model is asked: nothing to pay")
    else:
        estimate = client.estimate(requests)
        answer_either(arguments, estimate.to_json(), estimate.line())
    return EXIT_DONE
