"""The parts that a run is put together from: datasets and methods with their options, and how each is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.config import Settings, resolve
from su3d_bench.core.interfaces import TakesTruth
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import Truth
from su3d_bench.metrics.semantic.panoptic import told_truth
from su3d_bench.runs.own.watch import checked_dataset, checked_method, made, settings_model


@dataclass(frozen=True)
class Part:
    """A dataset or method of the run: its registry target, its own name, its resolved options as JSON."""

    target: str
    name: str
    options: str


def options_model(kind: str, target: str) -> Any:
    """The model of the options of a dataset, or of the settings of a method."""
    return settings_model(registry.load(kind, target), "Config" if kind == "method" else "Options")


def part_of(kind: str, target: str, settings: Settings) -> Part:
    """The dataset or method at ``target`` with what ``settings`` say of it."""
    name = str(registry.load(kind, target).name)
    return Part(target, name, resolve(settings, (kind, name), options_model(kind, target)).model_dump_json())


def build_dataset(part: Part, data_root: Path) -> Any:
    """The dataset of ``part``, reading below ``data_root``."""
    dataset_class = registry.load("dataset", part.target)
    return checked_dataset(made(dataset_class, data_root, dataset_class.Options.model_validate_json(part.options)))


def build_method(part: Part) -> Any:
    """A fresh method of ``part``."""
    method_class = registry.load("method", part.target)
    return checked_method(made(method_class, method_class.Config.model_validate_json(part.options)))


def as_told(
    part: Part, rules: ProtocolRules, truth: Truth, prediction: Prediction, first: Callable[[], LabelSet]
) -> Prediction:
    """``prediction``, a map of the method ``part``; that of a method that is told the truth is made anew where it must
    be told another one under ``rules``.

    So it is where ``truth`` names its classes otherwise than the ``first`` truth of the dataset, from which the map
    came, and where stuff counts that has no instances. Of OpenLex3D's labels it is told the first synonyms.
    """
    method = build_method(part)
    if isinstance(truth, OpenLexTruth):
        truth = truth.by_first_synonym()
    if not isinstance(method, TakesTruth) or not isinstance(truth, GroundTruth):
        return prediction
    told = told_truth(rules, truth)
    if told is truth and truth.labels == first():
        return prediction
    method.receive_truth(told)
    made_anew: Prediction = method.finish()
    return made_anew
