"""The structure of the code base: its folders, their layers, and the imports between them.

``python tools/docs/architecture.py`` writes the generated parts of docs/architecture.md; ``--check`` checks that they
are up to date.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "su3d_bench"
LINKED = ("datasets", "baselines", "reports")  # root folders, reached through links in the package
USERS = ("benchmarks", ".ci")  # folders outside the package that import it
PAGE = ROOT / "docs" / "architecture.md"
TEMPLATES = PACKAGE / "cli" / "new"  # files that a user copies
PURPOSE = {
    "core": "shared types, interfaces, registry, settings, errors, atomic files, locks, devices",
    "corruptions": "errors of cameras, poses, time, masks and names, in five severities",
    "numerics": "statistics, clustering, spatial relations, loading Open3D",
    "store": "run folders with records and predictions; the cache",
    "formats": "readers of plain data: images, PLY, HDF5, npz, torch archives, pickles, CSV",
    "metrics": "protocols, matching and metrics: counts per scene, ratios over scenes",
    "opensu3d": "the reference pipeline: association, fusion, tracking, post-processing",
    "datasets": "one folder per dataset: frames, ground truth, checks; generated scenes",
    "perception": "images to detections: profiles, foundation models, language models",
    "reports": "tables, pictures, HTML pages of runs and annotation sheets",
    "fetching": "downloads of published weights and data",
    "predictions": "prediction formats of other programs: reading and export",
    "questions": "queries and questions with known answers; reasoning over a map",
    "baselines": "one folder per method: baselines, external programs, the oracle",
    "online": "sessions: a method fed frame by frame by the caller; snapshots, saved states",
    "runs": "splits a run into jobs, in processes or on clusters; resuming",
    "evaluation": "scores of predictions from files",
    "human_eval": "annotation sheets: creation, answers, scores",
    "robustness": "sweeps over corruptions, and the errors that methods tolerate",
    "analysis": "comparison, regression checks, rankings and attribution of finished runs",
    "reproducing": "recipes for a paper's experiments; bundles; registries",
    "api": "the Python interface: runs and predictions as pandas tables",
    "cli": "one thin module per command",
}


@cache
def code_files() -> dict[str, Path]:
    """Every Python file of the package, of benchmarks and of .ci by module name, at its real path."""
    files = {}
    for top in (PACKAGE, *(ROOT / name for name in (*LINKED, *USERS))):
        for path in sorted(top.rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if parts[:2] in {("su3d_bench", name) for name in LINKED} or TEMPLATES in path.parents:
                continue
            parts = ("su3d_bench", *parts) if parts[0] in LINKED else parts
            files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return files


def folder_of(module: str) -> str:
    """The folder of a module; the package's own modules stand for themselves."""
    parts = module.removeprefix(".").split(".")
    if parts[0] != "su3d_bench":
        return ".ci" if module.startswith(".") else parts[0]
    return parts[1] if len(parts) > 1 else parts[0]


def imported(module: str, source: str) -> set[str]:
    """The modules of the package imported by ``source``, including in functions and for type checkers."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    found = set()
    for name in names:
        while name and name not in code_files():
            name = name.rpartition(".")[0]
        found |= {name} - {"", module}
    return found


@cache
def imports() -> dict[str, set[str]]:
    """Imports between files."""
    return {module: imported(module, path.read_text(encoding="utf-8")) for module, path in code_files().items()}


@cache
def folder_imports() -> dict[str, set[str]]:
    """Imports between folders."""
    graph: dict[str, set[str]] = {}
    for module, others in imports().items():
        folder = folder_of(module)
        graph.setdefault(folder, set()).update({folder_of(other) for other in others} - {folder})
    return graph


def layers(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """The nodes in layers, lowest first, each as low as its imports allow; ``ValueError`` for a cycle."""
    left, found = dict(graph), list[set[str]]()
    while left:
        free = {node for node, others in left.items() if not others & left.keys()}
        if not free:
            while free := left.keys() - set().union(*left.values()):  # nodes above the cycle
                left = {node: others & left.keys() - free for node, others in left.items() if node not in free}
            raise ValueError(f"a cycle of imports among {', '.join(sorted(left))}")
        found.append(free)
        left = {node: others for node, others in left.items() if node not in free}
    return found


def drawn() -> dict[str, str]:
    """The generated parts of the page, by the name in their markers."""
    graph = folder_imports()
    below = layers(graph)
    rows, arrows = ["| layer | folder | content |", "|---|---|---|"], ["```text"]
    for number, folders in reversed(list(enumerate(below, 1))):
        for folder in sorted(folders & PURPOSE.keys()):
            place = folder if folder in LINKED else f"su3d_bench/{folder}"
            rows.append(f"| {number} | `{place}` | {PURPOSE[folder]} |")
            lower = [other for level in reversed(below) for other in sorted(level & graph[folder])]
            arrows.append(f"{folder:<12} -> {' '.join(lower)}" if lower else folder)
    counts = f"{len(PURPOSE)} folders, no cycle. `__init__`, `__main__`, benchmarks and .ci are layer {len(below)}."
    return {"layers": "\n".join(rows), "arrows": "\n".join([*arrows, "```", "", counts])}


def page_with(parts: dict[str, str], page: str) -> str:
    """``page`` with each generated part between its markers."""
    for word, text in parts.items():
        begin, end = f"<!-- {word}: drawn from the code -->", f"<!-- end of {word} -->"
        page = re.sub(rf"{begin}.*?{end}", lambda _, t=f"{begin}\n{text}\n{end}": t, page, flags=re.DOTALL)  # type: ignore[misc]
    return page


def main(arguments: list[str]) -> int:
    """Write the page; with ``--check`` only compare it, exit code 1 if it is out of date."""
    written = PAGE.read_text(encoding="utf-8")
    page = page_with(drawn(), written)
    if "--check" not in arguments:
        PAGE.write_text(page, encoding="utf-8")
    elif page != written:
        print(f"{PAGE.relative_to(ROOT)} is out of date; run: make architecture")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
