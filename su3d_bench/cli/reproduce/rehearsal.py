"""A rehearsal: the recipe's runs on rooms made in the layouts of its datasets, under a profile without weights."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from su3d_bench.cli.datasets.make import dataset_part, make_files
from su3d_bench.cli.shared.answers import remark
from su3d_bench.core.errors import ConfigError, some
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.reproducing.asked import Asked
from su3d_bench.reproducing.recipe import Experiment, Recipe
from su3d_bench.runs.planning.scenes import split_address
from su3d_bench.store.atomic import make_folder
from su3d_bench.store.run_folder import RunFolder

ENCODER = "embedded"


def rehearsed(
    recipe: Recipe, experiments: Sequence[Experiment], asked: Asked, out: Path, arguments: argparse.Namespace
) -> Asked:
    """``asked`` of rooms below ``out/data``, which are made where they are not there yet."""
    rooms = tuple(arguments.rooms or recipe.rehearsal.rooms)
    settings = tuple(arguments.room_settings or recipe.rehearsal.settings)
    datasets = dict.fromkeys(split_address(scene)[0] for one in experiments for scene in one.scenes)
    unknown = [name for name in datasets if name not in LAYOUTS and name != "rooms"]
    if unknown:
        raise ConfigError(
            f"--rehearse: no room can be made in the layout of {some(unknown, 3)}; there are {some([*LAYOUTS], 9)}"
        )
    scenes: dict[str, tuple[str, ...]] = {}
    data = out / "data"
    make_folder(data)
    for dataset in datasets:
        if dataset == "rooms":
            scenes[dataset] = tuple(f"rooms/{room}" for room in rooms)
            continue
        layout = LAYOUTS[dataset]
        remark(f"rooms in the layout of {dataset}: {', '.join(rooms)}", quiet=arguments.quiet)
        wanted = argparse.Namespace(layout=dataset, jobs=arguments.jobs, quiet=arguments.quiet)
        with RunFolder(data).locked():
            make_files(dataset_part("rooms", settings), list(rooms), data, wanted)
        scenes[dataset] = tuple(f"{dataset}/{layout.scene_name(room)}" for room in rooms)
    return replace(
        asked, profile=asked.profile or recipe.rehearsal.profile, encoder=asked.encoder or ENCODER, scenes=scenes
    )
