"""Answers on stdout and in files, remarks on stderr."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from su3d_bench.core.errors import StoreError, printable, shown
from su3d_bench.core.printing import Door, escaped_json, one_line, terminal_width
from su3d_bench.core.system.files import file_text

if TYPE_CHECKING:
    from su3d_bench.formats.tables.table import Prose, Table

MOST_UNSEEN = 8  # words that are named


MOST_OF_AN_ANSWER = 1 << 28  # bytes of a file that is looked at before it is replaced


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


def written(path: Path, text: str) -> Path:
    """Write ``text`` to a file that a flag named, with its folder; its path."""
    from su3d_bench.core.files.atomic import make_folder, write_text
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
