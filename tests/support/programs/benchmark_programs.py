"""The measuring programs of ``benchmarks``, for the tests of what they promise."""

from __future__ import annotations

import importlib
import runpy
from types import ModuleType

from places import ROOT


def benchmark_program(name: str) -> ModuleType:
    """The module ``name`` of ``benchmarks``, with what it imports from the others."""
    runpy.run_path(str(ROOT / "benchmarks" / "measuring" / "folders.py"))
    return importlib.import_module(name)
