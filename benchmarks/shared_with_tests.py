"""Importing this lets a benchmark use what tests share: made scenes, small models, damage for readers."""

from __future__ import annotations

import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path[:0] = sorted({str(file.parent) for file in TESTS.rglob("*.py")})
