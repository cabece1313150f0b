"""``su3d-bench reproduce``: a paper's experiments: what they need, the runs, measured beside reported, the bundle."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli.options import EXECUTOR, Verbs, add_options, add_out, add_verb
from su3d_bench.cli.output import answer, answer_document, answer_json, formatted, remark, show, written
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError, RunIncomplete, counted, printable

if TYPE_CHECKING:
    from su3d_bench.reproducing.preflight import Preflight
    from su3d_bench.reproducing.recipe import Asked, AskedRun, Experiment, Recipe

VARIABLES = ("SU3D_DATA",)  # where a rehearsal's own data lie
OF_A_RUN = ("jobs", "limit", "solver", "offline", "executor", "ray_address", "gpus_per_job", "retries", "slurm")


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "reproduce",
        "Do a paper's experiments again: what is missing, the runs, its tables beside the printed ones, one archive.",
        (
            "su3d-bench reproduce opensu3d --table II III --dry-run",
            "su3d-bench reproduce opensu3d --table I II III IV V reasoning --rehearse",
        ),
        call,
        takes_up=True,
    )
    parser.add_argument(
        "recipe", metavar="RECIPE", nargs="?", help="its name, or a file of your own (default: list them)"
    )
    parser.add_argument("--table", nargs="+", default=[], metavar="NAME", help="these experiments alone (default: all)")
    add_out(parser, "DIR", "where all goes (default: reproduced/<recipe>)")
    add_options(parser, "--dry-run")
    parser.add_argument(
        "--rehearse", action="store_true", help="the same on rooms made in the same layouts, with embedded perception"
    )
    parser.add_argument("--rooms", nargs="+", metavar="ROOM", help="of a rehearsal (default: the recipe's)")
    parser.add_argument(
        "--room-settings", nargs="+", metavar="KEY=VALUE", help="options of the rooms, such as n_frames=80 width=160"
    )
    parser.add_argument(
        "--predictions",
        nargs="+",
        default=[],
        metavar="METHOD=DIR",
        help="of methods that are none here, as evaluate takes",
    )
    parser.add_argument(
        "--text-features",
        nargs="+",
        default=[],
        metavar="METHOD=FILE",
        help="what the encoder of its predictions makes of texts, as evaluate --text-features",
    )
    add_options(parser, "--profile")
    parser.add_argument("--encoder", help="of all runs, such as embedded (default: the recipe's)")
    add_options(parser, "--device", "--jobs", "--limit", "--solver", "--offline", *EXECUTOR, "--set")
    parser.add_argument(
        "--bundle", type=Path, metavar="FILE", help="the archive (default: bundle.zip in the folder of --out)"
    )
    add_options(parser, "--format")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.reproducing.recipe import load_recipe

    if arguments.recipe is None:
        return _list_recipes(arguments)
    recipe = load_recipe(arguments.recipe)
    experiments = recipe.chosen(arguments.table)
    rehearsal = [name for name in ("rooms", "room_settings") if getattr(arguments, name)]
    if rehearsal and not arguments.rehearse:
        raise ConfigError(f"--{rehearsal[0].replace('_', '-')}: belongs to --rehearse; leave it out, or rehearse")
    _check_device(arguments)
    out = arguments.out or Path("reproduced") / (recipe.name + ("-rehearsal" if arguments.rehearse else ""))
    if not arguments.rehearse:
        return _reproduce(recipe, experiments, _asked(arguments), out, arguments)
    from su3d_bench.cli.rehearsal import places, rehearsed
    from su3d_bench.reproducing.recipe import environment

    asked = rehearsed(recipe, experiments, _asked(arguments), out, arguments)
    with environment(**places(out)):
        return _reproduce(recipe, experiments, asked, out, arguments)


def _check_device(arguments: argparse.Namespace) -> None:
    """Raise before anything is made or weighed where there is no such GPU; a cluster's machines have theirs."""
    from su3d_bench.core.system.devices import DEVICE, EXPECTED_DEVICE, device_for
    from su3d_bench.runs.executors import ELSEWHERE

    if arguments.device is None:
        return
    if DEVICE.fullmatch(arguments.device) is None:
        raise ConfigError(f"--device {printable(arguments.device, 40)}: {EXPECTED_DEVICE}")
    if not arguments.dry_run and arguments.executor not in ELSEWHERE:
        device_for(arguments.device, 0)


def _list_recipes(arguments: argparse.Namespace) -> int:
    from su3d_bench.reproducing.recipe import load_recipe, recipe_names

    recipes = [load_recipe(name) for name in recipe_names()]
    value = [
        {"name": one.name, "title": one.title, "tables": [each.name for each in one.experiments]} for one in recipes
    ]
    if not answer_json(arguments, value):
        answer(*(f"{one['name']:<14} {', '.join(one['tables'])}" for one in value))
    return EXIT_DONE


