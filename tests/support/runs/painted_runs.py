"""Runs of painted scenes: the words that make one, and what it leaves."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from places import SCENES

from su3d_bench.cli.main import main

PAINTED = f"{SCENES}/painted.py:Painted"


COLLECTOR = f"{SCENES}/painted.py:Collector"


PROTOCOLS = ["--protocols", "rooms-semantic", "rooms-instance"]


def words(*more: str, scenes: str = "*", out: str = "out") -> list[str]:
    base = ["run", "--scenes", f"{PAINTED}/{scenes}", "--methods", COLLECTOR, *PROTOCOLS, "--no-pictures"]
    return [*base, "--jobs", "1", "--out", out, *more]


def run(*more: str, scenes: str = "*", out: str = "out") -> int:
    return main(words(*more, scenes=scenes, out=out))


def in_process(*more: str, out: str = "out") -> list[str]:
    return [sys.executable, str(SCENES / "painted_cli.py"), *words(*more, out=out)]


def metrics(out: str = "out") -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(Path(out, "metrics.json").read_text())
    return loaded


def job(scene: str = "a", method: str = "collector", out: str = "out") -> Path:
    return Path(out, "scenes", f"painted.{scene}", method)
