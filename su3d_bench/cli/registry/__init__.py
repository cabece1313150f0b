"""``su3d-bench dev registry``: bundles of many people taken in, scored anew and shown; one module a sub-verb."""

from __future__ import annotations

from typing import Any

from su3d_bench.cli.new import REGISTRY, add_new
from su3d_bench.cli.registry import add as registry_add
from su3d_bench.cli.registry import build as registry_build
from su3d_bench.cli.shared.flags import add_group


def add_parser(verbs: Any) -> None:
    actions = add_group(
        verbs,
        "registry",
        "Keep a registry of results: take bundles in after scoring them anew, and make a site of their rankings.",
        (
            "su3d-bench dev registry add reproduced/rooms/bundle.zip --to my-registry",
            "su3d-bench dev registry build my-registry --out site",
        ),
    )
    registry_add.add_parser(actions)
    registry_build.add_parser(actions)
    add_new(actions, REGISTRY)
