"""What a person could not read, reach or use of a page in a browser; each check gives lines that say where and what.

A check takes the browser with the page open and leaves it as a person with the defaults of a desktop sees it. What it
looks at is the page as ``unfold`` leaves it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from chromium import Chromium

SCRIPT = Path(__file__).with_name("looks.js").read_text(encoding="utf-8")
PHONE, DESKTOP = (390, 844), (1300, 900)
MIN_TARGET, MIN_TEXT = 24, 12  # px on a phone: WCAG 2.5.8; what is smaller is not read at arm's length
# A page is at rest once its sections are made and its views are drawn.
REST = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))))"
WHOLE = "!document.querySelector('[aria-busy=true]')"
# A browser without a graphics card says of itself that it reads canvases slowly.
OF_THE_BROWSER = "GL Driver Message (OpenGL, Performance"


def complaints(browser: Chromium) -> list[str]:
    """What the page complained of since it was opened, and every address outside it that it asked for."""
    return [line for line in browser.faults() if OF_THE_BROWSER not in line]


def look(browser: Chromium, call: str) -> Any:
    """What one of the functions of looks.js finds in the page."""
    if not browser.run("!!globalThis.looks"):
        browser.run(SCRIPT)
    return browser.run(f"looks.{call}")


def unfold(browser: Chromium) -> None:
    """Bring all that a page holds into being: what is folded is opened, what waits to be scrolled to is scrolled to."""
    browser.until(WHOLE)
    browser.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    browser.run(
        "(async () => { for (let y = 0; y < document.documentElement.scrollHeight; y += innerHeight / 2) {"
        f" scrollTo(0, y); await {REST}; }} scrollTo(0, 0); await {REST}; }})()"
    )


@contextmanager
def seen_as(browser: Chromium, *, scheme: str = "light", size: tuple[int, int] = DESKTOP) -> Iterator[None]:
    """The page in light or dark, on a screen of this size."""

    def show(scheme: str, size: tuple[int, int]) -> None:
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        browser.call("Emulation.setEmulatedMedia", {"media": "", "features": features})
        shape = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
        browser.call("Emulation.setDeviceMetricsOverride", shape)
        browser.run(REST)

    show(scheme, size)
    try:
        yield
    finally:
        show("", DESKTOP)


def pale_texts(browser: Chromium, scheme: str) -> list[str]:
    """Texts whose contrast with what is beneath them is below 4.5, 3 for large ones."""
    with seen_as(browser, scheme=scheme):
        found: list[str] = look(browser, "paleTexts()")
        return found


def on_a_phone(browser: Chromium) -> list[str]:
    """What makes the page scroll sideways on 390 px, and targets, texts and cuts that are too small for it."""
    with seen_as(browser, size=PHONE):
        browser.run("scrollTo(0, 0)")
        found: list[str] = look(browser, f"sideways({PHONE[0]})")
        found += look(browser, f"smallTargets({MIN_TARGET})") + look(browser, f"smallTexts({MIN_TEXT})")
        return [*found, *look(browser, "cutTexts()")]


def on_a_desktop(browser: Chromium) -> list[str]:
    """The same of a desktop, where texts may be smaller."""
    with seen_as(browser):
        found: list[str] = look(browser, f"sideways({DESKTOP[0]})")
        return [*found, *look(browser, "cutTexts()")]


def structure(browser: Chromium) -> list[str]:
    """What is no whole document: language, title, headings, words for pictures, names of controls, sources."""
    found: list[str] = look(browser, "structure()")
    nodes = browser.call("Accessibility.getFullAXTree")["nodes"]
    for node in nodes:
        is_control = any(one["name"] == "focusable" and one["value"].get("value") for one in node.get("properties", []))
        role = node.get("role", {}).get("value", "")
        if (
            is_control
            and not node.get("name", {}).get("value")
            and role not in ("RootWebArea", "row", "generic", "main")
        ):
            found.append(f"{role}: a control without a name")
    return found


def by_keyboard(browser: Chromium) -> list[str]:
    """What Tab does not reach once and in the order of the page, and what only a mouse can do."""
    with seen_as(browser):
        found: list[str] = look(browser, "order()")
        browser.run("document.activeElement.blur(); getSelection().removeAllRanges(); scrollTo(0, 0)")
        names: list[str] = look(browser, "list()")
        at = (
            "(() => { const el = document.activeElement, k = looks.listed.indexOf(el);"
            " return k >= 0 ? k : el === document.body || el === document.documentElement ? -1"
            " : looks.scrolls(el) ? -2 : looks.told(el); })()"
        )
        browser.run("document.body.tabIndex = -1; document.body.focus(); document.body.removeAttribute('tabindex')")
        reached: list[Any] = []
        while len(reached) <= 2 * len(names) + 20:
            browser.press("Tab")
            here = browser.run(at)
            if here == -1 or (reached and here == reached[0]):
                break
            reached.append(here)
        else:
            found.append(f"Tab never leaves the page: it goes on to {reached[-6:]}")
        ours = [one for one in reached if one != -2]
        found += [f"{one}: has the focus and is no control that can be seen" for one in ours if isinstance(one, str)]
        places = [one for one in ours if isinstance(one, int)]
        found += [f"{names[k]}: Tab does not reach it" for k in range(len(names)) if k not in places]
        found += [f"{names[k]}: Tab reaches it twice" for k in sorted({*places}) if places.count(k) > 1]
        if places != sorted(places):
            found.append(f"Tab goes through the page in another order than it is read: {places}")
        if len(places) > 1:
            look(browser, f"listed[{places[-1]}].focus()")
            browser.press("Shift+Tab")
            back = browser.run(at)
            if back not in (places[-2], -2):
                found.append(f"Shift+Tab does not go back from {names[places[-1]]}")
        browser.run("document.activeElement.blur()")
        return found


CHECKS: Mapping[str, Callable[[Chromium], list[str]]] = {
    "is a whole document": structure,
    "can be read in light": lambda browser: pale_texts(browser, "light"),
    "can be read in the dark": lambda browser: pale_texts(browser, "dark"),
    "fits a desktop": on_a_desktop,
    "fits a phone": on_a_phone,
    "can be reached by keyboard": by_keyboard,
}
