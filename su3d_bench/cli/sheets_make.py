"""``su3d-bench sheets make``: a run or scenes -> sheets for people, as page, workbook and table; the key apart."""

from __future__ import annotations

import argparse
import os
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from su3d_bench.cli import options, output
from su3d_bench.cli.options import Verbs, add_verb, count
from su3d_bench.cli.output import remark
from su3d_bench.core.errors import ConfigError, counted

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from su3d_bench.perception.language.chat import ChatRequest
    from su3d_bench.questions.model import Question
    from su3d_bench.sheets.drafts import Draft
    from su3d_bench.sheets.drawing import PictureSource
    from su3d_bench.sheets.items import Key, SheetKind
    from su3d_bench.sheets.sources import RunSource, TruthSource

QUESTIONS: Final = "questions"  # the kind that needs no method, and so no run
KINDS = ("retrieval", "annotation", "reasoning", QUESTIONS)
# A person judges some hundred items without a break: so many of each kind of question and scene, instances a scene,
# or questions of each template and scene.

PER_KIND = {"retrieval": 5, "annotation": 30, "reasoning": 1, QUESTIONS: 2}


def add_parser(verbs: Verbs) -> None:
    parser = add_verb(verbs, "make", call)
    parser.option(
        "run [RUN]", "the folder of a run; variants stand side by side in it (--kind questions can do with --scenes)"
    )
    parser.option("--kind ...", "what is judged; several give a folder each in DIR", choices=KINDS, required=True)
    parser.option("--out DIR", "where the sheets go", required=True)
    parser.option("--key DIR", "where the key goes (default: DIR-key)")
    parser.option(
        "--questions FILE",
        "a file of questions, 'paper' for those of its page, or 'generated' from the ground truth (default)",
        default="generated",
        type=str,
    )
    parser.shared("--methods")
    parser.option(
        "--scenes S...",
        "these alone (default: all of the run); without RUN addresses or patterns such as 'rooms/*'",
        default=[],
    )
    parser.shared("--leave-out")
    parser.option(
        "--per-kind N",
        "most items of a scene: questions of a kind (default: 5), instances (30), questions of a template (1); "
        "in sheets of questions 2 of each kind and template",
        type=count,
    )
    parser.option("--annotators N", "people who share the work", type=int, default=1)
    parser.option("--overlap SHARE", "of all items that everybody gets (default: 0.25)", type=float, default=0.25)
    parser.shared("--seed", "--jobs", "--device")
    parser.option(
        "--solver",
        "who answers in reasoning sheets: geometry alone (default), or a language model, as in query ask",
        choices=("built-in", "llm"),
        default="built-in",
    )
    options.add_language_options(parser)


