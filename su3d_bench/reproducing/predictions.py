"""Predictions of methods that are none here, scored as ``evaluate`` scores them, each as a run of its own."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from su3d_bench.core.errors import ConfigError, printable, suggest
from su3d_bench.evaluation.as_run import evaluate_methods
from su3d_bench.evaluation.result import Request
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.reproducing.asked import RUNS, Asked
from su3d_bench.reproducing.preflight import scene_names
from su3d_bench.reproducing.recipe import Experiment
from su3d_bench.runs.scenes import split_address


@dataclass(frozen=True)
class Given:
    """The predictions of one method: where they lie, and what its encoder makes of texts, where that is given."""

    place: Path
    text_features: Path | None = None


def named_predictions(
    experiments: Sequence[Experiment], texts: Sequence[str], text_features: Sequence[str] = ()
) -> dict[str, Given]:
    """What ``METHOD=DIR`` and ``METHOD=FILE`` give, by printed method.

    Raises ``ConfigError`` for a method of which no experiment takes predictions or that is named twice, for what is
    not there, and for one folder under two names.
    """
    places = _named(
        "--predictions", "DIR", dict.fromkeys(name for one in experiments for name in one.predictions), texts
    )
    features = _named("--text-features", "FILE", places, text_features)
    methods: dict[Path, str] = {}
    for method, place in places.items():
        other = methods.setdefault(place.resolve(), method)
        if other != method:
            raise ConfigError(
                f"--predictions {printable(method, 60)}: {printable(str(place), 200)} was given for "
                f"{printable(other, 60)}; each method has a folder of its own"
            )
    return {method: Given(place, features.get(method)) for method, place in places.items()}


def _named(flag: str, kind: str, known: Mapping[str, object], texts: Sequence[str]) -> dict[str, Path]:
    named: dict[str, Path] = {}
    for text in texts:
        method, equals, path = text.partition("=")
        if not equals or not path:
            raise ConfigError(f"{flag} {printable(text, 80)}: expected METHOD={kind}")
        if method not in known:
            hint = suggest(method, known, "it takes") if known else "; name its --predictions too"
            raise ConfigError(f"{flag}: this recipe takes none of '{printable(method, 60)}'{hint}")
        if method in named:
            raise ConfigError(f"{flag}: '{printable(method, 60)}' is given twice; give it once")
        if not Path(path).exists():
            raise ConfigError(f"{flag} {printable(method, 60)}: there is no {printable(path, 200)}")
        named[method] = Path(path)
    return named


def evaluate_predictions(
    named: Mapping[str, Given], experiments: Sequence[Experiment], asked: Asked, out: Path
) -> list[Path]:
    """The run folders of predictions, one a method and dataset; a folder that holds the same stays as it is."""
    folders: list[Path] = []
    for method, given in named.items():
        mine = [one for one in experiments if method in one.predictions]
        for dataset in dict.fromkeys(split_address(scene)[0] for one in mine for scene in one.scenes):
            protocols = dict.fromkeys(name for one in mine for name in one.protocols)
            fitting = tuple(name for name in protocols if dataset in load_protocol(name).datasets)
            name = re.sub(r"[^A-Za-z0-9-]+", "-", method).strip("-").lower()
            folder = out / RUNS / f"{dataset}-predictions-{name}"
            scenes = _scenes(mine, asked, dataset)
            request = Request((given.place,), dataset, None, None, fitting, scenes, None, given.text_features)
            evaluate_methods({method: request}, folder)
            folders.append(folder)
    return folders


def _scenes(experiments: Sequence[Experiment], asked: Asked, dataset: str) -> tuple[str, ...]:
    """The recipe's scenes of ``dataset``: what else was predicted is of no row of its tables."""
    addresses = asked.scenes.get(dataset) if asked.scenes else None
    if addresses is None:
        addresses = tuple(scene for one in experiments for scene in one.scenes if split_address(scene)[0] == dataset)
    return tuple(dict.fromkeys(scene_names(dataset, addresses)))
