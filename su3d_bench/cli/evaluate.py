"""``su3d-bench evaluate``: predictions made elsewhere to the numbers of the published protocols."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.common import add_protocols, add_table_format, add_verb, answer_tables, remark
from su3d_bench.core.errors import EXIT_DONE


def add_parser(verbs: Any) -> None:
    parser = add_verb(
        verbs,
        "evaluate",
        "Score predictions made elsewhere, under every protocol that fits; the format is recognised.",
        (
            "su3d-bench evaluate predictions/ --dataset replica --json numbers.json",
            "su3d-bench evaluate pred/ --ground-truth gt/ --protocols scannet-instance --per-class",
        ),
        call,
    )
    parser.add_argument(
        "predictions",
        nargs="+",
        type=Path,
        metavar="PREDICTIONS",
        help="a folder of predictions, a run folder, or files",
    )
    parser.add_argument(
        "--dataset", metavar="NAME", help="whose ground truth, below $SU3D_DATA: replica, scannet, rooms"
    )
    parser.add_argument(
        "--ground-truth",
        type=Path,
        metavar="DIR",
        help="ground truth as text instead, <scene>.txt with label * 1000 + instance a vertex, or label ids; or "
        "OpenLex3D's release",
    )
    parser.add_argument(
        "--truth-values",
        choices=("classes", "instances", "numbers"),
        help="what that text holds, where its values do not tell: class ids, label * 1000 + instance, or numbers of "
        "objects alone (0 for none), as in the OpenSUN3D challenge",
    )
    add_protocols(parser, "evaluations (default: all that fit)", "PROTOCOL")
    parser.add_argument("--scenes", nargs="+", default=[], metavar="SCENE", help="names or patterns (default: all)")
    parser.add_argument("--format", metavar="FORMAT", help="of the predictions, where it cannot be recognised")
    parser.add_argument(
        "--text-features",
        type=Path,
        metavar="FILE",
        help="features of class names for predictions that have features: .npz with names and features",
    )
    parser.add_argument(
        "--confidences",
        choices=("protocol", "file"),
        help="where a protocol has 1 for every mask: its rule, or the files' (default: file for ScanNet's text)",
    )
    parser.add_argument(
        "--queries",
        type=Path,
        metavar="FILE",
        help="texts and the objects that they speak of, for query-ap: TOML or CSV with scene, text and objects",
    )
    parser.add_argument("--per-class", action="store_true", help="print the table of every class too")
    add_table_format(parser, "--table-format")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.evaluation.evaluate import NOT_MEANT, Request, evaluate
    from su3d_bench.reports.tables.evaluation import evaluation_tables

    result = evaluate(
        Request(
            tuple(arguments.predictions),
            dataset=arguments.dataset,
            ground_truth=arguments.ground_truth,
            truth_values=arguments.truth_values,
            protocols=tuple(arguments.protocols),
            scenes=tuple(arguments.scenes),
            format=arguments.format,
            text_features=arguments.text_features,
            confidences=arguments.confidences,
            queries=arguments.queries,
        )
    )
    document = result.to_json()
    answer_tables(arguments, document, evaluation_tables(document, per_class=arguments.per_class))
    remark(f"format: {', '.join(result.formats)}; ground truth: {result.ground_truth}", quiet=arguments.quiet)
    for line in result.remarks:
        remark(line, quiet=arguments.quiet)
    reasons: dict[str, list[str]] = {}
    for name, reason in result.not_scored.items():
        reasons.setdefault(reason, []).append(name)
    for reason, names in reasons.items():
        if not reason.startswith(NOT_MEANT):
            remark(f"not scored under {', '.join(names)}: {reason}", quiet=arguments.quiet)
    return EXIT_DONE
