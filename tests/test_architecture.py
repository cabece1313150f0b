"""The structure of the code base: import rules, lightweight modules, content of the package."""

from __future__ import annotations

import ast
import re
import subprocess
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest
from architecture import (
    LINKED,
    PACKAGE,
    PAGE,
    PURPOSE,
    code_files,
    drawn,
    folder_imports,
    folder_of,
    imported,
    imports,
    layers,
    page_with,
)
from places import ROOT

CODE = [path for module, path in code_files().items() if module.startswith("su3d_bench")]
HEAVY = {"open3d", "torch", "onnxruntime", "sklearn", "pandas", "matplotlib", "numba"}
LATE = ("compiled.py",)  # imported lazily as a whole, like kernels


def test_folders_form_at_most_ten_layers_without_a_cycle() -> None:
    found = layers(folder_imports())
    assert len(found) <= 10, found
    assert found[0] == {"core"}


def test_no_files_import_each_other_in_a_cycle() -> None:
    layers(imports())


def test_every_folder_has_a_purpose() -> None:
    assert set(PURPOSE) == folder_imports().keys() - {"su3d_bench", "__main__", "benchmarks", ".ci"}
    assert len(PURPOSE) <= 23


def test_every_kind_of_import_counts() -> None:
    for line in (
        "from su3d_bench.cli import main",
        "import su3d_bench.cli.main",
        "def f():\n    from su3d_bench.cli.main import main",
        "if TYPE_CHECKING:\n    from su3d_bench.cli.main import main",
    ):
        assert {folder_of(module) for module in imported("su3d_bench.metrics.scoring", line)} == {"cli"}
    assert imported("su3d_bench.cli.new", "from su3d_bench import Frame") == {"su3d_bench"}
    with pytest.raises(ValueError, match="cycle of imports among b, c"):
        layers({"a": set(), "b": {"a", "c"}, "c": {"b"}})


def test_heavy_packages_are_imported_only_where_used() -> None:
    for path in CODE:
        if "training" in path.parts or "kernels" in (path.stem, path.parent.name) or path.name in LATE:
            continue
        for node in ast.parse(path.read_text()).body:
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            heavy = {name.split(".")[0] for name in names} & HEAVY
            assert not heavy, f"{path.relative_to(ROOT)}:{node.lineno}: {heavy} at module level"


@pytest.mark.parametrize("name", LINKED)
def test_root_folders_are_reached_only_through_links(name: str) -> None:
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


def test_harness_names_no_dataset_and_no_baseline() -> None:
    """A metric may be named after its origin (``F1-conceptgraphs``)."""
    names = re.compile(
        r"replica|scannet|rgbd|\btum\b|conceptfusion|(?<!F1-)conceptgraphs|openmask3d|sam3d", re.IGNORECASE
    )
    folders = {"core", "numerics", "store", "runs", "sheets", "analysis"}
    files = {path for module, path in code_files().items() if folder_of(module) in folders}
    assert [path for path in files if names.search(path.read_text())] == [PACKAGE / "core" / "registry.py"]


def test_architecture_page_matches_the_code() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page_with(drawn(), page) == page, "run: make architecture"
