"""Which settings of a finished run are not its methods' own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from su3d_bench.core.config import Setting, Settings
from su3d_bench.runs.finished import FinishedRun, RunData
from su3d_bench.store.run_folder import RunFolder


def run_with(**given: Any) -> FinishedRun:
    """A run of whose folder nothing is read; ``__`` stands between the parts of a path."""
    entries = tuple(Setting(tuple(name.split("__")), value, "run.toml:1") for name, value in given.items())
    record: Any = None
    return FinishedRun(RunFolder(Path("run")), record, {}, {}, 0, RunData(Settings(entries), {}))


def test_settings_that_are_not_the_methods_own_are_named_with_their_values() -> None:
    run = run_with(method__opensu3d__eps=0.05, method__opensu3d__top_m=5, method__opensu3d__border_px=20)
    assert run.changed("opensu3d") == ("eps = 0.05",)


def test_a_stride_of_the_whole_run_is_a_setting_of_each_method_that_has_another() -> None:
    assert run_with(stride=10).changed("opensu3d") == ("stride = 10",)
    assert run_with(stride=40).changed("opensu3d") == run_with(stride=0).changed("opensu3d") == ()


def test_of_a_method_that_is_not_known_here_no_setting_is_named() -> None:
    assert run_with(stride=10, method__mine__x=1).changed("mine") == ()
