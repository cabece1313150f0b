"""``su3d-bench runs show``: what a run was asked for, and how far it came."""

from __future__ import annotations

import argparse
import json
import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any

from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE

NAME = "show"


def add_parser(actions: Any) -> None:
    parser = add_verb(
        actions,
        NAME,
        "Show what a run was asked for, how far it came, and the command that takes it up again.",
        ("su3d-bench runs show runs/demo", "su3d-bench runs show runs/demo --json"),
        call,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="a run folder")


def call(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.analysis.run_list import run_entry, size_bytes
    from su3d_bench.core.config import DEFAULT_SOURCE
    from su3d_bench.core.errors import StoreError, printable, printable_json
    from su3d_bench.formats.tables.table import percent
    from su3d_bench.runs.existing import existing_run

    entry = run_entry(arguments.run)
    asked: dict[str, str] = {}
    with suppress(StoreError):  # a damaged run.toml tells nothing
        held = existing_run(arguments.run)
        for path, value in () if held is None else held.values.items():
            if held is not None and held.remarks.get(path) != DEFAULT_SOURCE:
                asked[".".join(path)] = json.dumps(value, ensure_ascii=False, default=str)
    n_bytes = size_bytes(arguments.run)
    config = arguments.run / "run.toml"
    again = shlex.join(["su3d-bench", "run", "--config", str(config), "--out", str(arguments.run)])
    value = asdict(entry) | {"bytes": n_bytes, "asked": printable_json(asked), "command": again}
    lines = [
        f"{entry.name}: {entry.state}, written {entry.when}, {n_bytes / 1e6:.1f} MB",
        f"scenes: {', '.join(entry.scenes) or 'not known'}",
        f"methods: {', '.join(entry.methods) or 'not known'}",
        *(f"  {one.method} under {one.protocol}: {one.metric} {percent(one.value)}" for one in entry.headlines),
        "asked for:",
        *(f"  {printable(key, 120)} = {printable(text, 300)}" for key, text in asked.items()),
        f"take it up again: {again}",
    ]
    answer_either(arguments, value, *lines)
    return EXIT_DONE
