"""The tool that plants faults: which faults, what it skips, and how it distinguishes survivors from killed ones."""

from __future__ import annotations

import ast
import random
import subprocess
from pathlib import Path
from types import ModuleType

import pytest
from benchmark_programs import benchmark_program
from places import ROOT

SOURCE = '''"""Text 1."""
LIMIT: float = 0.5


def kept(values: list[int], low: int = 3) -> list[int]:
    """Text 2."""
    found = [value for value in values if value >= low and value != 7]
    if not found:
        raise ValueError(f"none above {low + 1}")
    found[0] -= 1
    return found if min(found) < LIMIT * 4 else []
'''


@pytest.fixture(scope="module")
def mutants() -> ModuleType:
    return benchmark_program("mutants")


def test_operators_constants_conditions_and_statements_are_mutated_but_not_texts_and_types(
    mutants: ModuleType,
) -> None:
    found = [one.after for one in mutants.mutants_of("a.py", SOURCE)]
    expected = [
        "LIMIT: float = 0.75",
        "def kept(values: list[int], low: int = 4) -> list[int]:",
        "found = [value for value in values if True]",
        "found = [value for value in values if (value >= low or value != 7)]",
        "found = [value for value in values if (value > low) and value != 7]",
        "found = [value for value in values if value >= low and (value == 7)]",
        "found = [value for value in values if value >= low and value != 8]",
        "if (found):",
        "pass",
        "found[0] += 1",
        "found[1] -= 1",
        "found[0] -= 2",
        "return ([] if min(found) < LIMIT * 4 else found)",
        "return found if (min(found) <= LIMIT * 4) else []",
        "return found if max(found) < LIMIT * 4 else []",
        "return found if min(found) < (LIMIT / 4) else []",
        "return found if min(found) < LIMIT * 5 else []",
    ]
    assert sorted(found) == sorted(expected)
    assert all(one.before in " ".join(SOURCE.split()) for one in mutants.mutants_of("a.py", SOURCE))


def test_every_module_has_existing_guards_and_every_fault_is_a_program(mutants: ModuleType) -> None:
    modules = mutants.modules_of([])
    metrics = {str(path.relative_to(ROOT)) for path in (ROOT / "su3d_bench/metrics").rglob("*.py")}
    assert {path for path in metrics if not path.endswith("__init__.py")} <= set(modules)
    for module in modules:
        assert all((ROOT / guard).is_file() for guard in mutants.guards_of(module)), module
        source = (ROOT / module).read_text()
        every = mutants.mutants_of(module, source)
        for one in random.Random(0).sample(every, min(2, len(every))):
            text = mutants.planted(source, one)
            assert text != source
            ast.parse(text)


@pytest.mark.proof
def test_undetected_fault_survives_and_a_detected_one_does_not(
    mutants: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = tmp_path / "tree"
    (tree / "su3d_bench").mkdir(parents=True)
    (tree / "tests/metrics").mkdir(parents=True)
    (tree / "su3d_bench/small.py").write_text("def above(value):\n    return value > 3\n")
    test = "import sys\nsys.path.insert(0, 'su3d_bench')\nfrom small import above\n\n\n"
    test += "def test_above():\n    assert above(5) and not above(1)\n"
    (tree / "tests/metrics/test_small.py").write_text(test)
    for words in (["init", "-q"], ["add", "."]):
        subprocess.run(["git", *words], cwd=tree, check=True)
    monkeypatch.setattr(mutants, "ROOT", tree)
    monkeypatch.setattr(mutants, "GUARDS", {"small.py": ("test_small",)})
    assert mutants.modules_of([]) == ["su3d_bench/small.py"]
    every = mutants.mutants_of("su3d_bench/small.py", (tree / "su3d_bench/small.py").read_text())
    verdicts = {one.mutant.text: one.outcome for one in mutants.run_mutants(every, 1, tmp_path / "copies")}
    assert verdicts == {"(value >= 3)": "survived", "4": "survived"}
    (tree / "tests/metrics/test_small.py").write_text(test + "    assert not above(3) and above(4)\n")
    verdicts = {one.mutant.text: one.outcome for one in mutants.run_mutants(every, 1, tmp_path / "again")}
    assert verdicts == {"(value >= 3)": "killed", "4": "killed"}
