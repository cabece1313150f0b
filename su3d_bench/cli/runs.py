"""``su3d-bench runs``: run folders listed, shown and removed, and labels n' made from their maps."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli import export
from su3d_bench.cli.options import (
    Verbs,
    add_group,
    add_language_options,
    add_options,
    add_runs,
    add_verb,
    answer_estimate,
    chat_client,
    count,
)
from su3d_bench.cli.output import answer, answer_either, answer_json, answer_tables, remark
from su3d_bench.core.errors import EXIT_DONE, ConfigError, PredictionError, StoreError, counted, suggest

if TYPE_CHECKING:
    from su3d_bench.core.maps import Instances
    from su3d_bench.questions.refining import FilterConfig, NameRecords, RefinedName, TopNames
    from su3d_bench.store.run_folder import JobFolder, RunFolder

DEFAULT = Path("runs")


def add_parser(verbs: Verbs) -> None:
    actions = add_group(
        verbs,
        "runs",
        "List, show, remove, refine and export what runs leave.",
        ("su3d-bench runs list", "su3d-bench runs show runs/demo"),
        lists=True,
    )
    _add_list(actions)
    _add_show(actions)
    _add_remove(actions)
    _add_refine(actions)
    export.add_parser(actions)


def _add_list(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "list",
        "List the runs below a folder: when they were written, how far they came, their first numbers.",
        ("su3d-bench runs list", "su3d-bench runs list /shared/runs --json"),
        call_list,
    )
    parser.add_argument("folder", type=Path, nargs="?", default=DEFAULT, metavar="DIR", help="(default: runs)")
    add_options(parser, "--format")


def call_list(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.analysis.leaderboard import list_runs, runs_table

    if not arguments.folder.is_dir() and arguments.folder != DEFAULT:
        raise ConfigError(f"{arguments.folder}: there is no such folder; name one that holds runs")
    entries = list_runs(arguments.folder) if arguments.folder.is_dir() else []
    if not entries:
        remark(f"no run in {arguments.folder}; su3d-bench run rooms/living0 makes one", quiet=arguments.quiet)
    if entries or arguments.json:
        answer_tables(arguments, [asdict(entry) for entry in entries], [runs_table(entries)])
    return EXIT_DONE


def _add_show(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "show",
        "Show what a run was asked for, how far it came, and the command that takes it up again.",
        ("su3d-bench runs show runs/demo", "su3d-bench runs show runs/demo --json"),
        call_show,
    )
    add_runs(parser, None)


def call_show(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.analysis.leaderboard import run_entry, size_bytes
    from su3d_bench.core.errors import StoreError, printable, printable_json
    from su3d_bench.formats.tables.table import percent
    from su3d_bench.runs.existing import existing_run

    entry = run_entry(arguments.run)
    asked: dict[str, str] = {}
    with suppress(StoreError):  # a damaged run.toml tells nothing
        held = existing_run(arguments.run)
        for path, value in () if held is None else held.requested.items():
            asked[".".join(path)] = json.dumps(value, ensure_ascii=False, default=str)
    n_bytes = size_bytes(arguments.run)
    config = arguments.run / "run.toml"
    again = shlex.join(["su3d-bench", "run", "--config", str(config), "--out", str(arguments.run)])
    value = asdict(entry) | {"bytes": n_bytes, "asked": printable_json(asked), "command": again}
    lines = [
        f"{entry.name}: {entry.state}, written {entry.when}, {n_bytes / 1e6:.1f} MB",
        f"scenes: {', '.join(entry.scenes) or 'not known'}",
        f"methods: {', '.join(entry.methods) or 'not known'}",
        *(f"  {one.method} under {one.protocol}: {one.metric} {percent(one.value)}" for one in entry.headlines),
        "asked for:",
        *(f"  {printable(key, 120)} = {printable(text, 300)}" for key, text in asked.items()),
        f"take it up again: {again}",
    ]
    answer_either(arguments, value, *lines)
    return EXIT_DONE


def _add_remove(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "remove",
        "Remove run folders, once it is known that they hold nothing but a run; asks before it does.",
        ("su3d-bench runs remove runs/demo", "su3d-bench runs remove runs/a runs/b --yes"),
        call_remove,
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folders")
    parser.add_argument("--yes", action="store_true", help="do not ask; needed where nobody sits at a terminal")


def call_remove(arguments: argparse.Namespace) -> int:
    from su3d_bench.analysis.leaderboard import removable, run_entry, size_bytes

    folders = [removable(path) for path in dict.fromkeys(arguments.runs)]  # all of them, before the first goes
    lines = []
    for folder, path in zip(folders, dict.fromkeys(arguments.runs), strict=True):
        entry = run_entry(folder.path, str(path))
        what = f"{', '.join(entry.scenes) or 'no scene'} by {', '.join(entry.methods) or 'no method'}"
        lines.append(f"{entry.name}: {entry.state}, {size_bytes(folder.path) / 1e6:.1f} MB, {what}")
    if not arguments.yes and not _is_agreed(lines):
        answer_either(arguments, {"removed": []}, "nothing was removed")
        return EXIT_DONE
    for folder in folders:
        folder.remove()
    removed = [str(path) for path in dict.fromkeys(arguments.runs)]
    answer_either(arguments, {"removed": removed}, *(f"removed {line}" for line in lines))
    return EXIT_DONE


def _is_agreed(lines: list[str]) -> bool:
    """Whether whoever sits at the terminal wants the runs of ``lines`` gone."""
    from su3d_bench.cli.output import remark

    if not sys.stdin.isatty():
        raise ConfigError("runs remove: nobody is there to be asked; add --yes to remove without a question")
    for line in lines:
        remark(line)
    remark("remove for good? y or n")
    return sys.stdin.readline().strip().lower() in ("y", "yes")


REFINERS = ("vote", "model")


def _add_refine(verbs: Verbs) -> None:
    parser = add_verb(
        verbs,
        "refine",
        "Give each instance of a run's maps one name out of the names of its best views (label n'), and leave out what "
        "is large background under it.",
        (
            "su3d-bench runs refine runs/my-run",
            "su3d-bench runs refine runs/my-run --refiner model --model llama3.1 --base-url http://localhost:11434/v1",
        ),
        call_refine,
    )
    add_runs(parser, None)
    parser.add_argument("--method", default="opensu3d", help="whose maps (default: opensu3d)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="these scenes alone (default: all of the run)")
    parser.add_argument(
        "--refiner",
        choices=REFINERS,
        default="vote",
        help="vote: by the sum of the scores, without a model; model: a language model, as in the paper",
    )
    parser.add_argument("--top-m", type=count, default=5, metavar="N", help="views that have a say (default: 5)")
    parser.add_argument(
        "--background-names",
        nargs="*",
        metavar="NAME",
        help="nouns of what label n' leaves out (default: those that the paper leaves out of images); none: nothing",
    )
    parser.add_argument(
        "--max-map-fraction",
        type=float,
        metavar="SHARE",
        help="an instance whose box covers more of the map from above is left out (default: 0.95, the paper's share of "
        "an image); 1: none is",
    )
    add_language_options(parser)


def call_refine(arguments: argparse.Namespace) -> int:
    from su3d_bench.questions.refining import records_of, top_names, write_records

    config = _filter(arguments)
    jobs = _jobs(arguments)
    maps = {scene: _map(job) for scene, job in jobs.items()}
    tops = {scene: top_names(instances, arguments.top_m) for scene, instances in maps.items()}
    if arguments.dry_run:
        return _estimate(tops, arguments)
    refined, model = _refine(tops, arguments)
    made: dict[str, NameRecords] = {}
    for scene, job in jobs.items():
        chosen = tops[scene], refined[scene], arguments.refiner, model, arguments.top_m
        records = records_of(job, maps[scene], *chosen, config)
        path = write_records(job, records)
        made[scene] = records
        remark(f"{scene}: {path}", quiet=arguments.quiet)
    _answer(made, arguments)
    return EXIT_DONE


def _filter(arguments: argparse.Namespace) -> FilterConfig:
    from su3d_bench.questions.refining import FilterConfig

    share = arguments.max_map_fraction
    if share is not None and not 0 < share <= 1:
        raise ConfigError(f"--max-map-fraction {share}: expected a share above 0, 1 at most")
    given = {"background_names": arguments.background_names, "max_map_fraction": share}
    return FilterConfig.model_validate({name: value for name, value in given.items() if value is not None})


def _jobs(arguments: argparse.Namespace) -> dict[str, JobFolder]:
    """Scene -> folder of its map, of the scenes asked for."""
    from su3d_bench.store.run_folder import RunFolder

    run = RunFolder(arguments.run)
    known = _scenes(run)
    for scene in arguments.scenes or ():
        if scene not in known:
            hint = suggest(scene, known, "it has")
            raise ConfigError(f"{run.path}: holds no scene '{scene}'{hint}")
    jobs = {scene: run.job(scene, arguments.method) for scene in arguments.scenes or known}
    mapped = {scene: job for scene, job in jobs.items() if job.prediction.is_file()}
    if not mapped:
        raise StoreError(f"{run.path}: holds no map by '{arguments.method}'; name another with --method")
    return mapped


def _scenes(run: RunFolder) -> list[str]:
    """The scenes that the run was asked for."""
    from su3d_bench.core.errors import printable
    from su3d_bench.core.files.atomic import read_json
    from su3d_bench.store.records import RunRecord, checked

    scenes: tuple[str, ...] = ()
    record = read_json(run.path / "run.json")
    with suppress(ValueError, RecursionError):  # pydantic's errors are of value
        scenes = checked(RunRecord, record).scenes
    if not scenes or any(".." in scene for scene in scenes):
        raise StoreError(f"{run.path}: run.json is not as a run writes it; name the folder of a run")
    return [printable(scene, 200) for scene in scenes]


def _map(job: JobFolder) -> Instances:
    from su3d_bench.core.maps import Instances
    from su3d_bench.store.predictions import read_prediction

    prediction = read_prediction(job.prediction)
    if not isinstance(prediction, Instances) or prediction.view_names is None:
        raise PredictionError(
            f"{job.prediction}: keeps no names of views to choose from; make the map anew with opensu3d"
        )
    return prediction


def _estimate(tops: dict[str, list[TopNames]], arguments: argparse.Namespace) -> int:
    from su3d_bench.questions.refining import ModelRefiner
    from su3d_bench.store.run_folder import RunFolder

    if arguments.refiner != "model":
        return answer_estimate(arguments, None, ())
    client, config = chat_client(arguments, RunFolder(arguments.run))
    refiner = ModelRefiner(client, config)
    requests = [request for of_scene in tops.values() for request in refiner.requests(of_scene)]
    return answer_estimate(arguments, client, requests)


def _refine(
    tops: dict[str, list[TopNames]], arguments: argparse.Namespace
) -> tuple[dict[str, Sequence[RefinedName]], str]:
    """Labels n' of each scene, and the model that chose them."""
    from su3d_bench.questions.refining import ModelRefiner, vote
    from su3d_bench.store.run_folder import RunFolder

    if arguments.refiner == "vote":
        return {scene: [vote(top) for top in of_scene] for scene, of_scene in tops.items()}, ""
    client, config = chat_client(arguments, RunFolder(arguments.run))
    refiner = ModelRefiner(client, config)
    return {scene: refiner.refine(of_scene) for scene, of_scene in tops.items()}, config.text_model


def _answer(made: dict[str, NameRecords], arguments: argparse.Namespace) -> None:
    if answer_json(arguments, {scene: records.model_dump(mode="json") for scene, records in made.items()}):
        return
    for scene, records in made.items():
        changed = [name for name in records.names if name.refined != name.label]
        kept = [name for name in records.names if name.source == "label"]
        answer(f"{scene}: {counted(len(records.names), 'instance')}, {counted(len(changed), 'name')} changed")
        for name in changed:
            answer(f"  {name.id:>4}  {name.label} -> {name.refined}")
        for name in records.names:
            if name.left_out:
                answer(f"  {name.id:>4}  left out: {name.left_out}")
        if kept:
            reasons = ", ".join(dict.fromkeys(name.reason for name in kept))
            remark(f"{scene}: label n stays for {counted(len(kept), 'instance')}: {reasons}", quiet=arguments.quiet)
