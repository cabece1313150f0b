"""The command line's parser: errors of one line with a suggestion, flags of either spelling, ``--json`` with a file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from su3d_bench.core.errors import ConfigError, nearest, suggest

# A flag is plural where it takes several and ``--jobs`` wherever work is shared out; the other spelling is taken too.
SPELLINGS = {"--methods": "--method", "--protocols": "--protocol", "--scenes": "--scene", "--jobs": "--workers"}
OTHER_SPELLING = SPELLINGS | {other: name for name, other in SPELLINGS.items()}
JSON = "--json"
JSON_SUFFIX = ".json"


class JsonFlag(argparse.Action):
    """``--json``: ``json`` is true where the answer is printed in JSON, ``json_file`` is where it is written."""

    def __init__(self, option_strings: Sequence[str], dest: str, **form: Any) -> None:
        super().__init__(option_strings, dest, nargs="?", default=False, metavar="FILE.json", **form)

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option_string: Any = None
    ) -> None:
        namespace.json = not values
        namespace.json_file = Path(values) if values else None


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are ``ConfigError``, with a suggestion for a misspelt verb or flag."""

    def error(self, message: str) -> None:  # type: ignore[override]
        verb = self.prog.partition(" ")[2]
        raise ConfigError(f"{verb}{': ' if verb else ''}{self._with_suggestion(message)}; see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """As the base class, but a verb itself refuses what it does not know, for it knows what comes near.

        A word after ``--json`` that ends in ``.json`` is the file that the answer is written to, unless it is one that
        is there already and the verb lacks a word without it: ``compare --json A.json B.json``.
        """
        words, guess = self._in_own_words(args or (), takes_file=True)
        try:
            parsed, unknown = self._parsed(words, namespace)
        except ConfigError as error:
            if guess is None or not Path(guess).exists():
                raise
            try:
                parsed, unknown = self._parsed(self._in_own_words(args, takes_file=False)[0], namespace)
            except ConfigError:
                raise error from None
        if JSON in self._option_string_actions:
            parsed.json_is_guess = guess is not None
        return parsed, unknown

    def _parsed(self, words: list[str], namespace: Any) -> tuple[Any, list[str]]:
        parsed, unknown = super().parse_known_args(words, namespace)
        if unknown:
            if f"{JSON}= {unknown[0]}" in f"{' '.join(words)} ":
                self.error(f"'{unknown[0]}' is no word of it; a file for {JSON} is written {JSON}={unknown[0]}")
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, unknown

    def _in_own_words(self, args: Sequence[str], *, takes_file: bool) -> tuple[list[str], str | None]:
        """``args`` with flags as this parser spells them and each ``--json`` closed to the word after it, or joined to
        it where that is its file; that file.
        """
        words, guess = list[str](), None
        known = self._option_string_actions
        for place, word in enumerate(args):
            if word == "--":  # behind it none is a flag
                words += args[place:]
                break
            name, equals, value = word.partition("=")
            other = OTHER_SPELLING.get(name)
            if other in known and name not in known:
                word = f"{other}{equals}{value}"
            elif JSON in known and name.startswith("--js") and JSON.startswith(name):
                word = f"{JSON}={value}"
            if takes_file and words[-1:] == [f"{JSON}="] and word.endswith(JSON_SUFFIX) and not word.startswith("-"):
                words[-1] += word
                guess = word
            else:
                words.append(word)
        return words, guess

    def _with_suggestion(self, message: str) -> str:
        if message.startswith("unrecognized arguments: "):
            word = [*message.removeprefix("unrecognized arguments: ").split(), ""][0]
            return f"unknown argument '{word}'{nearest(word, self._option_string_actions)}"
        return message

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """As the base class, but a choice that is refused is told what there is."""
        if action.choices is not None and value not in action.choices:
            is_verb = isinstance(action, argparse._SubParsersAction)
            names = [*action.option_strings, action.dest] if is_verb or action.option_strings else [action.metavar]
            name = names[0] or action.dest
            self.error(f"unknown {name} '{value}'{suggest(str(value), map(str, action.choices))}")
