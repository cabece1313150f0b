"""Values of options and arguments for shell completion; see ``su3d-bench dev completion``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from su3d_bench.cli.paths import data_root
from su3d_bench.core import registry
from su3d_bench.core.errors import DataError


def complete(parser: argparse.ArgumentParser) -> None:
    """Print the completions of the command line in the environment, and exit."""
    import argcomplete

    _add_values(parser)
    argcomplete.autocomplete(parser)


def _add_values(parser: argparse.ArgumentParser) -> None:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _add_values(command)
        elif isinstance(action.metavar, str) and action.metavar in VALUES:
            action.completer = _completer(VALUES[action.metavar])  # type: ignore[attr-defined]


def _completer(values: Callable[[str], Iterable[str]]) -> Callable[..., list[str]]:
    """A completer of ``values``, and of files if none of them fits."""
    from argcomplete.completers import FilesCompleter

    def completions(prefix: str, **_: Any) -> list[str]:
        return [value for value in values(prefix) if value.startswith(prefix)] or list(FilesCompleter()(prefix))

    return completions


def _protocols(_: str) -> list[str]:
    """The names of the files; their module is slow to import."""
    rules = Path(__file__).parents[1] / "metrics" / "rules"
    return [file.stem for file in rules.glob("*/*.toml") if file.parent.name != "classes"]


def _scenes(prefix: str) -> list[str]:
    """The scenes of the dataset in ``prefix``; before its name is complete the datasets, because listing is slow."""
    names, (name, slash, _) = registry.names("dataset"), prefix.partition("/")
    if not slash or name not in names:
        return [f"{one}/" for one in names]
    dataset = registry.load("dataset", name)
    with suppress(DataError):  # no data here
        return [f"{name}/{scene}" for scene in dataset(data_root(), dataset.Options()).scenes()]
    return []


def _models(_: str) -> list[str]:
    from su3d_bench.perception.models.catalogue import MODELS

    return list(MODELS)


def _runs(_: str) -> list[str]:
    return sorted(str(file.parent) for file in Path("runs").glob("*/run.json"))


VALUES: dict[str, Callable[[str], Iterable[str]]] = {
    "METHOD": lambda _: registry.names("method"),
    "PROTOCOL": _protocols,
    "DATASET": lambda _: registry.names("dataset"),
    "SCENE": _scenes,
    "MODEL": _models,
    "ENCODER": _models,
    **dict.fromkeys(("RUN", "A", "B", "RUN_OR_PREDICTION"), _runs),
}
