from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from su3d_bench.core.types import PerceptionNeeds, SceneInfo
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.reports.tables.formats import markdown
from su3d_bench.reports.tables.run import run_tables
from su3d_bench.runs.job import caveat_of
from su3d_bench.runs.summary import confidences_of
from su3d_bench.store.records import NumbersRecord


def result(method: str = "opensu3d", **more: Any) -> dict[str, Any]:
    scored = {
        "n_scenes": 8,
        "metrics": {"mAcc": 0.40833, "F-mIoU": 0.3124},
        "intervals": {"mAcc": [0.3889, 0.4256], "F-mIoU": None},
        "coverage": {"0.025": 0.009, "0.05": 0.002, "0.1": 0.0},
        "warnings": ["rooms/a: 3 classes have no points", "rooms/b: 3 classes have no points"],
    }
    base = {
        "method": method,
        "protocol": "rooms-semantic",
        "version": 2,
        "headline": ["mAcc", "F-mIoU"],
        "caveat": None,
        "n_planned": 8,
        "failed": [],
        "unscored": [],
        "ceiling": {"mAcc": 0.971, "F-mIoU": 1.0},
        "result": scored,
    }
    return base | more


def table(*results: dict[str, Any], is_partial: bool = False) -> str:
    return markdown(run_tables({"is_partial": is_partial, "limit": 3, "results": list(results)}))


def test_row_shows_value_interval_ceiling_scenes_and_coverage() -> None:
    row = next(line for line in table(result()).splitlines() if "opensu3d" in line)
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells == ["opensu3d", "40.8 [38.9, 42.6]", "31.2", "97.1 / 100.0", "8", "99.1 / 99.8 / 100.0"]


def test_generated_rooms_in_another_datasets_layout_are_labelled() -> None:
    method: Any = SimpleNamespace(needs=PerceptionNeeds(masks="grounded"), caveat=None)
    perception: Any = SimpleNamespace(caveat=None, encoder=SimpleNamespace(name="embedded"))
    scene = SceneInfo("replica", "office0", 1, 1, "rendered-rooms")
    printed = caveat_of(method, perception, scene)
    assert printed == "generated scenes in the layout of replica, not its scenes"
    assert caveat_of(method, perception, replace(scene, image_domain="camera")) is None
    assert caveat_of(method, perception, replace(scene, dataset="rooms")) is None


def numbers(*warned: str) -> NumbersRecord:
    warnings = tuple(
        f"{scene}: all confidences are 1: AP per class is recall x (1 + precision) / 2" for scene in warned
    )
    return NumbersRecord(
        scenes=("d/a", "d/b", "d/c"),
        metrics={},
        intervals={},
        per_scene={},
        per_class={},
        n_predictions={"d/a": 7, "d/b": 4, "d/c": 1},
        warnings=warnings,
    )


def test_source_of_confidences_is_reported() -> None:
    own, ones = load_protocol("rooms-instance"), load_protocol("replica-openmask3d")
    assert confidences_of(load_protocol("rooms-semantic"), numbers()) is None
    assert confidences_of(ones, numbers()) == "1 for every instance, by the protocol"
    assert confidences_of(load_protocol("query-ap"), numbers()) == "similarity to the query, by the protocol"
    assert confidences_of(own, numbers("d/a", "d/b")) == "constant within each scene"
    assert confidences_of(own, numbers("every scene")) == "constant within each scene"
    assert confidences_of(own, numbers("d/a")) == "computed by the method"
