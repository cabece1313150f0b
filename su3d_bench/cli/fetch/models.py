"""``su3d-bench models fetch``: foundation models by name, or all that a profile loads."""

from __future__ import annotations

import argparse
from typing import Any

from su3d_bench.cli.fetch.asking import add_fetch_flags, fetch_planned, sources_of
from su3d_bench.cli.shared.flags import add_settings, add_verb

NAME = "fetch"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Fetch foundation models into $SU3D_MODELS: from the Hugging Face hub, or where their authors publish them.",
        (
            "su3d-bench models fetch --for paper --accept MIT Apache-2.0",
            "su3d-bench models fetch sam-vit-h --dry-run",
        ),
        call,
        takes_up=True,
    )
    parser.add_argument("names", nargs="*", metavar="MODEL", help="short names, as models list has them")
    parser.add_argument("--for", dest="profile", metavar="PROFILE", help="every model that this profile loads: paper")
    add_fetch_flags(parser)
    add_settings(parser, "where models lie, such as perception.models.folder=/data/models")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.cli.models import perception_config
    from su3d_bench.fetching.bringing import plan_models
    from su3d_bench.perception.models.files import models_folder

    root = models_folder(perception_config(arguments).models.folder)
    return fetch_planned(arguments, plan_models(sources_of(arguments), arguments.names, arguments.profile, root))
