"""docs/verbs.md, generated from the parser: the summary, examples and options of every command.

``python tools/docs/verbs_page.py`` writes the page; ``--check`` checks that it is up to date.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

from generated_pages import ROOT, cell, write_or_check

from su3d_bench.cli.main import build_parser

PAGE = ROOT / "docs" / "verbs.md"
HEAD = """# Command-line reference

Generated from the parser by `make architecture`; a test keeps it in sync. `su3d-bench COMMAND --help` shows the same.
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
    "ablate": "Perception is computed once. `--also all` adds all methods: one run gives the five tables of the "
    "paper ([Results](numbers/results.md)).",
    "evaluate": "See [Prediction formats](evaluate.md).",
    "reproduce": "See [Reproduce a paper](running/reproduce.md).",
    "report tables": "`report verify` recomputes every cell.",
    "report html": "See [HTML report](running/html-report.md).",
    "report rerun": "See [Rerun export](running/rerun.md).",
    "report leaderboard": "Runs are comparable if protocol, data and number of labels agree.",
    "dev registry add": "Entries with other rules, data, encoders or duplicate names are rejected: "
    "[Registry of results](running/registry.md).",
    "dev registry build": "See [Registry of results](running/registry.md).",
    "check": "See [Regression check in CI](running/regression-check.md).",
    "query ask": "See [Questions about a scene](questions/reasoning.md).",
    "query make": "Score maps with `--protocols rooms-retrieval`: [Several texts per object](questions/objects.md).",
    "query audit": "See [Human evaluation](questions/human-evaluation.md).",
    "sheets make": "Sheets do not reveal the method: [Human evaluation](questions/human-evaluation.md).",
    "sheets score": "Tables IV and V of the paper: [Human evaluation](questions/human-evaluation.md).",
    "compare": "Sign-flip test with Holm's correction; runs with other data, rules or encoders are rejected: "
    "[Statistics](numbers/statistics.md).",
    "report power": "From the variance of finished runs: [Statistics](numbers/statistics.md).",
    "report attribution": "Merged, split, duplicate, mislabelled, background, missed; geometry, association, label.",
    "datasets check": "See [Datasets](datasets.md).",
    "datasets make": "See [Datasets](datasets.md).",
    "models list": "See [Models](methods/models.md).",
    "dev cache list": "See [Environment](running/environment.md).",
    "dev doctor": "See [Environment](running/environment.md).",
    "dev completion": "See [Environment](running/environment.md).",
}


def page() -> str:
    verbs = list(_verbs(build_parser()))
    rows = [
        f"| [`{name}`](#su3d-bench-{name.replace(' ', '-')}) | {cell(_summary(parser))} |" for name, parser in verbs
    ]
    parts = [HEAD, "\n".join(["| command | summary |", "|---|---|", *rows]) + "\n"]
    return "\n".join([*parts, *(_section(name, parser) for name, parser in verbs)])


def _verbs(parser: argparse.ArgumentParser, path: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    deeper = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    for action in deeper:
        for name, below in action.choices.items():
            yield from _verbs(below, f"{path} {name}".strip())
    if not deeper:
        yield path, parser


def _summary(parser: argparse.ArgumentParser) -> str:
    return parser.description or ""


def _section(name: str, parser: argparse.ArgumentParser) -> str:
    examples = [line.strip() for line in (parser.epilog or "").splitlines()[1:] if line.strip()]
    rows = [
        f"| `{cell(_usage(action))}` | {cell((action.help or '').replace('%%', '%'))} |"
        for action in parser._actions
        if action.help != argparse.SUPPRESS and not COMMON_OPTIONS & set(action.option_strings)
    ]
    table = ["| argument or option | meaning |", "|---|---|", *rows, ""] if rows else []
    text = " ".join(part for part in (_summary(parser), MORE.get(name, "")) if part)
    return "\n".join([f"## su3d-bench {name}", "", text, "", "```sh", *examples, "```", "", *table])


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


def main(arguments: list[str]) -> int:
    return write_or_check(PAGE, page(), arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
