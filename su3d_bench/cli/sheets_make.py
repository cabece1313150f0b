"""``su3d-bench sheets make``: annotation sheets from a run, as page and table, and their key."""

from __future__ import annotations

import argparse
import os
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli import options, output
from su3d_bench.cli.options import Verbs, add_verb, count, output_path
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, counted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from su3d_bench.human_eval.drafts import Draft
    from su3d_bench.human_eval.items import Key, SheetKind
    from su3d_bench.human_eval.sources import RunSource
    from su3d_bench.perception.language.chat import ChatRequest
    from su3d_bench.questions.model import Question

KINDS = ("retrieval", "annotation", "reasoning")
# An annotator rates about a hundred items without a break: questions per kind and scene, instances per scene, or
# questions per template and scene.
PER_KIND = {"retrieval": 5, "annotation": 30, "reasoning": 1}


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "make", call, data=True)
    parser.shared("run")
    parser.option(
        "--kinds ...",
        "objects found, labels and masks, answers; a folder per kind if several",
        choices=KINDS,
        required=True,
    )
    parser.option("--out DIR", "folder for the sheets", type=output_path, required=True)
    parser.option("--key DIR", "folder of the key: which method made what (default: <--out>-key)", type=output_path)
    parser.option(
        "--questions FILE",
        "'generated' (default), 'paper' (those of OpenSU3D's paper), or a question file",
        default="generated",
        type=str,
    )
    parser.shared("--methods")
    parser.option("--scenes SCENE...", "scenes or patterns to use (default: all of RUN)", default=[])
    parser.option("--per-kind N", "maximum number per kind and scene (default: depends on the kind)", type=count)
    parser.option("--annotators N", "number of annotators (default: 1)", type=int, default=1)
    parser.option(
        "--overlap SHARE", "share of items that all annotators rate (default: 0.25)", type=float, default=0.25
    )
    parser.shared("--seed", "--jobs", "--device")
    parser.option(
        "--question-solver",
        "how to answer questions: built-in (geometry) or llm (default: built-in)",
        choices=("built-in", "llm"),
        default="built-in",
    )
    options.add_language_options(parser)


def call(arguments: argparse.Namespace) -> None:
    """Create annotation sheets for a run: an offline page and a CSV.

    su3d-bench sheets make runs/my-run --kinds retrieval annotation reasoning --annotators 3 --out sheets
    su3d-bench sheets make runs/my-run --kinds retrieval --scenes 'homes/test*' --annotators 2 --overlap 1 --out sheets
    """
    from su3d_bench.human_eval.sources import RunSource
    from su3d_bench.runs.finished import read_run

    _check(arguments)
    kinds: tuple[SheetKind, ...] = tuple(dict.fromkeys(arguments.kinds))
    source = RunSource(read_run(arguments.run), arguments.methods, arguments.scenes)
    sources = {kind: _judgeable(source, kind, arguments.quiet) for kind in kinds}
    if arguments.dry_run:
        _estimate(sources["reasoning"], arguments)
        return
    drafts, made_by = _drafts(sources, arguments)
    origins = {kind: _origin(kind, mine, made_by[kind]) for kind, mine in sources.items()}
    written_sets = _write(origins, drafts, _drawn(source, drafts, arguments), arguments)
    if output.answer_json(arguments, {"sets": written_sets}):
        return
    for sheet in written_sets:
        n_items, n_questions = counted(sheet["n_items"], "item"), counted(sheet["n_questions"], "question")
        output.answer(f"{sheet['sheet_id']}: {n_items}, {n_questions}", *sheet["files"])
        remark(f"key, which annotators must not see: {sheet['key']}", quiet=arguments.quiet)


