"""``su3d-bench questions``: make sets of queries with known answers, and look at sets from anywhere."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.common import add_verb, answer, answer_either, answer_json, remark
from su3d_bench.core.errors import EXIT_DONE, ConfigError, suggest

if TYPE_CHECKING:
    from su3d_bench.questions.model import Question

ACTIONS = ("make", "show")
PAPER = "paper"
SOURCES = ("auto", "generated")
N_SHOWN = 20
MOST_CHARACTERS = 80


def add_parser(verbs: Any) -> None:
    parser = add_verb(
        verbs,
        "questions",
        "Make sets of queries with known answers from ground truth, or show a set.",
        (
            "su3d-bench questions make --scenes 'rooms/*' --per-kind 40 --leave-out disputed.csv --out queries.toml",
            "su3d-bench questions show paper",
        ),
        call,
    )
    parser.add_argument("action", metavar="make|show")
    parser.add_argument("file", nargs="?", help="show: a set (.toml, .csv, ScanRefer, Nr3D, SQA3D), or 'paper'")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="addresses or patterns such as 'rooms/*'")
    parser.add_argument("--per-kind", type=int, metavar="N", help="at most N of each kind and scene (default: all)")
    parser.add_argument(
        "--source",
        default="auto",
        metavar="auto|generated",
        help="auto: what the dataset itself knows, else generated from classes and boxes",
    )
    parser.add_argument(
        "--leave-out", type=Path, metavar="FILE", help="make: without the questions that a CSV file lists by their id"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="make: where to write, .toml or .csv")


def call(arguments: argparse.Namespace) -> int:
    if arguments.action not in ACTIONS:
        hint = suggest(arguments.action, ACTIONS) or f"; known: {', '.join(ACTIONS)}"
        raise ConfigError(f"questions: unknown action '{arguments.action}'{hint}")
    return _make(arguments) if arguments.action == "make" else _show(arguments)


def _make(arguments: argparse.Namespace) -> int:
    from su3d_bench.questions.files.files import check_form, write_questions

    if arguments.file is not None:
        raise ConfigError("questions make: takes no file; name it with --out")
    if not arguments.scenes or arguments.out is None:
        raise ConfigError("questions make: needs --scenes and --out FILE.toml")
    if arguments.per_kind is not None and arguments.per_kind < 1:
        raise ConfigError(f"questions make: --per-kind is {arguments.per_kind}; expected 1 or more")
    if arguments.source not in SOURCES:
        hint = suggest(arguments.source, SOURCES) or f"; known: {', '.join(SOURCES)}"
        raise ConfigError(f"questions make: unknown source '{arguments.source}'{hint}")
    check_form(arguments.out)
    made = _made(arguments)
    write_questions(arguments.out, made)
    remark(f"{len(made)} questions: {arguments.out}", quiet=arguments.quiet)
    _answer_counts(made, arguments)
    return EXIT_DONE


def _made(arguments: argparse.Namespace) -> list[Question]:
    from su3d_bench.cli.datasets.check import chosen_scenes
    from su3d_bench.questions.files.left_out import read_left_out
    from su3d_bench.questions.generator import chosen
    from su3d_bench.questions.truths import questions_of

    left_out = frozenset[str]() if arguments.leave_out is None else read_left_out(arguments.leave_out)
    made: list[Question] = []
    for dataset, scene in chosen_scenes(arguments.scenes, [], is_quiet=arguments.quiet):
        found = questions_of(dataset, scene, own=arguments.source == "auto")
        kept = [question for question in found if question.id not in left_out]
        questions = chosen(kept, arguments.per_kind)
        without = f", {len(found) - len(kept)} left out" if left_out else ""
        remark(f"{dataset.name}/{scene}: {len(questions)} questions{without}", quiet=arguments.quiet)
        made += questions
    return made


def _show(arguments: argparse.Namespace) -> int:
    from su3d_bench.questions.files.files import paper_queries, read_questions

    if arguments.file is None:
        raise ConfigError("questions show: name a file, or 'paper' for the queries that the paper's page shows")
    questions: Sequence[Question]
    questions = paper_queries() if arguments.file == PAPER else read_questions(Path(arguments.file), "")
    if arguments.json:
        answer_json([_row(question) for question in questions])
        return EXIT_DONE
    _answer_counts(questions, arguments)
    for question in questions[:N_SHOWN]:
        answer("  ".join(str(value) for value in _printable_row(question)))
    if len(questions) > N_SHOWN:
        answer(f"... and {len(questions) - N_SHOWN} more; --json shows all")
    return EXIT_DONE


def _row(question: Question) -> dict[str, Any]:
    return {
        "id": question.id,
        "scene": question.scene,
        "kind": question.kind,
        "text": question.text,
        "answers": None if question.answers is None else list(question.answers),
        "reply": question.reply,
        "source": question.source,
    }


def _printable_row(question: Question) -> tuple[str, ...]:
    from su3d_bench.core.errors import printable

    ids = "unknown" if question.answers is None else " ".join(map(str, question.answers))
    return printable(question.scene, 60), question.kind, printable(question.text, MOST_CHARACTERS), f"-> {ids}"


def _answer_counts(questions: Sequence[Question], arguments: argparse.Namespace) -> None:
    counts = Counter(question.kind for question in questions)
    n_known = sum(question.is_known for question in questions)
    kinds = ", ".join(f"{n} {kind}" for kind, n in counts.items())
    n_scenes = len({question.scene for question in questions})
    text = f"{len(questions)} questions on {n_scenes} scenes ({kinds}); {n_known} with known answers"
    answer_either(arguments, {"n": len(questions), "n_known": n_known, "kinds": dict(counts)}, text)
