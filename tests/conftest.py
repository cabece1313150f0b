"""Where the tests keep their files, what they share within a session, and what belongs to which round."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parent
sys.path += sorted(
    {str(file.parent) for file in TESTS.rglob("*.py")} - {*sys.path}
)  # readers' samples are their tests'

MEMORY = Path("/dev/shm")
MOST_KEPT_BYTES = 4 << 30

# Every file of a run is brought to the disk before it counts; thousands of small runs would wait for nothing else.
if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > MOST_KEPT_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))
