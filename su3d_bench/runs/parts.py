"""The parts that a run is put together from: datasets and methods with their options, and how each is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from su3d_bench.core import registry
from su3d_bench.core.config import Settings, resolve
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
