"""Each page that the program makes, of the smallest things that it can be made of."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import chromium
import numpy as np
import pytest
from chromium import Chromium
from looks import DESKTOP
from made_sheets import made
from painted import WordEncoder, colour_perception
from places import SCENES
from registry_bundles import painted_bundle

from su3d_bench.cli.main import main
from su3d_bench.reports.pictures.items import png_bytes
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run
from su3d_bench.sheets.scores import SecondLook, second_looks_page
from su3d_bench.sheets.sets import PAGE, write_sheets

PAINTED = f"{SCENES}/painted.py"
# WebGL without a graphics card.
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
STRUCK = "<img src=x onerror=window.struck=1></script><script>window.struck=1</script>"
LONG = "the chair with a very long name that was given to it by nobody in particular and goes on"


def browser_for_pages(folder: Path) -> Chromium:
    """A browser that draws maps too; the profile is in ``folder``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chromium, "FLAGS", (*chromium.FLAGS, *SOFTWARE_GL))
        return Chromium(folder, width=DESKTOP[0], height=DESKTOP[1])


def finished_runs(folder: Path) -> list[str]:
    """Two runs: two methods on two scenes with maps midway, and one method of them on one of the scenes."""
    words = ["--jobs", "1", "--no-pictures", "--protocols", "rooms-semantic", "rooms-instance"]
    scenes = [f"{PAINTED}:Painted/a", f"{PAINTED}:Painted/b"]
    methods = [f"{PAINTED}:Collector", f"{PAINTED}:Collector@noise_m=0.3"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.setattr(finished_run, "encoder_of", lambda folder, device="cpu": WordEncoder())
        first = ["--scenes", *scenes, "--methods", *methods, "--anytime", "0.5", "--out", str(folder / "one")]
        assert main(["run", *first, *words]) == 0
        assert main(["run", "--scenes", scenes[0], "--methods", methods[0], "--out", str(folder / "two"), *words]) == 0
    record = json.loads((folder / "one" / "metrics.json").read_text())
    record["results"][0]["caveat"] = STRUCK
    (folder / "one" / "metrics.json").write_text(json.dumps(record))
    return [str(folder / "one"), str(folder / "two")]


def page_of_runs(folder: Path) -> Path:
    """``report html``."""
    runs = finished_runs(folder)
    page = folder / "page.html"
    words = ["--out", str(page), "--quiet", "--jobs", "1", "--queries", "chair", "table"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finished_run, "encoder_of", lambda folder, device="cpu": WordEncoder())
        assert main(["report", "html", *runs, *words]) == 0
    return page


def page_of_tables(folder: Path) -> Path:
    """``--format html``, which all verbs with tables have."""
    finished_runs(folder)
    page = folder / "board.html"
    words = ["--intervals", "--format", "html", "--out", str(page), "--quiet"]
    assert main(["report", "leaderboard", str(folder), *words]) == 0
    return page


def page_of_annotation(folder: Path) -> Path:
    """A sheet of three questions an item."""
    write_sheets(made("annotation", ("chair", LONG)), folder / "out", folder / "key")
    return folder / "out" / "annotator-1" / PAGE


def page_of_second_looks(folder: Path) -> Path:
    """What ``sheets score`` leaves to look at again."""
    (folder / "item-1.png").write_bytes(png_bytes(np.full((400, 1200, 3), 90, np.uint8)))
    look = SecondLook(
        "item-1", "label 1", LONG, "rooms/living0", ("opensu3d",), ("item-1.png",),
        {"annotator-1": "right", "annotator-2": "wrong"}, "right", "annotators disagree",
    )  # fmt: skip
    page = folder / "second_looks.html"
    page.write_text(second_looks_page([look, replace(look, text="x" * 200)], ".", "sheet-1"), encoding="utf-8")
    return page


def page_of_audit(folder: Path) -> Path:
    """``questions audit``."""
    words = ["query", "audit", "--scenes", f"{PAINTED}:Painted/a", "--n", "6", "--out", str(folder), "--quiet"]
    assert main(words) == 0
    return folder / "index.html"


def site_of_registry(folder: Path) -> Path:
    """``registry build``: two bundles, of which one says what its weights were trained on; one site for all pages."""
    registry, site = folder.parent / "registry", folder.parent / "registry-site"
    if not site.exists():
        registry.mkdir()
        painted_bundle(registry, "ann", ["@drop=1", "@noise_m=0.3"], said=f"{LONG} {STRUCK}")
        painted_bundle(registry, "bob", [""], scenes="ab")
        words = ["--out", str(site), "--bundles-at", "https://example.org/bundles", "--quiet"]
        assert main(["dev", "registry", "build", str(registry), *words]) == 0
    return site


def page_of_registry(folder: Path) -> Path:
    """The first page of the site."""
    return site_of_registry(folder) / "index.html"


def page_of_method(folder: Path) -> Path:
    """The page of a method of the site."""
    return min((site_of_registry(folder) / "methods").iterdir())


PAGES: Mapping[str, Callable[[Path], Path]] = {
    "page of runs": page_of_runs,
    "tables": page_of_tables,
    "sheet of annotation": page_of_annotation,
    "second looks": page_of_second_looks,
    "audit": page_of_audit,
    "registry": page_of_registry,
    "method of a registry": page_of_method,
}
# The files of the program that begin a page, and the pages above that come out of each.
WRITERS = {
    "reports/page/page.html.j2": ("page of runs",),
    "reports/tables/formats.py": ("tables",),
    "reports/sheet/page.html.j2": ("sheet of annotation",),
    "reports/sheet/list.html.j2": ("second looks", "audit"),
    "reports/registry/page.html.j2": ("registry", "method of a registry"),
}
