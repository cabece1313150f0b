"""The gallery of the HTML report: content of its cards, and in a browser its filters and links."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import Chromium, needs_chromium
from page_checks import WHOLE
from painted import Collector
from painted_runs import COLLECTOR, painted_page, painted_run
from runs_page import SELECT, choose

from su3d_bench.analysis.page.gallery import PHOTO, PREDICTED, ErrorView, error_photo
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import Frame, SceneInfo


class Mistaken(Collector):
    """A collector with one error per kind: in scene a the chair split in two and the sofa labelled table, in scene b
    the table missed."""

    name = "mistaken"

    def start(self, scene: SceneInfo) -> None:
        super().start(scene)
        self._scene = scene.scene

    def finish(self) -> Prediction:
        if self._scene != "a":
            self._points.pop("table", None)
            return super().finish()
        if {"chair", "sofa", "table"} <= set(self._points):
            chair = np.concatenate(self._points["chair"])
            is_left = chair[:, 0] < np.median(chair[:, 0])
            self._points |= {"chair": [chair[is_left]], "chair half": [chair[~is_left]]}
            self._views["chair half"] = self._views["chair"]
            self._features["chair half"] = self._features["chair"]
            self._features["sofa"] = self._features["table"]
        return super().finish()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on two scenes; the second makes mistakes."""
    methods = (COLLECTOR, f"{__file__}:Mistaken")
    return painted_run(tmp_path_factory.mktemp("gallery") / "run", methods=methods)


@pytest.fixture(scope="module")
def page(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("gallery") / "page.html"
    painted_page(run, place)
    return place


def galleries(text: str) -> list[dict[str, Any]]:
    pattern = r'<script type="application/json" id="gallery-\d+" class="gallery">(.*?)</script>'
    return [json.loads(one) for one in re.findall(pattern, text)]


def numbers(text: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    return found


def cards(text: str) -> list[dict[str, Any]]:
    return [
        {**card, "scene": one["scene"], **{key: of[key] for key in ("method", "protocol", "metrics")}}
        for one in galleries(text)
        for of in one["of_methods"]
        for card in of["cards"]
    ]


def test_single_card_of_a_kind_costs_as_much_as_the_kind(page: Path) -> None:
    text = page.read_text()
    found, n_compared = cards(text), 0
    for one in numbers(text)["errors"]:
        for of in (of for of in one["protocols"] if of["kind"] == "instance"):
            for kind, cause in of["causes"].items():
                own = [
                    card
                    for card in found
                    if (card["method"], card["protocol"], card["kind"]) == (one["method"], of["protocol"], kind)
                ]
                assert len(own) == cause["n"]
                if len(own) == 1:
                    gains = dict(zip(own[0]["metrics"], own[0]["gains"], strict=True))
                    assert gains == pytest.approx(cause["gains"], abs=1e-6)
                    n_compared += 1
    assert n_compared == 3


def test_cards_contain_all_wrong_points(page: Path) -> None:
    text = page.read_text()
    for one in numbers(text)["errors"]:
        for of in (of for of in one["protocols"] if of["kind"] == "semantic"):
            for cause, result in of["causes"].items():
                own = [card for card in cards(text) if (card["method"], card["kind"]) == (one["method"], cause)]
                assert sum(card["n_points"] for card in own) == result["n"]


def plane_seen(n_pixels: int = 40) -> Frame:
    """A frame of a wall two metres in front of a camera that looks along z."""
    depth = np.full((n_pixels, n_pixels), 2.0, np.float32)
    intrinsics = np.array([[n_pixels, 0, n_pixels / 2], [0, n_pixels, n_pixels / 2], [0, 0, 1]], np.float64)
    rgb = np.zeros((n_pixels, n_pixels, 3), np.uint8)
    return Frame(3, 0.1, rgb, depth, np.eye(4), intrinsics)


def on_wall(low: float, high: float, spacing: float, depth: float = 2.0) -> Any:
    line = np.arange(low, high, spacing)
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1).astype(np.float32)


def test_photo_shows_prediction_as_area_and_ground_truth_as_line() -> None:
    frame, small = plane_seen(), on_wall(-0.3, 0.3, 0.02)
    area = error_photo(frame, ErrorView((small,), ()))
    line = error_photo(frame, ErrorView((), (small,)))
    assert area is not None
    assert line is not None
    middle = PHOTO[1] // 2, PHOTO[0] // 2
    assert area[middle].tolist() == [int(0.45 * value) for value in PREDICTED]
    assert line[middle].tolist() == [0, 0, 0]
    assert (line[:, :, 2] == 255).any()


@pytest.fixture(scope="module")
def browser(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with Chromium(tmp_path_factory.mktemp("profile")) as found:
        found.open(page)
        found.until(WHOLE)
        found.until("document.querySelectorAll('#gallery .card').length > 0")
        yield found


@pytest.fixture
def reopened(browser: Chromium) -> Iterator[Chromium]:
    """The gallery without filters, masks sorted by AP."""
    choose(browser, "gallery", "Protocol", "rooms-instance")
    browser.run("document.querySelector('#gallery .toolbar > button:last-of-type').click()")
    choose(browser, "gallery", "Metric", "AP")
    yield browser
    assert [line for line in browser.faults() if "GL" not in line] == []


@needs_chromium
@pytest.mark.parametrize("kind", ["missed", "label"])
def test_card_links_to_its_instance_in_the_map_and_back(reopened: Chromium, page: Path, kind: str) -> None:
    choose(reopened, "gallery", "Protocol", "rooms-semantic" if kind == "label" else "rooms-instance")
    choose(reopened, "gallery", "Kind", kind)
    result = next(card for card in cards(page.read_text()) if card["kind"] == kind)
    reopened.run("document.querySelector('#gallery .card .to-map').scrollIntoView({ block: 'center' })")
    before = reopened.run("scrollY")
    reopened.run("document.querySelector('#gallery .card .to-map').focus()")
    reopened.press("Enter")
    heading = "document.querySelector('#maps .detail h3')"
    reopened.until(f"{heading} !== null && !document.querySelector('#maps .panes[aria-busy]')")
    reopened.until("Math.abs(document.getElementById('maps').getBoundingClientRect().top) < 200")
    shown = {
        name: reopened.run(f"{SELECT.format(part='maps', label=name)}.selectedOptions[0].text")
        for name in ("Scene", "Map", "Compare with")
    }
    assert shown == {"Scene": result["scene"], "Map": result["method"], "Compare with": "ground truth"}
    colour = reopened.run(f"{SELECT.format(part='maps', label='Colour by')}.value")
    assert colour == ("class" if kind == "label" else "instance")
    told_there = reopened.run("document.querySelector('#maps .detail').innerText")
    assert result["true"][0] in told_there
    if result["rows"]:
        chosen = reopened.run("document.querySelector('#maps .side tr[aria-selected=true]').innerText")
        assert chosen.split()[0] == reopened.run(f"{heading}.innerText")
    else:
        assert reopened.run(f"{heading}.innerText") == f"Ground truth: {result['true'][0]}"
    reopened.run("history.back()")
    reopened.until("!location.hash.startsWith('#maps')")
    reopened.until(f"Math.abs(scrollY - {before}) < 5")
