"""``su3d-bench sheets``: sheets for people to judge a run, and what their answers add up to; one module a sub-verb."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from su3d_bench.cli.shared.flags import add_modules
from su3d_bench.cli.sheets import make as sheets_make
from su3d_bench.cli.sheets import pictures as sheets_pictures
from su3d_bench.cli.sheets import score as sheets_score

# Modules with ``NAME`` and ``add_parser(actions)``, imported for --help too, so with nothing heavy at their top.
SUB_VERBS: tuple[ModuleType, ...] = (sheets_make, sheets_score, sheets_pictures)


def add_parser(verbs: Any) -> None:
    add_modules(
        verbs,
        "sheets",
        "Make sheets for people to judge a run, and score their answers.",
        SUB_VERBS,
        (
            "su3d-bench sheets make runs/my-run --kind retrieval --out sheets",
            "su3d-bench sheets score ann.csv bob.xlsx --key key/key.json",
        ),
    )
