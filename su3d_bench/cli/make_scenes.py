"""``su3d-bench datasets make``: generate scenes in parallel; a scene appears when it is complete."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from su3d_bench.cli.output import answer_either, overall_progress, remark
from su3d_bench.core import registry
from su3d_bench.core.config import read_assignments
from su3d_bench.core.errors import ConfigError, DataError, nearest
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.datasets.writing import SceneTarget, plan_scenes, write_scene
from su3d_bench.runs.executors import Event, Report, run_inline, run_processes
from su3d_bench.runs.job import Part, build_dataset, part_of
from su3d_bench.runs.scenes import data_root, expand_scenes
from su3d_bench.store.run_folder import RunFolder

LAYOUT_PARAMETERS = ("scan", "objects", "trajectory", "intrinsics")


@dataclass(frozen=True)
class WorkUnit:
    """A unit of work: a scene with its ``n_steps``; without ``target`` only its scan.

    ``layout`` is a name, because units are sent to other processes.
    """

    dataset: Part
    root: Path
    scene: str
    layout: str
    target: SceneTarget | None
    n_steps: int


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
    return _run([WorkUnit(part, out, scene, arguments.layout, None, 1) for scene in scenes], arguments)


def make_files(part: Part, scenes: Sequence[str], out: Path, arguments: argparse.Namespace) -> set[str]:
    """Write scenes in the layout of ``arguments`` (also ``jobs``, ``quiet``); returns those that were missing."""
    layout, root = LAYOUTS[arguments.layout], data_root()
    dataset = build_dataset(part, root)
    targets = plan_scenes(layout, dataset, scenes, out)
    units = [
        WorkUnit(part, root, target.scene, layout.name, target, dataset.info(target.scene, 1).n_frames)
        for target in targets
    ]
    return _run(units, arguments)


def _run(units: Sequence[WorkUnit], arguments: argparse.Namespace) -> set[str]:
    """Do the work, and return the names of its scenes."""
    n_workers = min(arguments.jobs or os.cpu_count() or 1, len(units))
    with overall_progress("generating", is_quiet=arguments.quiet) as (begin, report):
        begin(sum(unit.n_steps for unit in units))
        if n_workers > 1:
            return set(run_processes(_work, units, report, jobs=n_workers, lost=_lost))
        return set(run_inline(_work, units, report))


def _work(unit: WorkUnit, report: Report) -> str:
    dataset = build_dataset(unit.dataset, unit.root)
    if unit.target is None:
        dataset.scan(unit.scene)
    else:
        write_scene(
            LAYOUTS[unit.layout],
            dataset,
            unit.target,
            lambda n_done: report(Event(unit.scene, "generating", n_done, unit.n_steps)),
        )
    report(Event(unit.scene, "generated", unit.n_steps, unit.n_steps))
    return unit.scene


def _lost(unit: WorkUnit, cause: str) -> NoReturn:
    raise DataError(f"{unit.dataset.name}/{unit.scene}: {cause}")
