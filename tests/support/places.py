"""Paths of files for tests."""

from __future__ import annotations

from pathlib import Path

SUPPORT = Path(__file__).resolve().parent
TESTS = SUPPORT.parent
ROOT = TESTS.parent
CASES = TESTS / "cases"
SCENES = SUPPORT / "scenes"  # test datasets and methods, referenced by file: f"{SCENES}/painted.py:Painted"
