"""The shape of the code base: who may import whom, what stays light, what the package holds."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest
from house import FLOORS, LINKED, PACKAGE, PURPOSE, climbs, code_files, room_of
from places import ROOT, SUPPORT

CODE = code_files()
HEAVY = {"open3d", "torch", "onnxruntime", "sklearn", "pandas", "matplotlib", "numba"}
LATE = ("compiled.py", "torch_towers.py")  # they are imported late as a whole, as kernels are


@pytest.mark.parametrize("path", CODE, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_lead_downstairs(path: Path) -> None:
    room = room_of(path)
    if room is not None:
        assert climbs(path.read_text(), room) == []


@pytest.mark.parametrize(
    "line",
    [
        "from su3d_bench.cli.main import main",
        "from su3d_bench import analysis",
        "import su3d_bench.baselines.oracle",
        "def f():\n    from su3d_bench.reports.tables import run",
    ],
)
def test_an_import_in_the_wrong_direction_is_found(line: str) -> None:
    assert climbs(line, "metrics") != []
    assert (
        climbs("from su3d_bench.core.errors import DataError\nfrom su3d_bench.metrics import scoring", "metrics") == []
    )


def test_every_folder_stands_on_one_floor() -> None:
    rooms = [room for floor in FLOORS for room in floor]
    assert sorted(rooms) == sorted({room for path in CODE if (room := room_of(path)) is not None})
    assert set(PURPOSE) == set(rooms)
    assert len(FLOORS) <= 10 and len(rooms) <= 20


@pytest.mark.parametrize("path", CODE, ids=lambda path: str(path.relative_to(ROOT)))
def test_open3d_and_torch_are_imported_where_they_are_used(path: Path) -> None:
    if "training" in path.parts or "kernels" in (path.stem, path.parent.name) or path.name in LATE:
        return
    for node in ast.parse(path.read_text()).body:
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        heavy = {name.split(".")[0] for name in names} & HEAVY
        assert not heavy, f"{path.relative_to(ROOT)}:{node.lineno}: {heavy} at module level"


@pytest.mark.parametrize("name", LINKED)
def test_root_folders_are_reached_through_links_only(name: str) -> None:
    link = PACKAGE / name
    assert link.is_symlink()
    assert link.readlink() == Path("..") / name
    assert list((ROOT / name).rglob("__init__.py")) == []


def test_every_folder_with_code_or_data_is_packaged() -> None:
    configured = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    files = [Path(name) for name in listing.split("\0") if name.startswith(("su3d_bench/", *(f"{n}/" for n in LINKED)))]
    folders = {path.parent for path in files if (ROOT / path).is_file()}
    expected = {
        ".".join(folder.parts if folder.parts[0] == "su3d_bench" else ("su3d_bench", *folder.parts))
        for folder in folders
    }
    assert expected == set(configured["packages"])
    assert configured["package-dir"] == {f"su3d_bench.{name}": name for name in LINKED}
    patterns = configured["package-data"]["*"]
    data = [path.name for path in files if path.suffix != ".py" and (ROOT / path).is_file()]
    assert [name for name in data if not any(fnmatch(name, pattern) for pattern in patterns)] == []


def test_the_harness_names_no_dataset_and_no_baseline() -> None:
    """A metric may be named after its origin (``F1-conceptgraphs``)."""
    names = re.compile(
        r"replica|scannet|rgbd|\btum\b|conceptfusion|(?<!F1-)conceptgraphs|openmask3d|sam3d", re.IGNORECASE
    )
    rooms = {"core", "numerics", "store", "runs", "sheets", "analysis"}
    named = [path for path in CODE if room_of(path) in rooms and names.search(path.read_text())]
    assert named == [PACKAGE / "core" / "registry.py"]


def test_the_page_of_the_house_is_what_the_code_is() -> None:
    """In a process of its own: a trip shows the first call into each module, which a process makes once."""
    words = [sys.executable, str(SUPPORT / "house.py"), "--check"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