def call(arguments: argparse.Namespace) -> None:
    """Make sheets on which people judge a run, or questions: an offline page, a workbook and a table with pictures.

    su3d-bench sheets make runs/my-run --kind retrieval annotation reasoning --annotators 3 --out sheets
    su3d-bench sheets make --kind questions --scenes 'rooms/*' --annotators 2 --overlap 1 --out sheets
    """
    from su3d_bench.questions.query_files import read_left_out
    from su3d_bench.runs.finished import read_run
    from su3d_bench.sheets.sources import RunSource, truth_of_addresses, truth_of_run

    _check(arguments)
    left_out = frozenset[str]() if arguments.leave_out is None else read_left_out(arguments.leave_out)
    kinds: tuple[SheetKind, ...] = tuple(dict.fromkeys(arguments.kind))
    origins: dict[SheetKind, Key] = {}
    drafts: dict[SheetKind, list[Draft]] = {}
    drawn: dict[SheetKind, list[bytes]] = {}
    of_run = [kind for kind in kinds if kind != QUESTIONS]
    if of_run:
        source = RunSource(read_run(arguments.run), arguments.methods, arguments.scenes)
        sources: dict[SheetKind, RunSource] = {kind: _judgeable(source, kind, arguments.quiet) for kind in of_run}
        if arguments.dry_run:
            _estimate(sources["reasoning"], left_out, arguments)
            return
        drafts, made_by = _drafts(sources, left_out, arguments)
        origins = {kind: _origin(kind, mine, made_by[kind]) for kind, mine in sources.items()}
        drawn = _drawn(source, source.run.name, drafts, arguments)
    if QUESTIONS in kinds:
        truth = (
            truth_of_addresses(arguments.scenes)
            if arguments.run is None
            else truth_of_run(arguments.run, arguments.scenes)
        )
        of_truth, origins[QUESTIONS] = _questions(truth, left_out, arguments)
        drafts |= of_truth
        drawn |= _drawn(truth, truth.run or QUESTIONS, of_truth, arguments)
    written_sets = _write({kind: origins[kind] for kind in kinds}, drafts, drawn, arguments)
    if output.answer_json(arguments, {"sets": written_sets}):
        return
    for sheet in written_sets:
        n_items, n_questions = counted(sheet["n_items"], "item"), counted(sheet["n_questions"], "question")
        output.answer(f"{sheet['sheet_id']}: {n_items}, {n_questions}", *sheet["files"])
        remark(f"key, which annotators must not see: {sheet['key']}", quiet=arguments.quiet)


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what could not be done, or would be done without being asked for."""
    kinds = set(arguments.kind)
    if arguments.run is None and (kinds != {QUESTIONS} or not arguments.scenes):
        raise ConfigError(
            "RUN: name the folder of a run; only --kind questions can do without, and needs --scenes then"
        )
    has_questions = arguments.questions != "generated"
    if kinds == {"annotation"} and (has_questions or arguments.leave_out is not None):
        raise ConfigError("--questions, --leave-out: annotation sheets ask about labels and masks; leave it out")
    if kinds == {QUESTIONS} and (has_questions or arguments.methods):
        raise ConfigError(
            "--questions, --methods: sheets of kind questions judge those made from the ground truth; leave it out"
        )
    if arguments.solver == "llm" and "reasoning" not in arguments.kind:
        raise ConfigError("--solver llm: answers questions of reasoning sheets; add --kind reasoning")
    if arguments.solver != "llm" and (given := options.given_language_option(arguments)):
        raise ConfigError(f"{given}: is for --solver llm alone; the built-in solver asks nobody")


def _judgeable(source: RunSource, kind: SheetKind, is_quiet: bool) -> RunSource:
    """The run without the methods whose maps hold nothing that sheets of a kind judge; it is said which.

    Texts are compared with features, of instances or of points; labels, masks and answers are of instances.
    """
    is_able, lacks, wanted = source.has_instances, "has no instances to judge", "instances that people could judge"
    if kind == "retrieval":
        is_able, lacks = source.has_features, "keeps no features to rank by"
        wanted = "features that a text could be compared with"
    kept = tuple(method for method in source.methods if is_able(source.scenes[0], method))
    if not kept:
        raise ConfigError(
            f"{source.run.name}: {', '.join(source.methods)}: no map has {wanted}; give the run a method that makes "
            "them, such as opensu3d"
        )
    if kept == source.methods:
        return source
    left_out = [method for method in source.methods if method not in kept]
    remark(f"{kind}: left out {', '.join(left_out)}, which {lacks}", quiet=is_quiet)
    return source.of_methods(kept)


def _questions(
    truth: TruthSource, left_out: Collection[str], arguments: argparse.Namespace
) -> tuple[dict[SheetKind, list[Draft]], Key]:
    """The questions that people judge, and where they come from; what is counted together stands for methods."""
    from su3d_bench.sheets.drafts import question_drafts
    from su3d_bench.sheets.items import Key
    from su3d_bench.sheets.scores import OF_ALL_KINDS
    from su3d_bench.sheets.sets import check_split

    n_most = arguments.per_kind or PER_KIND[QUESTIONS]
    drafts = [draft for scene in truth.scenes for draft in question_drafts(truth, scene, n_most, left_out)]
    check_split(len(drafts), arguments.annotators, arguments.overlap)
    counted_kinds = (*dict.fromkeys(draft.question_kind for draft in drafts), OF_ALL_KINDS)
    return {QUESTIONS: drafts}, Key("", QUESTIONS, truth.run, truth.run_digest, counted_kinds, "", ())


def _drafts(
    sources: Mapping[SheetKind, RunSource], left_out: Collection[str], arguments: argparse.Namespace
) -> tuple[dict[SheetKind, list[Draft]], dict[SheetKind, str]]:
    """What is judged, and who answered the questions of reasoning sheets or made labels n'.

    Of retrieval sheets: what must be said of the encoder that compared the texts.
    """
    import numpy as np

    from su3d_bench.metrics.questions.score import relative_remark
    from su3d_bench.questions import solver
    from su3d_bench.sheets.drafts import annotation_drafts, questions_of, reasoning_drafts, retrieval_drafts
    from su3d_bench.sheets.sets import check_split

    source = next(iter(sources.values()))
    random = np.random.default_rng(arguments.seed)
    given = _given(source, arguments)
    drafts_of: dict[SheetKind, list[Draft]] = {kind: [] for kind in sources}
    needs_encoder = "retrieval" in sources or ("reasoning" in sources and arguments.solver != "llm")
    encoder = source.run.encoder(arguments.device or "cpu") if needs_encoder else None
    ask, answered_by = solver.built_in(encoder), solver.BUILT_IN
    if arguments.solver == "llm":
        client, config = options.chat_client(arguments, source.run.folder)
        ask, answered_by = solver.by_language_model(client, config).ask, config.text_model
    labelled_by: dict[str, None] = {}
    for scene in source.scenes:  # all kinds of one scene together, for they share its truth
        for kind, mine in sources.items():
            n_most = arguments.per_kind or PER_KIND[kind]
            if kind == "annotation":
                drafts_of[kind] += annotation_drafts(mine, scene, n_most, random)
                found = (mine.refined(scene, method) for method in mine.methods)
                labelled_by |= dict.fromkeys(refined.source for refined in found if refined is not None)
            elif kind == "reasoning":
                drafts_of[kind] += reasoning_drafts(mine, scene, given, n_most, ask, left_out)
            else:
                assert encoder is not None
                # A file is asked as it stands, unless --per-kind limits it.
                questions = questions_of(mine, scene, given, n_most if given is None else arguments.per_kind, left_out)
                drafts_of[kind] += retrieval_drafts(mine, scene, questions, encoder)
    for drafts in drafts_of.values():
        check_split(len(drafts), arguments.annotators, arguments.overlap)
    said = (relative_remark(encoder) or "") if "retrieval" in sources else ""
    return drafts_of, {"retrieval": said, "reasoning": answered_by, "annotation": " and ".join(labelled_by)}


def _estimate(source: RunSource, left_out: Collection[str], arguments: argparse.Namespace) -> None:
    """Tell what asking the language model would cost at the most."""
    from su3d_bench.sheets.drafts import reasoning_drafts, requests_into

    client, config = options.chat_client(arguments, source.run.folder)
    given = _given(source, arguments)
    requests: list[ChatRequest] = []
    for scene in source.scenes:
        n_most = arguments.per_kind or PER_KIND["reasoning"]
        reasoning_drafts(source, scene, given, n_most, requests_into(requests, client, config), left_out)
    return options.answer_estimate(arguments, client, requests)


def _given(source: RunSource, arguments: argparse.Namespace) -> Sequence[Question] | None:
    """The questions of a file or of the paper; None where they are made from the ground truth."""
    from su3d_bench.questions.question_files import paper_queries, read_questions

    if arguments.questions == "generated":
        return None
    datasets = {scene.partition("/")[0] for scene in source.scenes}
    if arguments.questions == "paper":
        given = paper_queries()
    else:
        given = read_questions(Path(arguments.questions), datasets.pop() if len(datasets) == 1 else None)
    if not any(question.scene in source.scenes for question in given):
        raise ConfigError(f"--questions {arguments.questions}: asks nothing of a scene of this run")
    return given


def _drawn(
    source: PictureSource, name: str, drafts: Mapping[SheetKind, Sequence[Draft]], arguments: argparse.Namespace
) -> dict[SheetKind, list[bytes]]:
    """The pictures of all drafts."""
    from su3d_bench.runs.executors import Event
    from su3d_bench.sheets.drawing import draw_all

    flat = [draft for of_kind in drafts.values() for draft in of_kind]
    with output.progress(1, is_quiet=arguments.quiet, last_step="writing") as report:
        pictures = draw_all(
            source,
            flat,
            arguments.jobs or os.cpu_count() or 1,
            lambda n_done, n: report(Event(name, "pictures", n_done, n)),
        )
    remaining = iter(pictures)
    return {kind: list(islice(remaining, len(of_kind))) for kind, of_kind in drafts.items()}


def _origin(kind: SheetKind, source: RunSource, made_by: str) -> Key:
    from su3d_bench.sheets.items import Key

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
    """Write a set of each kind, several of them each into a folder of its name; what was written."""
    from su3d_bench.sheets.sets import make_sheets, write_sheets

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
