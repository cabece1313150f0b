"""Importing this lets a benchmark use what tests share: made scenes, small models, damage for readers."""

from __future__ import annotations

import sys
from pathlib import Path

SUPPORT = Path(__file__).resolve().parents[1] / "tests" / "support"
sys.path[:0] = [str(SUPPORT), *(str(folder) for folder in sorted(SUPPORT.iterdir()) if folder.is_dir())]
