from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Chromium, needs_chromium
from synthetic_sheets import HOSTILE, made
from waiting import wait_until

from su3d_bench.human_eval.items import ANSWER_COLUMNS, SheetKind
from su3d_bench.human_eval.sets import GeneratedSheets, write_sheets

TEXTS = ("chair", "place to sit", "red cup", "lamp next to a bed")
COUNT = "document.getElementById('count').textContent"


def written(folder: Path, kind: SheetKind, texts: tuple[str, ...]) -> tuple[GeneratedSheets, Path]:
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
    """The export of the page."""
    folder.mkdir(exist_ok=True)
    browser.downloads_to(folder)
    browser.run("document.getElementById('export').click()")
    found = wait_until(lambda: list(folder.glob("*.csv")), "nothing was exported")
    return list(csv.DictReader(found[0].open(newline="")))


def shown(browser: Chromium) -> str:
    text: str = browser.run(COUNT)
    return text


def test_page_declares_what_may_run_and_load(tmp_path: Path) -> None:
    _, page = written(tmp_path, "retrieval", TEXTS)
    text = page.read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)
    assert policy is not None
    rules = dict(one.strip().split(" ", 1) for one in policy[1].split(";"))
    assert rules["default-src"] == "'none'" and rules["img-src"] == "data:"
    assert all(re.fullmatch(r"'sha256-[\w+/=]+'", rules[name]) for name in ("script-src", "style-src"))
    assert not re.findall(r"https?://|\bsrc=\"(?!data)|<link|@import|\son\w+=", text)


@needs_chromium
def test_sheet_keyboard_answers_survive_reload_and_export(tmp_path: Path, browser: Chromium) -> None:
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


@needs_chromium
def test_hostile_text_is_displayed_without_effect(tmp_path: Path, browser: Chromium) -> None:
    both, page = written(tmp_path, "retrieval", HOSTILE)
    browser.open(page)
    for item in both.sheet.items:
        assert browser.run("document.getElementById('text').textContent") == item.text
        assert browser.run("document.getElementById('text').children.length") == 0
        browser.press("ArrowRight")
    assert browser.run("document.title") == "Is the outlined object what is asked for?"
    assert browser.run("document.documentElement.scrollWidth <= innerWidth") is True
    assert browser.faults() == []
