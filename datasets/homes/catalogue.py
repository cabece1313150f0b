"""The classes and models of the homes, and which of them the embedded models never see in training."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.datasets.homes.model_builder import build_item
from su3d_bench.datasets.homes.model_format import ModelRow, Strict, read_models
from su3d_bench.datasets.procedural.items import Item

FOLDER = Path(__file__).parent
Kind = Literal["living", "bedroom", "kitchen", "dining", "office", "bathroom", "hobby"]
Place = Literal["shell", "floor", "wall", "corner", "hung", "ceiling", "surface", "shelf", "seat", "inside", "placed"]


class ClassRow(Strict):
    """A class in ``classes.toml``.

    ``rooms``: the kinds of rooms that it suits, all if empty; ``where``: where its objects may be, "placed" only by a
    group; ``often``: how often compared with others; ``height``: of the lower edge of hung objects, m.
    """

    id: Annotated[int, Field(ge=1, le=999)]
    group: Literal["base", "novel"] = "base"
    rooms: tuple[Kind, ...] = ()
    where: tuple[Place, ...] = Field(min_length=1)
    often: Annotated[float, Field(gt=0, le=100)] = 1.0
    height: tuple[float, float] = (1.3, 1.6)


@dataclass(frozen=True)
class Model:
    """A model of a class. ``is_held_out``: whether it never appears in scenes for training."""

    row: ModelRow
    is_held_out: bool

    @property
    def name(self) -> str:
        return self.row.name

    def build(self, rng: np.random.Generator, muted: bool = False, colour: str | None = None) -> Item:
        """A new instance; place the same ``Item`` several times for identical objects."""
        return build_item(self.row, rng, muted, colour)


@dataclass(frozen=True)
class HomeClass:
    """A class with its models. ``called``: the names of models that are kinds of the class by their last word.

    A "dining chair" is asked for as such; a "cactus" as an indoor plant, which is all that a map with classes knows.
    """

    name: str
    row: ClassRow
    models: tuple[Model, ...]
    called: Mapping[str, str]

    @property
    def id(self) -> int:
        return self.row.id

    @property
    def is_novel(self) -> bool:
        return self.row.group == "novel"


@dataclass(frozen=True)
class Catalogue:
    """Every class by name, in order of id."""

    classes: Mapping[str, HomeClass]

    def models(self, class_name: str, training: bool = False) -> tuple[Model, ...]:
        """The models of a class; for ``training`` without those held out, so none of a novel class."""
        known = self.classes[class_name].models
        return tuple(model for model in known if not (training and model.is_held_out))


@cache
def catalogue() -> Catalogue:
    """The catalogue of the package; a ``DataError`` names a faulty class or model."""
    rows = [row for path in sorted((FOLDER / "models").glob("*.toml")) for row in read_models(path)]
    names = [row.name for row in rows]
    if twice := [name for name in names if names.count(name) > 1]:
        raise DataError(f"homes: two models have the name '{twice[0]}'")
    classes = {}
    for name, row in read_classes().items():
        own = [model for model in rows if model.of_class == name]
        if not own and "shell" not in row.where:
            raise DataError(f"homes: class '{name}' has no model")
        held_out = {model.name for model in own} if row.group == "novel" else held_out_of([m.name for m in own])
        models = tuple(Model(model, model.name in held_out) for model in own)
        kind = name.rpartition("-")[2]
        called = {model.name: model.called for model in own if model.called.rpartition(" ")[2] == kind}
        classes[name] = HomeClass(name, row, models, called)
    if stray := next((model for model in rows if model.of_class not in classes), None):
        raise DataError(f"homes: model '{stray.name}': unknown class '{stray.of_class}'")
    return Catalogue(dict(sorted(classes.items(), key=lambda item: item[1].id)))


@cache
def read_classes() -> Mapping[str, ClassRow]:
    rows = parse_toml(file_text(FOLDER / "classes.toml"))["classes"]
    try:
        classes = {name: ClassRow.model_validate(row) for name, row in rows.items()}
    except ValidationError as error:
        raise DataError(f"classes.toml: {error.errors()[0]['msg']}") from error
    ids = [row.id for row in classes.values()]
    if len(set(ids)) < len(ids):
        raise DataError("classes.toml: two classes have the same id")
    return classes


def held_out_of(names: list[str]) -> set[str]:
    """A third of the models of a class, rounded up, none of a single one: the first by the digest of their names.

    >>> sorted(held_out_of(["mug", "tea_cup", "espresso_cup"]))
    ['espresso_cup']
    """
    if len(names) < 2:
        return set()
    ordered = sorted(names, key=lambda name: hashlib.sha256(name.encode()).hexdigest())
    return set(ordered[: -(-len(names) // 3)])
