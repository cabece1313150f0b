"""The HTML report in a browser, opened as a file: its numbers, its maps and every control."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import chromium
import pytest
import runs_page
from chromium import Chromium, needs_chromium
from page_checks import DESKTOP, PHONE, WHOLE, complaints, seen_as
from PIL import Image
from waiting import wait_until

pytestmark = needs_chromium
MIDDLE_SECTIONS = ("Scenes", "Classes", "Confusion", "Errors", "Timing", "Compare")
GALLERY = "Worst errors"  # its controls are tested separately


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return runs_page.page_of_runs(tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def opened(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    """The page in a browser, in the state left by previous tests."""
    with runs_page.browser_for_pages(tmp_path_factory.mktemp("profile")) as found:
        found.open(page)
        found.until(WHOLE)
        yield found


@pytest.fixture
def browser(opened: Chromium) -> Iterator[Chromium]:
    yield opened
    assert complaints(opened) == []


def test_navigation_lists_every_section_and_scrolls_to_it(browser: Chromium) -> None:
    names = browser.run("[...document.querySelectorAll('#nav a')].map((one) => one.textContent)")
    before = ["Summary", "Maps", "Scenes", "Classes", "Confusion", "Errors"]
    assert names == [*before, GALLERY, "Timing", "Compare", "Provenance"]
    browser.run("document.querySelector('#nav a[href=\"#timing\"]').click()")
    browser.until("document.querySelector('#nav a[aria-current]')?.textContent === 'Timing'")
    assert browser.run("Math.abs(document.getElementById('timing').getBoundingClientRect().top) < 120")


def test_text_of_a_run_is_never_markup_in_the_browser(browser: Chromium) -> None:
    assert "<img src=x onerror=window.struck=1>" in runs_page.text_of(browser, "#summary .notes")
    assert browser.run("window.struck === undefined && !document.querySelector('main img[src=x]')")


def test_header_sorts_in_both_directions_by_mouse_and_keyboard(browser: Chromium) -> None:
    browser.run("document.querySelectorAll('#summary table')[0].querySelectorAll('th button')[1].click()")
    down = runs_page.column(browser, "summary", 1)
    assert (
        browser.run("document.querySelectorAll('#summary th[aria-sort]')[0].getAttribute('aria-sort')") == "descending"
    )
    values = [float(value.split()[0]) for value in down]
    assert values == sorted(values, reverse=True)
    assert len(set(values)) > 1
    runs_page.press(browser, "#summary th[aria-sort] button")
    browser.call("Input.dispatchKeyEvent", {"type": "keyDown", "key": "Enter", "text": "\r"})
    browser.call("Input.dispatchKeyEvent", {"type": "keyUp", "key": "Enter"})
    assert [float(value.split()[0]) for value in runs_page.column(browser, "summary", 1)] == sorted(values)


def test_every_table_and_plot_is_downloaded_without_a_server(browser: Chromium, tmp_path: Path) -> None:
    browser.downloads_to(tmp_path)
    browser.run("document.querySelectorAll('#summary .get button')[0].click()")
    browser.run("document.querySelectorAll('#errors .get button')[0].click()")
    browser.run("document.querySelectorAll('#timing .get button')[0].click()")
    wait_until(lambda: len([*tmp_path.glob("*.csv")]) == 2 and len([*tmp_path.glob("*.png")]) == 1, "no files", 60)
    (table,) = tmp_path.glob("*summary.csv")
    head, *rows = csv.reader(table.read_text(encoding="utf-8-sig").splitlines())
    assert head[0] == "Method" and {"mAcc", "mAcc low", "mAcc high", "mAcc ceiling"} <= set(head) and len(rows) == 3
    assert all(0 <= float(row[head.index("mAcc")]) <= 1 for row in rows)
    (plot,) = tmp_path.glob("*.png")
    with Image.open(plot) as image:
        assert image.width == 2 * 760 and len(image.convert("RGB").getcolors(1 << 20) or ()) > 10
    n_parts = browser.run("document.querySelectorAll('#main .wide').length")
    assert browser.run("document.querySelectorAll('#main .get button').length") == n_parts


def test_tables_that_scroll_sideways_say_so(browser: Chromium) -> None:
    shown = "[...document.querySelectorAll('#summary .scrolls')].map((one) => !one.hidden)"
    scrolls = "[...document.querySelectorAll('#summary .wide')].map((one) => one.scrollWidth > one.clientWidth + 1)"
    for size in (PHONE, DESKTOP):
        with seen_as(browser, size=size):
            browser.until(f"JSON.stringify({shown}) === JSON.stringify({scrolls})")
            assert any(browser.run(shown)) is (size == PHONE)


# Operates the k-th control of a kind in a section; returns whether it could (a select with one option cannot change).
OPERATE = """(part, kind, k) => {
  const one = document.querySelectorAll(`${part} ${kind}`)[k];
  if (kind === 'select') {
    if (one.options.length < 2) return false;
    one.selectedIndex = (one.selectedIndex + 1 + (k % (one.options.length - 1))) % one.options.length;
    one.dispatchEvent(new Event('change'));
  } else if (kind === 'input') {
    one.value = one.type === 'range' ? String(Math.round(0.4 * one.max)) : 'no row has this text';
    one.dispatchEvent(new Event('input'));
  } else one.click();
  return true;
}"""


@pytest.mark.parametrize("part", ["summary", *(name.lower() for name in MIDDLE_SECTIONS), "provenance", "maps"])
def test_each_control_changes_its_section(browser: Chromium, part: str) -> None:
    runs_page.open_maps(browser)
    browser.run("document.querySelectorAll('details').forEach((one) => { one.open = false; })")
    shown = f"document.getElementById('{part}').outerHTML + document.querySelector('#{part} select')?.value"
    n_operated = 0
    if part == "confusion":  # the other methods have no confusions
        runs_page.choose(
            browser, part, "Method", next(one for one in runs_page.options(browser, part, "Method") if "noise" in one)
        )
    for kind in ("button.sort", "summary", "input", "select", "button:not(.sort, .to-gallery, .download)"):
        for k in range(browser.run(f"document.querySelectorAll('#{part} {kind}').length")):
            is_of_view = part == "maps" and kind == "button:not(.sort, .to-gallery, .download)"
            if is_of_view:  # so that the picture differs from the view of the whole map
                runs_page.press(browser, "#maps canvas", "ArrowLeft")
            before, seen = browser.run(shown), runs_page.picture(browser) if is_of_view else b""
            if kind == "select" and browser.run(
                f"document.querySelectorAll('#{part} select')[{k}].closest('[hidden]')"
            ):
                continue
            if not browser.run(f"({OPERATE})('#{part}', {json.dumps(kind)}, {k})"):
                continue
            n_operated += 1
            if seen:
                assert runs_page.picture(browser) != seen, (kind, k)
            else:
                browser.until(f"{shown} !== {json.dumps(before)}")
    assert n_operated > 0


def test_each_colouring_changes_the_picture_and_has_a_legend(browser: Chromium) -> None:
    runs_page.open_maps(browser)
    kinds = runs_page.options(browser, "maps", "Colour by")
    assert kinds == ["colour", "instance", "class", "ground-truth class", "error", "similarity to a text"]
    seen = {}
    for kind in kinds:
        runs_page.choose(browser, "maps", "Colour by", kind)
        seen[kind] = runs_page.picture(browser)
        assert runs_page.text_of(browser, "#maps .legend").strip()
    assert (
        len(set(seen.values())) >= 5
    )  # instances and classes may have the same colours if each instance has its own class
    runs_page.choose(browser, "maps", "Colour by", kinds[4])
    assert "correct class" in runs_page.text_of(browser, "#maps .legend")
    runs_page.choose(browser, "maps", "Colour by", kinds[5])
    assert runs_page.options(browser, "maps", "Text") == ["chair", "table"]
    first = runs_page.picture(browser)
    runs_page.choose(browser, "maps", "Text", "table")
    assert runs_page.picture(browser) != first
    assert runs_page.column(browser, "maps", 0)[0] == "table"
    assert runs_page.headers(browser, "maps") == ["Instance", "Similarity", "Points"]
    runs_page.choose(browser, "maps", "Colour by", kinds[0])
    assert browser.run(f"{runs_page.SELECT.format(part='maps', label='Text')}.closest('.field').hidden")
    assert runs_page.headers(browser, "maps") == ["Instance", "Score", "Points"]


def test_page_without_webgl_shows_a_message_and_all_numbers(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chromium, "FLAGS", (*chromium.FLAGS, "--disable-3d-apis"))
    with Chromium(tmp_path / "profile") as browser:
        browser.open(page)
        browser.run("document.getElementById('maps').scrollIntoView()")
        browser.until("document.querySelector('#maps .say')?.innerText.includes('no WebGL 2')")
        browser.until("document.querySelectorAll('#maps .side tbody tr').length > 0")
        browser.run("document.querySelector('#maps .side tbody tr').click()")
        assert "Points" in runs_page.text_of(browser, "#maps .detail")
        assert browser.run("document.querySelectorAll('#summary table').length") == 2
