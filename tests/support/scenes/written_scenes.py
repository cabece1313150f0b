"""One scene written as the files of a dataset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from su3d_bench.cli.main import main
from su3d_bench.datasets import writing
from su3d_bench.datasets.layouts import LAYOUTS
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


def made_in_layout(layout: str, root: Path, *settings: str) -> str:
    """The address of the room bedroom0, written by the command in ``layout`` below ``root``."""
    words = ["datasets", "make", "rooms", "--layout", layout, "--scenes", "bedroom0", "--jobs", "1", "--quiet"]
    assert main([*words, "--set", *settings, "--out", str(root)]) == 0
    return f"{layout}/{LAYOUTS[layout].scene_name('bedroom0')}"
