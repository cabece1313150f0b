"""The HTML report for browser tests: how it is built, and user actions on it."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import chromium
import pytest
from chromium import Chromium
from page_checks import DESKTOP
from painted_runs import COLLECTOR, painted_page, painted_run, run, see_painted

from su3d_bench.cli.main import main

# WebGL without a GPU.
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
STRUCK = "<img src=x onerror=window.struck=1></script><script>window.struck=1</script>"


def browser_for_pages(folder: Path) -> Chromium:
    """A browser with WebGL; its profile is in ``folder``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chromium, "FLAGS", (*chromium.FLAGS, *SOFTWARE_GL))
        return Chromium(folder, width=DESKTOP[0], height=DESKTOP[1])


def finished_runs(folder: Path) -> list[str]:
    """Two runs: two methods on two scenes with intermediate maps, and one of the methods on one of the scenes."""
    both = (COLLECTOR, f"{COLLECTOR}@noise_m=0.3")
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        painted_run(folder / "one", "--anytime", "0.5", methods=both)
        assert run(scenes="a", out=str(folder / "two")) == 0
    record = json.loads((folder / "one" / "metrics.json").read_text())
    record["results"][0]["caveat"] = STRUCK
    (folder / "one" / "metrics.json").write_text(json.dumps(record))
    return [str(folder / "one"), str(folder / "two")]


def page_of_runs(folder: Path) -> Path:
    """The output of ``report html``."""
    page = folder / "page.html"
    words = ["--out", str(page), "--quiet", "--jobs", "1", "--texts", "chair", "table"]
    runs = finished_runs(folder)
    with pytest.MonkeyPatch.context() as patch:
        see_painted(patch)
        assert main(["report", "html", *runs, *words]) == 0
    return page


def page_of_sweep(folder: Path) -> Path:
    """The output of ``report html`` for two methods under two corruptions."""
    variants = ("", "@drop=1")
    cells = [f"{one}~{name}" for name in ("masks/dropped/2", "masks/dropped/5", "pose/jumps/5") for one in variants]
    painted_run(folder / "sweep", methods=[f"{COLLECTOR}{one}" for one in (*variants, *cells)])
    painted_page(folder / "sweep", folder / "page.html")
    return folder / "page.html"


SELECT = "[...document.querySelectorAll('#{part} select')].find((one) => one.labels[0].textContent === '{label}')"


def options(browser: Chromium, part: str, label: str) -> list[str]:
    found: list[str] = browser.run(f"[...{SELECT.format(part=part, label=label)}.options].map((one) => one.text)")
    return found


def choose(browser: Chromium, part: str, label: str, text: str) -> None:
    """Choose an option like a user: set the value, then fire the event."""
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
    """A screenshot of the ``k``-th 3D view, after it was drawn."""
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
