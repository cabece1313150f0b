"""``su3d-bench ablate``: a sweep over settings of one method, as variants in one run."""

from __future__ import annotations

import argparse
from typing import Any

from su3d_bench.cli.run import add_run_flags, carry_out, plan_of, show_plan
from su3d_bench.cli.shared.answers import remark
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE


def add_parser(verbs: Any) -> None:
    parser = add_verb(
        verbs,
        "ablate",
        "Vary settings of a method, each on its own, over scenes; perception is computed once.",
        (
            "su3d-bench ablate --vary m=1,5,10 k=1,3,5 --beside conceptgraphs --scenes 'rooms/*' --out runs/sweep",
            "su3d-bench ablate --method conceptgraphs --vary sim_threshold=1.0,1.2 stride=5,10 --grid --dry-run",
        ),
        call,
        takes_up=True,
    )
    parser.add_argument("--vary", nargs="+", required=True, metavar="KEY=V1,V2", help="settings and their values")
    parser.add_argument("--method", default="opensu3d", help="name or file.py:Class (default: opensu3d)")
    parser.add_argument(
        "--beside",
        nargs="+",
        default=[],
        metavar="METHOD",
        help="other methods in the same run, as run --methods takes",
    )
    parser.add_argument("--grid", action="store_true", help="every combination, instead of one setting at a time")
    add_run_flags(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.core import registry
    from su3d_bench.runs.ablation import ablation_rows, write_rows

    rows = ablation_rows(arguments.method, arguments.vary, is_grid=arguments.grid)
    own_name = str(registry.load("method", arguments.method).name)
    swept = [arguments.method + row.method.removeprefix(own_name) for row in rows]
    arguments.methods = list(dict.fromkeys([*swept, *arguments.beside]))
    plan = plan_of(arguments)
    for note in plan.notes:
        remark(note, quiet=arguments.quiet)
    if arguments.dry_run:
        return show_plan(plan, arguments)
    code = carry_out(plan, arguments)
    if code == EXIT_DONE:
        write_rows(plan.folder.path, rows, joins=arguments.extend)
        plan.place.publish()
        remark(f"table: su3d-bench report tables {plan.folder.path} --table I", quiet=arguments.quiet or arguments.json)
    return code
