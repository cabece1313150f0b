"""Variants of a method in one run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from painted import colour_perception
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.runs import scene as scene_run
from su3d_bench.runs.plan import named_method

PAINTED = f"{SCENES}/painted.py"


def test_a_preset_sets_what_the_class_says() -> None:
    method = named_method("opensu3d@scheme3")
    assert (method.base, method.name) == ("opensu3d", "opensu3d@scheme3")
    assert [(one.path[2:], one.value) for one in method.settings] == [(("scheme",), "scheme3")]


def test_values_are_toml_and_lists_may_hold_commas() -> None:
    method = named_method("opensu3d@top_m=1,crop_ratios=[0.8, 1, 1.2],overlap_rule=as-printed")
    assert {one.path[2]: one.value for one in method.settings} == {
        "top_m": 1,
        "crop_ratios": [0.8, 1, 1.2],
        "overlap_rule": "as-printed",
    }
    assert " " not in method.name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("opensu3d@schema4", "did you mean 'scheme4'"),
        ("sam3d@x", "sam3d has no preset 'x'"),
        ("opensu3d@", "expected METHOD@PRESET or METHOD@KEY=VALUE"),
        ("opensu3d@a=../b", "expected METHOD@PRESET"),
        ("opensu3d@top_m=1,", "'' is no KEY=VALUE"),
        ("opensu4d@scheme1", "did you mean 'opensu3d'"),
    ],
)
def test_a_wrong_variant_is_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        named_method(text)


def test_variants_stand_side_by_side_and_run_toml_repeats_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scene_run, "build_perception", colour_perception)
    method = f"{PAINTED}:Collector"
    words = ["run", "--scenes", f"{PAINTED}:Painted/a", "--protocols", "rooms-semantic", "--no-pictures", "--jobs", "1"]
    out = tmp_path / "out"
    assert main([*words, "--methods", method, f"{method}@stride=2", "--out", str(out)]) == 0
    results = json.loads((out / "metrics.json").read_text())["results"]
    assert [one["method"] for one in results] == ["collector", "collector@stride=2"]
    n_updates = [len((out / "scenes/painted.a" / one["method"] / "updates.csv").read_text().split()) for one in results]
    assert n_updates[0] == 2 * n_updates[1] - 1
    before = (out / "metrics.json").read_bytes()
    assert main(["run", "--config", str(out / "run.toml"), "--out", str(out)]) == 0
    assert (out / "metrics.json").read_bytes() == before
