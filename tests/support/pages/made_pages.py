"""The page of runs as tests of it in a browser have it."""

from __future__ import annotations

import json
from pathlib import Path

import chromium
import pytest
from chromium import Chromium
from looks import DESKTOP
from painted_runs import COLLECTOR, painted_run, run, see_painted

from su3d_bench.cli.main import main

# WebGL without a graphics card.
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
STRUCK = "<img src=x onerror=window.struck=1></script><script>window.struck=1</script>"


def browser_for_pages(folder: Path) -> Chromium:
    """A browser that draws maps too; the profile is in ``folder``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chromium, "FLAGS", (*chromium.FLAGS, *SOFTWARE_GL))
        return Chromium(folder, width=DESKTOP[0], height=DESKTOP[1])


def finished_runs(folder: Path) -> list[str]:
    """Two runs: two methods on two scenes with maps midway, and one method of them on one of the scenes."""
    both = (COLLECTOR, f"{COLLECTOR}@noise_m=0.3")
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        painted_run(folder / "one", "--anytime", "0.5", methods=both)
        assert run(scenes="a", out=str(folder / "two")) == 0
    record = json.loads((folder / "one" / "metrics.json").read_text())
    record["results"][0]["caveat"] = STRUCK
    (folder / "one" / "metrics.json").write_text(json.dumps(record))
    return [str(folder / "one"), str(folder / "two")]


def page_of_runs(folder: Path) -> Path:
    """``report html``."""
    page = folder / "page.html"
    words = ["--out", str(page), "--quiet", "--jobs", "1", "--queries", "chair", "table"]
    runs = finished_runs(folder)
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main(["report", "html", *runs, *words]) == 0
    return page
