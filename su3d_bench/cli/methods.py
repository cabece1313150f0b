"""``su3d-bench methods``: the methods that can be run, and their settings."""

from __future__ import annotations

import argparse
from typing import Any

from su3d_bench.cli.flags import add_verb, answer, answer_json


def add_parser(verbs: Any) -> None:
    parser = add_verb(
        verbs,
        "methods",
        "List the methods that can be run; with a name, its settings and their defaults.",
        ("su3d-bench methods", "su3d-bench methods opensu3d"),
        call,
    )
    parser.add_argument("name", nargs="?", help="show the settings of this method")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench import registry

    if arguments.name is not None:
        return _show(arguments)
    rows = [{"name": name, "summary": _summary(registry.load("method", name))} for name in registry.names("method")]
    if arguments.json:
        answer_json(rows)
    else:
        width = max(len(row["name"]) for row in rows)
        answer("\n".join(f"{row['name']:<{width}}  {row['summary']}" for row in rows))
    return 0


def _summary(method: Any) -> str:
    return (method.__doc__ or "").strip().partition("\n")[0]


def _show(arguments: argparse.Namespace) -> int:
    from su3d_bench import registry
    from su3d_bench.config import flatten
    from su3d_bench.toml_text import write_toml

    method = registry.load("method", arguments.name)
    defaults = method.Config().model_dump(mode="json")
    if arguments.json:
        answer_json({"name": method.name, "summary": _summary(method), "settings": defaults})
        return 0
    leaves = [(("method", method.name, *path), value, _remark(method, path)) for path, value in flatten(defaults)]
    answer(f"# {_summary(method)}")
    answer(write_toml(leaves) if leaves else f"# {method.name} has no settings")
    return 0


def _remark(method: Any, path: tuple[str, ...]) -> str:
    field = method.Config.model_fields[path[0]]
    return field.description or "default"
