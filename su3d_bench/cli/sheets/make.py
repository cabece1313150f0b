"""``su3d-bench sheets make``: a finished run -> sheets for people, as a page, a workbook and a table; the key apart."""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.common import (
    add_language_flags,
    add_verb,
    answer,
    answer_estimate,
    answer_json,
    chat_client,
    remark,
)
from su3d_bench.core.errors import EXIT_DONE, ConfigError, counted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from su3d_bench.core.interfaces import Encoder
    from su3d_bench.perception.language.chat import ChatRequest
    from su3d_bench.questions.model import Question
    from su3d_bench.sheets.drafts import AskMap, Draft
    from su3d_bench.sheets.items import SheetKind
    from su3d_bench.sheets.run_source import RunSource

NAME = "make"
KINDS = ("retrieval", "annotation", "reasoning")
# A person judges some hundred items without a break: so many of each kind of question and scene, instances a scene,
# or questions of each template and scene.
LANGUAGE_FLAGS = ("model", "base_url", "config", "set", "offline", "ask_failed_again", "dry_run")
PER_KIND = {"retrieval": 5, "annotation": 30, "reasoning": 1}


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Make sheets on which people judge a run: an offline page, a workbook and a table with pictures.",
        (
            "su3d-bench sheets make runs/my-run --kind retrieval --out sheets/my-run",
            "su3d-bench sheets make runs/my-run --kind retrieval annotation reasoning --annotators 3 --out sheets",
        ),
        call,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run; variants stand side by side in it")
    parser.add_argument(
        "--kind", nargs="+", choices=KINDS, required=True, help="what is judged; several give a folder each in DIR"
    )
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
    parser.add_argument("--device", default="cpu", help="of the text's encoder (default: cpu)")
    parser.add_argument(
        "--solver",
        choices=("built-in", "llm"),
        default="built-in",
        help="who answers in reasoning sheets: geometry alone (default), or a language model, as in su3d-bench ask",
    )
    add_language_flags(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.runs.finished import read_run
    from su3d_bench.sheets.run_source import RunSource

    _check(arguments)
    kinds = tuple(dict.fromkeys(arguments.kind))
    source = RunSource(read_run(arguments.run), arguments.methods, arguments.scenes)
    sources: dict[SheetKind, RunSource] = {kind: _judgeable(source, kind, arguments.quiet) for kind in kinds}
    if arguments.dry_run:
        return _estimate(sources["reasoning"], arguments)
    drafts, answered_by = _drafts(sources, arguments)
    written_sets = _write(sources, drafts, _drawn(source, drafts, arguments), answered_by, arguments)
    if arguments.json:
        answer_json({"sets": written_sets})
        return EXIT_DONE
    for sheet in written_sets:
        answer(f"{sheet['sheet_id']}: {counted(sheet['n_items'], 'item')}, {counted(sheet['n_questions'], 'question')}")
        for path in sheet["files"]:
            answer(path)
        remark(f"key, which annotators must not see: {sheet['key']}", quiet=arguments.quiet)
    return EXIT_DONE


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what could not be done, or would be done without being asked for."""
    if arguments.per_kind is not None and arguments.per_kind < 1:
        raise ConfigError(f"--per-kind {arguments.per_kind}: at least 1 item is needed")
    if arguments.jobs < 1:
        raise ConfigError(f"--jobs {arguments.jobs}: at least 1 is needed")
    if arguments.seed < 0:
        raise ConfigError(f"--seed {arguments.seed}: expected 0 or more")
    if arguments.kind == ["annotation"] and arguments.questions != "generated":
        raise ConfigError("--questions: annotation sheets ask about labels and masks; leave it out")
    if arguments.solver == "llm" and "reasoning" not in arguments.kind:
        raise ConfigError("--solver llm: answers questions of reasoning sheets; add --kind reasoning")
    given = [f"--{name.replace('_', '-')}" for name in LANGUAGE_FLAGS if getattr(arguments, name)]
    if given and arguments.solver != "llm":
        raise ConfigError(f"{given[0]}: is for --solver llm alone; the built-in solver asks nobody")


def _judgeable(source: RunSource, kind: SheetKind, is_quiet: bool) -> RunSource:
    """The run without the methods whose maps have no features, where texts are compared with features."""
    if kind != "retrieval":
        return source
    scene = source.scenes[0]
    kept = tuple(method for method in source.methods if source.instances(scene, method).features is not None)
    if not kept:
        raise ConfigError(
            f"{source.run.name}: {', '.join(source.methods)}: no map has features that a text could be compared with; "
            "give the run a method that makes them, such as opensu3d"
        )
    if kept == source.methods:
        return source
    left_out = [method for method in source.methods if method not in kept]
    remark(f"retrieval: left out {', '.join(left_out)}, which keeps no features to rank by", quiet=is_quiet)
    return source.of_methods(kept)


def _drafts(
    sources: Mapping[SheetKind, RunSource], arguments: argparse.Namespace
) -> tuple[dict[SheetKind, list[Draft]], str]:
    """What is judged, and who answered the questions of reasoning sheets."""
    import numpy as np

    from su3d_bench.sheets.drafts import annotation_drafts, questions_of, reasoning_drafts, retrieval_drafts
    from su3d_bench.sheets.making import check_split

    source = next(iter(sources.values()))
    random = np.random.default_rng(arguments.seed)
    given = _given(source, arguments)
    drafts_of: dict[SheetKind, list[Draft]] = {kind: [] for kind in sources}
    needs_encoder = "retrieval" in sources or ("reasoning" in sources and arguments.solver != "llm")
    encoder = source.run.encoder(arguments.device) if needs_encoder else None
    ask, answered_by = _ask_map(source, encoder, arguments) if "reasoning" in sources else (None, "")
    for scene in source.scenes:  # all kinds of one scene together, for they share its truth
        for kind, mine in sources.items():
            n_most = arguments.per_kind or PER_KIND[kind]
            if kind == "annotation":
                drafts_of[kind] += annotation_drafts(mine, scene, n_most, random)
            elif kind == "reasoning":
                assert ask is not None
                drafts_of[kind] += reasoning_drafts(mine, scene, given, n_most, ask)
            else:
                assert encoder is not None
                # A file is asked as it stands, unless --per-kind limits it.
                questions = questions_of(mine, scene, given, n_most if given is None else arguments.per_kind)
                drafts_of[kind] += retrieval_drafts(mine, scene, questions, encoder)
    for drafts in drafts_of.values():
        check_split(len(drafts), arguments.annotators, arguments.overlap)
    return drafts_of, answered_by


def _ask_map(source: RunSource, encoder: Encoder | None, arguments: argparse.Namespace) -> tuple[AskMap, str]:
    """Who answers the questions of reasoning sheets, and how the key calls them."""
    from su3d_bench.sheets.drafts import built_in, by_language_model

    if arguments.solver != "llm":
        return built_in(encoder), "the built-in solver"
    client, config = chat_client(arguments, source.run.folder)
    return by_language_model(client, config), config.text_model


def _estimate(source: RunSource, arguments: argparse.Namespace) -> int:
    """Tell what asking the language model would cost at the most."""
    from su3d_bench.sheets.drafts import reasoning_drafts, requests_into

    client, config = chat_client(arguments, source.run.folder)
    given = _given(source, arguments)
    requests: list[ChatRequest] = []
    for scene in source.scenes:
        n_most = arguments.per_kind or PER_KIND["reasoning"]
        reasoning_drafts(source, scene, given, n_most, requests_into(requests, client, config))
    return answer_estimate(arguments, client, requests)


def _given(source: RunSource, arguments: argparse.Namespace) -> Sequence[Question] | None:
    """The questions of a file or of the paper; None where they are made from the ground truth."""
    from su3d_bench.questions.files.files import paper_queries, read_questions

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
    source: RunSource, drafts: Mapping[SheetKind, Sequence[Draft]], arguments: argparse.Namespace
) -> dict[SheetKind, list[bytes]]:
    """The pictures of all drafts."""
    from su3d_bench.cli.common import progress
    from su3d_bench.runs.executors.local import Event
    from su3d_bench.sheets.drawing import draw_all

    flat = [draft for of_kind in drafts.values() for draft in of_kind]
    name = source.run.name
    with progress(1, is_quiet=arguments.quiet, last_step="writing") as report:
        pictures = draw_all(
            source,
            arguments.colours,
            flat,
            arguments.jobs,
            lambda n_done, n: report(Event(name, "pictures", n_done, n)),
        )
    remaining = iter(pictures)
    return {kind: list(islice(remaining, len(of_kind))) for kind, of_kind in drafts.items()}


def _write(
    sources: Mapping[SheetKind, RunSource],
    drafts: Mapping[SheetKind, Sequence[Draft]],
    drawn: Mapping[SheetKind, Sequence[bytes]],
    answered_by: str,
    arguments: argparse.Namespace,
) -> list[dict[str, Any]]:
    """Write a set of each kind, several of them each into a folder of its name; what was written."""
    from su3d_bench.sheets.making import Origin, make_sheets, write_sheets

    apart = arguments.key or arguments.out.with_name(f"{arguments.out.name}-key")
    written_sets = []
    for kind, source in sources.items():
        rules = {rules.name for scene in source.scenes if (rules := source.rules(scene, kind)) is not None}
        by = answered_by if kind == "reasoning" else ""
        origin = Origin(source.run.name, source.run.record.code, source.methods, ", ".join(sorted(rules)), by)
        made = make_sheets(
            kind,
            drafts[kind],
            drawn[kind],
            origin,
            seed=arguments.seed,
            annotators=arguments.annotators,
            overlap=arguments.overlap,
        )
        folder, key = (arguments.out, apart) if len(sources) == 1 else (arguments.out / kind, apart / kind)
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
