"""Furnish a room by the recipe of its kind, from ``recipes.toml``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.datasets.rooms import groups
from su3d_bench.datasets.rooms.plan import Plan, add_openings, add_shell

KINDS: Mapping[str, Any] = parse_toml(file_text(Path(__file__).with_name("recipes.toml")))["kinds"]


def furnish(kind: str, rng: np.random.Generator) -> Plan:
    """A furnished room of the kind."""
    rules = KINDS[kind]
    is_tiled, n_lamps = rules.get("tiled", False), rules.get("n_lamps", 1)
    width, depth, height = (float(rng.uniform(*span)) for span in (rules["width"], rules["depth"], (2.5, 2.75)))
    plan = Plan(rng, width, depth, height)
    add_shell(plan, is_tiled)
    cover = "blinds" if is_tiled else str(rng.choice(["curtain", "curtain", "blinds"]))
    fewest, most = rules["n_windows"]
    add_openings(plan, int(rng.integers(fewest, most + 1)), cover)
    for k in range(n_lamps):
        y = plan.depth * float(rng.uniform(0.45, 0.55))
        groups.hang_ceiling_lamp(plan, plan.width * (k + 1) / (n_lamps + 1), y)
    for name, *arguments in rules["steps"]:
        given = dict(*arguments)
        chance = given.pop("chance", None)
        if chance is None or rng.random() < chance:
            getattr(groups, name)(plan, **given)
    plan.finish_lights()
    return plan
