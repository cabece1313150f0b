"""The shape of the code base: its rooms, the floors they stand on, who imports whom, and which way a call goes.

``python tests/support/house.py`` writes what of docs/architecture.md is drawn from the code; ``--check`` says whether
it still holds.
"""

from __future__ import annotations

import ast
import io
import os
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from made_documents import write_or_check
from places import ROOT

PACKAGE = ROOT / "su3d_bench"
LINKED = ("datasets", "baselines", "reports")  # root folders, reached through links in the package
PAGE = ROOT / "docs" / "architecture.md"

# The floors of the house, the lowest first: a folder imports from lower floors only.
FLOORS = (
    {"core"},
    {"numerics", "store"},
    {"formats", "metrics", "opensu3d"},
    {"datasets", "perception", "reports"},
    {"fetching", "predictions", "questions"},
    {"baselines", "runs"},
    {"evaluation", "sheets"},
    {"analysis"},
    {"reproducing"},
    {"api", "cli"},
)
PURPOSE = {
    "core": "types that go from room to room, interfaces, the registry, settings, errors, digests, devices, timing",
    "numerics": "geometry, statistics, clusters, grids of cells, Open3D's core, Numba with a cache that mends itself",
    "store": "what is kept on disk: whole files or none, run folders, their records, predictions, scratch",
    "formats": "files of others read as plain data: images, PLY, PCD, HDF5, npz, torch archives, pickles",
    "metrics": "protocols and their rules, matching, and every number: counts a scene, ratios over scenes",
    "opensu3d": "the reference pipeline: association, fusion, tracking, post-processing",
    "datasets": "a folder a dataset: frames, ground truth, checks, and rooms that the program makes itself",
    "perception": "images to detections: a folder a profile, foundation models, language models, the cache",
    "reports": "tables, pictures, the page of runs, the page of sheets: what people see",
    "fetching": "published weights and data brought here: what from where, downloads, archives",
    "predictions": "a file a format: predictions of other programs to ours, and back",
    "questions": "queries and questions with known answers, and reasoning over a map",
    "baselines": "a folder a method: re-implemented systems, other people's programs, the oracle",
    "runs": "a request to jobs, jobs to scenes, frames to methods; resumed, in processes or on clusters",
    "evaluation": "predictions made elsewhere to numbers",
    "sheets": "what people judge: made, answered, scored",
    "analysis": "finished runs compared, gated, ranked, taken apart",
    "reproducing": "a paper's experiments as recipes: needs, runs, reported beside measured, archives; registries",
    "api": "what a program or a notebook calls: runs and predictions to tables of pandas",
    "cli": "a thin module a verb",
}


def code_files() -> list[Path]:
    """Every Python file of the package, at its real place."""
    folders = (PACKAGE, *(ROOT / name for name in LINKED))
    files = {path for folder in folders for path in folder.rglob("*.py")}
    return sorted(path for path in files if not any((PACKAGE / name) in path.parents for name in LINKED))


def room_of(path: Path) -> str | None:
    """The folder of the house that a file stands in; None for the few at the door."""
    relative = path.relative_to(PACKAGE if PACKAGE in path.parents else ROOT)
    return relative.parts[0] if len(relative.parts) > 1 else None


def floor_of(room: str) -> int:
    """The index of a room's floor in ``FLOORS``."""
    return next(index for index, rooms in enumerate(FLOORS) if room in rooms)


