"""``su3d-bench query text`` and ``query ask``: search a map for a text, or ask it a question."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from su3d_bench.cli import options, output, questions
from su3d_bench.cli.options import SHARED, Verbs, add_group, add_verb, count
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, PredictionError, StoreError, counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from su3d_bench.core.maps import Instances
    from su3d_bench.metrics.questions.score import RefinedNames
    from su3d_bench.questions.model import Answer
    from su3d_bench.questions.scene_map import SceneMap
    from su3d_bench.store.run_folder import JobFolder, RunFolder


def add_parser(verbs: Verbs) -> None:
    """Search a map for a text, ask it questions, or work with question sets.

    su3d-bench query text homes/tuning0 "plant on shelf"
    su3d-bench query show paper
    """
    actions = add_group(verbs, "query", add_parser)
    parser = add_verb(actions, "text", call_text)
    parser.option("scene SCENE", "scene, such as homes/tuning0")
    parser.option("text", "text to search for")
    parser.shared("--run", "--method")
    parser.option("--top N", "number of instances to list (default: 10)", type=count, default=10)
    parser.shared("--device")
    parser.option("--out FIGURE", ".pdf, .png or .svg file to write (default: next to the map)")
    parser.shared("--width")
    parser = add_verb(actions, "ask", call_ask)
    parser.option("scene SCENE", "scene, such as homes/tuning0")
    parser.option("question", "question in English")
    parser.shared("--run", "--method")
    parser.option(
        "--question-solver", SHARED["--question-solver"]["help"], choices=("built-in", "llm"), default="built-in"
    )
    parser.option(
        "--labels",
        "labels to use: label, or refined by runs refine (default: refined if available)",
        choices=("auto", "label", "refined"),
        default="auto",
    )
    parser.option(
        "--eye",
        "viewpoint for left and right, in metres (default: centre of the map)",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
    )
    parser.option("--out FIGURE", ".pdf, .png or .svg file to write (default: next to the map)")
    parser.shared("--width")
    options.add_language_options(parser)
    questions.add_parser(actions)


def call_text(arguments: argparse.Namespace) -> None:
    """Rank the instances of a map by similarity to a text, and draw a heat map.

    su3d-bench query text homes/tuning0 "plant on shelf"
    su3d-bench query text homes/tuning0 "place to sit" --top 3 --method opensu3d --json
    """
    from su3d_bench.core.maps import DenseFeatures, Instances
    from su3d_bench.questions.model import best_of, rank
    from su3d_bench.reports.pictures.maps import draw_heat_map
    from su3d_bench.runs.finished import encoder_of

    if not arguments.text.strip():
        raise ConfigError('the text is empty; use for example: su3d-bench query text homes/tuning0 "a plant"')
    run, job, prediction = options.open_map(arguments, "text", arguments.text)
    if not isinstance(prediction, Instances):
        what = "one feature per point and no instances" if isinstance(prediction, DenseFeatures) else "no instances"
        raise PredictionError(f"{job.prediction}: has {what}, so nothing can be ranked; choose another --method")
    encoder = encoder_of(run, arguments.device or "cpu")
    ranking = rank(prediction, arguments.text, encoder)
    rows = [asdict(one) for one in best_of(prediction, ranking, arguments.top)]
    picture = arguments.out or job.picture(f"query-{output.file_name_of(arguments.text, 'text')}.png")
    output.remark_unseen(encoder, arguments.text, quiet=arguments.quiet)
    if not arguments.json:
        wide = max([4, *(len(str(row["id"])) for row in rows)])
        output.answer(f"{'rank':>4}  {'id':>{wide}}  {'similarity':>10}  {'centroid (m)':<22}  name")
        for row in rows:
            place = "".join(f"{value:7.2f}" for value in row["centroid"])
            scored = f"{row['rank']:>4}  {row['id']:>{wide}}  {row['similarity']:>10.3f}"
            output.answer(f"{scored}  {place:<22}  {row['name']}")
        output.show()  # the picture is slower than the answer
    lines = [f"{row['rank']}. {row['similarity']:.3f} {row['name']}" for row in rows]
    caption = f'{arguments.scene}: "{arguments.text}"; the most similar instance is outlined'
    draw_heat_map(prediction, ranking.similarity, picture, caption, lines, arguments.width)
    value = {"scene": arguments.scene, "text": arguments.text, "picture": str(picture), "ranking": rows}
    if not output.answer_json(arguments, value):
        remark(f"heat map: {picture}", quiet=arguments.quiet)


def call_ask(arguments: argparse.Namespace) -> None:
    """Answer a question about a scene from its map, by geometry or a language model.

    su3d-bench query ask homes/tuning0 "Which lamp is closer to the sofa?"
    su3d-bench query ask homes/tuning0 "I am feeling cold, what should I do?" --question-solver llm --dry-run
    """
    from su3d_bench.core.maps import Instances
    from su3d_bench.questions.scene_map import map_of

    if not arguments.question.strip():
        raise ConfigError(
            'the question is empty; use for example: su3d-bench query ask homes/tuning0 "How many lamps are there?"'
        )
    run, job, instances = options.open_map(arguments, "ask", arguments.question)
    if not isinstance(instances, Instances):
        raise PredictionError(f"{job.prediction}: has no instances, so questions cannot be answered")
    refined, note = _refined(job, arguments.labels)
    scene = map_of(instances, refined)
    if arguments.dry_run:
        _estimate(scene, run, arguments)
        return
    reply = _solve(scene, run, arguments)
    if not arguments.json:
        output.answer(reply.text)
        remark(*reply.notes, f"names: {note}", quiet=arguments.quiet)
        output.show()  # the picture is slower than the answer
    picture = _draw_ask(instances, scene, reply, job, arguments)
    value = {"scene": arguments.scene, "question": arguments.question} | reply.to_json()
    value |= {"names": note, "picture": None if picture is None else str(picture)}
    if not output.answer_json(arguments, value) and picture is not None:
        remark(f"picture: {picture}", quiet=arguments.quiet)


def _refined(job: JobFolder, wanted: str) -> tuple[RefinedNames | None, str]:
    """The scene with labels n or n', and a note on which."""
    from su3d_bench.questions.refining import read_records

    records = None if wanted == "label" else read_records(job)
    if records is None:
        if wanted == "refined":
            raise StoreError(f"{job.path}: no labels n'; create them with su3d-bench runs refine")
        return None, "labels n"
    n_left_out = sum(bool(name.left_out) for name in records.names)
    without = f", without {counted(n_left_out, 'excluded instance')}" if n_left_out else ""
    return records.refined, f"labels n' by {records.model or 'vote'}{without}"


