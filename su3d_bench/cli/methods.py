"""``su3d-bench methods``: list methods, show their settings, check one, or create your own."""

from __future__ import annotations

import argparse
import json
import textwrap
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from su3d_bench.cli.new import add_new
from su3d_bench.cli.options import Verbs, add_group, add_verb
from su3d_bench.cli.output import answer, answer_document, answer_either, answer_json
from su3d_bench.core.errors import counted
from su3d_bench.core.safe_output import one_line

if TYPE_CHECKING:
    from su3d_bench.reports.tables.paper import Figure

WIDTH = 118


def add_parser(verbs: Verbs) -> None:
    """List methods, show their settings, check one, or create your own.

    su3d-bench methods list
    su3d-bench methods show opensu3d
    """
    actions = add_group(verbs, "methods", add_parser, lists=True)
    add_verb(actions, "list", call_list)
    parser = add_verb(actions, "show", call_show)
    parser.option("name METHOD", "method, or file.py:Class")
    parser = add_verb(actions, "check", call_check)
    parser.option("name METHOD", "method, or file.py:Class")
    add_new(actions, "method")


def call_list(arguments: argparse.Namespace) -> None:
    """List methods with source, licence and requirements.

    su3d-bench methods list
    su3d-bench methods list --json
    """
    from su3d_bench.runs.catalogue import known_methods

    rows = known_methods()
    answer_either(arguments, rows, *[line for row in rows for line in ("", *_lines(row))][1:])


def call_check(arguments: argparse.Namespace) -> None:
    """Run a method on two frames and check its output.

    su3d-bench methods check oracle
    su3d-bench methods check my_method.py:MyMethod
    """
    from su3d_bench.runs.trial import try_method

    trial = try_method(arguments.name)
    made = f"{trial.kind} of {counted(trial.n_points, 'point')}"
    made += "" if trial.n_instances is None else f", {counted(trial.n_instances, 'instance')}"
    features = "with features" if trial.has_features else "without features"
    text = f"{trial.method}: two frames of {trial.scene} gave {made}, {features}: OK"
    answer_either(arguments, asdict(trial), text)


def _lines(row: dict[str, Any]) -> list[str]:
    lines = [f"{row['name']}  {row['summary']}"]
    for field in ("paper", "source", "licence", "needs", "status"):
        value = "; ".join(row[field]) if field == "needs" else row[field]
        if value:
            lines += textwrap.wrap(value, WIDTH, initial_indent=f"  {field:<9}", subsequent_indent=" " * 11)
    return lines


def call_show(arguments: argparse.Namespace) -> None:
    """Show the settings, presets and published results of a method.

    su3d-bench methods show opensu3d
    su3d-bench methods show my_method.py:MyMethod
    """
    from su3d_bench.core import registry
    from su3d_bench.core.config import flatten, write_toml
    from su3d_bench.reports.tables.paper import figures_of
    from su3d_bench.runs.catalogue import about_method

    method = registry.load("method", arguments.name)
    defaults = method.Config().model_dump(mode="json")
    row = about_method(method.name, method)
    figures = figures_of(method=method.name)
    presets = {name: dict(settings) for name, settings in getattr(method, "presets", {}).items()}
    published = [figure.model_dump(mode="json", exclude_none=True) for figure in figures]
    if answer_json(arguments, {**row, "settings": defaults, "presets": presets, "published": published}):
        return
    remarks = {name: field.description or "default" for name, field in method.Config.model_fields.items()}
    leaves = [(("method", method.name, *path), value, remarks[path[0]]) for path, value in flatten(defaults)]
    answer(*(f"# {line}" for line in _lines(row)))
    answer_document("\n" + write_toml(leaves) if leaves else f"# {one_line(method.name)} has no settings")
    if presets:
        answer("", "# presets, each usable as a method")
        for name, settings in presets.items():
            assigned = ", ".join(f"{key} = {json.dumps(value)}" for key, value in settings.items())
            answer(f"# {method.name}@{name}: {assigned}")
    if figures:
        answer("", "# published results; set-ups differ, so they may not be comparable")
        answer(*(f"# {line}" for figure in figures for line in _figure_lines(figure)))


def _figure_lines(figure: Figure) -> list[str]:
    values = ", ".join(f"{name} {value}" for name, value in figure.values.items())
    row = f" [{figure.row}]" if figure.row else ""
    note = f"; {figure.note}" if figure.note else ""
    text = f"{values}{row}: {figure.source}: {figure.setup}{note}; {figure.system.words}"
    return textwrap.wrap(text, WIDTH, subsequent_indent="    ")
