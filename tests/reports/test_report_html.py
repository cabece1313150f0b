"""The HTML report: its numbers and maps, and that no text of a run is markup."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packed_maps import unpacked
from painted import Painted, WordEncoder
from painted_runs import COLLECTOR, painted_page, painted_run

from su3d_bench.analysis.page.scene import same_objects
from su3d_bench.core.maps import DenseFeatures, Instances, Masks
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.core.version import __version__
from su3d_bench.reports.page.maps import (
    NO_GROUND_TRUTH_NEAR,
    NOT_SCORED,
)
from su3d_bench.reports.page.page import page_html
from su3d_bench.store.predictions import read_prediction, write_prediction

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(1)>&\"'<!--"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    methods = (COLLECTOR, f"{COLLECTOR}@noise_m=0.3")
    return painted_run(tmp_path_factory.mktemp("page") / "run", "--anytime", "0.5", "--seen-so-far", methods=methods)


@pytest.fixture(scope="module")
def page(run: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    return painted_page(run, tmp_path_factory.mktemp("page") / "page.html")


class Elements(HTMLParser):
    """Collects the elements of a page and the content of its scripts by id."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.content: dict[str, str] = {}
        self._open: str | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        self._open = dict(attrs).get("id") or tag if tag in ("script", "style", "title") else None

    def handle_endtag(self, tag: str) -> None:
        self._open = None

    def handle_data(self, data: str) -> None:
        if self._open is not None:
            self.content[self._open] = self.content.get(self._open, "") + data


def elements(text: str) -> Elements:
    found = Elements()
    found.feed(text)
    return found