def _estimate(scene: SceneMap, run: RunFolder, arguments: argparse.Namespace) -> None:
    from su3d_bench.questions.solver import LanguageSolver

    if arguments.question_solver != "llm":
        return options.answer_estimate(arguments, None, ())
    client, config = options.chat_client(arguments, run)
    request = LanguageSolver(scene, client, config).request(arguments.question)
    return options.answer_estimate(arguments, client, [request])


def _solve(scene: SceneMap, run: RunFolder, arguments: argparse.Namespace) -> Answer:
    import numpy as np

    from su3d_bench.perception.embedded.encoder import EmbeddedEncoder
    from su3d_bench.questions.scene_map import nearest_by
    from su3d_bench.questions.solver import LanguageSolver, Solver

    if arguments.question_solver == "llm":
        return LanguageSolver(scene, *options.chat_client(arguments, run)).answer(arguments.question)
    eye = None if arguments.eye is None else np.array(arguments.eye, np.float64)
    if eye is not None and not np.isfinite(eye).all():
        raise ConfigError(f"--eye {arguments.eye}: expected three finite numbers (metres)")
    unnamed: dict[str, None] = {}  # nouns that are not names of the map, each once

    def nearest_name(noun: str, names: Sequence[str]) -> tuple[str, float]:
        unnamed[noun] = None
        return nearest_by(encoder)(noun, names)

    encoder = EmbeddedEncoder()  # its files are only read if a name is looked up
    reply = Solver(scene, eye, nearest_name).answer(arguments.question)
    asked = arguments.question.split()
    for noun in unnamed or asked[: len(asked) == 1]:  # a single word is a noun, not a question
        output.remark_unseen(encoder, noun, quiet=arguments.quiet)
    return reply


def _draw_ask(
    instances: Instances, scene: SceneMap, reply: Answer, job: JobFolder, arguments: argparse.Namespace
) -> Path | None:
    """Draw the answer; None if it names no object."""
    from su3d_bench.reports.pictures.figures import AnswerRows, draw_reasoning

    if not reply.object_ids:
        if arguments.out is not None:
            remark(f"{arguments.out}: not drawn, because the answer names no object", quiet=arguments.quiet)
        return None
    picture: Path = arguments.out or job.picture(f"ask-{output.file_name_of(arguments.question, 'question')}.png")
    rows = [tuple(scene.by_id(object_id).row for object_id in ids) for ids in (reply.object_ids, reply.reference_ids)]
    names = [""] * len(instances)
    for thing in scene.objects:
        names[thing.row] = thing.shown
    caption = f"{arguments.scene}: {arguments.question} {reply.text}"
    draw_reasoning(instances, AnswerRows(*rows), names, picture, caption, arguments.width)
    return picture
