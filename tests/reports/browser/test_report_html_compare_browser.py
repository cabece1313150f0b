"""The maps of the HTML report in a browser: two views side by side, missed objects, timeline, links."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import runs_page
from chromium import Chromium, needs_chromium
from page_checks import WHOLE, complaints
from painted_runs import COLLECTOR, painted_page, painted_run
from runs_page import browser_for_pages, options, picture

from su3d_bench.core.maps import Instances
from su3d_bench.store.predictions import read_prediction, write_prediction

pytestmark = needs_chromium
FIELD = (
    "[...document.querySelectorAll('#maps .toolbar .field')].find((one) => one.textContent.trim().startsWith({label}))"
    ".querySelector('select, input')"
)
READ = (
    "document.querySelectorAll('#maps .side tbody tr').length > 0 && document.querySelector('#maps .say').hidden"
    " && document.querySelector('#maps canvas').getAttribute('aria-label').includes({text})"
)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on two scenes; the first map of scene a misses the chair."""
    folder = tmp_path_factory.mktemp("maps")
    run = painted_run(folder / "run", methods=(COLLECTOR, f"{COLLECTOR}@noise_m=0.3"))
    place = run / "scenes" / "painted.a" / "collector" / "prediction.npz"
    stored = read_prediction(place)
    assert isinstance(stored, Instances)
    kept = [k for k in range(len(stored)) if stored.names[k] != "chair"]
    views = [stored.views[stored.view_indptr[k] : stored.view_indptr[k + 1]].tolist() for k in kept]
    views[0] = [view for view in views[0] if view[0] >= 3]  # the sofa appears late
    assert stored.features is not None
    named = [stored.names[k] for k in kept]
    masks = [stored.mask(k) for k in kept]
    write_prediction(
        place, Instances.of(stored.points, masks, names=named, features=stored.features[kept], views=views)
    )
    painted_page(run, folder / "page.html", "--no-errors", "--texts", "chair", "table")
    return folder / "page.html"


