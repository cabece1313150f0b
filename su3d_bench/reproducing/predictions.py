"""Predictions of methods that are none here, scored as ``evaluate`` scores them, each as a run of its own."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from su3d_bench.core.errors import ConfigError, printable, suggest
from su3d_bench.evaluation.as_run import evaluate_methods
from su3d_bench.evaluation.request import Request
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.reproducing.asked import RUNS, Asked
from su3d_bench.reproducing.recipe import Experiment
from su3d_bench.runs.planning.scenes import split_address


def named_predictions(experiments: Sequence[Experiment], texts: Sequence[str]) -> dict[str, Path]:
    """Printed method -> folder; a ``ConfigError`` for a method of which no experiment takes predictions."""
    known = dict.fromkeys(name for one in experiments for name in one.predictions)
    named: dict[str, Path] = {}
    for text in texts:
        method, equals, path = text.partition("=")
        if not equals or not path:
            raise ConfigError(f"--predictions {printable(text, 80)}: expected METHOD=DIR")
        if method not in known:
            hint = suggest(method, known, "it takes")
            raise ConfigError(f"--predictions: this recipe takes none of '{printable(method, 60)}'{hint}")
        if not Path(path).exists():
            raise ConfigError(f"--predictions {printable(method, 60)}: there is no {printable(path, 200)}")
        named[method] = Path(path)
    return named


def evaluate_predictions(
    named: Mapping[str, Path], experiments: Sequence[Experiment], asked: Asked, out: Path
) -> list[Path]:
    """The run folders of predictions, one a method and dataset; a folder that holds the same stays as it is."""
    folders: list[Path] = []
    for method, place in named.items():
        mine = [one for one in experiments if method in one.predictions]
        for dataset in dict.fromkeys(split_address(scene)[0] for one in mine for scene in one.scenes):
            protocols = dict.fromkeys(name for one in mine for name in one.protocols)
            fitting = tuple(name for name in protocols if dataset in load_protocol(name).datasets)
            name = re.sub(r"[^A-Za-z0-9-]+", "-", method).strip("-").lower()
            folder = out / RUNS / f"{dataset}-predictions-{name}"
            evaluate_methods({method: Request((place,), dataset=dataset, protocols=fitting)}, folder)
            folders.append(folder)
    return folders