def _check(arguments: argparse.Namespace) -> None:
    """Raise ``ConfigError`` for options that do not fit together."""
    if set(arguments.kinds) == {"annotation"} and arguments.questions != "generated":
        raise ConfigError("--questions: not valid for annotation sheets, which have no questions")
    if arguments.question_solver == "llm" and "reasoning" not in arguments.kinds:
        raise ConfigError("--question-solver llm: needs --kinds reasoning")
    if arguments.question_solver != "llm" and (given := options.given_language_option(arguments)):
        raise ConfigError(f"{given}: only valid with --question-solver llm")


def _judgeable(source: RunSource, kind: SheetKind, is_quiet: bool) -> RunSource:
    """The run without the methods whose maps have nothing to rate in a kind of sheet, with a warning.

    Retrieval needs features of instances or points; the other kinds need instances.
    """
    is_able, lacks, wanted = source.has_instances, "has no instances to rate", "instances to rate"
    if kind == "retrieval":
        is_able, lacks = source.has_features, "has no features to rank by"
        wanted = "features to compare with texts"
    kept = tuple(method for method in source.methods if is_able(source.scenes[0], method))
    if not kept:
        raise ConfigError(
            f"{source.run.name}: {', '.join(source.methods)}: no map has {wanted}; use a method that has "
            "them, such as opensu3d"
        )
    if kept == source.methods:
        return source
    left_out = [method for method in source.methods if method not in kept]
    remark(f"{kind}: excluded {', '.join(left_out)}, which {lacks}", quiet=is_quiet)
    return source.of_methods(kept)


def _drafts(
    sources: Mapping[SheetKind, RunSource], arguments: argparse.Namespace
) -> tuple[dict[SheetKind, list[Draft]], dict[SheetKind, str]]:
    """The items to rate, and per kind the solver (reasoning), the source of labels n' (annotation), or a remark on the
    encoder (retrieval).
    """
    import numpy as np

    from su3d_bench.human_eval.drafts import annotation_drafts, questions_of, reasoning_drafts, retrieval_drafts
    from su3d_bench.human_eval.sets import check_split
    from su3d_bench.metrics.questions.score import relative_remark
    from su3d_bench.questions import solver

    source = next(iter(sources.values()))
    random = np.random.default_rng(arguments.seed)
    given = _given(source, arguments)
    drafts_of: dict[SheetKind, list[Draft]] = {kind: [] for kind in sources}
    needs_encoder = "retrieval" in sources or ("reasoning" in sources and arguments.question_solver != "llm")
    encoder = source.run.encoder(arguments.device or "cpu") if needs_encoder else None
    ask, answered_by = solver.built_in(encoder), solver.BUILT_IN
    if arguments.question_solver == "llm":
        client, config = options.chat_client(arguments, source.run.folder)
        ask, answered_by = solver.by_language_model(client, config).ask, config.text_model
    labelled_by: dict[str, None] = {}
    # All kinds of one scene together: they share its ground truth.
    for scene in output.stepped(source.scenes, "items", is_quiet=arguments.quiet):
        for kind, mine in sources.items():
            n_most = arguments.per_kind or PER_KIND[kind]
            if kind == "annotation":
                drafts_of[kind] += annotation_drafts(mine, scene, n_most, random)
                found = (mine.refined(scene, method) for method in mine.methods)
                labelled_by |= dict.fromkeys(refined.source for refined in found if refined is not None)
            elif kind == "reasoning":
                drafts_of[kind] += reasoning_drafts(mine, scene, given, n_most, ask)
            else:
                assert encoder is not None
                # Use all questions of a file, unless --per-kind limits them.
                questions = questions_of(mine, scene, given, n_most if given is None else arguments.per_kind)
                drafts_of[kind] += retrieval_drafts(mine, scene, questions, encoder)
    for drafts in drafts_of.values():
        check_split(len(drafts), arguments.annotators, arguments.overlap)
    note = (relative_remark(encoder) or "") if "retrieval" in sources else ""
    return drafts_of, {"retrieval": note, "reasoning": answered_by, "annotation": " and ".join(labelled_by)}


