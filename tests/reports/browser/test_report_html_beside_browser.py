"""The maps of the page in a real browser: two views side by side, names, missed objects, walls, growth, links."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import chromium
import numpy as np
import pytest
from chromium import Chromium, find_chromium
from painted import Painted, WordEncoder, colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.maps import Instances
from su3d_bench.runs import finished as finished_run
from su3d_bench.runs import scene as scene_run
from su3d_bench.store.predictions import read_prediction, write_prediction

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="needs Chromium")
PAINTED = f"{SCENES}/painted.py"
# WebGL without a graphics card.
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
WHOLE = "!document.querySelector('#main[aria-busy]')"
FIELD = (
    "[...document.querySelectorAll('#maps .toolbar .field')].find((one) => one.textContent.trim().startsWith({label}))"
    ".querySelector('select, input')"
)
READ = (
    "document.querySelectorAll('#maps .side tbody tr').length > 0 && document.querySelector('#maps .say').hidden"
    " && document.querySelector('#maps canvas').getAttribute('aria-label').includes({text})"
)
KINDS = ["colour", "instance", "class", "true class", "error against the truth", "similarity to a text"]


def room(*, without: tuple[str, ...] = ()) -> Instances:
    """A room of 4 x 3 x 2.4 m with its floor, four walls, a table in the middle and a picture on the wall at x = 4."""

    def plane(low: tuple[float, ...], high: tuple[float, ...]) -> Any:
        steps = [np.arange(a, b + 1e-6, 0.02) if b > a else np.array([a]) for a, b in zip(low, high, strict=True)]
        return np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)

    walls = [((0, 0, 0), (0, 3, 2.4)), ((4, 0, 0), (4, 3, 2.4)), ((0, 0, 0), (4, 0, 2.4)), ((0, 3, 0), (4, 3, 2.4))]
    parts = {
        "floor": plane((0, 0, 0), (4, 3, 0)),
        **{f"side {k}": plane(*wall) for k, wall in enumerate(walls)},
        "table": np.concatenate([plane((1.5, 1, 0.7), (2.5, 2, 0.7)), plane((2, 1.5, 0), (2, 1.5, 0.7))]),
        "picture": plane((3.96, 1, 1.2), (3.96, 2, 1.8)),
    }
    parts = {name: points for name, points in parts.items() if name not in without}
    ends = np.cumsum([0, *(len(points) for points in parts.values())])
    return Instances.of(
        np.concatenate(list(parts.values())).astype(np.float32),
        [np.arange(a, b) for a, b in pairwise(ends)],
        scores=np.linspace(0.5, 1, len(parts)),
        features=WordEncoder().encode_texts(list(parts)),
        names=list(parts),
        views=[[(k // 2, 0)] for k in range(len(parts))],
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on two scenes; of the first map of scene a the chair is missed, scene b is a room."""
    folder = tmp_path_factory.mktemp("maps")
    scenes = [f"{PAINTED}:Painted/a", f"{PAINTED}:Painted/b"]
    methods = [f"{PAINTED}:Collector", f"{PAINTED}:Collector@noise_m=0.3"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_run, "build_perception", colour_perception)
        patch.setattr(finished_run, "encoder_of", lambda folder, device="cpu": WordEncoder())
        words = ["--scenes", *scenes, "--methods", *methods, "--protocols", "rooms-semantic", "rooms-instance"]
        assert main(["run", *words, "--jobs", "1", "--no-pictures", "--out", str(folder / "run")]) == 0
        write_prediction(folder / "run" / "scenes" / "painted.b" / "collector" / "prediction.npz", room())
        place = folder / "run" / "scenes" / "painted.a" / "collector" / "prediction.npz"
        stored = read_prediction(place)
        assert isinstance(stored, Instances)
        kept = [k for k in range(len(stored)) if stored.names[k] != "chair"]
        views = [stored.views[stored.view_indptr[k] : stored.view_indptr[k + 1]].tolist() for k in kept]
        views[0] = [view for view in views[0] if view[0] >= 3]  # the sofa comes late
        assert stored.features is not None
        named = [stored.names[k] for k in kept]
        masks = [stored.mask(k) for k in kept]
        write_prediction(
            place, Instances.of(stored.points, masks, names=named, features=stored.features[kept], views=views)
        )
        out = [
            "--out",
            str(folder / "page.html"),
            "--quiet",
            "--jobs",
            "1",
            "--no-errors",
            "--queries",
            "chair",
            "table",
        ]
        assert main(["report", "html", str(folder / "run"), *out]) == 0
    return folder / "page.html"


