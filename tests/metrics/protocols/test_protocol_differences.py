"""The rules in which protocols differ."""

from __future__ import annotations

from pathlib import Path

import pytest

from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols.differences import differing
from su3d_bench.metrics.protocols.loading import load_protocol


def test_names_and_versions_are_no_differences(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    lines = ['extends = "rooms-instance"', 'name = "mine"', "version = 7", "min_region_size = 7", "[transfer]"]
    path.write_text("\n".join([*lines, "cap_m = 0.5"]))
    rules = load_protocol("rooms-instance")
    found = {one.rule: (one.first, one.second) for one in differing(rules, load_protocol(str(path)))}
    assert found == {"min_region_size": (rules.min_region_size, 7), "transfer.cap_m": (rules.transfer.cap_m, 0.5)}
    assert differing(rules, rules) == []


def test_protocols_of_two_kinds_give_one_line() -> None:
    with pytest.raises(ConfigError, match="rooms-semantic is of kind 'semantic' and rooms-instance of kind"):
        differing(load_protocol("rooms-semantic"), load_protocol("rooms-instance"))