def data_of(text: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(elements(text).content["data"])
    return found


def test_page_has_the_numbers_of_metrics_json(run: Path, page: str) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    found = data_of(page)
    assert [(one["method"], one["protocol"]) for one in found["results"]] == [
        (one["method"], one["protocol"]) for one in metrics["results"]
    ]
    for shown, stored in zip(found["results"], metrics["results"], strict=True):
        for name in ("metrics", "intervals", "per_scene", "per_class", "coverage"):
            assert shown["result"][name] == stored["result"][name]
        assert shown["ceiling"] == stored["ceiling"]
        for curve in ("anytime", "seen"):
            assert [one["metrics"] for one in shown[curve]] == [one["metrics"] for one in stored[curve]]


def test_page_begins_with_its_date_version_and_command(page: str) -> None:
    pattern = r'<p class="made">Created \d{4}-\d\d-\d\d \d\d:\d\d UTC by su3d-bench (\S+)[^:]*: <code>(.*)</code></p>'
    (found,) = re.findall(pattern, page)
    assert found[0] == __version__ and found[1].startswith("su3d-bench report html ")


def test_page_has_confusion_errors_timing_and_comparison_of_every_method(page: str) -> None:
    found = data_of(page)
    methods = found["runs"][0]["methods"]
    assert len(methods) == 2
    assert [one["method"] for one in found["confusions"]] == methods
    assert [one["method"] for one in found["timing"]] == methods
    assert {one["method"] for one in found["costs"]} == set(methods) and found["costs"][0]["saved_mib"] > 0
    assert [(one["method"], one["reason"]) for one in found["errors"]] == [(name, None) for name in methods]
    assert all(len(one["protocols"]) == 2 for one in found["errors"])
    assert [(one["left"], one["right"], one["reason"]) for one in found["comparisons"]] == [
        ([0, methods[0]], [0, methods[1]], None)
    ]
    assert set(found["timing"][0]["series"]) == {"painted/a", "painted/b"}


def test_page_policy_allows_only_embedded_scripts_and_styles(page: str) -> None:
    found = elements(page)
    policy = next(value for name, value in found.attributes if name == "content" and value and "default-src" in value)
    for kind, content in (("script", found.content["script"]), ("style", found.content["style"])):
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    assert [value for name, value in found.attributes if name in ("src", "href")] == ["data:,", "#main"]
    assert not [name for name, _ in found.attributes if name.startswith("on") or name == "style"]
    used = re.sub(r"http://www\.w3\.org/2000/svg", "", found.content["script"] + found.content["style"])
    assert not re.search(r"https?:|//[a-z]+\.|fetch\(|XMLHttpRequest|import\(|innerHTML|outerHTML|eval\(|url\(", used)


def test_hostile_text_of_a_run_is_never_markup() -> None:
    plain = elements(page_html("title", {"name": ""}, [{"name": ""}], ["AAAA"]))
    found = elements(page_html(HOSTILE, {"name": HOSTILE, HOSTILE: 1}, [{"name": HOSTILE}], ["AAAA"], command=HOSTILE))
    assert found.tags == plain.tags
    assert json.loads(found.content["data"]) == {"name": HOSTILE, HOSTILE: 1}
    assert json.loads(found.content["scene-0"]) == {"name": HOSTILE}
    assert found.content["title"] == HOSTILE


def test_packed_map_has_instances_colours_and_ground_truth(run: Path, page: str) -> None:
    found = elements(page)
    listed = data_of(page)["maps"]
    assert [(one["scene"], one["reason"]) for one in listed] == [("painted/a", None)] * 2 + [("painted/b", None)] * 2
    about, planes = unpacked(found.content["map-0"])
    stored = read_prediction(run / "scenes" / "painted.a" / "collector" / "prediction.npz")
    assert isinstance(stored, Instances)
    distance = np.linalg.norm(stored.points[None] - planes["position"][:, None], axis=2)
    assert len(planes["position"]) == about["n"]
    assert distance.min(axis=1).max() < about["step"]  # half a step along each axis
    owner_of = np.full(len(stored.points), -1)
    for k in range(len(stored)):
        owner_of[stored.mask(k)] = k
    assert np.array_equal(planes["owner"], owner_of[distance.argmin(axis=1)])
    assert [one["name"] for one in about["instances"]] == list(stored.names)
    assert [one["points"] for one in about["instances"]] == np.diff(stored.indptr).tolist()
    assert {one["view"] for one in about["instances"]} <= {
        int(frame) for frame in json.loads(found.content["scene-0"])["thumbnails"]
    }
    called = np.array([one["class"] for one in about["instances"]])[planes["owner"]]
    is_scored = planes["truth"] < NOT_SCORED
    assert 0.2 < is_scored.mean() < 1  # walls are not scored
    assert (called == planes["truth"])[is_scored].mean() > 0.9
    assert len(planes["colour"]) == about["n"]


def test_ground_truth_of_a_map_lists_its_objects_and_the_missed_ones(run: Path, tmp_path: Path) -> None:
    changed = tmp_path / "run"
    shutil.copytree(run, changed)
    place = changed / "scenes" / "painted.a" / "collector" / "prediction.npz"
    stored = read_prediction(place)
    assert isinstance(stored, Instances)
    kept = [k for k in range(len(stored)) if stored.names[k] != "chair"]
    fewer = Instances.of(
        stored.points, [stored.mask(k) for k in kept], names=[stored.names[k] for k in kept],
        features=None if stored.features is None else stored.features[kept],
    )  # fmt: skip
    write_prediction(place, fewer)
    found = elements(painted_page(changed, tmp_path / "page.html", "--no-errors"))
    scene = json.loads(found.content["scene-0"])
    assert len(scene["truths"]) == 1
    truth, planes = unpacked(scene["truths"][0])
    assert [one["name"] for one in truth["instances"]] == ["chair", "sofa", "table", "wall"]
    assert [truth["classes"][one["class"]] for one in truth["instances"]] == ["chair", "sofa", "table", "wall"]
    of_dataset = Painted(Path(), Painted.Options()).ground_truth("a", "mesh-vertices")
    distance = np.linalg.norm(of_dataset.points[None] - planes["position"][:, None], axis=2)
    assert distance.min(axis=1).max() < truth["step"]
    nearest_instance = of_dataset.instance[distance.argmin(axis=1)]
    assert (planes["owner"] == nearest_instance - 1).mean() > 0.99
    assert np.array_equal(planes["owner"], planes["class"])  # one object per class, in class order
    about, _ = unpacked(found.content["map-0"])
    assert about["beside"] == {
        "truth": 0, "objects": 4, "protocol": "rooms-instance", "counted": [0, 1, 2], "missed": [0],
    }  # fmt: skip
    named = {one["name"]: one["object"] for one in about["instances"]}
    assert named == {name: {"place": k, "name": name} for k, name in ((1, "sofa"), (2, "table"), (3, "wall"))}
    untouched, _ = unpacked(found.content["map-2"])
    assert untouched["beside"]["missed"] == []


def test_mask_matches_an_object_if_they_share_more_than_half() -> None:
    labels = LabelSet("painted", (5, 9), ("chair", "lamp"))
    instance = np.repeat([0, 40, 7], 10).astype(np.int32)
    semantic = np.repeat([0, 9, 5], 10).astype(np.int32)
    truth = GroundTruth(np.zeros((30, 3), np.float32), semantic, instance, labels, "mesh-vertices", "by hand")
    lump, half, most, twice, nothing = (np.arange(a, b) for a, b in ((10, 30), (10, 15), (9, 20), (20, 26), (0, 0)))
    found = same_objects(truth, Masks.of_sets([lump, half, most, twice, np.arange(20, 30), nothing]))
    lamp, chair = {"place": 1, "name": "lamp"}, {"place": 0, "name": "chair"}
    assert found == {2: lamp, 3: chair, 4: chair}  # half is not more than half


def test_instance_appears_at_the_update_of_its_first_view(run: Path, page: str) -> None:
    about, _ = unpacked(elements(page).content["map-0"])
    stored = read_prediction(run / "scenes" / "painted.a" / "collector" / "prediction.npz")
    assert isinstance(stored, Instances)
    assert about["growth"]["frame"] == list(range(6))
    assert about["growth"]["update"] == list(range(1, 7))
    assert about["growth"]["held"][-1] == len(stored)
    first = [stored.views[stored.view_indptr[k] : stored.view_indptr[k + 1], 0].min() for k in range(len(stored))]
    assert [one["born"] for one in about["instances"]] == first


def test_dense_features_have_one_class_per_point_and_no_instances(run: Path, tmp_path: Path) -> None:
    changed = tmp_path / "run"
    shutil.copytree(run, changed)
    points = np.array([[0, 0, 1], [0, 0, 2], [5, 0, 2], [5, 5, 2]], np.float32)
    rows = WordEncoder().encode_texts(["sofa", "table", "sofa", "sofa"]).astype(np.float16)
    rows[3] = 0
    write_prediction(changed / "scenes" / "painted.a" / "collector" / "prediction.npz", DenseFeatures(points, rows))
    about, planes = unpacked(elements(painted_page(changed, tmp_path / "page.html", "--no-errors")).content["map-0"])
    order = np.argmin(np.linalg.norm(points[None] - planes["position"][:, None], axis=2), axis=1)
    called = ["none" if c == 0xFFFF else about["classes"][c] for c in planes["class"]]
    assert called == [("sofa", "table", "sofa", "none")[k] for k in order]
    assert about["instances"] == []
    assert planes["owner"].tolist() == [0xFFFF] * 4
    assert planes["truth"][order.tolist().index(2)] == NO_GROUND_TRUTH_NEAR