def _estimate(source: RunSource, arguments: argparse.Namespace) -> None:
    """Print the maximum cost of the language model."""
    from su3d_bench.human_eval.drafts import reasoning_drafts, requests_into

    client, config = options.chat_client(arguments, source.run.folder)
    given = _given(source, arguments)
    requests: list[ChatRequest] = []
    for scene in source.scenes:
        n_most = arguments.per_kind or PER_KIND["reasoning"]
        reasoning_drafts(source, scene, given, n_most, requests_into(requests, client, config))
    return options.answer_estimate(arguments, client, requests)


def _given(source: RunSource, arguments: argparse.Namespace) -> Sequence[Question] | None:
    """The questions of a file or of the paper; None if they are generated."""
    from su3d_bench.questions.question_files import paper_queries, read_questions

    if arguments.questions == "generated":
        return None
    datasets = {scene.partition("/")[0] for scene in source.scenes}
    if arguments.questions == "paper":
        given = paper_queries()
    else:
        given = read_questions(Path(arguments.questions), datasets.pop() if len(datasets) == 1 else None)
    if not any(question.scene in source.scenes for question in given):
        raise ConfigError(f"--questions {arguments.questions}: no question about a scene of this run")
    return given


def _drawn(
    source: RunSource, drafts: Mapping[SheetKind, Sequence[Draft]], arguments: argparse.Namespace
) -> dict[SheetKind, list[bytes]]:
    """The pictures of all drafts."""
    from su3d_bench.human_eval.drawing import draw_all

    flat = [draft for of_kind in drafts.values() for draft in of_kind]
    jobs = arguments.jobs or os.cpu_count() or 1
    with output.steps("pictures", is_quiet=arguments.quiet) as step:
        pictures = draw_all(source, flat, jobs, lambda n_done, n: step(source.run.name, n_done, n))
    remaining = iter(pictures)
    return {kind: list(islice(remaining, len(of_kind))) for kind, of_kind in drafts.items()}


def _origin(kind: SheetKind, source: RunSource, made_by: str) -> Key:
    from su3d_bench.human_eval.items import Key

    rules = {rules.name for scene in source.scenes if (rules := source.rules(scene, kind)) is not None}
    run = source.run
    return Key(
        sheet_id="",
        kind=kind,
        items=(),
        run=run.name,
        run_digest=run.record.code,
        methods=source.methods,
        automatic_rule=", ".join(sorted(rules)),
        answered_by=made_by if kind != "retrieval" else "",
        profile=run.record.profile or "",
        encoder=run.record.encoder or "",
        limit=run.limit,
        changed={method: changed for method in source.methods if (changed := run.changed(method))},
        remarks=(made_by,) if kind == "retrieval" and made_by else (),
    )


def _write(
    origins: Mapping[SheetKind, Key],
    drafts: Mapping[SheetKind, Sequence[Draft]],
    drawn: Mapping[SheetKind, Sequence[bytes]],
    arguments: argparse.Namespace,
) -> list[dict[str, Any]]:
    """Write one set per kind, several sets into separate folders; returns what was written."""
    from su3d_bench.human_eval.sets import make_sheets, write_sheets

    apart = arguments.key or arguments.out.with_name(f"{arguments.out.name}-key")
    written_sets = []
    for kind, origin in origins.items():
        made = make_sheets(
            origin,
            drafts[kind],
            drawn[kind],
            seed=arguments.seed,
            annotators=arguments.annotators,
            overlap=arguments.overlap,
        )
        folder, key = (arguments.out, apart) if len(origins) == 1 else (arguments.out / kind, apart / kind)
        files = write_sheets(made, folder, key)
        written_sets.append(
            {
                "kind": kind,
                "sheet_id": made.sheet.id,
                "n_items": len(made.sheet.items),
                "n_questions": sum(len(item.asks) for item in made.sheet.items),
                "files": [str(path) for path in files],
                "key": str(key),
            }
        )
    return written_sets
