"""``su3d-bench sheets make``: a finished run -> sheets for people, as a page, a workbook and a table; the key apart."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.flags import add_verb, answer, answer_json, remark
from su3d_bench.errors import EXIT_DONE, ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from su3d_bench.questions.model import Question
    from su3d_bench.sheets.drafts import Draft
    from su3d_bench.sheets.run_source import RunSource

NAME = "make"
KINDS = ("retrieval", "annotation", "reasoning")
# A person judges some hundred items without a break: so many of each kind of question and scene, instances a scene,
# or questions of each template and scene.
PER_KIND = {"retrieval": 5, "annotation": 30, "reasoning": 1}


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Make sheets on which people judge a run: an offline page, a workbook and a table with pictures.",
        (
            "su3d-bench sheets make runs/my-run --kind retrieval --out sheets/my-run",
            "su3d-bench sheets make runs/my-run --kind annotation --annotators 3 --overlap 0.3 --out sheets/labels",
        ),
        call,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run; variants stand side by side in it")
    parser.add_argument("--kind", choices=KINDS, required=True, help="what is judged")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the sheets go")
    parser.add_argument("--key", type=Path, metavar="DIR", help="where the key goes (default: DIR-key)")
    parser.add_argument(
        "--questions",
        default="generated",
        metavar="FILE",
        help="a file of questions, 'paper' for those of its page, or 'generated' from the ground truth (default)",
    )
    parser.add_argument("--methods", nargs="+", default=[], metavar="M", help="these alone (default: all of the run)")
    parser.add_argument("--scenes", nargs="+", default=[], metavar="S", help="these alone (default: all of the run)")
    parser.add_argument(
        "--per-kind",
        type=int,
        metavar="N",
        help="most items of a scene: questions of a kind (default: 5), instances (30), questions of a template (1)",
    )
    parser.add_argument("--annotators", type=int, default=1, metavar="N", help="people who share the work")
    parser.add_argument(
        "--overlap", type=float, default=0.25, metavar="SHARE", help="of all items that everybody gets (default: 0.25)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the drawing and shuffling (default: 0)")
    parser.add_argument("--colours", choices=("paper", "cividis"), default="paper", help="of the heat maps")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="scenes drawn side by side (default: 2)")
    parser.add_argument("--device", default="cpu", help="of the text's encoder, if a large one (default: cpu)")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.cli.progress import progress
    from su3d_bench.executors import Event, limit_threads

    limit_threads()
    from su3d_bench.finished_run import read_run
    from su3d_bench.sheets.drawing_jobs import draw_all
    from su3d_bench.sheets.making import Origin, check_split, make_sheets, write_sheets
    from su3d_bench.sheets.run_source import RunSource

    if arguments.per_kind is not None and arguments.per_kind < 1:
        raise ConfigError(f"--per-kind {arguments.per_kind}: at least 1 item is needed")
    if arguments.jobs < 1:
        raise ConfigError(f"--jobs {arguments.jobs}: at least 1 is needed")
    if arguments.seed < 0:
        raise ConfigError(f"--seed {arguments.seed}: expected 0 or more")
    source = RunSource(read_run(arguments.run), arguments.methods, arguments.scenes)
    drafts = _drafts(source, arguments)
    rules = {rules.name for scene in source.scenes if (rules := source.rules(scene, arguments.kind)) is not None}
    check_split(len(drafts), arguments.annotators, arguments.overlap)
    origin = Origin(source.run.name, source.run.code, source.methods, ", ".join(sorted(rules)))
    with progress(1, is_quiet=arguments.quiet, last_step="writing") as report:
        drawn = draw_all(
            source,
            arguments.kind,
            arguments.colours,
            drafts,
            arguments.jobs,
            lambda n_done, n: report(Event(source.run.name, "pictures", n_done, n)),
        )
    made = make_sheets(
        arguments.kind,
        drafts,
        drawn,
        origin,
        seed=arguments.seed,
        annotators=arguments.annotators,
        overlap=arguments.overlap,
    )
    key = arguments.key or arguments.out.with_name(f"{arguments.out.name}-key")
    files = write_sheets(made, arguments.out, key)
    if arguments.json:
        answer_json(
            {
                "sheet_id": made.sheet.id,
                "n_items": len(made.sheet.items),
                "n_questions": sum(len(one.asks) for one in made.sheet.items),
                "files": [str(path) for path in files],
                "key": str(key),
            }
        )
        return EXIT_DONE
    answer(f"{made.sheet.id}: {len(made.sheet.items)} items, {sum(len(o.asks) for o in made.sheet.items)} questions")
    for path in files:
        answer(str(path))
    remark(f"key, which annotators must not see: {key}", quiet=arguments.quiet)
    return EXIT_DONE


def _drafts(source: RunSource, arguments: argparse.Namespace) -> list[Draft]:
    import numpy as np

    from su3d_bench.cli.query import encoder_of
    from su3d_bench.sheets.drafts import annotation_drafts, questions_of, reasoning_drafts, retrieval_drafts

    if arguments.kind == "annotation" and arguments.questions != "generated":
        raise ConfigError("--questions: annotation sheets ask about labels and masks; leave it out")
    n_most = arguments.per_kind or PER_KIND[arguments.kind]
    random = np.random.default_rng(arguments.seed)
    given = _given(source, arguments)
    found: list[Draft] = []
    encoder = None if arguments.kind == "annotation" else encoder_of(source.run.folder, arguments.device)
    for scene in source.scenes:
        if arguments.kind == "annotation":
            found += annotation_drafts(source, scene, n_most, random)
        elif arguments.kind == "reasoning":
            found += reasoning_drafts(source, scene, given, n_most, encoder)
        else:
            assert encoder is not None
            # A file is asked as it stands, unless --per-kind limits it.
            limit = n_most if given is None else arguments.per_kind
            found += retrieval_drafts(source, scene, questions_of(source, scene, given, limit), encoder)
    return found


def _given(source: RunSource, arguments: argparse.Namespace) -> Sequence[Question] | None:
    """The questions of a file or of the paper; None where they are made from the ground truth."""
    from su3d_bench.questions.files import paper_queries, read_questions

    if arguments.questions == "generated":
        return None
    datasets = {scene.partition("/")[0] for scene in source.scenes}
    if arguments.questions == "paper":
        given = paper_queries()
    else:
        given = read_questions(Path(arguments.questions), datasets.pop() if len(datasets) == 1 else None)
    if not any(one.scene in source.scenes for one in given):
        raise ConfigError(f"--questions {arguments.questions}: asks nothing of a scene of this run")
    return given
