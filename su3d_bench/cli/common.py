"""What verbs share: their parser's shape, common flags, answers on stdout."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def add_verb(
    verbs: Any,
    name: str,
    summary: str,
    examples: tuple[str, str],
    call: Callable[[argparse.Namespace], int],
    *,
    json_to_file: bool = False,
) -> argparse.ArgumentParser:
    """A verb's parser: help that ends with two examples, ``--json``, ``--quiet`` and ``--debug``.

    ``json_to_file``: ``--json`` takes a file to write the answer to, instead of answering in JSON.
    """
    parser: argparse.ArgumentParser = verbs.add_parser(
        name,
        help=summary[:1].lower() + summary[1:].rstrip("."),
        description=summary,
        epilog="examples:\n" + "\n".join(f"  {example}" for example in examples),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(call=call)
    if json_to_file:
        parser.add_argument("--json", type=Path, metavar="FILE", help="write the answer to a JSON file too")
    else:
        parser.add_argument("--json", action="store_true", help="answer in JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress and no remarks on stderr")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def add_group(
    verbs: Any, name: str, summary: str, actions: str, examples: tuple[str, str]
) -> argparse._SubParsersAction[argparse.ArgumentParser]:
    """The sub-verbs' parsers of a verb such as ``datasets``; ``actions`` names them, ``list|check``."""
    parser = verbs.add_parser(
        name,
        help=summary[:1].lower() + summary[1:].rstrip("."),
        description=summary,
        epilog="examples:\n" + "\n".join(f"  {example}" for example in examples),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    group: argparse._SubParsersAction[argparse.ArgumentParser] = parser.add_subparsers(
        dest="action", metavar=actions, required=True
    )
    return group


def add_settings(parser: argparse.ArgumentParser, description: str) -> None:
    """``--set KEY=VALUE...``, which may be given several times; ``description`` says whose settings."""
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help=description)


def add_whose_map(parser: argparse.ArgumentParser) -> None:
    """``--run`` and ``--method``: the map that is asked."""
    parser.add_argument(
        "--run", type=Path, metavar="DIR", help="run folder (default: the latest in runs/ with the scene)"
    )
    parser.add_argument("--method", default="opensu3d", help="whose map (default: opensu3d)")


def answer(text: str) -> None:
    """Print an answer to stdout."""
    print(text.rstrip("\n"))


def answer_json(value: Any) -> None:
    """Print ``value`` as JSON to stdout."""
    answer(json.dumps(value, indent=2, ensure_ascii=False))


def remark(text: str, *, quiet: bool = False) -> None:
    """Print a remark to stderr."""
    if not quiet:
        print(text, file=sys.stderr)
