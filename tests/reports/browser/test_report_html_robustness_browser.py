"""The section Robustness of the HTML report in a browser: curves, bands and pictures of a sweep."""

from __future__ import annotations

import json
import re
from pathlib import Path

import runs_page
from chromium import needs_chromium
from page_checks import WHOLE, complaints

pytestmark = needs_chromium


def test_robustness_section_has_curves_pictures_and_a_row_per_method(tmp_path: Path) -> None:
    page = runs_page.page_of_sweep(tmp_path)
    # names and units of a damaged page are shown as text
    text = re.sub(r'"unit":"cm RMS"', f'"unit":{json.dumps(runs_page.STRUCK.replace("</", ""))}', page.read_text())
    page.write_text(text)
    with runs_page.browser_for_pages(tmp_path / "profile") as browser:
        browser.open(page)
        browser.until(WHOLE)
        remark = runs_page.text_of(browser, "#summary .note")
        assert remark == "6 methods under corruptions are only in the section Robustness."
        assert runs_page.column(browser, "summary", 0) == ["collector", "collector@drop=1"]
        assert runs_page.headers(browser, "robustness")[2:5] == ["masks", "pose", "mean"]
        assert runs_page.column(browser, "robustness", 0) == ["collector", "collector@drop=1"]
        plots = "[...document.querySelectorAll('#robustness .corruption')]"
        assert browser.run(f"{plots}.map((one) => one.querySelectorAll('path.line').length)") == [2, 2]
        # severities 0, 2 and 5 of one corruption, 0 and 5 of the other, of two methods
        assert browser.run(f"{plots}.map((one) => one.querySelectorAll('circle').length)") == [6, 4]
        assert browser.run(f"{plots}.some((one) => one.querySelector('path.band'))")
        browser.run("document.querySelectorAll('#robustness details').forEach((one) => { one.open = true; })")
        images = "[...document.querySelectorAll('#robustness .corruption img')]"
        browser.until(f"{images}.every((one) => one.naturalWidth === 160)")
        assert browser.run(f"{images}.length") == 5
        assert "<img src=x" in str(browser.run(f"{plots}[1].querySelector('h3').textContent"))
        assert browser.run("window.struck === undefined")
        assert runs_page.text_of(browser, "#robustness caption").startswith("rooms-semantic")
        runs_page.choose(browser, "robustness", "Protocol", "rooms-instance")
        assert runs_page.text_of(browser, "#robustness caption").startswith("rooms-instance")
        assert browser.run(f"{plots}[0].querySelector('svg').getAttribute('aria-label')").startswith("AP against")
        assert complaints(browser) == []
