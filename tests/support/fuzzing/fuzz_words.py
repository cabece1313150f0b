"""Argument vectors for every verb, drawn from the parser itself: known flags, values of every right and wrong kind."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from fuzz_mutations import NUMBERS, TEXTS
from hypothesis import strategies as st
from places import SCENES

from su3d_bench.cli.main import build_parser

ODD = (
    *NUMBERS,
    *TEXTS,
    "-",
    "--",
    "---",
    "-1",
    "--x",
    "a=b",
    "=",
    "a.b.c=1",
    "@",
    "a@b@c",
    "a@",
    "x" * 300,
    "a/" * 2000,
)
# what is the right word of some place, or nearly so; nothing that would start long work
KNOWN = (
    *("opensu3d", "oracle", "opensu3d@scheme1", "opensu3d@top_m=1", "opensu3d@top_m=nan", "command", "all", "sam3d"),
    *(
        "rooms",
        "replica",
        "scannet",
        "rooms/none9",
        "rooms/living",
        "replica/*",
        "replica/room0",
        "rgbd/x",
        "tum/[",
        "*/*",
    ),
    *("rooms-semantic", "rooms-instance", "no-such-protocol", "embedded", "stored", "paper", "cpu", "cuda:99", "auto"),
    *(
        "a.toml",
        "a.json",
        "a.csv",
        "a.tex",
        "folder",
        "folder/none",
        "a.py:A",
        "broken.py:A",
        f"{SCENES}/painted.py:None",
    ),
    *(
        "opensu3d.top_m=3",
        "opensu3d.top_m=x",
        "perception.cache=1",
        "top_m=1,2",
        "method.x=1",
        "replica.a=1",
        "markdown",
    ),
)
# A verb whose work could begin with nothing more than its name ends with words that keep it from that.
HELD_BACK = {
    ("run",): ["--scenes", "replica/none", "--dry-run"],
    ("ablate",): ["--scenes", "replica/none", "--dry-run"],
    ("query", "make"): ["--scenes", "replica/none"],
    ("query", "audit"): ["--scenes", "replica/none"],
    ("datasets", "make"): ["--scenes", "none/none", "--out", "folder/out"],
}


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


def values(folder_words: tuple[str, ...] = KNOWN) -> st.SearchStrategy[str]:
    return st.one_of(st.sampled_from(folder_words), st.sampled_from(ODD), st.text(max_size=8), st.integers().map(str))


def given_flag(action: argparse.Action) -> st.SearchStrategy[list[str]]:
    name = st.sampled_from(action.option_strings)
    if action.nargs == 0:
        return name.map(lambda one: [one])
    one = st.sampled_from(tuple(map(str, action.choices))) | values() if action.choices else values()
    most = 3 if action.nargs in ("+", "*") or isinstance(action.nargs, int) else 1
    return st.builds(lambda flag, words: [flag, *words], name, st.lists(one, min_size=most > 1, max_size=most))


def _joined(parts: list[list[str]]) -> list[str]:
    return [word for part in parts for word in part]


def vectors(words: tuple[str, ...], parser: argparse.ArgumentParser) -> st.SearchStrategy[list[str]]:
    """Arguments of one verb: some of its flags, some words in their places; never ``--debug``, which shows tracebacks.

    Hypothesis draws texts from the constants of the code too, so that it would come as a word.
    """
    flags = [one for one in parser._actions if one.option_strings and one.dest not in ("help", "version", "debug")]
    placed = [one for one in parser._actions if not one.option_strings]
    parts: list[st.SearchStrategy[list[str]]] = []
    for action in placed:
        known = st.sampled_from(tuple(map(str, action.choices))) if action.choices else values()
        parts.append(st.lists(known | values() if action.choices else known, max_size=2))
    parts += [st.lists(st.one_of(*map(given_flag, flags)), max_size=4).map(_joined)]
    tail = HELD_BACK.get(words, [])
    drawn = st.tuples(*parts).map(lambda found: [word for word in _joined(list(found)) if word != "--debug"])
    return drawn.map(lambda found: [*words, *found, *tail])
