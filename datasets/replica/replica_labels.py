"""Replica's 101 classes, as ``info_semantic.json`` of the original release numbers them."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

from su3d_bench.core.types import LabelSet

LABEL_SPACE = "replica"


@cache
def replica_label_set() -> LabelSet:
    """The 101 classes, ids 1 to 101; 0 is void and no class."""
    rows = json.loads(Path(__file__).with_name("labels.json").read_text(encoding="utf-8"))
    return LabelSet(LABEL_SPACE, tuple(int(row["id"]) for row in rows), tuple(str(row["name"]) for row in rows))
