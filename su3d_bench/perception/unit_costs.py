"""Unit costs from ``unit_costs.toml``, for estimates before a run, and prices of language models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.perception.models.catalogue import MODELS

_TABLE = parse_toml(file_text(Path(__file__).with_name("unit_costs.toml")))
# US dollars per million tokens of named models, with date and source.
PRICES: Mapping[str, Mapping[str, Any]] = _TABLE["prices"]


@dataclass(frozen=True)
class UnitCost:
    """One cost: ``value`` in ``unit``; ``basis`` and ``source`` state where it comes from."""

    name: str
    value: float
    unit: str
    basis: Literal["measured", "published", "assumed"]
    source: str


UNIT_COSTS: Mapping[str, UnitCost] = {key: UnitCost(**row) for key, row in _TABLE["costs"].items()}


def weights_gb(models: Sequence[str], bytes_per_weight: int) -> float:
    """The memory of the weights of ``models``, in GB; RAM++ always runs in float32."""
    entries = [MODELS[name] for name in models]
    return sum(one.memory_mb(4 if one.kind == "tagger" else bytes_per_weight) for one in entries) / 1e3


def gpu_memory_gb(models: Sequence[str]) -> float:
    """The GPU memory of one process that runs ``models`` in float16, in GB."""
    return weights_gb(models, 2) + UNIT_COSTS["gpu memory"].value
