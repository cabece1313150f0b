"""Every object builder by class; one call makes one instance."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from su3d_bench.datasets.rooms.objects.decor import DECOR
from su3d_bench.datasets.rooms.objects.devices import DEVICES
from su3d_bench.datasets.rooms.objects.dishes import DISHES
from su3d_bench.datasets.rooms.objects.fixtures import FIXTURES
from su3d_bench.datasets.rooms.objects.furniture import FURNITURE
from su3d_bench.datasets.rooms.objects.household import HOUSEHOLD
from su3d_bench.datasets.rooms.objects.items import Builder, Item, choose_look
from su3d_bench.datasets.rooms.objects.textiles import TEXTILES


def _builders() -> Mapping[str, tuple[Builder, ...]]:
    table: dict[str, tuple[Builder, ...]] = {}
    for part in (FURNITURE, FIXTURES, DEVICES, DECOR, HOUSEHOLD, TEXTILES, DISHES):
        for name, builders in part.items():
            table[name] = table.get(name, ()) + builders
    return table


BUILDERS = _builders()


def make(
    class_name: str,
    rng: np.random.Generator,
    model: str | None = None,
    colour: str | None = None,
    avoid: frozenset[str] = frozenset(),
) -> Item:
    """A new instance of a class; ``model`` names one of its builders (``coffee_table``), else any of them."""
    look = choose_look(class_name, rng, colour, avoid)
    builder = _pick(class_name, rng, model)
    return builder(look).item(builder.__name__)


def _pick(class_name: str, rng: np.random.Generator, model: str | None) -> Builder:
    builders = BUILDERS[class_name]
    if model is None:
        return builders[int(rng.integers(len(builders)))]
    return next(builder for builder in builders if builder.__name__ == model)