@pytest.fixture(scope="module")
def browser(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with browser_for_pages(tmp_path_factory.mktemp("profile")) as found:
        found.open(page)
        yield found


@pytest.fixture(autouse=True)
def fresh(browser: Chromium, page: Path) -> Iterator[None]:
    """Each test starts with a freshly opened page and causes no errors or warnings."""
    browser.run("history.replaceState(null, '', location.pathname)")
    browser.open(page)
    browser.until(WHOLE)
    yield
    assert complaints(browser) == []


def field(label: str) -> str:
    return FIELD.format(label=json.dumps(label))


def opened(browser: Chromium, text: str = "painted/a by") -> None:
    browser.run("document.getElementById('maps').scrollIntoView()")
    browser.until(READ.format(text=json.dumps(text)))


def choose(browser: Chromium, label: str, text: str) -> None:
    runs_page.choose(browser, "maps", label, text)


def slide(browser: Chromium, label: str, value: int) -> None:
    browser.run(f"{{ const one = {field(label)}; one.value = '{value}'; one.dispatchEvent(new Event('input')); }}")


def press(browser: Chromium, *keys: str, k: int = 0) -> None:
    browser.run(f"document.querySelectorAll('#maps canvas')[{k}].focus()")
    browser.press(*keys)


def test_second_view_shows_ground_truth_or_another_map_and_moves_with_the_first(browser: Chromium) -> None:
    opened(browser)
    assert options(browser, "maps", "Compare with") == ["nothing", "ground truth", "collector@noise_m=0.3"]
    assert browser.run("document.querySelectorAll('#maps .pane')[1].hidden")
    for text in ("ground truth", "collector@noise_m=0.3"):
        choose(browser, "Compare with", text)
        browser.until(f"document.querySelectorAll('#maps .title')[1].textContent.includes({json.dumps(text)})")
        before = [picture(browser, 0), picture(browser, 1)]
        assert before[0] != before[1]
        press(browser, "ArrowLeft", "ArrowLeft", k=1)
        turned = [picture(browser, 0), picture(browser, 1)]
        assert turned[0] != before[0]
        assert turned[1] != before[1]
        press(browser, "ArrowUp", "-", k=0)
        assert picture(browser, 0) != turned[0]
        assert picture(browser, 1) != turned[1]
    choose(browser, "Compare with", "nothing")
    browser.until("document.querySelectorAll('#maps .pane')[1].hidden")


def test_missed_objects_can_be_shown_and_hidden(browser: Chromium) -> None:
    opened(browser)
    browser.until(f"{field('Missed objects')}.parentNode.textContent.includes('(1)')")
    assert not browser.run(f"{field('Missed objects')}.disabled")
    assert "rooms-instance" in browser.run(f"{field('Missed objects')}.parentNode.title")
    ghosts = picture(browser)
    browser.run(f"{field('Missed objects')}.click()")
    bare = picture(browser)
    assert bare != ghosts
    browser.run(f"{field('Missed objects')}.focus()")
    browser.call("Input.dispatchKeyEvent", {"type": "keyDown", "key": " ", "text": " ", "code": "Space"})
    browser.call("Input.dispatchKeyEvent", {"type": "keyUp", "key": " ", "code": "Space"})
    browser.until(f"{field('Missed objects')}.checked")
    assert picture(browser) == ghosts
    choose(browser, "Map", "collector@noise_m=0.3")
    browser.until(READ.format(text=json.dumps("noise_m")))
    browser.until(f"!{field('Missed objects')}.parentNode.textContent.includes('not known')")


def test_timeline_shows_only_instances_seen_so_far(browser: Chromium) -> None:
    opened(browser)
    note = "document.querySelector('#maps [role=status].keys').innerText"
    assert browser.run(note).startswith("Update 6 of 6, frame 5: 3 of 3 instances seen; the method had 4.")
    assert "instances that were merged or removed earlier are not shown" in browser.run(note)
    whole = picture(browser)
    slide(browser, "Timeline", 2)
    assert browser.run(note).startswith("Update 3 of 6, frame 2: 2 of 3 instances seen")
    early = picture(browser)
    assert early != whole
    slide(browser, "Timeline", 3)
    assert browser.run(note).startswith("Update 4 of 6, frame 3: 3 of 3 instances seen")
    assert picture(browser) == whole
    assert browser.run(f"{field('Timeline')}.getAttribute('aria-valuetext')").startswith("Update 4 of 6")


def address(browser: Chromium) -> str:
    browser.run("new Promise((done) => setTimeout(done, 500))")
    return str(browser.run("location.hash"))


def test_address_stores_and_restores_the_view(browser: Chromium, page: Path) -> None:
    opened(browser)
    assert address(browser) == ""  # nothing has been changed
    n_steps = browser.run("history.length")
    choose(browser, "Compare with", "ground truth")
    browser.until("!document.querySelectorAll('#maps .pane')[1].hidden")
    choose(browser, "Colour by", "class")
    slide(browser, "Clip height", 90)
    slide(browser, "Timeline", 2)
    press(browser, "n", "ArrowLeft", "+")
    browser.run(f"{field('Fade near walls')}.click()")
    link = address(browser)
    assert browser.run("history.length") == n_steps
    shown = "document.querySelector('#maps .detail h3').innerText"
    chosen = browser.run(shown)
    browser.run("history.replaceState(null, '', location.pathname)")
    browser.open(page)
    browser.run(f"history.replaceState(null, '', {json.dumps(link)})")
    browser.reload("true")
    browser.until("document.querySelector('#maps .detail h3') !== null")
    browser.until("!document.querySelectorAll('#maps .pane')[1].hidden")
    browser.until(READ.format(text=json.dumps("painted/a by")))
    assert browser.run(shown) == chosen
    assert browser.run(f"{field('Colour by')}.value") == "class"
    assert browser.run(f"{field('Clip height')}.value") == "90"
    assert browser.run(f"{field('Timeline')}.value") == "2"
    assert not browser.run(f"{field('Fade near walls')}.checked")
    assert browser.run("Math.abs(document.getElementById('maps').getBoundingClientRect().top) < 200")
    press(browser, "n", "p")
    assert address(browser) == link
    press(browser, "Escape")
    assert "instance" not in address(browser)
