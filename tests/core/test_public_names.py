"""The public names of the package, and the Python examples of the documentation, which use only these."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

import su3d_bench

IN_ORDER = ROOT / "docs" / "python.md"  # its examples build on each other: tests/api runs them
PAGES = [ROOT / "README.md", *sorted(set((ROOT / "docs").glob("*.md")) - {IN_ORDER})]
EXAMPLES = [
    pytest.param(block, id=f"{page.name}-{number}")
    for page in PAGES
    for number, block in enumerate(re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE))
]


def test_importing_the_package_imports_no_heavy_modules() -> None:
    code = "import sys, su3d_bench; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert {"numpy", "pandas", "numba", "torch", "open3d"}.isdisjoint(loaded)
    own = {name for name in loaded if name.startswith("su3d_bench.")}
    assert own == {"su3d_bench.core", "su3d_bench.core.version"}


@pytest.mark.parametrize("name", su3d_bench.__all__)
def test_each_public_name_is_importable_and_listed(name: str) -> None:
    assert getattr(su3d_bench, name).__name__ == name
    assert name in dir(su3d_bench)


def test_type_checkers_see_the_same_public_names() -> None:
    tree = ast.parse(Path(su3d_bench.__file__).read_text())
    checked = next(node for node in tree.body if isinstance(node, ast.If))
    named = [each.name for line in checked.body if isinstance(line, ast.ImportFrom) for each in line.names]
    assert sorted(named) == sorted(su3d_bench.__all__)


@pytest.mark.parametrize("block", EXAMPLES)
def test_documented_example_runs_and_uses_only_public_names(block: str, tmp_path: Path) -> None:
    for node in ast.walk(ast.parse(block)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("su3d_bench"):
            assert node.module == "su3d_bench"
            assert {each.name for each in node.names} <= set(su3d_bench.__all__)
    subprocess.run([sys.executable, "-c", block], cwd=tmp_path, check=True)