def imported_rooms(source: str) -> list[tuple[int, str]]:
    """(line, room) of every import of the package in ``source``, those inside functions included."""
    imports = []
    for node in ast.walk(ast.parse(source)):
        modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module == "su3d_bench":
            modules = [f"su3d_bench.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules = [node.module]
        line = getattr(node, "lineno", 0)
        imports += [(line, name.split(".")[1]) for name in modules if name.startswith("su3d_bench.")]
    return [(line, room) for line, room in imports if room in PURPOSE]


def climbs(source: str, room: str) -> list[str]:
    """The imports of ``source``, a file in ``room``, that do not lead to a lower floor or stay in the room."""
    return [
        f"line {line}: {room} imports {other}"
        for line, other in imported_rooms(source)
        if other != room and floor_of(other) >= floor_of(room)
    ]


def first_calls(call: Callable[[], Any]) -> list[str]:
    """The modules of the package in the order in which ``call`` first enters each, as ``metrics/protocols``.

    Calls of this thread; what runs while a module is imported does not count, nor do ``core``, ``cli`` and the door.
    """
    visited: dict[str, None] = {}
    passed: set[CodeType] = set()  # what needs no second look: this stands in the way of every call

    def visit(frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or frame.f_code in passed:
            return
        name = str(frame.f_globals.get("__name__", ""))
        room, _, module = name.removeprefix("su3d_bench.").partition(".")
        place = f"{room}/{module.replace('.', '/')}"
        is_met = name.startswith("su3d_bench.") and room in PURPOSE and room not in ("core", "cli", "api")
        if is_met and place not in visited:
            if _is_importing(frame):
                return
            visited[place] = None
        passed.add(frame.f_code)

    sys.setprofile(visit)
    try:
        call()
    finally:
        sys.setprofile(None)
    return list(visited)


def _is_importing(frame: FrameType) -> bool:
    """Whether a call stands below the execution of a module of the package."""
    at: FrameType | None = frame
    while at is not None:
        if at.f_code.co_name == "<module>" and str(at.f_globals.get("__name__", "")).startswith("su3d_bench."):
            return True
        at = at.f_back
    return False


def returns(modules: list[str]) -> list[str]:
    """The steps of a trip that climb back into a room which was left for a lower floor before."""
    left: set[str] = set()
    steps = []
    previous = ""
    for module in modules:
        room = module.split("/")[0]
        if room in left:
            steps.append(f"{module} after {previous}")
        if previous and floor_of(room) < floor_of(previous.split("/")[0]):
            left.add(previous.split("/")[0])
        previous = module
    return steps


def drawn() -> dict[str, str]:
    """The parts of the page that are drawn from the code, by the word in their marks."""
    return {"floors": _floors(), "arrows": _arrows(), **_trips()}


def _floors() -> str:
    lines = ["| floor | folder | what it holds |", "|---|---|---|"]
    for index in reversed(range(len(FLOORS))):
        for room in sorted(FLOORS[index]):
            place = room if room in LINKED else f"su3d_bench/{room}"
            lines.append(f"| {index} | `{place}` | {PURPOSE[room]} |")
    return "\n".join(lines)


def _arrows() -> str:
    imports: dict[str, set[str]] = {room: set() for room in PURPOSE}
    for path in code_files():
        room = room_of(path)
        if room is not None:
            imports[room] |= {other for _, other in imported_rooms(path.read_text(encoding="utf-8"))} - {room}
    n_arrows = sum(map(len, imports.values()))
    lines = ["```text"]
    for floor in reversed(FLOORS):
        for room in sorted(floor):
            lower = [other for rooms in reversed(FLOORS) for other in sorted(rooms & imports[room])]
            lines.append(f"{room:<12} -> {' '.join(lower)}" if lower else room)
    return "\n".join(
        [*lines, "```", "", f"{len(PURPOSE)} folders on {len(FLOORS)} floors, {n_arrows} arrows, all of them down."]
    )


def _trips() -> dict[str, str]:
    """What a run of two frames enters, and a table made of it, in the order in which each module is first called."""
    from su3d_bench.cli.main import main

    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()):
        out = str(Path(folder) / "run")
        small = ["rooms.width=160", "rooms.height=120", "rooms.n_frames=40", "perception.cache=false"]
        words = ["run", "--scenes", "rooms/bathroom7", "--methods", "opensu3d", "--limit", "2", "--set", *small]
        words += ["--profile", "embedded", "--no-pictures", "--quiet", "--jobs", "1", "--out", out]
        os.environ |= {"SU3D_DATA": f"{folder}/data", "SU3D_CACHE": f"{folder}/cache"}  # a first run, whoever draws
        frame = first_calls(lambda: main(words))
        run = first_calls(lambda: main(["report", "tables", out, "--table", "II", "--quiet"]))
        prediction = prediction_trip(Path(folder))
    return {"frame": stations(frame), "prediction": stations(prediction), "finished run": stations(run)}


def prediction_trip(folder: Path) -> list[str]:
    """What an evaluation of one scene enters: two masks in ScanNet's text files against a truth of such a file."""
    from su3d_bench.evaluation.evaluate import Request, evaluate

    for name, lines in {
        "truth/scene0000_00.txt": ["5001"] * 200 + ["7002"] * 200,
        "prediction/scene0000_00.txt": ["chair.txt 5 0.9", "table.txt 7 0.8"],
        "prediction/chair.txt": ["1"] * 200 + ["0"] * 200,
        "prediction/table.txt": ["0"] * 200 + ["1"] * 200,
    }.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    request = Request(
        (folder / "prediction/scene0000_00.txt",), ground_truth=folder / "truth", protocols=("scannet-instance",)
    )
    evaluate(request)  # compiles what is compiled, which enters modules of its own
    return first_calls(lambda: evaluate(request))


def stations(modules: list[str]) -> str:
    """A trip as a list: a line a stay in a room, with the modules that are entered there for the first time."""
    lines: list[str] = []
    previous = ""
    for module in modules:
        room, _, name = module.partition("/")
        if room == previous:
            lines[-1] += f", `{name}`"
        else:
            lines.append(f"{len(lines) + 1}. {room}: `{name}`")
        previous = room
    return "\n".join(lines)


def page_with(parts: dict[str, str], page: str) -> str:
    """``page`` with each part between its marks."""
    for word, text in parts.items():
        begin, end = f"<!-- {word}: drawn from the code -->", f"<!-- end of {word} -->"
        page = re.sub(rf"{begin}.*?{end}", lambda _, t=f"{begin}\n{text}\n{end}": t, page, flags=re.DOTALL)  # type: ignore[misc]
    return page


def main(arguments: list[str]) -> int:
    """Write the page, or with ``--check`` say whether it still holds."""
    return write_or_check(PAGE, page_with(drawn(), PAGE.read_text(encoding="utf-8")), arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
