"""``su3d-bench datasets check`` and ``show``; imported late, because it is slow to import."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from su3d_bench.cli.output import answer, answer_either, answer_json, file_name_of_scene, progress, remark
from su3d_bench.core import registry
from su3d_bench.core.config import read_assignments
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError, counted, printable, printable_json
from su3d_bench.core.files.atomic import write_bytes
from su3d_bench.core.types import WorldUp
from su3d_bench.datasets.checks import Inspection, TruthVariant, inspect
from su3d_bench.datasets.frame_checks import Finding
from su3d_bench.formats.images import png_bytes
from su3d_bench.reports.pictures.scene import draw_scene_picture, facts_line, look_at
from su3d_bench.runs.executors import Event
from su3d_bench.runs.job import build_dataset, part_of
from su3d_bench.runs.scenes import data_root, dataset_targets, expand_scenes
from su3d_bench.runs.trial import try_dataset

MAX_FINDINGS_PER_KIND = 10  # printed findings per kind; --json has all


def check(arguments: argparse.Namespace) -> int:
    """Check every requested scene; exit code 1 if one has errors."""
    scenes = chosen_scenes(arguments.scenes, arguments.set, is_quiet=arguments.quiet)
    n_threads = arguments.jobs or os.cpu_count() or 1
    inspections = []
    for dataset, scene in scenes:
        inspections.append(_inspect(dataset, scene, n_threads, arguments))
        if not arguments.json:
            answer(*([""] if len(inspections) > 1 else []), *lines_of(inspections[-1]))
    n_with_errors = sum(inspection.count("error") > 0 for inspection in inspections)
    value = {
        "data_root": printable(str(data_root())),
        "n_scenes": len(inspections),
        "n_with_errors": n_with_errors,
        "scenes": [as_json(inspection) for inspection in inspections],
    }
    answer_either(arguments, value, "", f"{counted(len(inspections), 'scene')}, {n_with_errors} with errors")
    return EXIT_CHECK_FAILED if n_with_errors else EXIT_DONE


def _inspect(dataset: Any, scene: str, n_threads: int, arguments: argparse.Namespace) -> Inspection:
    try_dataset(dataset, scene)
    # One bar per scene: printing while a bar is drawn would disturb it.
    with progress(1, is_quiet=arguments.quiet, last_step="ground truth") as report:
        return inspect(
            dataset,
            scene,
            is_quick=arguments.quick,
            n_threads=n_threads,
            progress=lambda n_done, n: report(Event(f"{dataset.name}/{scene}", "frames", n_done, n)),
        )


def chosen_scenes(addresses: Sequence[str], assignments: Sequence[str], *, is_quiet: bool) -> list[tuple[Any, str]]:
    """(dataset, scene) for every address or pattern, with the settings of ``--set``; datasets are built once."""
    targets = {str(registry.load("dataset", target).name): target for target in dataset_targets(addresses)}
    settings = read_assignments(assignments, (), tuple(targets))
    parts = {target: part_of("dataset", target, settings) for target in targets.values()}
    chosen, notes = expand_scenes(addresses, parts)
    for note in notes:
        remark(printable(note), quiet=is_quiet)
    datasets = {target: build_dataset(part, data_root()) for target, part in parts.items()}
    return [(datasets[target], scene) for target, scene in chosen]


def as_json(inspection: Inspection) -> dict[str, Any]:
    """An inspection as JSON, with its numbers of errors and warnings."""
    counts = {"n_errors": inspection.count("error"), "n_warnings": inspection.count("warning")}
    table: dict[str, Any] = printable_json(asdict(inspection))
    return {"scene": table.pop("scene"), **counts, **table}


def lines_of(inspection: Inspection) -> list[str]:
    """The lines of one scene: contents, then problems."""
    rows = [("frames", _frames_text(inspection))]
    if inspection.depth is not None:
        d = inspection.depth
        text = f"{d.near_m:.2f} to {d.far_m:.2f} m, median {d.median_m:.2f} m, {d.valid_share:.1%} of the pixels"
        rows.append(("depth", text))
    if inspection.up is not None:
        rows.append(("up", up_text(inspection.up)))
    rows += [("ground truth", _truth_text(variant)) for variant in inspection.truth]
    if inspection.meeting is not None:
        meeting = inspection.meeting
        rows.append(("seen points", f"{meeting.share:.1%} within {meeting.distance_m * 100:.3g} cm of ground truth"))
    rows.append(("digest", inspection.digest or "none"))
    lines = [printable(inspection.scene), *(f"  {name:<13} {text}" for name, text in rows)]
    for _, group in groupby(inspection.findings, key=lambda finding: (finding.severity, finding.check)):
        lines += _finding_lines(list(group))
    n_errors, n_warnings = inspection.count("error"), inspection.count("warning")
    wrong = f"{counted(n_errors, 'error')}, {counted(n_warnings, 'warning')}"
    verdict = wrong if inspection.findings else "OK"
    return [*lines, f"  {'checked':<13} {inspection.elapsed_s:.1f} s: {verdict}"]


def _finding_lines(findings: Sequence[Finding]) -> list[str]:
    shown = [f"  {fault.severity:<13} {f'{fault.where}: ' if fault.where else ''}{fault.text}" for fault in findings]
    n_more = len(shown) - MAX_FINDINGS_PER_KIND
    if n_more <= 0:
        return shown
    return [*shown[:MAX_FINDINGS_PER_KIND], f"  {'':<13} and {n_more} more of this kind; --json lists all"]


def _frames_text(inspection: Inspection) -> str:
    if inspection.n_frames is None:
        return "cannot be counted"
    read = "all read" if inspection.n_read == inspection.n_frames else f"{inspection.n_read} read"
    size = "" if inspection.size is None else f", {inspection.size[0]}x{inspection.size[1]}"
    files = f", {counted(inspection.n_files, 'file')}" if inspection.n_files else ", rendered on demand"
    return f"{inspection.n_frames} ({read}){size}{files}"


def up_text(up: WorldUp) -> str:
    """The up axis, its source, and whether the scene is rotated."""
    if up.axis is None:
        return f"assumed z; {up.reason}"
    if up.is_turned or up.axis == "z":
        return f"{up.axis}, {up.reason}" + ("" if up.axis == "z" else "; rotated to z")
    return f"assumed z, but probably {up.axis}: {up.reason}"


def _truth_text(variant: TruthVariant) -> str:
    if variant.reason is not None:
        reason = variant.reason.removeprefix(f"no ground truth '{variant.variant}'; ")
        return f"{variant.variant}: not available; {reason}"
    return (
        f"{variant.variant}: {variant.n_points:,} points, {counted(variant.n_objects, 'object')}, "
        f"{variant.n_classes} {'class' if variant.n_classes == 1 else 'classes'}"
    )


def show(arguments: argparse.Namespace) -> None:
    """Draw the scene and print its counts and the path of the picture; or the models or statistics of a dataset."""
    if arguments.models is not None:
        _show_models(arguments)
    elif arguments.statistics:
        _show_statistics(arguments)
    else:
        _show_scene(arguments)


def _show_scene(arguments: argparse.Namespace) -> None:
    scenes = chosen_scenes([arguments.scene], arguments.set, is_quiet=arguments.quiet)
    if len(scenes) > 1:
        names = ", ".join(f"{dataset.name}/{scene}" for dataset, scene in scenes[:3])
        raise ConfigError(f"datasets show {arguments.scene}: {len(scenes)} scenes match ({names}, ...); name one")
    dataset, scene = scenes[0]
    name = f"{dataset.name}/{scene}"
    path = arguments.out or Path(f"{file_name_of_scene(name)}.png")
    with progress(1, is_quiet=arguments.quiet, last_step="drawing") as report:
        look = look_at(dataset, scene, arguments.stride, lambda n_done, n: report(Event(name, "frames", n_done, n)))
        draw_scene_picture(look, path, arguments.width)
    table = {
        "scene": name,
        "picture": str(path),
        "n_frames": look.n_frames,
        "size": list(look.shown[0].rgb.shape[1::-1]) if look.shown else None,
        "depth_m": list(look.depth_m),
        "up": None if look.up is None else asdict(look.up),
        "ground_truth": None if look.truth is None else {"variant": look.truth.variant, **look.counts},
        "no_ground_truth": look.no_truth or None,
        "no_frames": look.no_frames or None,
    }
    if answer_json(arguments, printable_json(table)):
        return
    answer(f"{printable(name)}: {facts_line(look)}")
    if look.up is not None:
        answer(f"up: {printable(up_text(look.up))}")
    for reason in filter(None, (look.no_frames, look.no_truth)):
        answer(printable(reason))
    answer(f"picture: {printable(str(path))}")


def _show_models(arguments: argparse.Namespace) -> None:
    name = arguments.scene.rstrip("/*")
    draw = getattr(registry.load("dataset", name), "model_sheet", None)
    if draw is None:
        raise ConfigError(f"datasets show {printable(name)} --models: this dataset has no models; known: homes")
    path = arguments.out or Path(f"{name}-models.png")
    sheet, n_models, n_classes = draw(arguments.models)
    write_bytes(path, png_bytes(sheet))
    table = {"dataset": name, "picture": str(path), "n_models": n_models, "n_classes": n_classes}
    answer_either(
        arguments, table, f"{name}: {n_models} models of {n_classes} classes", f"picture: {printable(str(path))}"
    )


def _show_statistics(arguments: argparse.Namespace) -> None:
    from su3d_bench.datasets.homes.statistics import view_statistics

    rows = []
    for dataset, scene in chosen_scenes([arguments.scene], arguments.set, is_quiet=arguments.quiet):
        if not hasattr(dataset, "built"):
            raise ConfigError(f"datasets show {dataset.name} --statistics: only for generated scenes: homes, rooms")
        rows.append({"scene": f"{dataset.name}/{scene}", **view_statistics(dataset, scene, arguments.stride or 40)})
    columns = list(rows[0])
    lines = ["  ".join([f"{columns[0]:16}", *columns[1:]])]
    for row in rows:
        values = [f"{row[name]:{len(name)}.1f}".removesuffix(".0").rjust(len(name)) for name in columns[1:]]
        lines.append("  ".join([f"{row['scene']:16}", *values]))
    answer_either(arguments, {"scenes": rows}, *lines)
