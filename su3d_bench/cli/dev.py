"""``su3d-bench dev``: the cache, this machine, completion in a shell, and registries of results."""

from __future__ import annotations

import argparse
from typing import Any

from su3d_bench.cli import cache, doctor, registry
from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_group, add_verb
from su3d_bench.core.errors import EXIT_DONE

SHELLS = ("bash", "zsh", "fish")


def add_parser(verbs: Any) -> None:
    actions = add_group(
        verbs,
        "dev",
        "Look after the program: its cache, this machine, completion in a shell, registries of results.",
        ("su3d-bench dev doctor", "su3d-bench dev cache list"),
    )
    cache.add_parser(actions)
    doctor.add_parser(actions)
    parser = add_verb(
        actions,
        "completion",
        "Print a script that completes verbs, flags and choices in a shell.",
        ('eval "$(su3d-bench dev completion bash)"', "su3d-bench dev completion fish | source"),
        call_completion,
    )
    parser.add_argument("shell", choices=SHELLS, help="bash, zsh or fish")
    registry.add_parser(actions)


def call_completion(arguments: argparse.Namespace) -> int:
    import argcomplete

    script = argcomplete.shellcode(["su3d-bench"], shell=arguments.shell)
    answer_either(arguments, {"shell": arguments.shell, "script": script}, *script.splitlines())
    return EXIT_DONE