@pytest.fixture(scope="module")
def browser(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chromium, "FLAGS", (*chromium.FLAGS, *SOFTWARE_GL))
        with Chromium(tmp_path_factory.mktemp("profile")) as found:
            found.open(page)
            yield found


@pytest.fixture(autouse=True)
def fresh(browser: Chromium, page: Path) -> Iterator[None]:
    """Each test begins with the page as it opens, and no test makes it complain."""
    browser.run("history.replaceState(null, '', location.pathname)")
    browser.open(page)
    browser.until(WHOLE)
    yield
    assert [line for line in browser.faults() if "GL Driver Message (OpenGL, Performance" not in line] == []


def field(label: str) -> str:
    return FIELD.format(label=json.dumps(label))


def opened(browser: Chromium, text: str = "painted/a by") -> None:
    browser.run("document.getElementById('maps').scrollIntoView()")
    browser.until(READ.format(text=json.dumps(text)))


def settled(browser: Chromium) -> None:
    """Until an address that was given has been followed."""
    browser.run("new Promise((done) => setTimeout(done, 100))")
    browser.until("!document.querySelector('#maps .panes[aria-busy]')")


def choose(browser: Chromium, label: str, text: str) -> None:
    browser.run(
        f"{{ const one = {field(label)}; one.value = [...one.options].find((o) => o.text === {json.dumps(text)}).value;"
        " one.dispatchEvent(new Event('change')); }"
    )


def slide(browser: Chromium, label: str, value: int) -> None:
    browser.run(f"{{ const one = {field(label)}; one.value = '{value}'; one.dispatchEvent(new Event('input')); }}")


def choices(browser: Chromium, label: str) -> list[str]:
    found: list[str] = browser.run(f"[...{field(label)}.options].map((one) => one.text)")
    return found


def picture(browser: Chromium, k: int = 0) -> bytes:
    """What the view ``k`` shows, after it was drawn."""
    browser.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 60))))")
    box = browser.run(
        f"(() => {{ const c = document.querySelectorAll('#maps canvas')[{k}].getBoundingClientRect(); return {{"
        " x: c.x + scrollX, y: c.y + scrollY + 40, width: c.width - 140, height: c.height - 100, scale: 1 }; })()"
    )
    shot = browser.call("Page.captureScreenshot", {"format": "png", "clip": box, "captureBeyondViewport": False})
    return base64.b64decode(shot["data"])


def press(browser: Chromium, *keys: str, k: int = 0) -> None:
    browser.run(f"document.querySelectorAll('#maps canvas')[{k}].focus()")
    browser.press(*keys)


