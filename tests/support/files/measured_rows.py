"""Rows as measured by a run, for tests of tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from su3d_bench.reports.tables.model import Measured

SCENES = tuple(f"replica/{kind}{k}" for kind, n in (("office", 5), ("room", 3)) for k in range(n))


def measured(method: str = "opensu3d", accuracy: float = 0.4, **more: Any) -> Measured:
    """Eight scenes under ConceptGraphs' rules, with slightly different values."""
    per_scene: Mapping[str, Any] = {
        scene: {"mAcc": accuracy + 0.001 * k, "F-mIoU": accuracy / 2} for k, scene in enumerate(SCENES)
    }
    base = Measured(
        run="runs/first",
        method=method,
        protocol="replica-conceptgraphs-ex6",
        version=1,
        kind="semantic",
        headline=("mAcc", "F-mIoU"),
        metrics={"mAcc": accuracy, "F-mIoU": accuracy / 2, "mIoU": None},
        intervals={"mAcc": (accuracy - 0.05, accuracy + 0.05), "F-mIoU": None},
        per_scene=per_scene,
        ceilings={"mAcc": 0.98, "F-mIoU": 1.0},
        n_planned=8,
        failed=(),
        unscored=(),
        limit=0,
        profile="embedded",
        encoder="rooms-encoder",
        caveat=None,
    )
    return replace(base, **more)


def measured_instances(method: str, value: float) -> Measured:
    return measured(
        method,
        protocol="replica-openmask3d",
        kind="instance",
        headline=("AP", "AP50", "AP25"),
        metrics={"AP": value, "AP50": value, "AP25": value},
        intervals={},
        per_scene={scene: {"AP": value, "AP50": value, "AP25": value} for scene in SCENES},
    )
