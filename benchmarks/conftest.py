"""Benchmarks use each other and the tests' support."""

from __future__ import annotations

import runpy
from pathlib import Path

runpy.run_path(str(Path(__file__).parent / "measuring" / "folders.py"))
