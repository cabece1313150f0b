from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Chromium, find_chromium
from made_sheets import HOSTILE, made
from waiting import wait_until

from su3d_bench.reports.sheet.page import json_in_html
from su3d_bench.sheets.items import ANSWER_COLUMNS, SheetKind
from su3d_bench.sheets.making.guide import GUIDE
from su3d_bench.sheets.making.sets import MadeSheets, write_sheets

needs_browser = pytest.mark.skipif(find_chromium() is None, reason="no browser: install chromium")
TEXTS = ("chair", "place to sit", "red cup", "lamp next to a bed")
COUNT = "document.getElementById('count').textContent"


def written(folder: Path, kind: SheetKind, texts: tuple[str, ...]) -> tuple[MadeSheets, Path]:
    both = made(kind, texts)
    write_sheets(both, folder / "out", folder / "key")
    return both, folder / "out" / "annotator-1" / "sheet.html"


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("profile")


@pytest.fixture(scope="module")
def browser(profile: Path) -> Iterator[Chromium]:
    with Chromium(profile) as started:
        yield started


def answers(browser: Chromium, folder: Path) -> list[dict[str, str]]:
    """What the page exports."""
    folder.mkdir(exist_ok=True)
    browser.downloads_to(folder)
    browser.run("document.getElementById('export').click()")
    found = wait_until(lambda: list(folder.glob("*.csv")), "nothing was exported")
    return list(csv.DictReader(found[0].open(newline="")))


def shown(browser: Chromium) -> str:
    text: str = browser.run(COUNT)
    return text


def test_the_page_says_what_may_run_and_load(tmp_path: Path) -> None:
    _, page = written(tmp_path, "retrieval", TEXTS)
    text = page.read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)
    assert policy is not None
    rules = dict(one.strip().split(" ", 1) for one in policy[1].split(";"))
    assert rules["default-src"] == "'none'" and rules["img-src"] == "data:"
    assert all(re.fullmatch(r"'sha256-[\w+/=]+'", rules[name]) for name in ("script-src", "style-src"))
    assert not re.findall(r"https?://|\bsrc=\"(?!data)|<link|@import|\son\w+=", text)


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_ends_no_element_of_the_page(text: str) -> None:
    held = json_in_html({"text": text})
    assert not set("<>&") & set(held) and held.isascii()
    assert json.loads(held)["text"] == text


@needs_browser
def test_a_sheet_is_answered_by_keyboard_kept_over_a_reload_and_exported(tmp_path: Path, browser: Chromium) -> None:
    both, page = written(tmp_path, "retrieval", TEXTS)
    browser.open(page)
    assert shown(browser) == "0 of 4 answered, item 1 of 4"
    browser.press("1", "2", "3")
    assert shown(browser) == "3 of 4 answered, item 4 of 4"
    browser.press("u")
    assert shown(browser) == "2 of 4 answered, item 3 of 4"
    browser.press("ArrowLeft", "ArrowLeft", "2", "n")
    assert shown(browser) == "2 of 4 answered, item 3 of 4"
    browser.reload(until=f"{COUNT} === '2 of 4 answered, item 3 of 4'")
    browser.press("u", "1", "n", "3", "1", "9", "x")
    assert shown(browser) == "4 of 4 answered, item 4 of 4"
    rows = answers(browser, tmp_path / "down")
    assert tuple(rows[0]) == ANSWER_COLUMNS
    share, items = both.sheet.annotators[0], {item.id: item for item in both.sheet.items}
    assert [row["item_id"] for row in rows] == list(share.item_ids)
    assert all(row["check"] == items[row["item_id"]].check for row in rows)
    assert {row["sheet_id"] for row in rows} == {both.sheet.id} and {row["annotator"] for row in rows} == {share.name}
    assert [row["answer"] for row in rows] == ["right", "wrong", "cannot tell", "right"]
    assert browser.faults() == []


@needs_browser
def test_each_question_of_an_item_is_answered_before_the_next_item(tmp_path: Path, browser: Chromium) -> None:
    _, page = written(tmp_path, "annotation", TEXTS[:2])
    browser.open(page)
    browser.press("1", "2", "4")
    assert shown(browser) == "3 of 6 answered, item 2 of 2"
    rows = answers(browser, tmp_path / "down")
    assert [(row["question"], row["answer"]) for row in rows] == [
        ("label 1", "right"), ("label 2", "wrong"), ("merging", "cannot tell"),
        ("label 1", ""), ("label 2", ""), ("merging", ""),
    ]  # fmt: skip
    browser.run("document.querySelectorAll('.choices')[2].querySelectorAll('button')[1].click()")
    assert shown(browser) == "4 of 6 answered, item 2 of 2"


