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
LEAST_TARGET, LEAST_TEXT = 24, 12  # px on a phone: WCAG 2.5.8; what is smaller is not read at arm's length
IDLE_MS = 400
MOST_FRAMES = 6  # that a page at rest may ask for in that time
# A page is at rest once its sections are made and its views are drawn.
REST = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))))"
WHOLE = "!document.querySelector('[aria-busy=true]')"
COUNT_FRAMES = """(() => { const ask = window.requestAnimationFrame.bind(window); window.nFrames = 0;
  window.requestAnimationFrame = (work) => { window.nFrames += 1; return ask(work); }; })()"""
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
def seen_as(
    browser: Chromium, *, scheme: str = "light", size: tuple[int, int] = DESKTOP, media: str = "", motion: str = ""
) -> Iterator[None]:
    """The page in light or dark, on a screen of this size, on paper, or for who wants nothing to move."""
    features = {"prefers-color-scheme": scheme, "prefers-reduced-motion": motion}

    def show(features: Mapping[str, str], media: str, size: tuple[int, int]) -> None:
        named = [{"name": name, "value": value} for name, value in features.items()]
        browser.call("Emulation.setEmulatedMedia", {"media": media, "features": named})
        shape = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
        browser.call("Emulation.setDeviceMetricsOverride", shape)
        browser.run(REST)

    show(features, media, size)
    try:
        yield
    finally:
        show({}, "", DESKTOP)


def pale_in_light(browser: Chromium) -> list[str]:
    """Texts whose contrast with what is beneath them is below 4.5, 3 for large ones."""
    with seen_as(browser):
        found: list[str] = look(browser, "paleTexts()")
        return found


def pale_in_dark(browser: Chromium) -> list[str]:
    with seen_as(browser, scheme="dark"):
        found: list[str] = look(browser, "paleTexts()")
        return found


def light_in_dark(browser: Chromium) -> list[str]:
    """What stays light where everything is dark: grounds that are as they were, and the page itself."""
    with seen_as(browser):
        before = {(text, tuple(colour)) for text, colour, _ in look(browser, "grounds()")}
    with seen_as(browser, scheme="dark"):
        found = [
            f"{text}: stays light in the dark"
            for text, colour, luminance in look(browser, "grounds()")
            if luminance > 0.5 and (text, tuple(colour)) in before
        ]
        if look(browser, "isLight()"):
            found.append("the page is light in the dark")
        return list(dict.fromkeys(found))


def on_a_phone(browser: Chromium) -> list[str]:
    """What makes the page scroll sideways on 390 px, and targets, texts and cuts that are too small for it."""
    with seen_as(browser, size=PHONE):
        browser.run("scrollTo(0, 0)")
        found: list[str] = look(browser, f"sideways({PHONE[0]})")
        found += look(browser, f"smallTargets({LEAST_TARGET})") + look(browser, f"smallTexts({LEAST_TEXT})")
        return [*found, *look(browser, "cutTexts()")]


def on_a_desktop(browser: Chromium) -> list[str]:
    """The same of a desktop, where texts may be smaller."""
    with seen_as(browser):
        found: list[str] = look(browser, f"sideways({DESKTOP[0]})")
        return [*found, *look(browser, "cutTexts()")]


def on_paper(browser: Chromium) -> list[str]:
    """What a printed page would leave out, or show too pale."""
    with seen_as(browser, media="print"):
        found: list[str] = look(browser, "unprinted()")
        return [*found, *look(browser, "paleTexts()")]


def moving(browser: Chromium) -> list[str]:
    """What moves though nothing shall."""
    counted = browser.call("Page.addScriptToEvaluateOnNewDocument", {"source": COUNT_FRAMES})
    with seen_as(browser, motion="reduce"):
        browser.reload("window.nFrames !== undefined")
        unfold(browser)
        found: list[str] = look(browser, "moving()")
        n = browser.run(
            f"new Promise((done) => {{ const n = nFrames; setTimeout(() => done(nFrames - n), {IDLE_MS}); }})"
        )
        browser.call("Page.removeScriptToEvaluateOnNewDocument", counted)
        return found + ([f"the page at rest draws {n} times in {IDLE_MS} ms"] if n > MOST_FRAMES else [])


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
        found: list[str] = look(browser, "order()") + _mouse_only(browser)
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


def _mouse_only(browser: Chromium) -> list[str]:
    """Elements that a mouse can click and that no key reaches or answers."""
    root = browser.call("Runtime.evaluate", {"expression": "document.body"})["result"]["objectId"]
    heard = browser.call("DOMDebugger.getEventListeners", {"objectId": root, "depth": -1})["listeners"]
    kinds: dict[int, set[str]] = {}
    for one in heard:
        kinds.setdefault(one["backendNodeId"], set()).add(one["type"])
    found = []
    for node, types in kinds.items():
        if not types & {"click", "dblclick", "mousedown", "pointerdown", "mouseup"}:
            continue
        element = browser.call("DOM.resolveNode", {"backendNodeId": node})["object"]["objectId"]
        body = (
            "function (hasKeys) { const own = 'a[href], button, select, input, textarea, summary, label, option';"
            " if (!looks.isShown(this) || looks.isOff(this) || this.matches(own)) return '';"
            " if (this.tabIndex >= 0) return hasKeys ? '' : `${looks.told(this)}: no key does what a click does`;"
            " return this.querySelector(`${own}, [tabindex]`) ? ''"
            " : `${looks.told(this)}: a click does something, and no key reaches it`; }"
        )
        arguments = [{"value": bool(types & {"keydown", "keyup", "keypress"})}]
        values = {"objectId": element, "functionDeclaration": body, "arguments": arguments, "returnByValue": True}
        found.append(browser.call("Runtime.callFunctionOn", values)["result"]["value"])
    return sorted({one for one in found if one})


# What a keyboard does with a control; what none of them is, is clicked.


CHECKS: Mapping[str, Callable[[Chromium], list[str]]] = {
    "is a whole document": structure,
    "can be read in light": pale_in_light,
    "can be read in the dark": pale_in_dark,
    "is dark in the dark": light_in_dark,
    "fits a desktop": on_a_desktop,
    "fits a phone": on_a_phone,
    "can be printed": on_paper,
    "rests where nothing shall move": moving,
    "can be reached by keyboard": by_keyboard,
}
