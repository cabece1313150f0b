"""Random arguments for the verbs of the command line: valid, odd, and arbitrary ones."""

from __future__ import annotations

import argparse
import random
from collections.abc import Iterator

from mutations import NUMBERS, TEXTS

from su3d_bench.cli.main import build_parser

ODD = (*NUMBERS, *TEXTS, "-", "--", "--x", "a=b", "=", "a.b.c=1", "@", "a@b@c", "x" * 300, "a/" * 2000)
# Words that are valid or nearly valid somewhere; nothing that would start long work.
KNOWN = (
    *(
        "opensu3d",
        "oracle",
        "opensu3d@top_m=1",
        "opensu3d@top_m=nan",
        "command",
        "all",
        "rooms",
        "replica",
        "rooms/none9",
    ),
    *(
        "replica/*",
        "*/*",
        "rooms-semantic",
        "rooms-instance",
        "no-such-protocol",
        "embedded",
        "paper",
        "cpu",
        "cuda:99",
    ),
    *("a.toml", "a.json", "a.csv", "a.tex", "folder", "folder/none", "a.py:A", "broken.py:A", "opensu3d.top_m=3"),
    *("opensu3d.top_m=x", "top_m=1,2", "perception.cache=1", "markdown"),
)


def verbs() -> Iterator[tuple[tuple[str, ...], argparse.ArgumentParser]]:
    """Every verb with its sub-verbs, and its parser."""
    open_ends: list[tuple[tuple[str, ...], argparse.ArgumentParser]] = [((), build_parser())]
    while open_ends:
        words, parser = open_ends.pop()
        deeper = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
        for action in deeper:
            open_ends += [((*words, name), below) for name, below in action.choices.items()]
        if not deeper:
            yield words, parser


def drawn_words(parser: argparse.ArgumentParser, rng: random.Random) -> list[str]:
    """Some flags of a verb and some positional words; never ``--debug``, which shows tracebacks."""
    words: list[str] = []
    flags = [one for one in parser._actions if one.dest not in ("help", "version", "debug")]
    for action in rng.sample(flags, min(len(flags), rng.randrange(4))):
        words += [rng.choice(action.option_strings)] if action.option_strings else []
        known = [str(one) for one in action.choices] if action.choices else list(KNOWN)
        n = 0 if action.nargs == 0 else rng.randrange(3) if action.nargs in ("+", "*") else 1
        words += [rng.choice(known if rng.random() < 0.7 else ODD) for _ in range(n)]
    return words
