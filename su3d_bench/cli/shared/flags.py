"""What parsers of verbs share: their shape, and flags that several have."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.parser import JSON, JsonFlag

if TYPE_CHECKING:
    pass

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


def add_modules(
    verbs: Any,
    name: str,
    summary: str,
    modules: Sequence[ModuleType],
    examples: tuple[str, str],
    *,
    lists: bool = False,
) -> None:
    """A verb whose sub-verbs are ``modules`` with ``add_parser(actions)``."""
    actions = add_group(verbs, name, summary, examples, lists=lists)
    for module in modules:
        module.add_parser(actions)


def add_group(
    verbs: Any, name: str, summary: str, examples: tuple[str, str], *, lists: bool = False
) -> argparse._SubParsersAction[argparse.ArgumentParser]:
    """The sub-verbs' parsers of a verb such as ``datasets``, which given alone does its ``list`` if it ``lists``."""
    parser = _parser(verbs, name, summary, examples)
    return parser.add_subparsers(dest="action", metavar="VERB", required=not lists)


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
    from su3d_bench.runs.scenes import looks_like_scene

    if not looks_like_scene(scene) and looks_like_scene(text):
        command = shlex.join(["su3d-bench", *verb.split(), text, scene])
        raise ConfigError(f"'{scene}' is no scene: the scene comes first, then the text; {command}")


def add_table_format(parser: argparse.ArgumentParser, flag: str = "--format") -> None:
    """The form in which a verb gives its tables; the flag has another name where ``--format`` means the input's."""
    parser.add_argument(
        flag,
        dest="table_format",
        choices=TABLE_FORMATS,
        help="of tables (default: text where they are printed, markdown in a file)",
    )
