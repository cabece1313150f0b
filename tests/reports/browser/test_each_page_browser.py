"""Every page that the program makes, in a browser: read, reached and used in light, in the dark and on a phone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Chromium, find_chromium
from looks import CHECKS, complaints, unfold
from made_pages import PAGES, WRITERS, browser_for_pages
from places import ROOT

needs_browser = pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")


@pytest.fixture(scope="module", params=PAGES)
def opened(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Chromium, Path]]:
    """The page, made once, in a browser of its own."""
    page = PAGES[request.param](tmp_path_factory.mktemp("page"))
    folder = tmp_path_factory.mktemp("profile")
    with browser_for_pages(folder) as browser:
        browser.downloads_to(folder)
        yield browser, page


@needs_browser
@pytest.mark.parametrize("check", CHECKS)
def test_each_page(opened: tuple[Chromium, Path], check: str) -> None:
    browser, page = opened
    browser.open(page)
    unfold(browser)
    found = CHECKS[check](browser)
    assert not found, f"{page.name} {check}: not so\n" + "\n".join(found)
    assert complaints(browser) == [], "no request leaves a page, and nothing is complained of"


def test_the_list_of_pages_is_whole() -> None:
    begins = {
        str(file.relative_to(ROOT))
        for folder in ("reports", "su3d_bench")
        for file in (ROOT / folder).rglob("*.*")
        if file.suffix in (".py", ".j2", ".html")
        and not file.is_symlink()
        and "su3d_bench/reports/" not in str(file)
        and "<!doctype html" in file.read_text(encoding="utf-8").lower()
    }
    assert begins == {*WRITERS}
    assert {name for names in WRITERS.values() for name in names} == {*PAGES}
