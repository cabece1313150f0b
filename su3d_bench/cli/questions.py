"""``su3d-bench query make|show|score``: question sets with known answers."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli import options, output
from su3d_bench.cli.options import Verbs, add_verb, count, output_path
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, counted, printable

if TYPE_CHECKING:
    from su3d_bench.questions.model import Question

JUDGE_MODEL = "gpt-4o-2024-08-06"  # Beacon3D's
FIELDS = ("id", "scene", "kind", "text", "answers", "reply", "source")  # of a question with --json
N_SHOWN = 20
MAX_CHARACTERS = 80


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "make", _make, data=True)
    parser.option("--scenes SCENE...", "scenes or patterns to use (such as 'homes/test*')", required=True)
    parser.option("--out FILE", ".toml or .csv file to write", type=output_path, required=True)
    parser.option("--per-kind N", "maximum number per kind and scene (default: all)", type=count)
    parser.option("--generated", "generate all questions (default: use the dataset's own, if any)")
    parser = add_verb(verbs, "show", _show)
    parser.option(
        "file FILE", "question set (.toml, .csv, ScanRefer, ...), or 'paper' for those of OpenSU3D's paper", type=str
    )
    parser = add_verb(verbs, "score", _score)
    parser.option("file FILE", "metadata_*.json of Beacon3D")
    parser.option("--answers FILE", "JSON list of answers, in the order of Beacon3D's scannet_*.json", required=True)
    parser.option("--judge", "score unmatched free-form answers with an LLM judge")
    options.add_language_options(parser, JUDGE_MODEL)
    parser.shared("--format")


def _make(arguments: argparse.Namespace) -> None:
    """Generate a question set with known answers from the ground truth of scenes.

    su3d-bench query make --scenes 'homes/test*' --per-kind 40 --out queries.toml
    su3d-bench query make --scenes replica/room0 --generated --out queries.csv
    """
    from su3d_bench.questions.question_files import check_form, write_questions

    check_form(arguments.out)
    made = _made(arguments)
    write_questions(arguments.out, made)
    remark(f"{counted(len(made), 'question')}: {arguments.out}", quiet=arguments.quiet)
    output.answer_either(arguments, *_counts(made))


def _made(arguments: argparse.Namespace) -> list[Question]:
    from su3d_bench.cli.scenes import chosen_scenes
    from su3d_bench.questions.generator import chosen
    from su3d_bench.questions.ground_truths import questions_of

    made: list[Question] = []
    for dataset, scene in chosen_scenes(arguments.scenes, [], is_quiet=arguments.quiet):
        questions = chosen(questions_of(dataset, scene, own=not arguments.generated), arguments.per_kind)
        remark(f"{dataset.name}/{scene}: {counted(len(questions), 'question')}", quiet=arguments.quiet)
        made += questions
    return made


def _show(arguments: argparse.Namespace) -> None:
    """Show a question set: counts by kind, and the first questions.

    su3d-bench query show queries.toml
    su3d-bench query show paper --json
    """
    from su3d_bench.questions.question_files import paper_queries, read_questions

    questions: Sequence[Question]
    questions = paper_queries() if arguments.file == "paper" else read_questions(Path(arguments.file), "")
    lines = [_counts(questions)[1], *map(_line, questions[:N_SHOWN])]
    if len(questions) > N_SHOWN:
        lines.append(f"... and {len(questions) - N_SHOWN} more; --json shows all")
    value = [{name: getattr(question, name) for name in FIELDS} for question in questions]
    output.answer_either(arguments, value, *lines)


def _line(question: Question) -> str:
    ids = " ".join(map(str, question.answers or ()))
    reply = f'"{printable(question.reply, MAX_CHARACTERS)}"' if question.reply else ""
    known = " ".join(part for part in (ids, reply) if part) or "unknown"
    text = printable(question.text, MAX_CHARACTERS)
    return f"{printable(question.scene, 60)}  {question.kind}  {text}  -> {known}"


def _counts(questions: Sequence[Question]) -> tuple[dict[str, Any], str]:
    """The counts by kind, as JSON and as text."""
    counts = Counter(question.kind for question in questions)
    n_known = sum(question.is_known for question in questions)
    kinds = ", ".join(f"{n} {kind}" for kind, n in counts.items())
    on = counted(len({question.scene for question in questions}), "scene")
    text = f"{counted(len(questions), 'question')} on {on} ({kinds}); {n_known} with known answers"
    if n_replies := sum(bool(question.reply) for question in questions):
        text += f", {n_replies} with a free-form answer"
    content = {"n": len(questions), "n_known": n_known, "n_replies": n_replies, "kinds": dict(counts)}
    return content, text


def _score(arguments: argparse.Namespace) -> None:
    """Score answers to questions of Beacon3D.

    su3d-bench query score metadata_qa.json --answers answers.json
    su3d-bench query score metadata_qa.json --answers answers.json --judge --dry-run
    """
    from su3d_bench.questions import beacon3d
    from su3d_bench.store.run_folder import RunFolder

    judge = None
    if arguments.judge:
        folder = RunFolder(arguments.answers.with_name(f"{arguments.answers.stem}.judged"))
        client, config = options.chat_client(arguments, folder, JUDGE_MODEL)
        if arguments.dry_run:
            asked = beacon3d.answers_to_questions(arguments.file, arguments.answers)
            options.answer_estimate(arguments, client, list(beacon3d.judge_requests(asked, config).values()))
            return
        judge = partial(beacon3d.judged, model=client, config=config)
    elif flag := options.given_language_option(arguments):
        raise ConfigError(f"query score: {flag} needs --judge")
    answered = beacon3d.answered_file(arguments.file, arguments.answers, judge)
    output.answer_tables(arguments, beacon3d.answered_json(answered), [beacon3d.answered_table(answered)])
