"""The command that makes a run anew, out of what its records say that it was asked for."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from typing import Any

from su3d_bench.core.config import DEFAULT_SOURCE, MOVES_NO_NUMBER, KeyPath, RunConfig, toml_value
from su3d_bench.core.errors import printable
from su3d_bench.runs.existing import existing_run
from su3d_bench.runs.finished import FinishedRun

UNKNOWN = "not known: run.toml is not whole"
MOST_CHARACTERS = 2000


def command_of(run: FinishedRun, method: str) -> str:
    """A line for a shell that does what gave the rows of ``method``: ``run`` of it alone, or ``evaluate``.

    What moves no number is left out, and so is what nobody asked for.
    """
    if method in run.made_elsewhere:
        return printable(_evaluation(run, method), MOST_CHARACTERS)
    held = existing_run(run.folder.path)
    if held is None or not held.is_known:
        return UNKNOWN
    asked = {path: value for path, value in held.values.items() if held.remarks.get(path) != DEFAULT_SOURCE}
    words = ["su3d-bench", "run", *_flags(asked, run, method), *_settings(asked, method)]
    return printable(shlex.join(words), MOST_CHARACTERS)


def _flags(asked: Mapping[KeyPath, Any], run: FinishedRun, method: str) -> Iterator[str]:
    scenes = asked.get(("scenes",)) or run.scenes
    yield from ("--scenes", *map(str, scenes), "--methods", method)
    for name in RunConfig.model_fields:
        value = asked.get((name,))
        if name in ("scenes", "methods") or name in MOVES_NO_NUMBER or value is None:
            continue
        yield f"--{name.replace('_', '-')}"
        yield from map(str, value) if isinstance(value, list | tuple) else (str(value),)


def _settings(asked: Mapping[KeyPath, Any], method: str) -> Iterator[str]:
    """``--set`` of what was asked of this method, the datasets and perception; a variant's name says its own."""
    base = method.partition("@")[0]
    pairs = []
    for path, value in asked.items():
        if len(path) > 2 and path[0] in ("method", "dataset"):
            if path[0] == "dataset" or (path[1] == base == method):
                pairs.append(f"{'.'.join(path[1:])}={toml_value(value)}")
        elif len(path) > 1 and path[0] == "perception":
            pairs.append(f"{'.'.join(path)}={toml_value(value)}")
    if pairs:
        yield from ("--set", *pairs)


def _evaluation(run: FinishedRun, method: str) -> str:
    record, truth = run.made_elsewhere[method], run.record.ground_truth
    words = ["su3d-bench", "evaluate", *record.paths]
    if truth is not None and truth.dataset is not None:
        words += ["--dataset", truth.dataset]
    return shlex.join([*words, "--protocols", *run.protocols])
