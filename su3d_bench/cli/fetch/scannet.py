"""``su3d-bench datasets fetch scannet``: scans, by the script or the link that whoever signed the terms was given."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.fetch.asking import (
    accept,
    add_fetch_flags,
    answer_brought,
    patience_of,
    plan_lines,
    plan_row,
    watching,
)
from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE, ConfigError

NAME = "scannet"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Fetch scans of ScanNet into $SU3D_DATA by your own official script or link, or say how to sign its terms.",
        (
            "su3d-bench datasets fetch scannet --script download-scannet.py",
            "su3d-bench datasets fetch scannet val --from https://example.org/scannet --accept scannet",
        ),
        call,
        takes_up=True,
    )
    parser.add_argument(
        "scans", nargs="*", metavar="SCAN", help="scene0000_00, paper, train, val or test (default: paper)"
    )
    given = parser.add_mutually_exclusive_group()
    given.add_argument("--script", type=Path, metavar="FILE", help="your official download script")
    given.add_argument(
        "--from", dest="address", metavar="URL", help="your own link, in which v1/scans and v2/scans lie"
    )
    add_fetch_flags(parser, has_servers=False)


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.fetching.scannet import fetch_by_script, fetch_from, how_to_sign, plan_scans
    from su3d_bench.fetching.sources import built_in
    from su3d_bench.runs.scenes import data_root

    source, root = built_in().named("scannet"), data_root()
    scans = plan_scans(arguments.scans, root)
    here = root if scans.is_here else None
    if arguments.dry_run:
        missing = [name for names in scans.missing.values() for name in names]
        row = plan_row(source, here) | {"missing": missing, "label_table": scans.label_table}
        counts = f"  {scans.n_files} files of {scans.n_asked} scans are missing below {root}"
        answer_either(arguments, [row], *plan_lines(source, here), counts, *(f"  {name}" for name in missing))
        return EXIT_DONE
    if scans.is_here:
        answer_brought(arguments, [(source.name, root)], [])
        return EXIT_DONE
    if arguments.script is None and arguments.address is None:
        raise how_to_sign(source)
    for name in arguments.accept:
        if name.lower() not in (source.name, source.licence.name.lower()):
            raise ConfigError(f"--accept '{name}': is nothing that is asked for; known: {source.name}")
    accept(arguments, [source])
    with watching(arguments) as watch:
        if arguments.script is not None:
            brought = fetch_by_script(source, scans, arguments.script, watch)
        else:
            brought = fetch_from(source, scans, arguments.address, watch, patience_of(arguments))
    answer_brought(arguments, [], [brought])
    return EXIT_DONE
