"""``su3d-bench runs refine``: one name for each instance out of the names of its best views, label n' of the paper."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.shared.answers import answer, answer_json, remark
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.cli.shared.language import add_language_flags, answer_estimate, answer_nothing_to_pay, chat_client
from su3d_bench.core.errors import EXIT_DONE, ConfigError, PredictionError, StoreError, counted, suggest

if TYPE_CHECKING:
    from su3d_bench.core.maps import Instances
    from su3d_bench.questions.refining import FilterConfig, NameRecords, RefinedName, TopNames
    from su3d_bench.store.run_folder import JobFolder, RunFolder

REFINERS = ("vote", "model")


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        "refine",
        "Give each instance of a run's maps one name out of the names of its best views (label n'), and leave out what "
        "is large background under it.",
        (
            "su3d-bench runs refine runs/my-run",
            "su3d-bench runs refine runs/my-run --refiner model --model llama3.1 --base-url http://localhost:11434/v1",
        ),
        call,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run")
    parser.add_argument("--method", default="opensu3d", help="whose maps (default: opensu3d)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="these scenes alone (default: all of the run)")
    parser.add_argument(
        "--refiner",
        choices=REFINERS,
        default="vote",
        help="vote: by the sum of the scores, without a model; model: a language model, as in the paper",
    )
    parser.add_argument("--top-m", type=int, default=5, metavar="N", help="views that have a say (default: 5)")
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
    add_language_flags(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.questions.refining import records_of, top_names, write_records

    if arguments.top_m < 1:
        raise ConfigError(f"--top-m {arguments.top_m}: at least 1 view must have a say")
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
    from su3d_bench.store.records import RequestRecord, checked

    scenes: tuple[str, ...] = ()
    record = read_json(run.path / "run.json")
    with suppress(ValueError, RecursionError):  # pydantic's errors are of value
        scenes = checked(RequestRecord, record).scenes
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
        return answer_nothing_to_pay(arguments, "the vote")
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
