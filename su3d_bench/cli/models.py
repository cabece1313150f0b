"""``su3d-bench models``: list, download and check foundation models."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from su3d_bench.cli import fetch
from su3d_bench.cli.options import Verbs, add_group, add_verb, perception_config
from su3d_bench.cli.output import answer_either, remark
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError

if TYPE_CHECKING:
    from su3d_bench.perception.models.loading import ModelState


def add_parser(verbs: Verbs) -> None:
    """List, download and check foundation models.

    su3d-bench models list
    su3d-bench models fetch --profile paper --dry-run
    """
    actions = add_group(verbs, "models", add_parser, lists=True)
    listing = add_verb(actions, "list", call_list)
    listing.shared("--set")
    checking = add_verb(actions, "check", call_check)
    checking.option("names [MODEL...]", "models to check (default: all that are present)")
    checking.shared("--set")
    fetch.add_models(actions)


def call_list(arguments: argparse.Namespace) -> None:
    """List all models with size, licence, profile and location.

    su3d-bench models list
    su3d-bench models list --json
    """
    states = _states(arguments, ())
    width = max(len(state.entry.name) for state in states)
    lines = []
    for state in states:
        entry = state.entry
        place = f"found: {state.files[0].folder}" if state.files else "missing"
        size = f"{entry.forms[0].size_mb / 1000:.1f} GB"
        profiles = f" (profile {', '.join(state.profiles)})" if state.profiles else ""
        lines.append(f"{entry.name:<{width}}  {entry.kind:<9}  {size:>6}  {entry.licence:<10}  {place}{profiles}")
    answer_either(arguments, [_state_row(state) for state in states], *lines)
    if missing := [state.entry.name for state in states if not state.files]:
        text = f"{len(missing)} missing; su3d-bench models check {missing[0]} shows what to download"
        remark(text, quiet=arguments.quiet or arguments.json)


def _states(arguments: argparse.Namespace, names: tuple[str, ...]) -> list[ModelState]:
    from su3d_bench.perception.models.catalogue import MODELS, model_entry
    from su3d_bench.perception.models.loading import model_state

    config = perception_config(arguments).models
    entries = [model_entry(name) for name in names] or list(MODELS.values())
    return [model_state(entry, config.paths.get(entry.name), config.folder) for entry in entries]


def _state_row(state: ModelState) -> dict[str, Any]:
    entry = state.entry
    return {
        "name": entry.name,
        "kind": entry.kind,
        "summary": entry.summary,
        "licence": entry.licence,
        "profiles": list(state.profiles),
        "memory_mb": {"float32": entry.memory_mb(4), "float16": entry.memory_mb(2)},
        "forms": [
            {"form": form.form, "files": list(form.files), "size_mb": form.size_mb, "source": form.source}
            for form in entry.forms
        ],
        "found": {files.form.form: str(files.folder) for files in state.files},
        "missing": state.missing,
        "remark": entry.remark or None,
    }


def call_check(arguments: argparse.Namespace) -> int:
    """Print the SHA-256 of every model file, as in run.json, and report all problems.

    su3d-bench models check
    su3d-bench models check clip-vit-h-14 sam-vit-h --json
    """
    from su3d_bench.perception.models.loading import problems_of

    names = tuple(dict.fromkeys(arguments.names))
    states = _states(arguments, names)
    rows: list[dict[str, Any]] = [
        {
            "name": files.entry.name,
            "form": files.form.form,
            "folder": str(files.folder),
            "sha256": files.digests(),
            "problems": problems_of(files),
        }
        for state in states
        for files in state.files
    ]
    absent: dict[str, Any] = {"form": None, "folder": None, "sha256": {}}
    rows += [
        {"name": state.entry.name, **absent, "problems": [state.missing]}
        for state in states
        if names and not state.files
    ]
    if not rows:
        raise ConfigError("models check: no models found; to list them: su3d-bench models list")
    answer_either(arguments, rows, *(line for row in rows for line in _check_lines(row)))
    return EXIT_CHECK_FAILED if any(row["problems"] for row in rows) else EXIT_DONE


def _check_lines(row: dict[str, Any]) -> list[str]:
    if row["form"] is None:
        return list(row["problems"])
    state = "invalid" if row["problems"] else "OK"
    digests = [f"  {digest}  {name}" for name, digest in row["sha256"].items()]
    return [f"{row['name']} ({row['form']}): {row['folder']}: {state}", *digests, *(f"  {p}" for p in row["problems"])]
