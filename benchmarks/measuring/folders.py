"""Importing this lets a benchmark import all others by name, the tests' support, and the programs of ``tools``."""

from __future__ import annotations

import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[1]
ROOT = BENCHMARKS.parent
PROGRAMS = {file.stem: file for file in sorted(BENCHMARKS.glob("*/*.py"))}
FOLDERS = (BENCHMARKS, ROOT / "tests", ROOT / "tools")
sys.path[:0] = sorted({str(file.parent) for folder in FOLDERS for file in folder.glob("**/*.py")})
