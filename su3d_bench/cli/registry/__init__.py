"""``su3d-bench registry``: bundles of many people taken in, scored anew and shown; one module a sub-verb."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from su3d_bench.cli.registry import add as registry_add
from su3d_bench.cli.registry import build as registry_build
from su3d_bench.cli.shared.flags import add_modules

SUB_VERBS: tuple[ModuleType, ...] = (registry_add, registry_build)


def add_parser(verbs: Any) -> None:
    add_modules(
        verbs,
        "registry",
        "Keep a registry of results: take bundles in after scoring them anew, and make a site of their rankings.",
        SUB_VERBS,
        (
            "su3d-bench registry add reproduced/rooms/bundle.zip --to my-registry",
            "su3d-bench registry build my-registry --out site",
        ),
    )
