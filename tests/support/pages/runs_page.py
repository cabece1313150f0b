"""What a person does with the page of runs, for its tests in a browser."""

from __future__ import annotations

import base64
import json

from chromium import Chromium

SELECT = "[...document.querySelectorAll('#{part} select')].find((one) => one.labels[0].textContent === '{label}')"


def options(browser: Chromium, part: str, label: str) -> list[str]:
    found: list[str] = browser.run(f"[...{SELECT.format(part=part, label=label)}.options].map((one) => one.text)")
    return found


def choose(browser: Chromium, part: str, label: str, text: str) -> None:
    """Choose an option as a person does: the value and then the event."""
    field = SELECT.format(part=part, label=label)
    browser.run(
        f"{{ const field = {field}; field.value = [...field.options].find((one) => one.text === {json.dumps(text)})"
        ".value; field.dispatchEvent(new Event('change')); }"
    )


def text_of(browser: Chromium, selector: str) -> str:
    return str(browser.run(f"document.querySelector({json.dumps(selector)}).innerText"))


def column(browser: Chromium, part: str, k: int, table: int = 0) -> list[str]:
    rows = f"document.querySelectorAll('#{part} table')[{table}].querySelectorAll('tbody tr')"
    found: list[str] = browser.run(f"[...{rows}].map((row) => row.children[{k}].innerText.split('\\n')[0])")
    return found


def headers(browser: Chromium, part: str) -> list[str]:
    found: list[str] = browser.run(f"[...document.querySelectorAll('#{part} thead th')].map((one) => one.innerText)")
    return found


def picture(browser: Chromium, k: int = 0) -> bytes:
    """What the ``k``-th 3D view shows, after it was drawn."""
    browser.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 60))))")
    box = browser.run(
        f"(() => {{ const c = document.querySelectorAll('#maps canvas')[{k}].getBoundingClientRect(); return {{"
        " x: c.x + scrollX, y: c.y + scrollY + 40, width: c.width - 140, height: c.height - 100, scale: 1 }; })()"
    )
    shot = browser.call("Page.captureScreenshot", {"format": "png", "clip": box, "captureBeyondViewport": False})
    return base64.b64decode(shot["data"])


def open_maps(browser: Chromium) -> None:
    browser.run("document.getElementById('maps').scrollIntoView()")
    browser.until("document.querySelectorAll('#maps .side tbody tr').length > 0")
    choose(browser, "maps", "Scene", "painted/a")
    browser.until(
        "document.querySelector('#maps canvas').getAttribute('aria-label').includes('painted/a by')"
        " && document.querySelector('#maps .say').hidden"
    )
    browser.run("document.querySelector('#maps button[title=\"Whole map\"]').click()")


def press(browser: Chromium, selector: str, *keys: str) -> None:
    browser.run(f"document.querySelector({json.dumps(selector)}).focus()")
    browser.press(*keys)
