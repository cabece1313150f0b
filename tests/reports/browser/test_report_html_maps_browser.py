"""The maps of the page of runs in a real browser: drawn, turned, coloured, picked."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import chromium
import pytest
from chromium import Chromium, find_chromium
from looks import complaints
from runs_page import SELECT, choose, column, headers, open_maps, options, picture, text_of

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")


@pytest.fixture
def browser(opened_runs: Chromium) -> Iterator[Chromium]:
    yield opened_runs
    assert complaints(opened_runs) == []


def test_every_colouring_draws_another_picture_and_says_what_it_means(browser: Chromium) -> None:
    open_maps(browser)
    kinds = options(browser, "maps", "Colour by")
    assert kinds == ["colour", "instance", "class", "true class", "error against the truth", "similarity to a text"]
    seen = {}
    for kind in kinds:
        choose(browser, "maps", "Colour by", kind)
        seen[kind] = picture(browser)
        assert text_of(browser, "#maps .legend").strip()
    assert len(set(seen.values())) >= 5  # instances and classes may have the same colours where each is of one class
    choose(browser, "maps", "Colour by", kinds[4])
    assert "right class" in text_of(browser, "#maps .legend")
    choose(browser, "maps", "Colour by", kinds[5])
    assert options(browser, "maps", "Text") == ["chair", "table"]
    first = picture(browser)
    choose(browser, "maps", "Text", "table")
    assert picture(browser) != first
    assert column(browser, "maps", 0)[0] == "table"
    assert headers(browser, "maps") == ["Instance", "Similarity", "Points"]
    choose(browser, "maps", "Colour by", kinds[0])
    assert browser.run(f"{SELECT.format(part='maps', label='Text')}.closest('.field').hidden")
    assert headers(browser, "maps") == ["Instance", "Score", "Points"]


def test_without_webgl_the_page_says_so_and_keeps_its_numbers(
    runs_page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chromium, "FLAGS", (*chromium.FLAGS, "--disable-3d-apis"))
    with Chromium(tmp_path / "profile") as browser:
        browser.open(runs_page)
        browser.run("document.getElementById('maps').scrollIntoView()")
        browser.until("document.querySelector('#maps .say')?.innerText.includes('no WebGL 2')")
        browser.until("document.querySelectorAll('#maps .side tbody tr').length > 0")
        browser.run("document.querySelector('#maps .side tbody tr').click()")
        assert "Points" in text_of(browser, "#maps .detail")
        assert browser.run("document.querySelectorAll('#summary table').length") == 2
