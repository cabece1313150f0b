"""``su3d-bench dev doctor``: whether this machine has what the program needs, and what to do where not."""

from __future__ import annotations

import argparse
from typing import Any

from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, counted


def add_parser(verbs: Any) -> None:
    add_verb(
        verbs,
        "doctor",
        "Look at libraries, GPU, data, models, folders and cores; exit code 1 where the main job cannot run.",
        ("su3d-bench dev doctor", "su3d-bench dev doctor --json doctor.json"),
        call,
        uses_all_cores=True,  # computes nothing, and shows what is set of threads
    )


def call(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from su3d_bench.cli.doctor.checks import examine

    checks = examine()
    missing = [check for check in checks if check.state == "missing"]
    width = max(len(check.what) for check in checks)
    lines = []
    for check in checks:
        text = "; ".join(part for part in (check.found, check.to_do) if part)
        lines.append(f"{check.state:<7}  {check.what:<{width}}  {text}")
    verdict = (
        f"the main job cannot run: {counted(len(missing), 'thing')} missing" if missing else "the main job can run"
    )
    value = {"can_run": not missing, "checks": [asdict(check) for check in checks]}
    answer_either(arguments, value, *lines, "", verdict)
    return EXIT_CHECK_FAILED if missing else EXIT_DONE
