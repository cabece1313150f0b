"""The checks of pages: a small whole page passes all of them, and each refuses the page that has its fault."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Chromium, find_chromium
from looks import CHECKS, complaints, unfold
from made_pages import browser_for_pages

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")
STYLE = (
    ":root { color-scheme: light dark } body { font: 16px/1.5 sans-serif; margin: 1rem }"
    " button, select { min-height: 28px; min-width: 28px } canvas { width: 200px; height: 100px }"
)
SCRIPT = """
const count = document.getElementById('count'), canvas = document.querySelector('canvas');
const pen = canvas.getContext('2d'), dark = matchMedia('(prefers-color-scheme: dark)');
let n = 0;
function draw() {
  pen.fillStyle = dark.matches ? '#111' : '#eee';
  pen.fillRect(0, 0, 300, 150);
  pen.fillStyle = '#07f';
  pen.fillRect(20 + 10 * n, 20, 20, 20);
}
canvas.addEventListener('keydown', (event) => { if (event.key.startsWith('Arrow')) { n += 1; draw(); } });
document.getElementById('more').addEventListener('click', () => { count.textContent += '1'; });
document.getElementById('which').addEventListener('change', () => { count.textContent += '2'; });
dark.addEventListener('change', draw);
draw();
"""
BODY = """
<a href="#part">Go on</a>
<main>
<h1>A page</h1>
<p>Some text, <span id="count">0</span>.</p>
<button type="button" id="more">More</button>
<label>Which <select id="which"><option>one</option><option>two</option></select></label>
<details><summary>What it means</summary><p>Folded text.</p></details>
<canvas tabindex="0" role="application" aria-label="A view"></canvas>
<div style="overflow-x: auto" tabindex="0" role="region" aria-label="Numbers">
<table><caption>Numbers</caption><tr><th scope="col">a</th></tr><tr><td><!-- cell --></td></tr></table></div>
<h2 id="part">A part</h2>
<img alt="A point" src="data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA=">
<!-- more -->
</main>
"""
MORE = "<!-- more -->"


def written(folder: Path, old: str = "", new: str = "") -> Path:
    """The page with ``old`` replaced by ``new``."""
    text = (
        '<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8"><meta name="viewport"'
        ' content="width=device-width, initial-scale=1"><link rel="icon" href="data:,"><title>A page</title>'
        f"<style>{STYLE}</style></head>\n<body>{BODY}<script>{SCRIPT}</script></body></html>\n"
    )
    assert old in text
    page = folder / "page.html"
    page.write_text(text.replace(old, new or old, 1), encoding="utf-8")
    return page


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with browser_for_pages(tmp_path_factory.mktemp("profile")) as found:
        yield found


def looked_at(browser: Chromium, page: Path, check: str) -> list[str]:
    browser.messages.clear()
    browser.open(page)
    unfold(browser)
    return CHECKS[check](browser)


def test_a_whole_page_passes(browser: Chromium, tmp_path: Path) -> None:
    for check in CHECKS:
        assert looked_at(browser, written(tmp_path), check) == []
    assert complaints(browser) == []


DOCUMENT, LIGHT, DARK, NIGHT, DESKTOP, PHONE, PAPER, STILL, TAB = CHECKS
# What is broken in the page, the check that refuses it, and what that says.
BROKEN = {
    "no title": ("<title>A page</title>", "<title> </title>", DOCUMENT, "no title"),
    "a nameless choice": ("<label>Which ", "<label>", DOCUMENT, "a control without a name"),
    "a source outside": (MORE, '<link rel="preconnect" href="https://a.example">', DOCUMENT, "leaves"),
    "pale text": ("<p>Some", '<p style="color: #888">Some', LIGHT, "contrast 3.54"),
    "dark on dark": ("<p>Some", '<p style="color: #333">Some', DARK, "contrast"),
    "a light page": (" light dark }", " light }", NIGHT, "the page is light"),
    "too wide": (MORE, '<div style="width: 500px">a</div>', PHONE, "516 px wide on a screen of 390"),
    "too wide for all": (MORE, '<div style="width: 2000px">a</div>', DESKTOP, "px wide on a screen of 1300"),
    "small text": ("<p>Some", '<p style="font-size: 11px">Some', PHONE, "text of 11.0 px"),
    "a bar on paper": (MORE, '<p style="position: fixed; top: 0">a</p>', PAPER, "over each page"),
    "a transition": (MORE, "<style>h2 { transition: left 1s }</style>", STILL, "changes over"),
    "the mouse alone": (MORE, "<p id='m'>a</p><script>m.addEventListener('click', () => 0)</script>", TAB,
        "no key reaches it"),
    "a trap": (MORE, '<button id="t">a</button><script>t.addEventListener("keydown", (event) => event.preventDefault())'
        "</script>", TAB, "Tab never leaves"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_page_is_refused(browser: Chromium, tmp_path: Path, fault: str) -> None:
    old, new, check, said = BROKEN[fault]
    found = looked_at(browser, written(tmp_path, old, new or " "), check)
    assert any(said in line for line in found), found


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('<img alt="a" src="https://a.example/b.png">', "https://a.example/b.png"),
        ("<script>console.error('it is broken')</script>", "it is broken"),
    ],
)
def test_what_leaves_the_page_or_goes_wrong_is_told(browser: Chromium, tmp_path: Path, more: str, said: str) -> None:
    browser.messages.clear()
    browser.open(written(tmp_path, MORE, more))
    browser.run("new Promise((done) => setTimeout(done, 50))")
    assert any(said in line for line in complaints(browser))
