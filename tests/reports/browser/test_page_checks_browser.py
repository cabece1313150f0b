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


@pytest.mark.parametrize("check", CHECKS)
def test_a_whole_page_passes(browser: Chromium, tmp_path: Path, check: str) -> None:
    assert looked_at(browser, written(tmp_path), check) == []
    assert complaints(browser) == []


ON_A_PICTURE = (
    '<div style="position: relative; width: 200px; height: 60px">'
    '<canvas id="under" role="img" aria-label="Grey" style="position: absolute; width: 200px; height: 60px"></canvas>'
    '<b style="position: absolute; color: #777">On a canvas</b></div>'
    "<script>{ const c = document.getElementById('under'), p = c.getContext('2d'); p.fillStyle = '#888';"
    " p.fillRect(0, 0, 999, 999); }</script>"
)
DOCUMENT, LIGHT, DARK, NIGHT, DESKTOP, PHONE, PAPER, STILL, TAB, KEYS = CHECKS
# What is broken in the page, the check that refuses it, and what that says.
BROKEN = {
    "no language": ('<html lang="en">', "<html>", DOCUMENT, "says no language"),
    "no title": ("<title>A page</title>", "<title> </title>", DOCUMENT, "no title"),
    "no main part": ("<main>", "<div>", DOCUMENT, "0 main parts"),
    "two h1": ("<h2 id", "<h1>A</h1><h2 id", DOCUMENT, "exactly one h1"),
    "a level left out": ("<h2 id", "<h4>A</h4><h2 id", DOCUMENT, "follows a heading of level 1"),
    "no alt": ('<img alt="A point"', "<img", DOCUMENT, "without words"),
    "a nameless canvas": (' aria-label="A view"', "", DOCUMENT, "no role and label"),
    "a nameless choice": ("<label>Which ", "<label>", DOCUMENT, "a control without a name"),
    "a table of nothing": ("<caption>Numbers</caption>", "", DOCUMENT, "without a caption"),
    "a header of nothing": ('<th scope="col">', "<th>", DOCUMENT, "heads nothing"),
    "one id twice": ("<p>Some", '<p id="part">Some', DOCUMENT, "two elements have the id part"),
    "a dead link": ('href="#part"', 'href="#gone"', DOCUMENT, "leads nowhere"),
    "a dead reference": ("<p>Some", '<p aria-describedby="x">Some', DOCUMENT, "names no element"),
    "a source outside": (MORE, '<link rel="preconnect" href="https://a.example">', DOCUMENT, "leaves"),
    "pale text": ("<p>Some", '<p style="color: #888">Some', LIGHT, "contrast 3.54"),
    "pale by opacity": ("<p>Some", '<p style="opacity: .5">Some', LIGHT, "contrast 3."),
    "a pale hint": (MORE, '<style>::placeholder { color: #aaa }</style><input aria-label="a" placeholder="any">',
        LIGHT, "contrast 2."),
    "a pale sign": (MORE, '<style>h2::after { content: "x1"; color: #bbb }</style>', LIGHT, "contrast"),
    "pale on a canvas": (MORE, ON_A_PICTURE, LIGHT, "with what is beneath"),
    "pale on a gradient": ("<p>Some", '<p style="background: linear-gradient(#333, #444)">Some', LIGHT,
        "with what is beneath"),
    "pale in SVG": (MORE, '<svg role="img" aria-label="a"><rect width="99" height="40"/><text y="20">text</text></svg>',
        LIGHT, "with what is beneath"),
    "dark on dark": ("<p>Some", '<p style="color: #333">Some', DARK, "contrast"),
    "a light box": (MORE, '<p style="background: #fff; color: #000">a</p>', NIGHT, "stays light"),
    "a light page": (" light dark }", " light }", NIGHT, "the page is light"),
    "a light canvas": ("dark.matches ? '#111' : '#eee'", "'#eee'", NIGHT, "its edge stays light"),
    "too wide": (MORE, '<div style="width: 500px">a</div>', PHONE, "516 px wide on a screen of 390"),
    "too wide for all": (MORE, '<div style="width: 2000px">a</div>', DESKTOP, "px wide on a screen of 1300"),
    "a table without a box": ("<!-- cell -->", f"{'x' * 90}</td></tr></table></div><table><caption>a</caption><tr><td>"
        f"{'x' * 90}", PHONE, "wide on a screen of 390"),
    "a small target": (MORE, '<button style="min-height: 0; height: 20px">a</button>', PHONE, "x 20 px, not 24"),
    "a small row": ("<td><!-- cell -->", '<td tabindex="0" style="cursor: pointer; line-height: 9px; padding: 0">abc',
        PHONE, "px, not 24"),
    "small text": ("<p>Some", '<p style="font-size: 11px">Some', PHONE, "text of 11.0 px"),
    "small text in SVG": (MORE, '<svg role="img" aria-label="a" viewBox="0 0 600 50" width="300">'
        '<text y="20" font-size="16">a</text></svg>', PHONE, "text of 8.0 px"),
    "cut text": ("<p>Some", '<p style="width: 40px; overflow: hidden; white-space: nowrap">Some', PHONE, "is cut"),
    "a box on paper": (MORE, '<div tabindex="0" style="height: 40px; overflow: auto"><p>a<p>b<p>c</div>', PAPER,
        "are not printed"),
    "a bar on paper": (MORE, '<p style="position: fixed; top: 0">a</p>', PAPER, "over each page"),
    "an animation": (MORE, "<style>@keyframes a { to { left: 9px } } h2 { animation: a 3s infinite }</style>",
        STILL, "is animated"),
    "a transition": (MORE, "<style>h2 { transition: left 1s }</style>", STILL, "changes over"),
    "smooth scrolling": (MORE, "<style>html { scroll-behavior: smooth }</style>", STILL,
        "scrolls smoothly"),
    "drawn for ever": (MORE, "<script>const again = () => requestAnimationFrame(again); again();</script>",
        STILL, "the page at rest draws"),
    "the mouse alone": (MORE, "<p id='m'>a</p><script>m.addEventListener('click', () => 0)</script>",
        TAB, "no key reaches it"),
    "no key answers": (MORE, "<p id='m' tabindex='0'>a</p><script>m.addEventListener('click', () => 0)</script>",
        TAB, "no key does what a click does"),
    "no focus to be seen": (MORE, "<style>button:focus { outline: none }</style>", TAB,
        "does not show that it has the focus"),
    "out of turn": ('id="more"', 'id="more" tabindex="3"', TAB, "by tabindex 3"),
    "turned round": ("<p>Some", '<p style="display: flex; flex-direction: row-reverse"><button>a</button>Some',
        TAB, "elsewhere than its place"),
    "a trap": (MORE, '<button id="t">a</button><script>t.addEventListener("keydown", (event) => event.preventDefault())'
        "</script>", TAB, "Tab never leaves"),
    "dead button": ("count.textContent += '1'", "0", KEYS, "no key changes anything"),
    "dead choice": ("</select>", '</select></label><label>a <select id="d"><option>1<option>2</select>'
        '<script>d.addEventListener("keydown", (event) => event.preventDefault())</script>',
        KEYS, "no key changes anything"),
    "dead view": ("n += 1; draw();", "", KEYS, "no key changes anything"),
    "pale once it changed": ("count.textContent += '1'", "count.textContent += '1'; count.style.color = '#999'",
        KEYS, "(after main > button#more"),
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
        ("<script>fetch('http://a.example/').catch(() => 0)</script>", "http://a.example/"),
        ("<script>try { new WebSocket('wss://a.example/') } catch { }</script>", "wss://a.example/"),
        ("<script>console.error('it is broken')</script>", "it is broken"),
        ("<script>throw Error('it is broken')</script>", "Uncaught"),
    ],
)
def test_what_leaves_the_page_or_goes_wrong_is_told(browser: Chromium, tmp_path: Path, more: str, said: str) -> None:
    browser.messages.clear()
    browser.open(written(tmp_path, MORE, more))
    browser.run("new Promise((done) => setTimeout(done, 50))")
    assert any(said in line for line in complaints(browser))
