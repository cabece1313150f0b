"""Every kind of page in a browser: accessibility and layout in light mode, dark mode and on a phone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import needs_chromium
from page_checks import CHECKS, complaints, unfold
from registry_bundles import painted_bundle
from runs_page import STRUCK, browser_for_pages, finished_runs, page_of_runs, page_of_sweep
from synthetic_sheets import made

from su3d_bench.cli.main import main
from su3d_bench.human_eval.scores import ReviewItem, review_items_page
from su3d_bench.human_eval.sets import PAGE, write_sheets
from su3d_bench.reports.pictures.items import jpeg_bytes

LONG = "the chair with a very long name that was given to it by nobody in particular and goes on"


def page_of_tables(folder: Path) -> Path:
    """The output of ``--format html``, shared by all commands with tables."""
    finished_runs(folder)
    page = folder / "board.html"
    words = ["--intervals", "--format", "html", "--out", str(page), "--quiet"]
    assert main(["report", "leaderboard", str(folder), *words]) == 0
    return page


def page_of_annotation(folder: Path) -> Path:
    """An annotation sheet with three questions per item."""
    write_sheets(made("annotation", ("chair", LONG)), folder / "out", folder / "key")
    return folder / "out" / "annotator-1" / PAGE


def page_of_second_looks(folder: Path) -> Path:
    """The list of items to review of ``sheets score``."""
    (folder / "item-1.jpg").write_bytes(jpeg_bytes(np.full((400, 1200, 3), 90, np.uint8)))
    look = ReviewItem(
        "item-1", "label 1", LONG, "rooms/living0", ("opensu3d",), ("item-1.jpg",),
        {"annotator-1": "right", "annotator-2": "wrong"}, "right", "annotators disagree",
    )  # fmt: skip
    page = folder / "review_items.html"
    page.write_text(review_items_page([look, replace(look, text="x" * 200)], ".", "sheet-1"), encoding="utf-8")
    return page


def site_of_registry(folder: Path) -> Path:
    """The site of ``registry build``: two bundles, one with stated training data; shared by all pages."""
    registry, site = folder.parent / "registry", folder.parent / "registry-site"
    if not site.exists():
        registry.mkdir()
        painted_bundle(registry, "ann", ["@drop=1", "@noise_m=0.3"], printed=f"{LONG} {STRUCK}")
        painted_bundle(registry, "bob", [""], scenes="ab")
        words = ["--out", str(site), "--bundle-url", "https://example.org/bundles", "--quiet"]
        assert main(["dev", "registry", "build", str(registry), *words]) == 0
    return site


def page_of_registry(folder: Path) -> Path:
    """The index page of the registry site."""
    return site_of_registry(folder) / "index.html"


def page_of_method(folder: Path) -> Path:
    """A method page of the registry site."""
    return min((site_of_registry(folder) / "methods").iterdir())


PAGES: Mapping[str, Callable[[Path], Path]] = {
    "HTML report": page_of_runs,
    "HTML report of a sweep": page_of_sweep,
    "tables": page_of_tables,
    "annotation sheet": page_of_annotation,
    "items to review": page_of_second_looks,
    "registry": page_of_registry,
    "registry method": page_of_method,
}


@needs_chromium
@pytest.mark.parametrize("name", PAGES)
def test_page_is_accessible_and_fits(name: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    page = PAGES[name](tmp_path_factory.mktemp("page"))
    with browser_for_pages(tmp_path) as browser:
        browser.downloads_to(tmp_path)
        for check, find in CHECKS.items():
            browser.open(page)
            unfold(browser)
            found = find(browser)
            assert not found, f"{page.name} {check}: failed\n" + "\n".join(found)
        assert complaints(browser) == [], "no external requests, errors or warnings"
