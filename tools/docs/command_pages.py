"""Pages of the documentation site that are generated from the parser: one per command, and their index."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from su3d_bench.cli.main import build_parser

COMMANDS = "reference/commands"
INDEX = f"{COMMANDS}/index.md"
HEAD = """# Command-line reference

`su3d-bench COMMAND --help` shows the same as these pages, which are generated from it.
Exit codes: 0 success, 1 check failed, 2 invalid input, 3 some scenes failed, 4 internal error.

Every command has these options:

- `--json` prints the result as JSON; `--json FILE.json` writes it to a file and prints the text. An existing file that
  is not an earlier result of the command is only overwritten with `--json=FILE.json`; files of a run never are.
- `--quiet` shows no progress and no warnings; `--debug` shows the traceback of an error.

`--methods`, `--protocols` and `--scenes` take several values, `--method` and `--protocol` one; either spelling works.
`--set KEY=VALUE` takes keys such as `opensu3d.top_m`, or `method.opensu3d.top_m` as in a file for `--config`.
"""
COMMON_OPTIONS = {"--help", "--json", "--quiet", "--debug"}
# Details that do not fit into the help, and the page with more.
MORE = {
    "run": "`--methods all` runs OpenSU3D and the seven baselines; `opensu3d@scheme4` (a preset) and "
    "`opensu3d@top_m=1` are variants of a method. See [Run folder](running/run-folder.md), "
    "[Clusters](running/clusters.md) and [GPU](running/gpu.md).",
    "ablate": "Perception is computed once. `--also-methods all` adds all methods: one run gives the five tables "
    "of the paper ([Results](numbers/results.md)).",
    "evaluate": "See [Predictions of other programs](evaluate.md) and [Prediction formats](formats.md).",
    "reproduce": "See [Reproduce a paper](running/reproduce.md).",
    "report tables": "`report verify` recomputes every cell.",
    "report html": "See [HTML report](running/html-report.md).",
    "report leaderboard": "Runs are comparable if protocol, data and number of labels agree.",
    "dev registry add": "Entries with other rules, data, encoders or duplicate names are rejected: "
    "[Registry of results](running/registry.md).",
    "dev registry build": "See [Registry of results](running/registry.md).",
    "check": "See [Regression check in CI](running/regression-check.md).",
    "query ask": "See [Questions about a scene](questions/reasoning.md).",
    "query make": "Score maps with `--protocols rooms-retrieval`: [Several texts per object](questions/objects.md).",
    "sheets make": "Sheets do not reveal the method: [Human evaluation](questions/human-evaluation.md).",
    "sheets score": "Tables IV and V of the paper: [Scores of human evaluation](questions/human-scores.md).",
    "compare": "Sign-flip test with Holm's correction; runs with other data, rules or encoders are rejected: "
    "[Statistics](numbers/statistics.md).",
    "report power": "From the variance of finished runs: [Statistics](numbers/statistics.md).",
    "report attribution": "Merged, split, duplicate, mislabelled, background, missed; geometry, association, label.",
    "datasets check": "See [Datasets](datasets.md).",
    "datasets make": "See [Datasets](datasets.md).",
    "models list": "See [Models](methods/models.md).",
    "dev doctor": "See [Environment](running/environment.md).",
    "dev completion": "See [Environment](running/environment.md).",
}


def command_pages() -> dict[str, str]:
    """One page per command, and their index, by place in the site."""
    commands = list(_commands(build_parser()))
    rows = [f"| [`{name}`]({_file(name)}) | {cell(_summary(parser))} |" for name, parser in commands]
    index = "\n".join([HEAD, "| command | summary |", "|---|---|", *rows, ""])
    return {INDEX: index} | {place_of_command(name): _page(name, parser) for name, parser in commands}


def place_of_command(name: str) -> str:
    """The page of a command such as ``report html``."""
    return f"{COMMANDS}/{_file(name)}"


def command_names() -> list[str]:
    return [name for name, _ in _commands(build_parser())]


def _file(name: str) -> str:
    return f"{name.replace(' ', '-')}.md"


def _commands(parser: argparse.ArgumentParser, path: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    deeper = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    for action in deeper:
        for name, below in action.choices.items():
            yield from _commands(below, f"{path} {name}".strip())
    if not deeper:
        yield path, parser


def cell(text: str) -> str:
    """``text`` as a cell of a Markdown table."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def _summary(parser: argparse.ArgumentParser) -> str:
    return parser.description or ""


def _page(name: str, parser: argparse.ArgumentParser) -> str:
    examples = [line.strip() for line in (parser.epilog or "").splitlines()[1:] if line.strip()]
    rows = [
        f"| `{_usage(action)}` | {cell(action.help or '')} |"
        for action in parser._actions
        if action.help != argparse.SUPPRESS and not COMMON_OPTIONS & set(action.option_strings)
    ]
    table = ["| argument or option | meaning |", "|---|---|", *rows, ""] if rows else []
    more = MORE.get(name, "").replace("](", "](../../")
    text = " ".join(part for part in (_summary(parser), more) if part)
    return "\n".join([f"# su3d-bench {name}", "", text, "", "```sh", *examples, "```", "", *table])


def _usage(action: argparse.Action) -> str:
    """An argument or option with its values, as in the usage line."""
    metavar = action.metavar
    if isinstance(metavar, tuple):
        values = " ".join(metavar)
    else:
        choices = None if action.choices is None else "|".join(map(str, action.choices))
        values = metavar or choices or action.dest.upper()
    several = f"{values}..." if action.nargs in ("+", "*") else values
    if not action.option_strings:
        return f"[{several}]" if action.nargs in ("?", "*") else several
    names = ", ".join(action.option_strings)
    return names if action.nargs == 0 else f"{names} {several}"