@needs_browser
def test_hostile_text_is_shown_and_does_nothing(tmp_path: Path, browser: Chromium) -> None:
    both, page = written(tmp_path, "retrieval", HOSTILE)
    browser.open(page)
    for item in both.sheet.items:
        assert browser.run("document.getElementById('text').textContent") == item.text
        assert browser.run("document.getElementById('text').children.length") == 0
        browser.press("ArrowRight")
    assert browser.run("document.title") == "Is the outlined object what is asked for?"
    assert browser.run("document.documentElement.scrollWidth <= innerWidth") is True
    assert browser.faults() == []


@needs_browser
def test_a_browser_that_keeps_nothing_says_so(tmp_path: Path, browser: Chromium) -> None:
    _, page = written(tmp_path, "retrieval", TEXTS)
    refuse = "Object.defineProperty(window, 'localStorage', {get() { throw new DOMException('no') }})"
    added = browser.call("Page.addScriptToEvaluateOnNewDocument", {"source": refuse})
    browser.open(page)
    browser.press("1")
    assert shown(browser) == "1 of 4 answered, item 2 of 4"
    assert "export before you close" in browser.run("document.getElementById('note').textContent")
    assert answers(browser, tmp_path / "down")[0]["answer"] == "right"
    browser.call("Page.removeScriptToEvaluateOnNewDocument", added)


@needs_browser
def test_what_is_kept_and_is_no_answer_is_passed_over(tmp_path: Path, browser: Chromium) -> None:
    both, page = written(tmp_path, "retrieval", TEXTS)
    browser.open(page)
    first, second = (item.id for item in both.sheet.items[:2])
    kept = {"answers": {first: {"retrieval": "<b>"}, second: {"retrieval": "wrong"}, "x": 1}, "history": [7], "at": 1e9}
    browser.run("localStorage.clear()")
    place = f"su3d-bench sheet {both.sheet.id} annotator-1"
    keep = f"localStorage.setItem({json.dumps(place)}, {json.dumps(json.dumps(kept))})"
    browser.reload(until=f"{COUNT}.startsWith('1 of 4 answered')", keep=keep)
    assert shown(browser).startswith("1 of 4 answered")
    browser.run("localStorage.clear()")


@needs_browser
def test_a_phone_needs_no_sideways_scrolling(tmp_path: Path, browser: Chromium) -> None:
    _, page = written(tmp_path, "annotation", (*TEXTS, "word" * 300))
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.call("Emulation.setDeviceMetricsOverride", size)
    browser.open(page)
    for _ in range(5):
        assert browser.run("document.documentElement.scrollWidth") <= 390
        heights = browser.run("[...document.querySelectorAll('.choices button')].map(b => b.offsetHeight)")
        assert min(heights) >= 44
        browser.press("ArrowRight")


@needs_browser
@pytest.mark.parametrize("kind", ["retrieval", "annotation", "reasoning", "questions"])
def test_the_page_tells_how_to_judge_in_the_words_of_the_workbook(
    tmp_path: Path, browser: Chromium, kind: SheetKind
) -> None:
    openpyxl = pytest.importorskip("openpyxl", reason="needs the sheets extra")
    both, page = written(tmp_path, kind, TEXTS[:2])
    guide = openpyxl.load_workbook(page.with_name("sheet.xlsx"))[GUIDE]
    of_book = [str(value) for row in guide.iter_rows(min_row=2, values_only=True) for value in row if value]
    browser.open(page)
    assert browser.run("document.getElementById('guide').open") is False
    browser.press("h")
    assert browser.run("document.getElementById('guide').open") is True
    of_page = browser.run("[...document.querySelectorAll('#how p, #how h2, #how dt, #how dd')].map(e => e.textContent)")
    assert of_page == of_book and len(of_book) > 4
    asks = {word for ask in both.sheet.asks for word in (ask.text, *ask.choices, *ask.meanings)}
    assert asks <= set(of_page)


@needs_browser
def test_the_picture_is_enlarged_by_keyboard(tmp_path: Path, browser: Chromium) -> None:
    _, page = written(tmp_path, "retrieval", TEXTS)
    browser.open(page)
    large = "document.getElementById('image').getAttribute('aria-pressed')"
    browser.press("z")
    assert browser.run(large) == "true"
    browser.run("document.getElementById('image').focus()")
    browser.press("Enter")
    assert browser.run(large) == "false"
    browser.run("document.getElementById('image').blur()")  # where it is focused the arrows scroll it
    browser.press("z", "ArrowRight")
    assert browser.run(large) == "false" and browser.faults() == []