def _asked(arguments: argparse.Namespace) -> Asked:
    from su3d_bench.reproducing.recipe import Asked

    values = {name: getattr(arguments, name) for name in OF_A_RUN if getattr(arguments, name) is not None}
    return Asked(arguments.profile, arguments.encoder, arguments.device, values, tuple(arguments.set))


def _reproduce(
    recipe: Recipe, experiments: Sequence[Experiment], asked: Asked, out: Path, arguments: argparse.Namespace
) -> int:
    from su3d_bench.reproducing.preflight import preflight
    from su3d_bench.reproducing.recipe import asked_runs, evaluate_predictions, named_predictions

    runs = asked_runs(recipe, experiments, asked)
    named = named_predictions(experiments, arguments.predictions, arguments.text_features)
    known = preflight(runs)
    if arguments.dry_run:
        _show(known, arguments)
        return EXIT_CHECK_FAILED if known.missing else EXIT_DONE
    _say(known, arguments)
    if known.missing:
        first = known.missing[0]
        more = f" and {len(known.missing) - 1} more" if len(known.missing) > 1 else ""
        how = f"; get it with: {first.how}" if first.how else f"; {first.remark}" if first.remark else ""
        ends = "" if arguments.rehearse else ", --rehearse does without"
        raise ConfigError(
            f"reproduce {recipe.name}: {first.kind} {first.name} is missing{more}{how}; --dry-run lists all{ends}"
        )
    folders = evaluate_predictions(named, experiments, asked, out)  # first: it takes minutes, the runs hours
    failures = [failure for run in runs for failure in _carry_out(run, out, arguments)]
    folders = [run.folder(out) for run in runs] + folders
    _answer(recipe, experiments, folders, out, arguments)
    if failures:
        raise RunIncomplete(f"reproduce {recipe.name}: {counted(len(failures), 'scene')} failed; {failures[0]}")
    return EXIT_DONE


def _show(known: Preflight, arguments: argparse.Namespace) -> None:
    from su3d_bench.reproducing.preflight import preflight_tables

    if not answer_json(arguments, known.to_json()):
        answer_document(formatted(preflight_tables(known), arguments))


def _say(known: Preflight, arguments: argparse.Namespace) -> None:
    from su3d_bench.reproducing.preflight import summary

    for line in summary(known):
        remark(line, quiet=arguments.quiet)


def _carry_out(run: AskedRun, out: Path, arguments: argparse.Namespace) -> list[str]:
    """Lines of what failed."""
    from su3d_bench.cli.output import progress
    from su3d_bench.reproducing.recipe import carry_out, plan_of

    plan = plan_of(run, out)
    with progress(len(plan.jobs), is_quiet=arguments.quiet) as report:
        result = carry_out(run, plan, report)
    for line in result.remarks:
        remark(line, quiet=arguments.quiet)
    remark(f"run folder: {plan.folder.path}", quiet=arguments.quiet)
    return [line for _, _, line in result.failures]


def _answer(
    recipe: Recipe, experiments: Sequence[Experiment], folders: Sequence[Path], out: Path, arguments: argparse.Namespace
) -> None:
    """The tables on stdout and in ``tables.md``, every cell in ``compared.json``, pictures, and the archive."""
    from su3d_bench.core.files.atomic import write_json
    from su3d_bench.reproducing.bundle import write_bundle
    from su3d_bench.reproducing.differences import Results, compared_all, compared_json, draw_queries, result_tables
    from su3d_bench.reproducing.recipe import recipe_file

    results = Results(tuple(folders))
    cells = compared_all(experiments, results)
    tables = result_tables(experiments, cells, results)
    value = compared_json(recipe, cells)
    written(out / "tables.md", formatted(tables, argparse.Namespace(table_format="markdown"), is_file=True))
    write_json(out / "compared.json", value)
    if not answer_json(arguments, value):
        answer_document(formatted(tables, arguments))
        show()
    for picture in draw_queries(experiments, results, out / "pictures", arguments.device or "cpu"):
        remark(f"picture: {picture}", quiet=arguments.quiet)
    bundle = arguments.bundle or out / "bundle.zip"
    write_bundle(bundle, recipe.name, recipe_file(arguments.recipe), folders, out)
    remark(f"bundle: {bundle}", quiet=arguments.quiet)
    names = [name for name in VARIABLES if arguments.rehearse and name in os.environ]
    where = "".join(f"{name}={shlex.quote(os.environ[name])} " for name in names)
    remark(f"next: {where}su3d-bench report verify {shlex.quote(str(bundle))}", quiet=arguments.quiet)