def hovered(browser: Chromium, k: int = 0, *, kind: str = "mouseMoved", x: float = 0.5, y: float = 0.5) -> None:
    """The pointer goes to a place of the view ``k``."""
    box = browser.run(
        f"(() => {{ const c = document.querySelectorAll('#maps canvas')[{k}]; c.scrollIntoView({{ block: 'center' }});"
        " const b = c.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()"
    )
    place = {"x": box[0] + x * box[2], "y": box[1] + y * box[3]}
    if kind == "tap":
        browser.call("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [place]})
        browser.call("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    else:
        browser.call("Input.dispatchMouseEvent", {"type": kind, "button": "none", "buttons": 0, **place})


def name_at(browser: Chromium, k: int = 0) -> str:
    name = f"document.querySelectorAll('#maps .stage')[{k}].querySelector('.name')"
    browser.until(f"!{name}.hidden")
    return str(browser.run(f"{name}.innerText"))


def test_the_truth_or_another_map_stands_beside_and_moves_with_the_first(browser: Chromium) -> None:
    opened(browser)
    assert choices(browser, "Beside") == ["nothing", "truth", "collector@noise_m=0.3"]
    assert browser.run("document.querySelectorAll('#maps .pane')[1].hidden")
    for text in ("truth", "collector@noise_m=0.3"):
        choose(browser, "Beside", text)
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
    choose(browser, "Beside", "nothing")
    browser.until("document.querySelectorAll('#maps .pane')[1].hidden")


def test_the_truth_beside_is_coloured_as_far_as_it_can_be(browser: Chromium) -> None:
    opened(browser)
    choose(browser, "Beside", "truth")
    legend = "document.querySelectorAll('#maps .legend')[1].innerText"
    said = {}
    for kind in KINDS:
        choose(browser, "Colour by", kind)
        browser.until("document.querySelectorAll('#maps .legend')[1].innerText.trim()")
        said[kind] = browser.run(legend)
    assert said["class"] == said["true class"] == said["similarity to a text"]
    assert "chair" in said["class"]
    assert said["error against the truth"].split("\n") == ["missed (1)", "not missed (2)", "not counted (1)"]
    assert "4 instances" in said["instance"]


def test_the_pointer_and_a_tap_tell_names_and_the_truth_tells_classes(browser: Chromium) -> None:
    opened(browser)
    choose(browser, "Scene", "painted/b")
    browser.until(READ.format(text=json.dumps("painted/b by")))
    hovered(browser, y=0.55)
    assert name_at(browser).split("\n")[0] == "table"
    assert "score 0.9" in name_at(browser)
    hovered(browser, x=0.02, y=0.98)
    browser.until("document.querySelector('#maps .name').hidden")
    hovered(browser, kind="tap", y=0.55)
    assert "table" in name_at(browser)
    browser.until("document.querySelector('#maps .detail h3')?.innerText === 'table'")
    choose(browser, "Scene", "painted/a")
    browser.until(READ.format(text=json.dumps("painted/a by")))
    choose(browser, "Beside", "truth")
    browser.until("!document.querySelectorAll('#maps .pane')[1].hidden")
    press(browser, "Enter", k=1)
    browser.until("document.querySelector('#maps .detail h3')?.innerText.startsWith('Truth: ')")
    title = browser.run("document.querySelector('#maps .detail h3').innerText").removeprefix("Truth: ")
    assert title in {"chair", "sofa", "table", "wall"}
    assert name_at(browser, 1).split("\n")[0] == title
    assert "In this map (rooms-instance)" in browser.run("document.querySelector('#maps .detail').innerText")


def test_the_legend_names_instances_and_marks_the_chosen_one(browser: Chromium) -> None:
    opened(browser)
    choose(browser, "Colour by", "instance")
    entries = browser.run("[...document.querySelector('#maps .legend').children].map((one) => one.innerText)")
    assert entries[0] == "3 instances; 3 of them are objects of the truth, in its colour"
    assert sorted(entries[1:]) == ["sofa", "table", "wall"]
    press(browser, "n")
    chosen = browser.run("document.querySelector('#maps .legend [aria-current]').innerText")
    assert chosen == browser.run("document.querySelector('#maps .detail h3').innerText")
    press(browser, "Escape")
    assert browser.run("document.querySelector('#maps .legend [aria-current]') === null")


def test_an_object_has_one_colour_in_the_map_and_in_the_truth(browser: Chromium) -> None:
    opened(browser)
    choose(browser, "Beside", "truth")
    choose(browser, "Colour by", "instance")
    browser.until("document.querySelectorAll('#maps .legend')[1].innerText.includes('chair')")
    entries = "[...document.querySelectorAll('#maps .legend')[{k}].querySelectorAll('[data-instance]')]"
    tint = "[one.innerText, one.querySelector('.swatch').style.backgroundColor]"
    found = [
        dict(browser.run(f"{entries.format(k=k)}.map((one) => {tint})")) for k in range(2)
    ]  # by name, which are all different here
    same = sorted(name for name in found[0] if name in found[1] and found[0][name] == found[1][name])
    assert same == ["sofa", "table", "wall"]  # the wall is pale whatever it is
    assert found[1]["chair"] not in found[0].values()  # it is missed: no other object has its colour


def test_the_number_of_an_object_in_an_address_is_that_of_the_truth(browser: Chromium) -> None:
    opened(browser)
    values = {"scene": "painted/a", "map": "collector", "beside": "truth", "colour": "instance"}
    asked_for(browser, **values, object="1")
    heading = "document.querySelector('#maps .detail h3')"
    browser.until(f"{heading} !== null")
    assert browser.run(f"{heading}.innerText") == "Truth: chair"
    chosen = "document.querySelectorAll('#maps .legend')[1].querySelector('[aria-current]')"
    assert browser.run(f"{chosen}.innerText") == "chair"
    browser.until("location.hash.includes('object=1')")
    asked_for(browser, **values, object="77")
    browser.until(f"{heading} === null")
    assert browser.run(chosen) is None


def test_missed_objects_are_ghosts_that_can_be_taken_away(browser: Chromium) -> None:
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


def asked_for(browser: Chromium, **values: str) -> None:
    """Somebody puts this into the address."""
    browser.run(f"location.hash = '#maps?' + new URLSearchParams({json.dumps(values)})")
    settled(browser)


def test_a_ghost_tells_what_is_missed(browser: Chromium) -> None:
    opened(browser)
    truth = Painted(Path(), Painted.Options()).ground_truth("a", "mesh-vertices")
    chair = "_".join(f"{value:.3f}" for value in truth.points[truth.instance == 1].mean(axis=0))
    asked_for(browser, scene="painted/a", map="collector", cut="100", camera=f"0.5_1.2_0.5_{chair}")
    name = "document.querySelector('#maps .name')"
    for x, y in [(0.5 + 0.02 * i, 0.5 + 0.02 * j) for i in range(4) for j in range(4)]:
        hovered(browser, x=x, y=y)
        browser.run("new Promise((done) => setTimeout(done, 300))")
        if not browser.run(f"{name}.hidden"):
            break
    assert name_at(browser) == "chair\nmissed by this map"


@pytest.mark.parametrize(("side", "wall"), [(0, "side 1"), (1, "side 3"), (2, "side 0"), (3, "side 2")])
def test_the_wall_towards_the_eye_fades_wherever_the_eye_is(browser: Chromium, side: int, wall: str) -> None:
    opened(browser)
    camera = f"{side * np.pi / 2:.3f}_0.25_7_2_1.5_0.9"
    found = {}
    for walls in ("yes", "no"):
        asked_for(browser, scene="painted/b", map="collector", cut="100", walls=walls, camera=camera, colour="instance")
        assert browser.run(f"{field('Near walls fade')}.checked") == (walls == "yes")
        assert browser.run("document.querySelector('#maps .detail h3') === null")
        press(browser, "Enter")
        browser.until("document.querySelector('#maps .detail h3') !== null")
        found[walls] = browser.run("document.querySelector('#maps .detail h3').innerText")
    assert found["no"] == wall
    assert found["yes"] != wall


def test_growth_shows_the_instances_that_frames_had_shown_by_then(browser: Chromium) -> None:
    opened(browser)
    note = "document.querySelector('#maps [role=status].keys').innerText"
    assert browser.run(note).startswith("Update 6 of 6, frame 5: 3 of 3 instances seen; the method held 4.")
    assert "what was merged into others or dropped on the way is not kept" in browser.run(note)
    whole = picture(browser)
    slide(browser, "Grown to", 2)
    assert browser.run(note).startswith("Update 3 of 6, frame 2: 2 of 3 instances seen")
    early = picture(browser)
    assert early != whole
    slide(browser, "Grown to", 3)
    assert browser.run(note).startswith("Update 4 of 6, frame 3: 3 of 3 instances seen")
    assert picture(browser) == whole
    assert browser.run(f"{field('Grown to')}.getAttribute('aria-valuetext')").startswith("Update 4 of 6")


def address(browser: Chromium) -> str:
    browser.run("new Promise((done) => setTimeout(done, 500))")
    return str(browser.run("location.hash"))


def test_the_address_follows_what_is_changed_and_brings_it_back(browser: Chromium, page: Path) -> None:
    opened(browser)
    assert address(browser) == ""  # nobody has changed anything
    n_steps = browser.run("history.length")
    choose(browser, "Beside", "truth")
    browser.until("!document.querySelectorAll('#maps .pane')[1].hidden")
    choose(browser, "Colour by", "class")
    slide(browser, "Cut above", 90)
    slide(browser, "Grown to", 2)
    press(browser, "n", "ArrowLeft", "+")
    browser.run(f"{field('Near walls fade')}.click()")
    link = address(browser)
    assert browser.run("history.length") == n_steps
    shown = "document.querySelector('#maps .detail h3').innerText"
    chosen = browser.run(shown)
    browser.run("history.replaceState(null, '', location.pathname)")
    browser.open(page)
    browser.run(f"history.replaceState(null, '', {json.dumps(link)})")
    browser.reload("document.querySelector('#maps .detail h3') !== null")
    browser.until("!document.querySelectorAll('#maps .pane')[1].hidden")
    browser.until(READ.format(text=json.dumps("painted/a by")))
    assert browser.run(shown) == chosen
    assert browser.run(f"{field('Colour by')}.value") == "class"
    assert browser.run(f"{field('Cut above')}.value") == "90"
    assert browser.run(f"{field('Grown to')}.value") == "2"
    assert not browser.run(f"{field('Near walls fade')}.checked")
    assert browser.run("Math.abs(document.getElementById('maps').getBoundingClientRect().top) < 200")
    press(browser, "n", "p")
    assert address(browser) == link
    press(browser, "Escape")
    assert "instance" not in address(browser)


HOSTILE = [
    "#maps?scene=painted/a&map=collector&camera=NaN_0_0_0_0_0",
    "#maps?scene=painted/a&map=collector&camera=1e999_1_1_1_1_1&cut=1e9&instance=-1&frame=x&text=9",
    "#maps?scene=painted/a&map=collector&camera=_____&instance=65535&colour=constructor&beside=__proto__",
    "#maps?scene=painted/a&map=collector&beside=map:__proto__&walls=__proto__&missed=toString",
    "#maps?scene=__proto__&map=constructor",
    "#maps?scene=painted/a&map=%3Cimg%20src=x%20onerror=window.struck=1%3E",
    "#maps?scene=painted/a&map=collector&text=%3Cscript%3Ewindow.struck=1%3C/script%3E&" + "a" * 5000,
    "#maps?%E0%A4%A",
    "#%00%ff",
]


@pytest.mark.parametrize("link", HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_address_does_nothing(browser: Chromium, page: Path, link: str) -> None:
    opened(browser)
    plain = picture(browser)
    given = json.dumps(link)
    for in_place in (True, False):
        if in_place:
            browser.run(f"location.hash = {given}; 0")
        else:
            browser.run(f"history.replaceState(null, '', {given})")
            browser.reload(WHOLE)
            opened(browser)
        settled(browser)
        assert browser.run("window.struck === undefined")
        assert browser.run("document.querySelector('#maps .detail h3') === null")
        browser.run("document.getElementById('maps').scrollIntoView()")
        assert picture(browser) == plain


def test_on_a_phone_the_two_views_stand_one_below_the_other(page: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chromium, "FLAGS", (*chromium.FLAGS, *SOFTWARE_GL))
        with Chromium(tmp_path / "phone", width=390, height=844, is_phone=True) as phone:
            phone.open(page)
            phone.until(WHOLE)
            opened(phone)
            choose(phone, "Beside", "truth")
            phone.until("!document.querySelectorAll('#maps .pane')[1].hidden")
            boxes = phone.run(
                "[...document.querySelectorAll('#maps canvas')].map((one) => one.getBoundingClientRect())"
                ".map((box) => [box.left, box.top, box.width, box.bottom])"
            )
            assert boxes[0][0] == boxes[1][0]
            assert boxes[1][1] > boxes[0][3]
            assert boxes[0][2] > 300
            assert phone.run("document.documentElement.scrollWidth <= innerWidth")
