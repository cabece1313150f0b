"""``su3d-bench runs``: list, show, remove, refine and export runs."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli import export, options, output
from su3d_bench.cli.options import Verbs, add_group, add_verb, count, searched_folder
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, PredictionError, StoreError, counted, printable, printable_json, suggest

if TYPE_CHECKING:
    from su3d_bench.core.maps import Instances
    from su3d_bench.questions.refining import FilterConfig, NameRecords, RefinedName
    from su3d_bench.store.run_folder import JobFolder, RunFolder

DEFAULT = Path("runs")


def add_parser(verbs: Verbs) -> None:
    """List, show, remove, refine and export runs.

    su3d-bench runs list
    su3d-bench runs show runs/demo
    """
    actions = add_group(verbs, "runs", add_parser, lists=True)
    parser = add_verb(actions, "list", call_list)
    parser.option("folder [DIR]", "folder to search (default: runs)", type=searched_folder, default=DEFAULT)
    parser.shared("--format")
    parser = add_verb(actions, "show", call_show)
    parser.shared("run")
    parser = add_verb(actions, "remove", call_remove)
    parser.option("runs RUN...", "run folders")
    parser.option("--yes", "do not ask for confirmation")
    parser = add_verb(actions, "refine", call_refine)
    parser.shared("run", "--method", "--scenes")
    parser.shared("--refiner", default="vote")
    parser.option("--top-m N", "number of views used (default: 5)", type=count, default=5)
    parser.option("--background-names [NAME...]", "names of background to exclude (default: those of the paper)")
    parser.option(
        "--max-map-fraction SHARE",
        "maximum share of the map that a box may cover from above (default: 0.95)",
        type=float,
    )
    options.add_language_options(parser)
    export.add_parser(actions)


def call_list(arguments: argparse.Namespace) -> None:
    """List runs with date, progress and headline scores.

    su3d-bench runs list
    su3d-bench runs list /shared/runs --json
    """
    from su3d_bench.analysis.leaderboard import list_runs, runs_table

    if not arguments.folder.is_dir() and arguments.folder != DEFAULT:
        raise ConfigError(f"{arguments.folder}: no such folder; name a folder of runs")
    entries = list_runs(arguments.folder) if arguments.folder.is_dir() else []
    if not entries:
        remark(f"{arguments.folder}: no runs; create one with su3d-bench run homes/tuning0", quiet=arguments.quiet)
    if entries or arguments.json:
        output.answer_tables(arguments, [asdict(entry) for entry in entries], [runs_table(entries)])


def call_show(arguments: argparse.Namespace) -> None:
    """Show the settings and progress of a run, and the command that resumes it.

    su3d-bench runs show runs/demo
    su3d-bench runs show runs/demo --json
    """
    from su3d_bench.analysis.leaderboard import run_entry, size_bytes
    from su3d_bench.formats.tables.table import percent
    from su3d_bench.runs.existing import existing_run

    entry = run_entry(arguments.run)
    asked: dict[str, str] = {}
    with suppress(StoreError):  # run.toml is damaged
        if (run := existing_run(arguments.run)) is not None:
            asked = {
                ".".join(path): json.dumps(value, ensure_ascii=False, default=str)
                for path, value in run.requested.items()
            }
    n_bytes = size_bytes(arguments.run)
    config = arguments.run / "run.toml"
    again = shlex.join(["su3d-bench", "run", "--config", str(config), "--out", str(arguments.run)])
    value = asdict(entry) | {"bytes": n_bytes, "asked": printable_json(asked), "command": again}
    lines = [
        f"{entry.name}: {entry.state}, written {entry.when}, {n_bytes / 1e6:.1f} MB",
        f"scenes: {', '.join(entry.scenes) or 'not known'}",
        f"methods: {', '.join(entry.methods) or 'not known'}",
        *(f"  {one.method} under {one.protocol}: {one.metric} {percent(one.value)}" for one in entry.headlines),
        "settings:",
        *(f"  {printable(key, 120)} = {printable(text, 300)}" for key, text in asked.items()),
        f"resume: {again}",
    ]
    output.answer_either(arguments, value, *lines)


def call_remove(arguments: argparse.Namespace) -> None:
    """Remove run folders after confirmation; folders that contain other files are kept.

    su3d-bench runs remove runs/demo
    su3d-bench runs remove runs/a runs/b --yes
    """
    from su3d_bench.analysis.leaderboard import removable, run_entry, size_bytes

    folders = [removable(path) for path in dict.fromkeys(arguments.runs)]  # check all before removing the first
    lines = []
    for folder, path in zip(folders, dict.fromkeys(arguments.runs), strict=True):
        entry = run_entry(folder.path, str(path))
        what = f"{', '.join(entry.scenes) or 'no scene'} by {', '.join(entry.methods) or 'no method'}"
        lines.append(f"{entry.name}: {entry.state}, {size_bytes(folder.path) / 1e6:.1f} MB, {what}")
    if not arguments.yes and not _is_agreed(lines):
        output.answer_either(arguments, {"removed": []}, "nothing was removed")
        return
    for folder in folders:
        folder.remove()
    removed = [str(path) for path in dict.fromkeys(arguments.runs)]
    output.answer_either(arguments, {"removed": removed}, *(f"removed {line}" for line in lines))


def _is_agreed(lines: list[str]) -> bool:
    """Ask at the terminal whether to remove the runs of ``lines``."""
    if not sys.stdin.isatty():
        raise ConfigError("runs remove: no terminal to ask for confirmation; add --yes")
    remark(*lines, "remove permanently? [y/n]")
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def call_refine(arguments: argparse.Namespace) -> None:
    """Refine labels: choose a final name per instance from its best views, and exclude large background instances.

    su3d-bench runs refine runs/my-run
    su3d-bench runs refine runs/my-run --refiner model --model llama3.1 --base-url http://localhost:11434/v1
    """
    from su3d_bench.questions.refining import ModelRefiner, records_of, top_names, vote, write_records
    from su3d_bench.store.run_folder import RunFolder

    run = RunFolder(arguments.run)
    config = _filter(arguments)
    jobs = _jobs(run, arguments)
    maps = {scene: _map(job) for scene, job in jobs.items()}
    tops = {scene: top_names(instances, arguments.top_m) for scene, instances in maps.items()}
    client, refiner, model = None, None, ""
    if arguments.refiner == "model":
        client, language = options.chat_client(arguments, run)
        refiner, model = ModelRefiner(client, language), language.text_model
    if arguments.dry_run:
        requests = [] if refiner is None else [one for top in tops.values() for one in refiner.requests(top)]
        options.answer_estimate(arguments, client, requests)
        return
    refined: dict[str, Sequence[RefinedName]] = {
        scene: [vote(one) for one in top] if refiner is None else refiner.refine(top) for scene, top in tops.items()
    }
    made = {}
    for scene, job in jobs.items():
        chosen = tops[scene], refined[scene], arguments.refiner, model, arguments.top_m
        made[scene] = records_of(job, maps[scene], *chosen, config)
        remark(f"{scene}: {write_records(job, made[scene])}", quiet=arguments.quiet)
    lines = [line for scene, records in made.items() for line in _refined_lines(scene, records)]
    output.answer_either(arguments, {scene: one.model_dump(mode="json") for scene, one in made.items()}, *lines)
    for scene, records in made.items():
        kept = [name for name in records.names if name.source == "label"]
        reasons = ", ".join(dict.fromkeys(name.reason for name in kept))
        if kept and not arguments.json:
            remark(f"{scene}: label n unchanged for {counted(len(kept), 'instance')}: {reasons}", quiet=arguments.quiet)


def _filter(arguments: argparse.Namespace) -> FilterConfig:
    from su3d_bench.questions.refining import FilterConfig

    share = arguments.max_map_fraction
    if share is not None and not 0 < share <= 1:
        raise ConfigError(f"--max-map-fraction {share}: expected a share above 0 and at most 1")
    given = {"background_names": arguments.background_names, "max_map_fraction": share}
    return FilterConfig.model_validate({name: value for name, value in given.items() if value is not None})


def _jobs(run: RunFolder, arguments: argparse.Namespace) -> dict[str, JobFolder]:
    """The folder of each requested scene."""
    from su3d_bench.store.records import RunRecord, read_record

    shown = printable(str(run.path), 200)
    known = [printable(scene, 200) for scene in read_record(RunRecord, run.path / "run.json", shown).scenes]
    for scene in arguments.scenes:
        if scene not in known:
            raise ConfigError(f"{shown}: no scene '{scene}'{suggest(scene, known, 'it has')}")
    jobs = {scene: run.job(scene, arguments.method) for scene in arguments.scenes or known}
    mapped = {scene: job for scene, job in jobs.items() if job.prediction.is_file()}
    if not mapped:
        raise StoreError(f"{shown}: no map of method '{arguments.method}'; choose another with --method")
    return mapped


def _map(job: JobFolder) -> Instances:
    from su3d_bench.core.maps import Instances
    from su3d_bench.store.predictions import read_prediction

    prediction = read_prediction(job.prediction)
    if not isinstance(prediction, Instances) or prediction.view_names is None:
        raise PredictionError(f"{job.prediction}: no names of views; create the map with opensu3d")
    return prediction


def _refined_lines(scene: str, records: NameRecords) -> list[str]:
    changed = [name for name in records.names if name.refined != name.label]
    return [
        f"{scene}: {counted(len(records.names), 'instance')}, {counted(len(changed), 'name')} changed",
        *(f"  {name.id:>4}  {name.label} -> {name.refined}" for name in changed),
        *(f"  {name.id:>4}  excluded: {name.left_out}" for name in records.names if name.left_out),
    ]
