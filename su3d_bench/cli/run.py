"""``su3d-bench run`` and ``ablate``: run methods on scenes and score them under all protocols that fit."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli import output
from su3d_bench.cli.options import EXECUTOR, JOBS, Parser, Verbs, add_verb, count, positive, run_folder
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import EXIT_DONE, EXIT_INCOMPLETE, counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from su3d_bench.core.config import Settings
    from su3d_bench.runs.existing import Into
    from su3d_bench.runs.plan import Plan
    from su3d_bench.runs.runner import RunResult

    Answer = Callable[[RunResult, argparse.Namespace], None]


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "run", call_run, resumes=True, data=True)
    parser.option("--methods METHOD...", "methods to use (variants, file.py:Class or all; default: opensu3d)")
    add_run_options(parser)
    parser = add_verb(verbs, "ablate", call_ablate, resumes=True, data=True)
    parser.option("--vary KEY=V1,V2...", "settings to vary and their values", required=True)
    parser.option("--method METHOD", "method to use (or file.py:Class; default: opensu3d)", default="opensu3d")
    parser.option("--also-methods METHOD...", "additional methods to run without variation", default=[])
    parser.option("--grid", "run every combination instead of one setting at a time")
    add_run_options(parser)


def add_run_options(parser: Parser) -> None:
    """Add the options of both commands; values come from the flag, then ``--config``, then the default."""
    parser.option("scene [SCENE...]", "scenes or patterns, as in --scenes")
    parser.option("--scenes SCENE...", "scenes or patterns to use (default: 'homes/test*')")
    headline = "protocols to use (default: the dataset's headline protocol)"
    parser.option("--protocols PROTOCOL...", headline, action="extend")
    parser.shared("--all-protocols", "--profile", "--device")
    parser.shared("--jobs", help=JOBS)
    parser.option("--memory SIZE", "memory limit of each worker process, such as 8G (default: none)")
    parser.shared("--limit", "--question-solver", "--refiner", "--offline", *EXECUTOR)
    parser.shared("--seed", type=int, default=None)
    parser.option("--stride N", "use every Nth frame (default: set by the method)", type=int)
    parser.option(
        "--pictures",
        "draw the maps into the run folder (default: yes; sweeps of robustness: no)",
        action=argparse.BooleanOptionalAction,
    )
    parser.option(
        "--accept-poses",
        "warn instead of failing if depth contradicts the poses",
        action=argparse.BooleanOptionalAction,
    )
    anytime = "also score the map after these fractions of the updates, with --realtime of the recording"
    parser.option("--anytime SHARE...", anytime, type=float)
    parser.option("--anytime-every N", "also score the map after every N updates", type=int)
    parser.option(
        "--seen-so-far",
        "score each of these maps and the last one also against what the frames until then have shown",
        action=argparse.BooleanOptionalAction,
    )
    parser.option("--realtime HZ", "frames that arrive per second; those that find no place are dropped", type=positive)
    queues = ("newest", "drop-new", "drop-old")
    parser.option("--queue POLICY", "what waits while the method is busy (default: newest)", choices=queues)
    parser.option("--queue-size N", "places in the queue of drop-new and drop-old (default: 10)", type=count)
    parser.option("--schedule PATH", "run or schedule.csv to replay: the same frames, the same maps", type=Path)
    parser.option("--cost FILE", "CSV file of durations to simulate: device, and duration_ms or mean_ms and sd_ms")
    parser.shared("--set", "--config", "--dry-run", "--format")
    parser.option("--out DIR", "run folder (default: a folder in runs/)", type=run_folder)
    into = parser.add_mutually_exclusive_group()
    what = "add scenes, methods and protocols to the run in --out"
    parser.option("--extend", what, into)
    parser.option("--replace", "overwrite the run in --out", into)


def call_run(arguments: argparse.Namespace) -> int:
    """Run methods on scenes and score them; the same command resumes an interrupted run.

    su3d-bench run homes/tuning0 --methods opensu3d oracle
    su3d-bench run --scenes 'homes/test*' --limit 5 --set opensu3d.top_m=10 --dry-run
    """
    return execute(plan_of(arguments), arguments)


def settings_of(arguments: argparse.Namespace) -> Settings:
    """The settings of the file, overridden by those of the flags."""
    from su3d_bench.core.config import RunConfig
    from su3d_bench.runs.plan import asked_settings

    scenes = [*arguments.scene, *(arguments.scenes or ())] or None
    values = {name: scenes if name == "scenes" else getattr(arguments, name) for name in RunConfig.model_fields}
    return asked_settings(
        values, device=arguments.device, config=arguments.config, source_of=lambda key: f"--{key.replace('_', '-')}"
    )


def plan_of(arguments: argparse.Namespace) -> Plan:
    """The plan of the requested run."""
    from su3d_bench.runs.plan import make_plan

    into: Into = "extend" if arguments.extend else "replace" if arguments.replace else "own"
    plan = make_plan(settings_of(arguments), arguments.set, arguments.out, into=into)
    remark(*plan.notes, quiet=arguments.quiet)
    return plan


def execute(plan: Plan, arguments: argparse.Namespace, answer: Answer | None = None) -> int:
    """Run the plan and print its tables, or ``answer`` if nothing failed; with ``--dry-run`` print the cost."""
    from su3d_bench.runs.runner import run_plan

    if arguments.dry_run:
        _show_plan(plan, arguments)
        return EXIT_DONE
    if arguments.out is None:
        remark(f"{counted(len(plan.jobs), 'scene')}, run folder: {plan.folder.path}", quiet=arguments.quiet)
    n_maps = sum(len(job.parts) for job in plan.jobs)
    with output.progress(len(plan.jobs), is_quiet=arguments.quiet, n_maps=n_maps) as report:
        result = run_plan(plan, report)
    (answer if answer and result.is_complete else _answer_result)(result, arguments)
    remark(*dict.fromkeys(f"su3d-bench: {line}" for _, _, line in result.failures))
    if result.is_complete:
        return EXIT_DONE
    n_failed = len({scene for scene, _, _ in result.failures})
    log = plan.folder.job(*result.failures[0][:2]).log
    remark(f"su3d-bench: incomplete: {n_failed} of {counted(len(plan.jobs), 'scene')} failed; see {log}")
    return EXIT_INCOMPLETE


def _answer_result(result: RunResult, arguments: argparse.Namespace) -> None:
    """Print the tables, then the run folder, its pictures and commands for next steps."""
    from su3d_bench.reports.tables.run import run_tables
    from su3d_bench.runs.advice import next_commands, pictures_of

    found = {"found": [asdict(found) for found in result.found]} if result.found else {}
    output.answer_tables(arguments, result.metrics | found, run_tables(result.metrics, result.found))
    plan = result.plan
    remark(*result.remarks, f"run folder: {plan.folder.path}", quiet=arguments.quiet)
    if arguments.quiet:
        return
    if pictures := pictures_of(result):
        others = plan.folder.path / "scenes" / "*" / "*" / pictures[0].parent.name
        more = f" and {len(pictures) - 1} more in {others}" if len(pictures) > 1 else ""
        remark(f"pictures: {pictures[0]}{more}")
    remark(*(f"{'     ' if n else 'next:'} {command}" for n, command in enumerate(next_commands(result))))


def _show_plan(plan: Plan, arguments: argparse.Namespace) -> None:
    from su3d_bench.runs.advice import estimate

    rows = estimate(plan)
    lines = []
    for row in rows:
        state = "already done" if row.is_done else f"{counted(row.n_updates, 'update')}, about {row.seconds:.0f} s"
        lines.append(f"{row.scene:<24} {row.method:<12} {row.remark or state}")
    minutes = sum(row.seconds for row in rows if not row.is_done) / plan.n_workers / 60
    source = "measured in earlier runs" if all(row.is_measured for row in rows) else "a rough guess"
    n_jobs = counted(plan.n_workers, "job")
    lines.append(f"about {minutes:.1f} minutes with {n_jobs} ({source}); folder {plan.folder.path}")
    lines += [f"protocols: {', '.join(job.protocols) or 'none'}; profile {job.config.profile}" for job in plan.jobs[:1]]
    value = {"folder": str(plan.folder.path), "n_workers": plan.n_workers, "jobs": [asdict(row) for row in rows]}
    output.answer_either(arguments, value, *lines)


def call_ablate(arguments: argparse.Namespace) -> int:
    """Run an ablation: vary settings of a method, one at a time, on the same scenes.

    su3d-bench ablate --vary top_m=1,5,10 k=1,3,5 --also-methods conceptgraphs --scenes 'homes/test*' --out runs/sweep
    su3d-bench ablate --method conceptgraphs --vary sim_threshold=1.0,1.2 stride=5,10 --grid --dry-run
    """
    from su3d_bench.core import registry
    from su3d_bench.runs.ablation import ablation_rows, write_rows

    rows = ablation_rows(arguments.method, arguments.vary, is_grid=arguments.grid)
    default_name = str(registry.load("method", arguments.method).name)
    swept = [arguments.method + row.method.removeprefix(default_name) for row in rows]
    arguments.methods = list(dict.fromkeys([*swept, *arguments.also_methods]))
    plan = plan_of(arguments)
    code = execute(plan, arguments)
    if code == EXIT_DONE and not arguments.dry_run:
        write_rows(plan.folder.path, rows, joins=arguments.extend)
        remark(
            f"table: su3d-bench report tables {plan.folder.path} --tables I", quiet=arguments.quiet or arguments.json
        )
    return code
