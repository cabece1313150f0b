"""``su3d-bench reproduce``: run the experiments of a paper and compare with its tables."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli import output
from su3d_bench.cli.options import EXECUTOR, JOBS, SHARED, Verbs, add_verb, output_path
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import (
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    ConfigError,
    RunIncomplete,
    counted,
)

if TYPE_CHECKING:
    from su3d_bench.reproducing.recipe import Experiment, Recipe, RecipeRequest, RecipeRun

RUN_OPTIONS = (
    "jobs",
    "limit",
    "question_solver",
    "refiner",
    "offline",
    "executor",
    "gpus_per_job",
    "retries",
    "slurm",
)


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "reproduce", call, resumes=True, data=True)
    parser.option("recipe [RECIPE]", "experiments of a paper: built-in recipe or .toml file (default: list recipes)")
    parser.option("--tables TABLE...", "tables of the paper (default: all)", default=[])
    parser.option("--out DIR", "output folder (default: reproduced/<recipe>)", type=output_path)
    parser.shared("--dry-run")
    parser.option("--scenes SCENE...", "scenes or patterns to use (default: those of the recipe)", default=[])
    parser.option(
        "--predictions METHOD=PREDICTIONS...", "predictions of several methods (not implemented here)", default=[]
    )
    parser.option("--text-features METHOD=FILE...", SHARED["--text-features"]["help"], default=[])
    parser.shared("--profile")
    parser.option("--encoder ENCODER", "encoder to use (default: set by the recipe)")
    parser.shared("--device")
    parser.shared("--jobs", help=JOBS)
    parser.shared("--limit", "--question-solver", "--refiner", "--offline", *EXECUTOR, "--set")
    parser.option("--bundle FILE", "archive to write (default: bundle.zip in --out)", type=output_path)
    parser.shared("--format")


def call(arguments: argparse.Namespace) -> int:
    """Reproduce the experiments of a paper: runs, tables next to the published ones, and an archive.

    su3d-bench reproduce opensu3d --tables II III --dry-run
    su3d-bench reproduce opensu3d --tables V --scenes replica/room0 --profile embedded --encoder embedded
    """
    from su3d_bench.reproducing.recipe import load_recipe

    if arguments.recipe is None:
        return _list_recipes(arguments)
    recipe = load_recipe(arguments.recipe)
    experiments = recipe.chosen(arguments.tables)
    out = arguments.out or Path("reproduced") / recipe.name
    return _reproduce(recipe, experiments, _asked(arguments), out, arguments)


def _list_recipes(arguments: argparse.Namespace) -> int:
    from su3d_bench.reproducing.recipe import load_recipe, recipe_names

    recipes = [load_recipe(name) for name in recipe_names()]
    value = [
        {"name": one.name, "title": one.title, "tables": [each.name for each in one.experiments]} for one in recipes
    ]
    output.answer_either(arguments, value, *(f"{one['name']:<14} {', '.join(one['tables'])}" for one in value))
    return EXIT_DONE


def _asked(arguments: argparse.Namespace) -> RecipeRequest:
    from su3d_bench.reproducing.recipe import RecipeRequest
    from su3d_bench.runs.scenes import split_address

    values = {name: getattr(arguments, name) for name in RUN_OPTIONS if getattr(arguments, name) is not None}
    scenes: dict[str, tuple[str, ...]] = {}
    for address in arguments.scenes:
        dataset, _ = split_address(address)
        scenes[dataset] = (*scenes.get(dataset, ()), address)
    chosen = arguments.profile, arguments.encoder, arguments.device
    return RecipeRequest(*chosen, values=values, assignments=tuple(arguments.set), scenes=scenes or None)


def _reproduce(
    recipe: Recipe, experiments: Sequence[Experiment], asked: RecipeRequest, out: Path, arguments: argparse.Namespace
) -> int:
    from su3d_bench.reproducing.preflight import preflight, preflight_tables, summary
    from su3d_bench.reproducing.recipe import asked_runs, evaluate_predictions, named_predictions

    runs = asked_runs(recipe, experiments, asked)
    named = named_predictions(experiments, arguments.predictions, arguments.text_features)
    known = preflight(runs, out)
    if arguments.dry_run:
        output.answer_tables(arguments, known.to_json(), preflight_tables(known))
        return EXIT_CHECK_FAILED if known.missing else EXIT_DONE
    remark(*summary(known), quiet=arguments.quiet)
    if known.missing:
        first = known.missing[0]
        more = f" and {len(known.missing) - 1} more" if len(known.missing) > 1 else ""
        how = f"; get it with: {first.how}" if first.how else f"; {first.remark}" if first.remark else ""
        raise ConfigError(
            f"reproduce {recipe.name}: {first.kind} {first.name} is missing{more}{how}; --dry-run lists all"
        )
    folders = evaluate_predictions(named, experiments, asked, out)  # first, because it is much faster than the runs
    failures = [failure for run in runs for failure in _execute_run(run, out, arguments)]
    folders = [run.folder(out) for run in runs] + folders
    _answer(recipe, experiments, folders, out, arguments)
    if failures:
        raise RunIncomplete(f"reproduce {recipe.name}: {counted(len(failures), 'scene')} failed; {failures[0]}")
    return EXIT_DONE


def _execute_run(run: RecipeRun, out: Path, arguments: argparse.Namespace) -> list[str]:
    """One line per failure."""
    from su3d_bench.reproducing.recipe import execute, plan_of

    plan = plan_of(run, out)
    with output.progress(len(plan.jobs), is_quiet=arguments.quiet) as report:
        result = execute(run, plan, report)
    remark(*result.remarks, quiet=arguments.quiet)
    remark(f"run folder: {plan.folder.path}", quiet=arguments.quiet)
    return [line for _, _, line in result.failures]


def _answer(
    recipe: Recipe, experiments: Sequence[Experiment], folders: Sequence[Path], out: Path, arguments: argparse.Namespace
) -> None:
    """Write tables to stdout and ``tables.md``, cells to ``compared.json``, pictures and the archive."""
    from su3d_bench.core.files.atomic import write_json
    from su3d_bench.reproducing.bundle import write_bundle
    from su3d_bench.reproducing.deviations import deviation_table, run_deviations
    from su3d_bench.reproducing.differences import Results, compared_all, compared_json, draw_queries, result_tables
    from su3d_bench.reproducing.recipe import recipe_file

    results = Results(tuple(folders))
    cells = compared_all(experiments, results)
    found = run_deviations(results.runs.values())
    tables = [*result_tables(experiments, cells, results), *([deviation_table(found)] if found else [])]
    value = compared_json(recipe, cells) | {"deviations": [asdict(one) for one in found]}
    output.written(
        out / "tables.md", output.formatted(tables, argparse.Namespace(table_format="markdown"), is_file=True)
    )
    write_json(out / "compared.json", value)
    if not output.answer_json(arguments, value):
        output.answer_document(output.formatted(tables, arguments))
        output.show()
    for picture in draw_queries(experiments, results, out / "pictures", arguments.device or "cpu"):
        remark(f"picture: {picture}", quiet=arguments.quiet)
    bundle = arguments.bundle or out / "bundle.zip"
    write_bundle(bundle, recipe.name, recipe_file(arguments.recipe), folders, out)
    remark(f"bundle: {bundle}", quiet=arguments.quiet)
    data = ["--data", arguments.data] if arguments.data else []
    remark(f"next: {shlex.join(['su3d-bench', 'report', 'verify', str(bundle), *data])}", quiet=arguments.quiet)
