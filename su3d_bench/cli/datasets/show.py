"""``su3d-bench datasets show``: one picture of a scene and its counts."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from su3d_bench.cli.datasets.check import chosen_scenes, up_text
from su3d_bench.cli.shared.answers import answer, answer_json, file_name_of_scene
from su3d_bench.cli.shared.bars import progress
from su3d_bench.core.errors import EXIT_DONE, ConfigError, printable, printable_json
from su3d_bench.reports.pictures.scene import draw_scene_picture, facts_line, look_at
from su3d_bench.runs.executors import Event


def show(arguments: argparse.Namespace) -> int:
    """Draw the scene and print its counts and where the picture is."""
    if arguments.stride is not None and arguments.stride < 1:
        raise ConfigError(f"--stride {arguments.stride}: expected 1 or more")
    scenes = chosen_scenes([arguments.scene], arguments.set, is_quiet=arguments.quiet)
    if len(scenes) > 1:
        names = ", ".join(f"{dataset.name}/{scene}" for dataset, scene in scenes[:3])
        raise ConfigError(f"datasets show {arguments.scene}: {len(scenes)} scenes match ({names}, ...); name one")
    dataset, scene = scenes[0]
    name = f"{dataset.name}/{scene}"
    path = arguments.out or Path(f"{file_name_of_scene(name)}.png")
    if path.suffix.lower() != ".png" or path.is_dir():
        raise ConfigError(f"--out {path}: the picture is a PNG; expected a file name that ends in .png")
    with progress(1, is_quiet=arguments.quiet, last_step="drawing") as report:
        look = look_at(dataset, scene, arguments.stride, lambda n_done, n: report(Event(name, "frames", n_done, n)))
        draw_scene_picture(look, path)
    table = {
        "scene": name,
        "picture": str(path),
        "n_frames": look.n_frames,
        "size": list(look.shown[0].rgb.shape[1::-1]) if look.shown else None,
        "depth_m": list(look.depth_m),
        "up": None if look.up is None else asdict(look.up),
        "ground_truth": None if look.truth is None else {"variant": look.truth.variant, **look.counts},
        "no_ground_truth": look.no_truth or None,
    }
    if answer_json(arguments, printable_json(table)):
        return EXIT_DONE
    answer(f"{printable(name)}: {facts_line(look)}")
    if look.up is not None:
        answer(f"up: {printable(up_text(look.up))}")
    if look.no_truth:
        answer(printable(look.no_truth))
    answer(f"picture: {printable(str(path))}")
    return EXIT_DONE
