"""Every page that the program makes, in a browser: read, reached and used in light, in the dark and on a phone."""

from __future__ import annotations

from pathlib import Path

import pytest
from chromium import find_chromium
from looks import CHECKS, complaints, unfold
from made_pages import PAGES, WRITERS, browser_for_pages
from places import ROOT

needs_browser = pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")


@needs_browser
@pytest.mark.parametrize("name", PAGES)
def test_each_page(name: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    page = PAGES[name](tmp_path_factory.mktemp("page"))
    with browser_for_pages(tmp_path) as browser:
        browser.downloads_to(tmp_path)
        for check, find in CHECKS.items():
            browser.open(page)
            unfold(browser)
            found = find(browser)
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
