"""The programs in ``benchmarks``, for tests of their output."""

from __future__ import annotations

import importlib
import runpy
from types import ModuleType

from places import ROOT


def benchmark_program(name: str) -> ModuleType:
    """The module ``name`` of ``benchmarks``, and the modules that it imports there."""
    runpy.run_path(str(ROOT / "benchmarks" / "measuring" / "folders.py"))
    return importlib.import_module(name)
