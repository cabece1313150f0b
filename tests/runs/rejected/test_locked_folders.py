"""Runs that are rejected before any work: foreign folders, duplicate names, invalid variants."""

from __future__ import annotations

from pathlib import Path

import pytest
from painted_runs import COLLECTOR, PAINTED, run, words
from places import SCENES

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.runs.plan import named_method

pytestmark = pytest.mark.usefixtures("painted_place")


def test_foreign_folder_is_rejected_and_left_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").mkdir()
    Path("out/.notes.tmp").write_text("theirs")
    assert run() == 2
    assert capsys.readouterr().err == (
        "su3d-bench: out: contains '.notes.tmp' and is not a run folder; choose another with --out\n"
    )
    assert [path.name for path in Path("out").iterdir()] == [".notes.tmp"]


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (["--methods", f"{SCENES}/painted.py:SlashCollector"], "'../elsewhere' is not a valid folder name"),
        (["--methods", COLLECTOR, f"{SCENES}/./painted.py:Collector"], "different ones are named 'collector'"),
        (
            ["--scenes", f"{PAINTED}/a", f"{SCENES}/./painted.py:Painted/b"],
            "two different ones are named 'pai",
        ),
        (["--protocols", "one/mine.toml", "two/mine.toml"], "two different ones are named 'mine'"),
    ],
)
def test_duplicate_or_invalid_names_are_rejected_before_any_work(
    more: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, voxel in (("one", "0.05"), ("two", "0.06")):
        Path(folder).mkdir()
        text = f'extends = "rooms-semantic"\nname = "mine"\n[transfer]\nevaluation_voxel_m = {voxel}\n'
        Path(folder, "mine.toml").write_text(text)
    assert main([*words(), *more]) == 2
    assert line in capsys.readouterr().err
    assert not Path("out").exists()


PAINTED_FILE = f"{SCENES}/painted.py"


def test_preset_sets_the_values_of_the_class() -> None:
    method = named_method("opensu3d@scheme3")
    assert (method.base, method.name) == ("opensu3d", "opensu3d@scheme3")
    assert [(one.path[2:], one.value) for one in method.settings] == [(("scheme",), "scheme3")]


def test_variant_values_are_toml_and_lists_may_contain_commas() -> None:
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
        ("opensu3d@top_m=1,", "expected KEY=VALUE, not ''"),
        ("opensu4d@scheme1", "did you mean 'opensu3d'"),
    ],
)
def test_invalid_variant_is_rejected(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        named_method(text)
