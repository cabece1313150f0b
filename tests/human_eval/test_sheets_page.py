from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Chromium, needs_chromium
from synthetic_sheets import HOSTILE, made
from waiting import wait_until

from su3d_bench.human_eval.answers import check_answers, read_answers
from su3d_bench.human_eval.items import ANSWER_COLUMNS, COMMENT, SheetKind
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
    assert tuple(rows[0]) == (*ANSWER_COLUMNS, COMMENT)
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


@needs_chromium
def test_one_key_answers_all_questions_of_an_item(tmp_path: Path, browser: Chromium) -> None:
    _, page = written(tmp_path, "annotation", TEXTS[1:])
    browser.open(page)
    browser.press("2", "a")
    assert shown(browser) == "3 of 9 answered, item 2 of 3"
    browser.press("u")  # takes back all three, not the answer before
    assert shown(browser) == "1 of 9 answered, item 1 of 3"
    browser.press("a")
    rows = answers(browser, tmp_path / "down")
    assert [row["answer"] for row in rows[:4]] == ["right", "right", "well-merged", ""]
    assert browser.faults() == []


@needs_chromium
def test_enlarged_picture_is_wider_than_its_pane(tmp_path: Path, browser: Chromium) -> None:
    _, page = written(tmp_path, "annotation", TEXTS)
    browser.open(page)
    ratio = "document.getElementById('image').width / document.getElementById('picture').clientWidth"
    assert browser.run(ratio) <= 1
    browser.press("z")
    assert browser.run(ratio) > 2
    browser.press("z")
    assert browser.run(ratio) <= 1


@needs_chromium
def test_comments_survive_reload_and_are_read_as_written(tmp_path: Path, browser: Chromium) -> None:
    both, page = written(tmp_path, "annotation", TEXTS)
    browser.open(page)
    text = '=1+1 "a" <b>, \u202e\U0001f600'
    browser.press("c")
    browser.call("Input.insertText", {"text": f"{text}\n2a"})  # the keys 2 and a answer nothing here
    browser.press("Escape", "ArrowRight", "c")
    browser.call("Input.insertText", {"text": "second"})
    browser.reload(until="document.getElementById('comment').value === 'second'")
    browser.press("ArrowLeft", "a")
    browser.press("ArrowLeft")
    assert browser.run("document.getElementById('comment').value") == f"{text}\n2a"
    answers(browser, tmp_path / "down")
    (file,) = (tmp_path / "down").glob("*.csv")
    assert ",\"'=1+1" in file.read_text()  # a spreadsheet shows it as text
    checked = check_answers(both.sheet, read_answers(file), is_partial=True)
    first, second = both.sheet.annotators[0].item_ids[:2]
    assert checked.faults == () and len(checked.judgements) == 3
    name = both.sheet.annotators[0].name
    assert checked.comments == {first: {name: f"{text} 2a"}, second: {name: "second"}}
    assert browser.faults() == []


@needs_chromium
def test_current_question_is_visible_on_a_laptop_screen(tmp_path: Path, browser: Chromium) -> None:
    _, page = written(tmp_path, "annotation", ("label 1: chair, " * 20, *TEXTS))
    size = {"width": 1366, "height": 768, "deviceScaleFactor": 1, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", size)
    place = "document.querySelector('{}').getBoundingClientRect().{}"
    browser.open(page)
    for _ in range(3):  # each question of an item, the last of which begins below the screen
        browser.run("document.querySelector('.now button').focus()")
        assert browser.run(f"{place.format('.now', 'bottom')} <= {place.format('nav', 'top')}")
        assert browser.run(f"{place.format('.now', 'top')} >= {place.format('main', 'top')}")
        assert browser.run(f"{place.format('nav', 'bottom')} <= {place.format('footer', 'top')}")
        browser.press("Enter")
        assert browser.run("document.querySelector('.now').contains(document.activeElement)")
    assert shown(browser) == "3 of 15 answered, item 2 of 5"


@needs_chromium
def test_time_left_is_estimated_from_own_pace(tmp_path: Path, browser: Chromium) -> None:
    _, page = written(tmp_path, "retrieval", TEXTS * 3)
    browser.open(page)
    browser.run("window.now = 4e12; Date.now = () => window.now")
    browser.press("1")  # after a long pause, which does not count
    for _ in range(5):
        assert browser.run("document.getElementById('left').textContent") == ""
        browser.run("window.now += 60000")
        browser.press("1")
    assert browser.run("document.getElementById('left').textContent") == "about 6 min left (estimate)"
