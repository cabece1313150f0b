"""``su3d-bench run`` and ``ablate``: methods over scenes, scored under all protocols that fit."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli.options import EXECUTOR, Verbs, add_options, add_verb
from su3d_bench.cli.output import answer, answer_document, answer_json, formatted, progress, remark
from su3d_bench.core.errors import EXIT_DONE, EXIT_INCOMPLETE, counted

if TYPE_CHECKING:
    from su3d_bench.core.config import Settings
    from su3d_bench.runs.existing import Into
    from su3d_bench.runs.plan import Plan
    from su3d_bench.runs.runner import RunResult


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "run",
        "Run methods over scenes and score them; the same command again resumes.",
        (
            "su3d-bench run rooms/living0 --methods opensu3d oracle",
            "su3d-bench run --scenes 'rooms/*' --limit 5 --set opensu3d.top_m=10 --dry-run",
        ),
        call_run,
        takes_up=True,
    )
    parser.add_argument(
        "--methods", nargs="+", metavar="METHOD", help="names, variants, file.py:Class, or all (default: opensu3d)"
    )
    _add_run_options(parser)
    parser = add_verb(
        verbs,
        "ablate",
        "Vary settings of a method, each on its own, over scenes; perception is computed once.",
        (
            "su3d-bench ablate --vary m=1,5,10 k=1,3,5 --beside conceptgraphs --scenes 'rooms/*' --out runs/sweep",
            "su3d-bench ablate --method conceptgraphs --vary sim_threshold=1.0,1.2 stride=5,10 --grid --dry-run",
        ),
        call_ablate,
        takes_up=True,
    )
    parser.add_argument("--vary", nargs="+", required=True, metavar="KEY=V1,V2", help="settings and their values")
    parser.add_argument("--method", default="opensu3d", help="name or file.py:Class (default: opensu3d)")
    parser.add_argument(
        "--beside",
        nargs="+",
        default=[],
        metavar="METHOD",
        help="other methods in the same run, as run --methods takes",
    )
    parser.add_argument("--grid", action="store_true", help="every combination, instead of one setting at a time")
    _add_run_options(parser)


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    """The options of both verbs; what is not given comes from ``--config`` or has its default."""
    parser.add_argument("scene", nargs="*", metavar="SCENE", help="addresses or patterns, as --scenes takes them")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="addresses or patterns (default: 'rooms/*')")
    parser.add_argument(
        "--protocols", nargs="+", metavar="PROTOCOL", help="evaluations (default: those of the dataset)"
    )
    add_options(parser, "--profile", "--device", "--jobs", "--limit", "--solver", "--offline", *EXECUTOR)
    add_options(parser, "--seed", type=int, default=None)
    parser.add_argument("--stride", type=int, metavar="N", help="frames between updates (default: the method's own)")
    parser.add_argument(
        "--pictures", action=argparse.BooleanOptionalAction, help="draw the maps into the run folder (default: yes)"
    )
    parser.add_argument(
        "--accept-poses",
        action=argparse.BooleanOptionalAction,
        help="run recordings whose depth contradicts their poses all the same, with a warning (default: refuse them)",
    )
    parser.add_argument(
        "--anytime", nargs="+", type=float, metavar="SHARE", help="score the map after these shares of the updates too"
    )
    add_options(parser, "--set", "--config", "--dry-run", "--format")
    parser.add_argument(
        "--out",
        type=run_place,
        metavar="DIR",
        help="run folder, or URL of one such as s3://bucket/run (default: runs/<name made from the request>)",
    )
    into = parser.add_mutually_exclusive_group()
    into.add_argument(
        "--extend",
        action="store_true",
        help="add these scenes, methods and protocols to the run in --out, whose other values stay",
    )
    into.add_argument("--replace", action="store_true", help="put this run in the place of the one in --out")


def run_place(text: str) -> Path | str:
    """A folder, or the text of a URL."""
    return text if "://" in text else Path(text)


def call_run(arguments: argparse.Namespace) -> int:
    plan = plan_of(arguments)
    for note in plan.notes:
        remark(note, quiet=arguments.quiet)
    return show_plan(plan, arguments) if arguments.dry_run else carry_out(plan, arguments)


def plan_of(arguments: argparse.Namespace) -> Plan:
    """The plan of what was asked for, in a process that leaves the cores to the scenes side by side."""
    from su3d_bench.runs.plan import make_plan

    into: Into = "extend" if arguments.extend else "replace" if arguments.replace else "own"
    return make_plan(settings_of(arguments), arguments.set, arguments.out, into=into)


def settings_of(arguments: argparse.Namespace) -> Settings:
    """The file's settings, then those of the flags, which win."""
    from su3d_bench.core.config import RunConfig
    from su3d_bench.runs.plan import asked_settings

    scenes = [*arguments.scene, *(arguments.scenes or ())] or None
    values = {name: scenes if name == "scenes" else getattr(arguments, name) for name in RunConfig.model_fields}
    return asked_settings(
        values, device=arguments.device, config=arguments.config, source_of=lambda key: f"--{key.replace('_', '-')}"
    )


