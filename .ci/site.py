"""Check that the built documentation site is complete and works from disk without a network.

``python .ci/site.py [build/site]`` checks every page: all links and anchors inside the site resolve, nothing
is loaded from elsewhere, every protocol, method and public name has a page. Then Chromium, if installed, opens
pages as files, on a desktop and a phone, in light and dark mode: readable text, working search, no network
access. Exit code 1 with one line per fault.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import su3d_bench
from su3d_bench.core.registry import BUILT_IN
from su3d_bench.metrics.protocols.loading import protocol_names

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "tests/support"), str(ROOT / "tests/support/programs")]
LOADED = {("script", "src"), ("img", "src"), ("iframe", "src"), ("source", "src"), ("link", "href")}
ELSEWHERE = re.compile(r"@import|url\(\s*[\"']?(?:https?:)?//")
SEARCHED, FOUND = "HOV-SG", "reference/protocols/replica-hovsg"
WIDTHS = {"desk": 1280, "phone": 390}
# Text with a contrast to its background below 4.5, or 3 if it is large: WCAG 2, 1.4.3. Colours are drawn to
# a canvas because styles may use any notation.
FAINT = """(() => {
  const pen = document.createElement('canvas').getContext('2d', {willReadFrequently: true})
  const rgba = text => { pen.clearRect(0, 0, 1, 1); pen.fillStyle = text; pen.fillRect(0, 0, 1, 1)
    const [r, g, b, a] = pen.getImageData(0, 0, 1, 1).data; return [r, g, b, a / 255] }
  const over = (top, under) => [0, 1, 2].map(k => top[k] * top[3] + under[k] * (1 - top[3]))
  const linear = v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4
  const light = rgb => { const [r, g, b] = rgb.map(v => linear(v / 255))
    return 0.2126 * r + 0.7152 * g + 0.0722 * b }
  const behind = node => { const layers = []
    for (; node; node = node.parentElement) layers.unshift(rgba(getComputedStyle(node).backgroundColor))
    return layers.reduce((under, top) => over(top, under), [255, 255, 255]) }
  const found = {}
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT)
  while (texts.nextNode()) {
    const node = texts.currentNode.parentElement, style = getComputedStyle(node)
    const box = node.getBoundingClientRect()
    if (!texts.currentNode.data.trim()) continue
    if (!node.checkVisibility({opacityProperty: true, visibilityProperty: true})) continue
    if (!box.width || /^(SCRIPT|STYLE|TITLE)$/.test(node.tagName)) continue
    const under = behind(node), own = rgba(style.color)
    let opacity = 1
    for (let one = node; one; one = one.parentElement) opacity *= getComputedStyle(one).opacity
    own[3] *= opacity
    const [high, low] = [light(over(own, under)), light(under)].sort((a, b) => b - a)
    const ratio = (high + 0.05) / (low + 0.05), size = parseFloat(style.fontSize)
    if (ratio < (size >= 24 || (size >= 18.66 && style.fontWeight >= 700) ? 3 : 4.5))
      found[`${node.tagName.toLowerCase()}.${node.className}`] =
        `${ratio.toFixed(2)} '${texts.currentNode.data.trim().slice(0, 30)}'`
  }
  return Object.entries(found).map(([where, what]) => `${where}: ${what}`)
})()"""
SEARCH = """(() => {
  const query = document.querySelector('[data-md-component=search-query]')
  query.focus()
  query.value = %s
  query.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true}))
})()"""
RESULTS = "[...document.querySelectorAll('.md-search-result__link')].map(one => one.href)"


class _Page(HTMLParser):
    """A page's links, loaded resources, and anchors."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.places: set[str] = set()
        self.styles = ""
        self._in_style = False
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attributes}
        self.places |= {values[name] for name in ("id", "name") if name in values}
        self.links += [values["href"]] if tag == "a" and "href" in values else []
        self.loaded += [value for name, value in values.items() if (tag, name) in LOADED]
        self.styles += values.get("style", "")
        self._in_style = tag == "style"

    def handle_endtag(self, tag: str) -> None:
        self._in_style = self._in_style and tag != "style"

    def handle_data(self, data: str) -> None:
        self.styles += data if self._in_style else ""


