"""``su3d-bench dev registry add``: a bundle scored anew and taken into a registry, or refused with its reasons."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer, answer_json, show
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError

NAME = "add"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Score bundles anew and take them into a registry; exit code 1 where one is refused, with its reasons.",
        (
            "su3d-bench dev registry add bundle.zip --to my-registry --name opensu3d-rooms",
            "su3d-bench dev registry add bundles/mine.zip",
        ),
        call,
    )
    parser.add_argument(
        "bundles", nargs="+", type=Path, metavar="BUNDLE", help="archives of report bundle or reproduce"
    )
    parser.add_argument(
        "--to", type=Path, default=Path(), metavar="DIR", help="the registry's folder (default: where you are)"
    )
    parser.add_argument("--name", help="of the bundle in the registry (default: its file's, or its recipe and digest)")


def call(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.reproducing.registry.folder import add_bundle, lines_of

    if arguments.name is not None and len(arguments.bundles) > 1:
        raise ConfigError("--name: is of one bundle; add them one after the other")
    found = []
    for bundle in arguments.bundles:
        found.append(add_bundle(bundle, arguments.to, arguments.name))
        if not arguments.json:
            answer(*lines_of(found[-1]))
            show()
    answer_json(arguments, {"bundles": [{**asdict(one), "is_added": not one.reasons} for one in found]})
    return EXIT_CHECK_FAILED if any(one.reasons for one in found) else EXIT_DONE
