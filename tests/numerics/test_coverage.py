"""The coverage of intervals in docs/numbers/statistics.md, and the simulation behind it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from benchmark_programs import benchmark_program
from places import ROOT

coverage = benchmark_program("coverage_of_intervals")

PAGE = (ROOT / "docs" / "numbers" / "statistics.md").read_text(encoding="utf-8")


def cells(table: str) -> dict[str, list[str]]:
    rows = [[cell.strip(" *") for cell in line.strip("|").split("|")] for line in table.splitlines()]
    return {name.strip(): values for name, *values in rows if not name.startswith("-")}


def test_page_matches_the_simulation_and_coverage_is_at_least_90_percent() -> None:
    shown = PAGE.partition(coverage.BEGIN)[2].partition(coverage.END)[0]
    n_simulations = int(re.findall(r"(\d+) simulations per cell", shown)[0])
    assert n_simulations >= 2000
    over_scenes = cells(shown.strip().partition("\n\n")[0])
    header = over_scenes.pop("coverage, %")
    assert {"4 scenes", "8 scenes", "20 scenes", "100 scenes"} <= set(header)
    worlds = [name for make in coverage.WORLDS for name in make().names]
    assert set(over_scenes) == {*worlds, *(f"{name}, difference" for name in worlds)}
    values = {name: [float(value) for value in row] for name, row in over_scenes.items()}
    assert min(min(row) for row in values.values()) >= coverage.MIN_COVERAGE
    for name, row in values.items():  # a coverage outside the range is listed with its reason
        missed = [n.removesuffix(" scenes") for n, value in zip(header, row, strict=True) if not 93 <= value <= 97]
        assert not missed or f"- {name} at {', '.join(missed)} scenes: " in shown


@pytest.mark.proof
def test_intervals_of_few_scenes_have_coverage_where_bootstrap_fails() -> None:
    world = coverage.Shares()
    tally = coverage.simulate(world, world.truth(np.random.default_rng(0)), 4, 400, 0)["correct answers"]
    assert 89 < (tally.per_cent(coverage.JACKKNIFE) or 0) < 98  # 93 of the page, within 3 standard errors
    assert (tally.per_cent(coverage.BOOTSTRAP) or 100) < 88
