"""Code that can move a value in perception's cache lies within the key of that value."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from su3d_bench.core.digests import PACKAGE_ROOT
from su3d_bench.perception import oracle as oracle_segmenter
from su3d_bench.perception import regions
from su3d_bench.perception.embedded import segmenter as rgbd_segmenter

KEYED = {
    "perception/regions.py": regions.SOURCES,
    "perception/embedded/segmenter/segmenter.py": rgbd_segmenter.SOURCES,
    "perception/oracle/segmenter.py": oracle_segmenter.SOURCES,
}


def imported(path: Path) -> Iterator[Path]:
    """The modules of the package that a module imports, late imports too, without ``core``."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            package, _, inner = name.partition(".")
            place = PACKAGE_ROOT / inner.replace(".", "/")
            if package == PACKAGE_ROOT.name and not inner.startswith("core."):
                yield from (found for found in (place.with_suffix(".py"), place / "__init__.py") if found.is_file())


def reached(path: Path) -> set[str]:
    """``path`` and every module that it imports, directly or through others, below the package."""
    found, waiting = set(), [path]
    while waiting:
        module = waiting.pop()
        if module not in found:
            found.add(module)
            waiting += imported(module)
    return {module.relative_to(PACKAGE_ROOT).as_posix() for module in found}


@pytest.mark.parametrize("module", KEYED)
def test_what_a_keyed_part_is_made_of_lies_within_its_key(module: str) -> None:
    within = tuple(name if name.endswith(".py") else f"{name}/" for name in KEYED[module])
    outside = {name for name in reached(PACKAGE_ROOT / module) if not name.startswith(within)}
    assert not outside, f"{module}: a change in {sorted(outside)} would leave its key as it is"


def test_the_search_follows_imports_through_other_modules() -> None:
    found = reached(PACKAGE_ROOT / "perception/oracle/segmenter.py")
    assert {"perception/oracle/noise.py", "perception/crops.py", "numerics/open3d_core.py"} <= found
