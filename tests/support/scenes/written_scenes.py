"""One scene written as the files of a dataset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from su3d_bench.datasets import writing
from su3d_bench.datasets.writing import Layout, plan_scenes


def write_scene(
    layout: Layout,
    dataset: Any,  # rooms, or a replacement
    scene: str,
    out: Path,
    report: Callable[[int], None] = lambda n_done: None,
) -> None:
    """Write one complete scene; nothing is done if it exists already."""
    for target in plan_scenes(layout, dataset, [scene], out):
        writing.write_scene(layout, dataset, target, report)
