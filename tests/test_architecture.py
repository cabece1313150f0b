"""The shape of the code base: who may import whom, what stays light, what the package holds."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest
from places import ROOT

PACKAGE = ROOT / "su3d_bench"
LINKED = ("datasets", "baselines", "reports")
CODE = sorted(
    path
    for folder in (PACKAGE, *(ROOT / name for name in LINKED))
    for path in folder.rglob("*.py")
    if not any((PACKAGE / name) in path.parents for name in LINKED)
)

# The direction of imports: a layer may import itself and every layer left of it.
LAYERS = (
    {"plain_text"},
    {"errors"},
    {"types"},
    {"interfaces"},
    {"compiled_open3d", "geometry", "statistics", "timing"},
    {"update_times", "gate_findings"},
    {"digests", "toml_text", "row_blocks", "kept_files", "scratch", "temporary_folders"},
    {"kernels"},
    {"cell_kernels"},
    {"config", "protocols", "rules"},
    {"metrics"},
    {"registry", "store", "scoring"},
    {"remote_folder"},
    {"plain_pickles"},
    {"perception"},
    {"opensu3d", "datasets", "reasoning"},
    {"predictions", "questions"},
    {"baselines", "reports"},
    {"executors"},
    {"executors_ray", "executors_slurm"},
    {"execution"},
    {"scene_job"},
    {"scene_tools", "read_ahead", "scene_log"},
    {"scene_feeding"},
    {"job_inputs"},
    {"finished_scenes", "scene_run"},
    {"distant_scene", "remote_data"},
    {"method_names", "ablation"},
    {"planning"},
    {"evaluation_truth", "evaluation_scenes", "evaluation_texts", "evaluation_checks", "evaluation_bound"},
    {"evaluation_scoring"},
    {"evaluation_result", "evaluation_openlex"},
    {"evaluation_questions"},
    {"evaluation"},
    {"estimate"},
    {"runner"},
    {"finished_run"},
    {"comparison_sides", "finished_updates", "sheets"},
    {"comparison", "attribution", "gate", "leaderboard", "table_sources"},
    {"page_sources", "page_maps"},
    {"inspection_checks"},
    {"inspection"},
    {"cli"},
)
HEAVY = {"open3d", "torch", "onnxruntime", "sklearn", "pandas", "matplotlib", "numba"}


def part_of(path: Path) -> str:
    """The part of the package that a file belongs to: its folder, or its own name at the top."""
    relative = path.relative_to(PACKAGE if PACKAGE in path.parents else ROOT)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


def layer_of(part: str) -> int:
    for index, layer in enumerate(LAYERS):
        if part in layer:
            return index
    raise AssertionError(f"'{part}' stands in no layer of LAYERS")


def imported_parts(path: Path) -> list[tuple[int, str]]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("su3d_bench"):
            parts = node.module.split(".")
            if len(parts) > 1:
                found.append((node.lineno, parts[1]))
            else:
                found += [(node.lineno, alias.name) for alias in node.names if alias.name != "__version__"]
        elif isinstance(node, ast.Import):
            found += [(node.lineno, a.name.split(".")[1]) for a in node.names if a.name.startswith("su3d_bench.")]
    return found


@pytest.mark.parametrize("path", CODE, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_follow_the_direction(path: Path) -> None:
    part = part_of(path)
    if part in {"__init__", "__main__"}:
        return
    for line, other in imported_parts(path):
        if other == part:
            continue
        assert layer_of(other) < layer_of(part), f"{path.relative_to(ROOT)}:{line}: {part} imports {other}"


@pytest.mark.parametrize("path", CODE, ids=lambda path: str(path.relative_to(ROOT)))
def test_open3d_and_torch_are_imported_where_they_are_used(path: Path) -> None:
    if path.stem.startswith(("training", "_kernels")) or "kernels" in path.stem:
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
    assert not (ROOT / name / "__init__.py").exists()
    assert not any(child.is_dir() and child.name != "__pycache__" for child in (ROOT / name).iterdir())


def test_every_folder_with_code_is_packaged() -> None:
    configured = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for path in CODE if PACKAGE in path.parents}
    expected = {".".join(("su3d_bench", *folder.relative_to(PACKAGE).parts)) for folder in folders}
    expected |= {f"su3d_bench.{name}" for name in LINKED}
    assert expected <= set(configured["packages"])
    assert configured["package-dir"] == {f"su3d_bench.{name}": name for name in LINKED}


def test_the_core_names_no_dataset_and_no_baseline() -> None:
    names = re.compile(r"scannet|conceptfusion|openmask3d|sam3d", re.IGNORECASE)
    for path in CODE:
        if part_of(path) in {"geometry", "timing", "store", "executors", "types", "statistics"}:
            assert not names.search(path.read_text()), path
