"""docs/verbs.md, made from the parser: every verb with what it does, its examples and its flags.

``python tools/docs/verbs_page.py`` writes the page; ``--check`` says whether it still holds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

from made_documents import ROOT, cell, write_or_check

from su3d_bench.cli.main import build_parser

PAGE = ROOT / "docs" / "verbs.md"
HEAD = """# The verbs

Made from the parser by `make architecture`; a test fails where it does not hold any more. `su3d-bench VERB --help` says
the same. Exit codes: 0 done, 1 a check failed, 2 wrong input, 3 some scenes failed, 4 an error of ours.

One rule for flags, in every verb:

- `--json` alone gives the answer as JSON on stdout; `--json FILE.json` writes it there, beside the answer in words. A
  file that is no earlier answer of the verb stays as it is; `--json=FILE` replaces it whatever it is. What a run
  itself has written is never replaced.
- `--out` is the place of what is written, `--jobs N` how many processes work side by side.
- `--methods`, `--protocols` and `--scenes` take several, `--method` and `--protocol` one; either spelling is
  understood.
- `--set KEY=VALUE` takes a key as `opensu3d.top_m`, or as a file for `--config` has it, `method.opensu3d.top_m`.
- `--quiet` leaves out progress and remarks, `--debug` shows the traceback of an error.
"""
IN_EVERY = {"--help", "--json", "--quiet", "--debug"}
# What a verb's help has no room for, and the page that says more.
MORE = {
    "run": "Frames of each scene go to each method, maps are scored under every protocol that fits the "
    "dataset and drawn. Killed, it goes on where it was. `--methods all` is OpenSU3D and the seven "
    "baselines; `opensu3d@scheme4` or `opensu3d@top_m=1` is a variant beside its base; `--anytime "
    "0.25 0.5` scores the maps midway too. Many scenes on many machines: "
    "[Clusters](running/clusters.md); what a run leaves behind: "
    "[Run folder](running/run-folder.md); GPUs: [GPU](running/gpu.md).",
    "ablate": "A sweep as variants in one run; `--beside all opensu3d@scheme4` puts other methods into the same "
    "run: the five tables of the paper from one ([results.md](numbers/results.md)).",
    "report tables": "The paper's tables, with the figures as reported beside, in Markdown, LaTeX, CSV or HTML; "
    "`report verify` recomputes every cell.",
    "report html": "One page that works offline: tables that sort, confusion, errors, timing, every map in 3D.",
    "report rerun": "A recording a scene with frames, masks, maps, truth and the map's growth, for rerun's "
    "viewer: [Rerun export](running/rerun.md).",
    "report bundle": "Anybody scores it anew by `report verify`; a registry takes it in.",
    "dev registry add": "By the rule of `report verify`; rows that mix rules, data, encoders or names are refused: "
    "[Registry of results](running/registry.md).",
    "dev registry build": "Rankings with intervals of values and ranks, a page a method and a scene, from the disk.",
    "check": "See [Regression check in CI](running/regression-check.md), `action.yml`.",
    "query ask": "By the built-in solver or a language model: [Questions about a scene](questions/reasoning.md).",
    "query make": "Score maps with `--protocols rooms-retrieval`: [Several texts per object](questions/objects.md).",
    "query audit": "What people look for: [Human evaluation](questions/human-evaluation.md).",
    "sheets make": "Blind sheets with pictures, as an offline page, a workbook and a CSV: "
    "[Human evaluation](questions/human-evaluation.md).",
    "sheets score": "The paper's Tables IV and V with agreement: [Human evaluation](questions/human-evaluation.md).",
    "compare": "Exact sign-flip test with the smallest p that so many scenes allow, corrected where much is "
    "compared, and the paired difference with its interval; other data, rules or encoders are "
    "refused: [statistics.md](numbers/statistics.md).",
    "report power": "At 80 % power, from the variance of finished runs: [statistics.md](numbers/statistics.md).",
    "report attribution": "Merged, split, duplicate, mislabelled, background, missed; geometry, association, label.",
    "datasets check": "Names what is missing, damaged or contradictory, and whether frames and ground truth meet: "
    "[datasets.md](datasets.md).",
    "datasets make": "In the exact layout of Replica or ScanNet (`.sens`): [datasets.md](datasets.md).",
    "models list": "Where files are looked for, sizes, licences: [methods/models.md](methods/models.md).",
    "dev cache list": "What is kept, and which variable says where: [Environment](running/environment.md).",
    "dev doctor": "What each line means: [Environment](running/environment.md).",
    "dev completion": "For bash, zsh and fish: [Environment](running/environment.md).",
}


def page() -> str:
    verbs = list(_verbs(build_parser()))
    rows = [
        f"| [`{name}`](#su3d-bench-{name.replace(' ', '-')}) | {cell(_summary(parser))} |" for name, parser in verbs
    ]
    parts = [HEAD, "\n".join(["| verb | what it does |", "|---|---|", *rows]) + "\n"]
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
        if action.help != argparse.SUPPRESS and not IN_EVERY & set(action.option_strings)
    ]
    table = ["| word or flag | what |", "|---|---|", *rows, ""] if rows else []
    text = " ".join(part for part in (_summary(parser), MORE.get(name, "")) if part)
    return "\n".join([f"## su3d-bench {name}", "", text, "", "```sh", *examples, "```", "", *table])


def _usage(action: argparse.Action) -> str:
    """A word or flag with its values, as the usage line has it."""
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