def faults_of(site: Path) -> Iterator[str]:
    """One line per broken link, external resource, and missing page."""
    pages = {path: _Page(path.read_text()) for path in sorted(site.rglob("*.html"))}
    for path, page in pages.items():
        where = path.relative_to(site)
        for address in [*page.links, *page.loaded]:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                if address in page.loaded and parts.scheme != "data":
                    yield f"{where}: loads {address}"
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file():
                yield f"{where}: {address} does not exist"
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                yield f"{where}: {address}: the page has no such anchor"
        if ELSEWHERE.search(page.styles):
            yield f"{where}: a style loads from elsewhere"
    for path in sorted(site.rglob("*.css")):
        if ELSEWHERE.search(path.read_text()):
            yield f"{path.relative_to(site)}: loads from elsewhere"
    made = {f"reference/protocols/{name}.html" for name in protocol_names()}
    made |= {f"reference/methods/{name}.html" for name in BUILT_IN["method"]}
    yield from (f"{name} is missing" for name in sorted(made) if site / name not in pages)
    api = pages.get(site / "reference/api.html")
    names = api.places if api is not None else set()
    yield from (f"reference/api.html lacks {name}" for name in su3d_bench.__all__ if f"su3d_bench.{name}" not in names)


def faults_in_browser(site: Path) -> Iterator[str]:
    """One line per fault seen when opening the start page from disk: missing content or bad layout."""
    from chromium import Chromium

    opened = [
        "index.html",
        "reference/commands/run.html",
        "reference/methods/opensu3d.html",
        f"{FOUND}.html",
        "reference/api.html",
    ]
    for device, width in WIDTHS.items():
        for colours in ("light", "dark"):
            who = f"Chromium, {device}, {colours}"
            with (
                tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
                Chromium(Path(profile), width=width, height=900, is_phone=device == "phone") as browser,
            ):
                scheme = {"name": "prefers-color-scheme", "value": colours}
                browser.call("Emulation.setEmulatedMedia", {"features": [scheme]})
                for name in opened:
                    browser.open(site / name)
                    is_dark = browser.run("document.body.dataset.mdColorScheme") == "slate"
                    if is_dark != (colours == "dark"):
                        yield f"{who}: {name} has wrong colours"
                    if (seen := browser.run("document.documentElement.scrollWidth")) > width:
                        yield f"{who}: {name} is {seen} pixels wide"
                    yield from (f"{who}: {name}: faint: {one}" for one in browser.run(FAINT))
                browser.open(site / opened[0])
                browser.run("document.querySelector('[data-md-toggle=search]').click()")
                browser.until("document.querySelector('[data-md-component=search-query]').offsetWidth > 0")
                browser.run(SEARCH % json.dumps(SEARCHED))
                browser.until(f"{RESULTS}.length > 0")
                if not any(FOUND in address for address in browser.run(RESULTS)):
                    yield f"{who}: a search for {SEARCHED} does not find {FOUND}"
                yield from (f"{who}: {fault}" for fault in browser.faults())


def main(arguments: list[str]) -> int:
    from chromium import find_chromium

    site = Path(arguments[0] if arguments else ROOT / "build/site").resolve()
    if not (site / "index.html").is_file():
        print(f"site: {site} has no site; run: make docs")
        return 2
    faults = list(faults_of(site))
    if find_chromium() is None:
        print("site: no Chromium; the pages were not opened")
    else:
        faults += faults_in_browser(site)
    print("\n".join(faults) or f"site: {len(list(site.rglob('*.html')))} pages, all links resolve")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
