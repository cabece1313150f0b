"""Where tests find what stands in files."""

from __future__ import annotations

from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
TESTS = SUPPORT.parent
ROOT = TESTS.parent
CASES = TESTS / "cases"
SCENES = SUPPORT / "scenes"  # datasets and methods of tests, named by file: f"{SCENES}/painted.py:Painted"
