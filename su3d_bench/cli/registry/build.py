"""``su3d-bench dev registry build``: the site of a registry."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either, remark
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, counted, printable

NAME = "build"
MOST_TOLD = 20


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Make a static site of a registry's bundles; exit code 1 where something in it can stand in no ranking.",
        (
            "su3d-bench dev registry build my-registry --out site",
            'su3d-bench dev registry build . --out site --title "Maps of rooms" --bundles-at https://example.org/bundles',
        ),
        call,
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="a registry, or any folder of bundles")
    parser.add_argument(
        "--out", type=Path, default=Path("site"), metavar="DIR", help="where the site goes (default: site)"
    )
    parser.add_argument("--title", metavar="TEXT", help="of the first page (default: Registry of results)")
    parser.add_argument("--bundles-at", metavar="URL", help="link the bundles there (default: named, not linked)")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.reproducing.registry.folder import read_registry
    from su3d_bench.reproducing.registry.site import TITLE, write_site

    registry = read_registry(arguments.folder)
    title = TITLE if arguments.title is None else printable(arguments.title, 120)
    pages = write_site(registry, arguments.out, title, arguments.bundles_at)
    refused = [f"left out: {one.run}, {one.what}: {one.reason}" for one in registry.refused]
    for line in refused[:MOST_TOLD]:
        remark(line)
    if len(refused) > MOST_TOLD:
        remark(f"left out: {len(refused) - MOST_TOLD} more")
    counts = f"{counted(len(registry.rows), 'row')} of {counted(registry.n_bundles, 'bundle')} in "
    value = {
        "index": str(pages[0]),
        "n_pages": len(pages) - 1,
        "n_bundles": registry.n_bundles,
        "n_rows": len(registry.rows),
        "left_out": [vars(one) for one in registry.refused],
    }
    answer_either(arguments, value, f"{pages[0]}: {counts}{counted(len(registry.boards), 'ranking')}")
    return EXIT_CHECK_FAILED if refused else EXIT_DONE
