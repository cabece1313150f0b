"""A rehearsal: the recipe's runs on rooms made in the layouts of its datasets, with tiny networks for its models."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from su3d_bench.cli.make_scenes import dataset_part, make_files
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, ModelMissing, some
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.datasets.layouts import LAYOUTS
from su3d_bench.reproducing.asked import Asked, asked_runs
from su3d_bench.reproducing.recipe import Experiment, Recipe
from su3d_bench.runs.planning.scenes import split_address
from su3d_bench.store.run_folder import RunFolder

EMBEDDED, PAPER = "embedded", "paper"
PACKAGES = ("torch", "transformers", "safetensors", "onnx")
SEGMENTER = "sam-vit-h"
DATA, MODELS = "data", "models"


def rehearsed(
    recipe: Recipe, experiments: Sequence[Experiment], asked: Asked, out: Path, arguments: argparse.Namespace
) -> Asked:
    """``asked`` of rooms below ``out/data`` and models below ``out/models``, made where they are not there yet."""
    asked = _perceived(recipe, asked, arguments)
    rooms = tuple(arguments.rooms or recipe.rehearsal.rooms)
    settings = tuple(arguments.room_settings or recipe.rehearsal.settings)
    datasets = dict.fromkeys(split_address(scene)[0] for one in experiments for scene in one.scenes)
    unknown = [name for name in datasets if name not in LAYOUTS and name != "rooms"]
    if unknown:
        raise ConfigError(
            f"--rehearse: no room can be made in the layout of {some(unknown, 3)}; there are {some([*LAYOUTS], 9)}"
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
    asked = replace(asked, scenes=scenes)
    if asked.profile == PAPER:
        _write_models(recipe, experiments, asked, out / MODELS)
    return asked


def places(out: Path, asked: Asked) -> dict[str, str]:
    """Variables of the environment under which a rehearsal into ``out`` finds its data and its models."""
    found = {"SU3D_DATA": str((out / DATA).absolute())}
    return found | ({"SU3D_MODELS": str((out / MODELS).absolute())} if asked.profile == PAPER else {})


def _perceived(recipe: Recipe, asked: Asked, arguments: argparse.Namespace) -> Asked:
    """``asked`` with the profile that is rehearsed, which the first line says; packages that lack may decide it."""
    profile = asked.profile or recipe.rehearsal.profile
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if profile == PAPER and not missing:
        remark(
            "rehearsal: the profile 'paper' with tiny networks of random weights in the published ones' files; no "
            "number says anything of the models",
            quiet=arguments.quiet,
        )
        return replace(asked, profile=PAPER)
    if asked.profile == PAPER:
        raise ConfigError(
            f"--rehearse --profile paper: {some(missing, 9)} is not installed: pip install 'su3d-bench[models]'; or "
            "leave --profile out, then the profile 'embedded' is rehearsed"
        )
    why = f": {some(missing, 9)} is not installed (pip install 'su3d-bench[models]')" if profile == PAPER else ""
    profile = EMBEDDED if profile == PAPER else profile
    remark(f"rehearsal: the profile '{profile}' in place of '{recipe.profile}'{why}", quiet=arguments.quiet)
    return replace(asked, profile=profile, encoder=asked.encoder or EMBEDDED)


def _write_models(recipe: Recipe, experiments: Sequence[Experiment], asked: Asked, folder: Path) -> None:
    """What lacks of the models that the runs need, as tiny networks."""
    from su3d_bench.perception.models.front_end import DETECTOR, TAGGER
    from su3d_bench.perception.models.stand_ins.folder import write_stand_ins

    encoders = [run.encoder for run in asked_runs(recipe, experiments, asked) if run.encoder != EMBEDDED]
    make_folder(folder)
    with RunFolder(folder).locked():
        missing = [name for name in (*encoders, SEGMENTER, DETECTOR, TAGGER) if not _is_below(name, folder)]
        if missing:
            write_stand_ins(folder, *dict.fromkeys(missing))


def _is_below(name: str, folder: Path) -> bool:
    from su3d_bench.perception.models.files import locate

    try:
        return folder.absolute() in locate(name, folder=folder).folder.parents
    except ModelMissing:
        return False
