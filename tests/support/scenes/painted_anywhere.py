"""``painted.py`` for workers that no test can reach: importing it puts its perception in place there."""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import patch

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from painted import Collector, Painted, colour_perception  # noqa: E402

from su3d_bench.runs import scene as scene_run  # noqa: E402

if "pytest" not in sys.modules:  # a test patches, and unpatches, its own process
    patch.object(scene_run, "build_perception", colour_perception).start()

__all__ = ["Collector", "Painted"]
