"""Importing this lets a benchmark import every other by its name, and what tests share: scenes, models, damage."""

from __future__ import annotations

import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[1]
ROOT = BENCHMARKS.parent
PROGRAMS = {file.stem: file for file in sorted(BENCHMARKS.glob("*/*.py"))}
sys.path[:0] = sorted({str(file.parent) for folder in (BENCHMARKS, ROOT / "tests") for file in folder.glob("**/*.py")})
