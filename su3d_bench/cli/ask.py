"""``su3d-bench query ask``: a question about a scene, answered from its map, with the objects of the answer."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.shared.answers import answer, answer_json, file_name_of, remark, remark_unseen, show
from su3d_bench.cli.shared.flags import add_verb, add_whose_map, check_scene_first
from su3d_bench.cli.shared.language import add_language_flags, answer_estimate, answer_nothing_to_pay, chat_client
from su3d_bench.core.errors import EXIT_DONE, ConfigError, PredictionError, StoreError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from su3d_bench.core.maps import Instances
    from su3d_bench.metrics.questions.score import RefinedNames
    from su3d_bench.questions.model import Answer
    from su3d_bench.questions.scene_map import SceneMap
    from su3d_bench.store.run_folder import JobFolder, RunFolder

SOLVERS = ("built-in", "llm")
NAMES = ("auto", "label", "refined")


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        "ask",
        "Answer a question about a scene from its map: by geometry, or by a language model.",
        (
            'su3d-bench query ask rooms/living0 "Which lamp is closer to the sofa?"',
            'su3d-bench query ask rooms/living0 "I am feeling cold, what should I do?" --solver llm --dry-run',
        ),
        call,
    )
    parser.add_argument("scene", help="the scene's address, such as rooms/living0")
    parser.add_argument("question", help="the question, in English")
    add_whose_map(parser)
    parser.add_argument(
        "--solver", choices=SOLVERS, default="built-in", help="who answers: geometry alone, or a language model"
    )
    parser.add_argument(
        "--names",
        choices=NAMES,
        default="auto",
        help="the map's labels n, or n' of su3d-bench runs refine (default: n' where it is there)",
    )
    parser.add_argument(
        "--eye",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="where one stands for left and right, in metres (default: the middle of the map)",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="where the picture goes (default: beside the map)")
    add_language_flags(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.core.maps import Instances
    from su3d_bench.questions.scene_map import map_of
    from su3d_bench.runs.finished import map_of_scene

    if not arguments.question.strip():
        raise ConfigError(
            'the question is empty; ask such as: su3d-bench query ask rooms/living0 "How many lamps are there?"'
        )
    check_scene_first("query ask", arguments.scene, arguments.question)
    run, job, instances = map_of_scene(arguments.scene, arguments.method, arguments.run)
    if not isinstance(instances, Instances):
        raise PredictionError(f"{job.prediction}: holds no instances, so there is nothing to ask about")
    refined, note = _refined(job, arguments.names)
    scene = map_of(instances, refined)
    if arguments.dry_run:
        return _estimate(scene, run, arguments)
    reply = _solve(scene, run, arguments)
    if not arguments.json:
        answer(reply.text)
        for line in (*reply.notes, f"names: {note}"):
            remark(line, quiet=arguments.quiet)
        show()  # the picture takes longer than the answer
    picture = _draw(instances, scene, reply, job, arguments)
    value = {"scene": arguments.scene, "question": arguments.question} | reply.to_json()
    is_json = answer_json(arguments, value | {"names": note, "picture": None if picture is None else str(picture)})
    if picture is not None and not is_json:
        remark(f"picture: {picture}", quiet=arguments.quiet)
    return EXIT_DONE


def _refined(job: JobFolder, wanted: str) -> tuple[RefinedNames | None, str]:
    """Labels n' where they are wanted and there, and which names these are."""
    from su3d_bench.questions.refining import read_records

    records = None if wanted == "label" else read_records(job)
    if records is None:
        if wanted == "refined":
            raise StoreError(f"{job.path}: has no labels n'; make them with su3d-bench runs refine")
        return None, "labels n"
    n_left_out = sum(bool(name.left_out) for name in records.names)
    without = f", without {n_left_out} that it leaves out" if n_left_out else ""
    return records.refined, f"labels n' by {records.model or 'vote'}{without}"


def _estimate(scene: SceneMap, run: RunFolder, arguments: argparse.Namespace) -> int:
    from su3d_bench.questions.language_solver import LanguageSolver

    if arguments.solver != "llm":
        return answer_nothing_to_pay(arguments, "the built-in solver")
    client, config = chat_client(arguments, run)
    return answer_estimate(arguments, client, [LanguageSolver(scene, client, config).request(arguments.question)])


def _solve(scene: SceneMap, run: RunFolder, arguments: argparse.Namespace) -> Answer:
    import numpy as np

    from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
    from su3d_bench.questions.language_solver import LanguageSolver
    from su3d_bench.questions.scene_map import nearest_by
    from su3d_bench.questions.solver import Solver

    if arguments.solver == "llm":
        return LanguageSolver(scene, *chat_client(arguments, run)).answer(arguments.question)
    eye = None if arguments.eye is None else np.array(arguments.eye, np.float64)
    if eye is not None and not np.isfinite(eye).all():
        raise ConfigError(f"--eye {arguments.eye}: expected three finite numbers of metres")
    unnamed: dict[str, None] = {}  # nouns by which the map calls nothing, each once

    def nearest_name(noun: str, names: Sequence[str]) -> tuple[str, float]:
        unnamed[noun] = None
        return nearest_by(encoder)(noun, names)

    encoder = EmbeddedEncoder()  # whose files are read only where a name is looked for
    reply = Solver(scene, eye, nearest_name).answer(arguments.question)
    asked = arguments.question.split()
    for noun in unnamed or asked[: len(asked) == 1]:  # of one word there is no question, only a noun
        remark_unseen(encoder, noun, quiet=arguments.quiet)
    return reply


def _draw(
    instances: Instances, scene: SceneMap, reply: Answer, job: JobFolder, arguments: argparse.Namespace
) -> Path | None:
    """Draw the answer; None where it names no object."""
    from su3d_bench.reports.pictures.figures import SpokenOf, draw_reasoning

    if not reply.object_ids:
        if arguments.out is not None:
            remark(f"{arguments.out}: not drawn, for the answer names no object", quiet=arguments.quiet)
        return None
    picture: Path = arguments.out or job.picture(f"ask-{file_name_of(arguments.question, 'question')}.png")
    rows = [tuple(scene.by_id(object_id).row for object_id in ids) for ids in (reply.object_ids, reply.reference_ids)]
    names = [""] * len(instances)
    for thing in scene.objects:
        names[thing.row] = thing.shown
    title = f"{arguments.scene}: {arguments.question}"
    draw_reasoning(instances, SpokenOf(*rows), names, picture, title, (reply.text, *reply.notes))
    return picture
