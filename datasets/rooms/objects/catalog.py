"""Every object builder by class; one call makes one instance."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from su3d_bench.datasets.procedural.items import Item
from su3d_bench.datasets.rooms.classes import CLASSES
from su3d_bench.datasets.rooms.objects import decor, fixtures, furniture, household
from su3d_bench.datasets.rooms.objects.items import Builder, begin

_BUILDER_OF_MODEL: Mapping[str, Builder] = {
    name: builder
    for module in (furniture, fixtures, decor, household)
    for name, builder in vars(module).items()
    if getattr(builder, "__module__", None) == module.__name__ and not name.startswith("_")
}
BUILDERS: Mapping[str, tuple[Builder, ...]] = {
    known.name: tuple(_BUILDER_OF_MODEL[model] for model in known.models) for known in CLASSES if known.models
}


def make(
    class_name: str,
    rng: np.random.Generator,
    model: str | None = None,
    colour: str | None = None,
    avoid: frozenset[str] = frozenset(),
) -> Item:
    """A new instance of a class; ``model`` selects one of its builders (``coffee_table``), by default any of them."""
    assembly = begin(class_name, rng, colour, avoid)
    builders = BUILDERS[class_name]
    if model is None:
        model = builders[int(rng.integers(len(builders)))].__name__
    _BUILDER_OF_MODEL[model](assembly)
    return assembly.item(model)
