"""``su3d-bench datasets make``: generate scenes in parallel; a scene appears when it is complete."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

from su3d_bench.cli.output import answer_either, overall_progress, remark
from su3d_bench.core import registry
from su3d_bench.core.config import read_assignments
from su3d_bench.core.errors import ConfigError, DataError, nearest
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.writing import SceneTarget, finish_scene, plan_scenes, write_frames
from su3d_bench.runs.executors import Event, Report, run_inline, run_processes
from su3d_bench.runs.job import Part, build_dataset, part_of
from su3d_bench.runs.scenes import data_root, expand_scenes
from su3d_bench.store.run_folder import RunFolder

FRAMES_PER_UNIT = 400  # a quarter of a room: much more work than building the room in each process
LAYOUT_PARAMETERS = ("scan", "objects", "trajectory", "intrinsics")


@dataclass(frozen=True)
class WorkUnit:
    """A unit of work: the frames at ``indices``, or (None) the ground truth; without ``target`` only the scan.

    ``layout`` is a name, because units are sent to other processes.
    """

    dataset: Part
    root: Path
    scene: str
    layout: str
    target: SceneTarget | None
    indices: range | None

    @property
    def n_steps(self) -> int:
        return 1 if self.indices is None else len(self.indices)


def make(arguments: argparse.Namespace) -> None:
    """Generate the requested scenes and print the status of each."""
    part = dataset_part(arguments.dataset, arguments.set)
    scenes = _scenes(part, arguments.scenes)
    is_native = arguments.layout == "native"
    if arguments.out is None and not is_native:
        raise ConfigError(f"datasets make --layout {arguments.layout}: name the folder with --out DIR")
    out = arguments.out or data_root()
    make_folder(out)
    with RunFolder(out).locked():
        made = _make_native(part, scenes, out, arguments) if is_native else make_files(part, scenes, out, arguments)
    reader = part.name if is_native else LAYOUTS[arguments.layout].reader
    rows = [
        {
            "scene": scene,
            "status": "generated" if scene in made else "already present",
            "address": f"{reader}/{scene if is_native else LAYOUTS[arguments.layout].scene_name(scene)}",
        }
        for scene in scenes
    ]
    lines = [f"{row['scene']:<16} {row['status']:<17} {row['address']}" for row in rows]
    answer_either(arguments, {"out": str(out), "layout": arguments.layout, "scenes": rows}, *lines)
    remark(f"to use them: su3d-bench run --data {out} --scenes '{reader}/*'", quiet=arguments.quiet)


def dataset_part(name: str, assignments: Sequence[str]) -> Part:
    dataset_class = registry.load("dataset", name)
    if not all(hasattr(dataset_class, wanted) for wanted in LAYOUT_PARAMETERS):
        raise ConfigError(f"datasets make {name}: scenes of this dataset cannot be generated; known: homes, rooms")
    default_name = str(dataset_class.name)
    # A setting may have the name of the dataset as prefix, as in `run --set`.
    texts = [text if text.partition("=")[0].count(".") else f"{default_name}.{text}" for text in assignments]
    return part_of("dataset", name, read_assignments(texts, (), (default_name,)))


def _scenes(part: Part, wanted: Sequence[str] | None) -> list[str]:
    prefix = f"{part.target}/"
    addresses = [scene if "/" in scene else prefix + scene for scene in wanted or ("*",)]
    for address in addresses:
        if not address.startswith(prefix):
            hint = nearest(address, [prefix + "*"]) or f"; expected '{prefix}...'"
            raise ConfigError(f"datasets make {part.target}: no scene '{address}'{hint}")
    chosen, _ = expand_scenes(addresses, {part.target: part})
    return [scene for _, scene in chosen]


def _make_native(part: Part, scenes: Sequence[str], out: Path, arguments: argparse.Namespace) -> set[str]:
    units = [WorkUnit(part, out, scene, arguments.layout, None, None) for scene in scenes]
    _run(units, arguments, lambda unit: None)
    return set(scenes)


def make_files(part: Part, scenes: Sequence[str], out: Path, arguments: argparse.Namespace) -> set[str]:
    """Write scenes in the layout of ``arguments`` (also ``jobs``, ``quiet``); returns those that were missing."""
    layout, dataset = LAYOUTS[arguments.layout], build_dataset(part, data_root())
    units = []
    for target in plan_scenes(layout, dataset, scenes, out):
        n_frames = dataset.info(target.scene, 1).n_frames
        starts = range(0, n_frames, FRAMES_PER_UNIT)
        pieces = [range(start, min(start + FRAMES_PER_UNIT, n_frames)) for start in starts]
        units += [WorkUnit(part, data_root(), target.scene, layout.name, target, piece) for piece in (*pieces, None)]
    n_open = Counter(unit.scene for unit in units)

    def count_down(unit: WorkUnit) -> None:
        n_open[unit.scene] -= 1
        if n_open[unit.scene] == 0:
            assert unit.target is not None
            finish_scene(layout, dataset, unit.target)

    _run(units, arguments, count_down)
    return set(n_open)


def _run(units: Sequence[WorkUnit], arguments: argparse.Namespace, done: Callable[[WorkUnit], None]) -> None:
    n_workers = min(arguments.jobs or os.cpu_count() or 1, len(units))
    with overall_progress("generating", is_quiet=arguments.quiet) as (begin, report):
        begin(sum(unit.n_steps for unit in units))
        if n_workers > 1:
            outcomes = run_processes(_work, units, report, jobs=n_workers, lost=_lost)
        else:
            outcomes = run_inline(_work, units, report)
        for unit in outcomes:
            done(unit)


def _work(unit: WorkUnit, report: Report) -> WorkUnit:
    dataset = _dataset(unit.dataset, unit.root)
    name = f"{unit.scene}, {'ground truth' if unit.indices is None else f'frames from {unit.indices.start}'}"
    if unit.target is None:
        dataset.scan(unit.scene)
    elif unit.indices is None:
        LAYOUTS[unit.layout].write_truth(dataset, unit.target)
    else:
        layout, n = LAYOUTS[unit.layout], unit.n_steps

        def count(n_done: int) -> None:
            report(Event(name, "generating", n_done, n))

        write_frames(layout, dataset, unit.target, unit.indices, count)
    report(Event(name, "generated", unit.n_steps, unit.n_steps))
    return unit


@cache
def _dataset(part: Part, root: Path) -> Any:
    """One dataset per process, because it caches the room that the next unit is likely to use."""
    return build_dataset(part, root)


def _lost(unit: WorkUnit, cause: str) -> NoReturn:
    raise DataError(f"{unit.dataset.name}/{unit.scene}: {cause}")
