"""``su3d-bench fetch``: published weights and data brought here, once their terms are accepted."""

from __future__ import annotations

from typing import Any

from su3d_bench.cli.fetch import models, replica, scannet
from su3d_bench.cli.shared.flags import add_modules


def add_parser(verbs: Any) -> None:
    add_modules(
        verbs,
        "fetch",
        "Bring published weights and data here: shown first, resumed, checked, unpacked where they are looked for.",
        (models, replica, scannet),
        ("su3d-bench fetch models --for paper --dry-run", "su3d-bench fetch replica"),
    )
