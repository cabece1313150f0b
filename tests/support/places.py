"""Where tests find what stands in files: cases, made scenes, and real recordings where somebody has them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

SUPPORT = Path(__file__).resolve().parent
TESTS = SUPPORT.parent
ROOT = TESTS.parent
CASES = TESTS / "cases"
SCENES = SUPPORT / "scenes"  # datasets and methods of tests, named by file: f"{SCENES}/painted.py:Painted"
REAL_RECORDINGS = Path(os.environ.get("SU3D_RECORDINGS") or "no-recordings")
needs_recordings = pytest.mark.skipif(
    not REAL_RECORDINGS.is_dir(),
    reason="needs real recordings: SU3D_RECORDINGS names their folder (see CONTRIBUTING.md)",
)
