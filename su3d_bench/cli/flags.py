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
