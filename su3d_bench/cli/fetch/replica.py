"""``su3d-bench datasets fetch replica``: the rendered frames and the annotated meshes."""

from __future__ import annotations

import argparse
from typing import Any

from su3d_bench.cli.fetch.asking import add_fetch_flags, fetch_planned, sources_of
from su3d_bench.cli.shared.flags import add_verb

NAME = "replica"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Fetch Replica into $SU3D_DATA: NICE-SLAM's RGB-D frames, and the annotated meshes of the release.",
        ("su3d-bench datasets fetch replica --dry-run", "su3d-bench datasets fetch replica frames --accept replica"),
        call,
        takes_up=True,
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help="frames, meshes (default: both)")
    parser.add_argument("--keep-archives", action="store_true", help="keep what was unpacked, in .fetched")
    add_fetch_flags(parser)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.fetching.bringing import plan_replica
    from su3d_bench.runs.scenes import data_root

    return fetch_planned(arguments, plan_replica(sources_of(arguments), arguments.parts, data_root()))
