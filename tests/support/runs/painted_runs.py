"""Runs of painted scenes: their command lines and results."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from painted import WordEncoder, colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run

PAINTED = f"{SCENES}/painted.py:Painted"
COLLECTOR = f"{SCENES}/painted.py:Collector"
PROTOCOLS = ["--protocols", "rooms-semantic", "rooms-instance"]


def see_painted(patch: pytest.MonkeyPatch) -> None:
    """Makes this process find painted scenes, and encode texts like their perception."""
    patch.setattr(scene_run, "build_perception", colour_perception)
    patch.setattr(finished_run, "encoder_of", lambda run, device="cpu": WordEncoder())


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


def painted_run(folder: Path, *more: str, methods: Sequence[str] = (COLLECTOR,), scenes: str = "ab") -> Path:
    """A finished run of some scenes, created in this process."""
    named = ["run", *(f"{PAINTED}/{scene}" for scene in scenes), "--methods", *methods, *PROTOCOLS, "--no-pictures"]
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main([*named, "--jobs", "1", "--out", str(folder), *more]) == 0
    return folder


def painted_page(run: Path, page: Path, *more: str) -> str:
    """The page of a run, created with the encoder of painted scenes."""
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main(["report", "html", str(run), "--out", str(page), "--quiet", "--jobs", "1", *more]) == 0
    return page.read_text(encoding="utf-8")
