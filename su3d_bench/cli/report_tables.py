"""``su3d-bench report tables``: the paper's tables and any other selection, from finished runs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli.flags import add_verb, answer, remark
from su3d_bench.errors import EXIT_DONE

NAME = "tables"
FORMATS = ("markdown", "latex", "csv", "html")
TABLES = ("I", "II", "III", "IV", "V")
