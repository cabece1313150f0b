"""Paths on the command line: which options are outputs, and the check that no output replaces or lies in an input.

An option is an output if its type is in ``OUTPUTS``, or if it is ``--json``; every other path is an input. Folders that
are only searched, such as that of ``report leaderboard``, may contain outputs.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from su3d_bench.cli.options import figure_path, output_path, run_folder, searched_folder
from su3d_bench.core.errors import ConfigError, shown

OUTPUTS = (output_path, figure_path, run_folder)
# Texts that contain the path of a file or folder; in other texts, such as METHOD, only files are inputs.
TEXTS = ("A", "B", "RUN", "METHOD=PREDICTIONS", "METHOD=FILE", "KEY=VALUE", "FILE")
FREE_TEXTS = (None, "TEXT", "NAME")


def data_root() -> Path:
    """The data root; repeated here because the module that plans runs is slow to import."""
    return Path(os.environ.get("SU3D_DATA") or "~/.cache/su3d-bench/data").expanduser()


def is_output(action: argparse.Action) -> bool:
    return action.type in OUTPUTS or action.dest == "json"


def check_outputs(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Raise ``ConfigError`` if an output is an input, another output or a file of the data root, or lies in an input or
    a run.

    Links and the case of letters make no difference, because files are compared by their identity. If the working
    directory or one above it is an input, new files may be created there.
    """
    inputs: dict[tuple[int, int], tuple[Path, bool]] = {}
    outputs: dict[str, tuple[Path, bool]] = {}
    for action in parser._actions:
        value = getattr(arguments, action.dest, None)
        if is_output(action):
            value = arguments.json_file if action.dest == "json" else value
            name = action.option_strings[0] if action.option_strings else str(action.metavar)
            outputs |= {name: (value, action.type is run_folder)} if isinstance(value, Path) else {}
        else:
            searched = action.type is searched_folder
            inputs |= {key: (path, searched) for path in _paths(action, value) if (key := _identity(path))}
    if not outputs:
        return
    from su3d_bench.store.run_folder import JOBS, is_run  # slow to import

    data, here, written = _identity(data_root()), Path.cwd(), dict[Path, str]()
    for name, (path, may_be_run) in outputs.items():
        real = Path(os.path.realpath(path))
        for place in (real, *real.parents, *Path(os.path.abspath(path)).parents):
            identity = _identity(place)
            found, is_searched = inputs.get(identity or (0, 0), (None, False))
            fault = None
            if found is not None and place == real:
                fault = "is an input of this command"
            elif found is not None and not is_searched and (real.is_file() or not here.is_relative_to(place)):
                fault = f"lies in {shown(found)}, which is an input"
            elif identity == data is not None and real.is_file() and not here.is_relative_to(place):
                fault = f"is a file of the data root {shown(data_root())}"
            elif is_run(place) and (place / JOBS).is_dir() and not (place == real and may_be_run):
                fault = f"{'is' if place == real else 'lies in'} the run folder {shown(place)}"
            if fault is not None:
                raise ConfigError(f"{name} {shown(path)}: {fault}; choose another place")
        if real in written:
            raise ConfigError(f"{name} {shown(path)}: is also written by {written[real]}; choose another place")
        written[real] = name


def _paths(action: argparse.Action, value: Any) -> Iterator[Path]:
    """The existing files and folders that an input option names."""
    for word in value if isinstance(value, list | tuple) else [value]:
        if isinstance(word, Path):
            yield word
        elif isinstance(word, str) and action.metavar not in FREE_TEXTS:
            for piece in (word, *re.split("[,=]", word)):
                for text in (piece, piece.rpartition(":")[0]):
                    if os.path.isfile(text) or (action.metavar in TEXTS and os.path.isdir(text)):
                        yield Path(text)


def _identity(path: Path) -> tuple[int, int] | None:
    """The device and number of a file or folder; None if there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino
