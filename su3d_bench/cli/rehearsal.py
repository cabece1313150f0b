"""Rehearsal: the runs of a recipe on synthetic rooms in the layouts of its datasets."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from su3d_bench.cli.make_scenes import dataset_part, make_files
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, some
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.reproducing.recipe import Experiment, Recipe, RecipeRequest
from su3d_bench.runs.scenes import split_address
from su3d_bench.store.run_folder import RunFolder

EMBEDDED = "embedded"
DATA = "data"


def rehearsed(
    recipe: Recipe, experiments: Sequence[Experiment], asked: RecipeRequest, out: Path, arguments: argparse.Namespace
) -> RecipeRequest:
    """``asked`` for rooms in ``out/data``, generated if missing."""
    asked = _perceived(recipe, asked, arguments)
    rooms = tuple(arguments.rooms or recipe.rehearsal.rooms)
    settings = tuple(arguments.room_settings or recipe.rehearsal.settings)
    datasets = dict.fromkeys(split_address(scene)[0] for one in experiments for scene in one.scenes)
    unknown = [name for name in datasets if name not in LAYOUTS and name != "rooms"]
    if unknown:
        raise ConfigError(
            f"--rehearse: rooms cannot be generated in the layout of {some(unknown, 3)}; known: {some([*LAYOUTS], 9)}"
        )
    scenes: dict[str, tuple[str, ...]] = {}
    data = out / DATA
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
    return replace(asked, scenes=scenes)


def places(out: Path) -> dict[str, str]:
    """Environment variables with which a rehearsal in ``out`` finds its data."""
    return {"SU3D_DATA": str((out / DATA).absolute())}


def _perceived(recipe: Recipe, asked: RecipeRequest, arguments: argparse.Namespace) -> RecipeRequest:
    """``asked`` with the profile of the rehearsal, which is printed."""
    profile = asked.profile or recipe.rehearsal.profile
    if profile == recipe.profile:
        return replace(asked, profile=profile)
    remark(f"rehearsal: profile '{profile}' instead of '{recipe.profile}'", quiet=arguments.quiet)
    return replace(asked, profile=profile, encoder=asked.encoder or EMBEDDED)