def carry_out(plan: Plan, arguments: argparse.Namespace) -> int:
    from su3d_bench.runs.runner import run_plan
    from su3d_bench.store.caches import why_slow

    if line := why_slow():
        remark(f"su3d-bench: {line}", quiet=arguments.quiet)
    with progress(len(plan.jobs), is_quiet=arguments.quiet) as report:
        result = run_plan(plan, report)
    _answer_result(result, arguments)
    for line in dict.fromkeys(line for _, _, line in result.failures):
        remark(f"su3d-bench: {line}")
    if result.is_complete:
        return EXIT_DONE
    n_failed = len({scene for scene, _, _ in result.failures})
    log = plan.folder.job(*result.failures[0][:2]).log
    remark(f"su3d-bench: incomplete: {n_failed} of {counted(len(plan.jobs), 'scene')} failed; see {log}")
    return EXIT_INCOMPLETE


def _answer_result(result: RunResult, arguments: argparse.Namespace) -> None:
    from su3d_bench.reports.tables.run import run_tables

    found = {"found": [asdict(found) for found in result.found]} if result.found else {}
    if not answer_json(arguments, result.metrics | found):
        answer_document(formatted(run_tables(result.metrics, result.found), arguments))
    for line in result.remarks:
        remark(line, quiet=arguments.quiet)
    plan = result.plan
    place = plan.place.name if plan.place.url is None else f"{plan.place.url} (its small files: {plan.folder.path})"
    remark(f"run folder: {place}", quiet=arguments.quiet)
    if not arguments.quiet:
        _say_what_is_next(result)


def _say_what_is_next(result: RunResult) -> None:
    from su3d_bench.runs.advice import next_commands, pictures_of

    pictures = pictures_of(result)
    if pictures:
        others = result.plan.folder.path / "scenes" / "*" / "*" / pictures[0].parent.name
        more = f" and {len(pictures) - 1} more in {others}" if len(pictures) > 1 else ""
        remark(f"pictures: {pictures[0]}{more}")
    for n, command in enumerate(next_commands(result)):
        remark(f"{'     ' if n else 'next:'} {command}")


def show_plan(plan: Plan, arguments: argparse.Namespace) -> int:
    from su3d_bench.runs.advice import estimate

    rows = estimate(plan)
    jobs = [asdict(row) for row in rows]
    if answer_json(arguments, {"folder": str(plan.folder.path), "n_workers": plan.n_workers, "jobs": jobs}):
        return EXIT_DONE
    for row in rows:
        state = "done already" if row.is_done else f"{counted(row.n_updates, 'update')}, about {row.seconds:.0f} s"
        state = row.remark or state
        answer(f"{row.scene:<24} {row.method:<12} {state}")
    total = sum(row.seconds for row in rows if not row.is_done) / plan.n_workers
    source = "measured in earlier runs" if all(row.is_measured for row in rows) else "a rough guess"
    answer(
        f"about {total / 60:.1f} minutes with {counted(plan.n_workers, 'job')} ({source}); folder {plan.folder.path}"
    )
    for job in plan.jobs[:1]:
        answer(f"protocols: {', '.join(job.protocols) or 'none'}; profile {job.config.profile}")
    return EXIT_DONE


def call_ablate(arguments: argparse.Namespace) -> int:
    from su3d_bench.core import registry
    from su3d_bench.runs.ablation import ablation_rows, write_rows

    rows = ablation_rows(arguments.method, arguments.vary, is_grid=arguments.grid)
    own_name = str(registry.load("method", arguments.method).name)
    swept = [arguments.method + row.method.removeprefix(own_name) for row in rows]
    arguments.methods = list(dict.fromkeys([*swept, *arguments.beside]))
    plan = plan_of(arguments)
    for note in plan.notes:
        remark(note, quiet=arguments.quiet)
    if arguments.dry_run:
        return show_plan(plan, arguments)
    code = carry_out(plan, arguments)
    if code == EXIT_DONE:
        write_rows(plan.folder.path, rows, joins=arguments.extend)
        plan.place.publish()
        remark(f"table: su3d-bench report tables {plan.folder.path} --table I", quiet=arguments.quiet or arguments.json)
    return code
