"""The coverage of intervals in docs/numbers/interval-coverage.md, and the simulation behind it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from benchmark_programs import benchmark_program
from places import ROOT

from su3d_bench import load_protocol
from su3d_bench.numerics.statistics import ALPHA, sign_flip_test

coverage = benchmark_program("coverage_of_intervals")

PAGE = (ROOT / "docs" / "numbers" / "interval-coverage.md").read_text(encoding="utf-8")


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
    assert set(over_scenes) == {name for make in coverage.WORLDS for name in make().names}
    values = {name: [float(value) for value in row] for name, row in over_scenes.items()}
    assert min(min(row) for row in values.values()) >= coverage.MIN_COVERAGE
    for name, row in values.items():  # a coverage outside the range is listed with its reason
        missed = [n.removesuffix(" scenes") for n, value in zip(header, row, strict=True) if not 93 <= value <= 97]
        assert not missed or f"- {name} at {', '.join(missed)} scenes: " in shown
    rare = cells(shown.partition("AP of 48 classes")[2].partition("\n\n")[2].partition("\n\n")[0])
    for kind, words in ((", S scenes", "at least"), ("very many scenes", "only")):
        lowest = min(float(value) for name, row in rare.items() if name.endswith(kind) for value in row)
        assert f"in {words} {int(lowest)} %" in " ".join(PAGE.split())


def test_simulated_classes_are_those_of_replica() -> None:
    classes = load_protocol("replica-openmask3d").classes
    assert list(benchmark_program("coverage_worlds").REPLICA) == [one.name for one in classes]


@pytest.mark.proof
def test_intervals_have_coverage_of_as_many_scenes_where_bootstrap_fails() -> None:
    world = coverage.AlikeRooms()
    found = coverage.simulate(world, 8, 400, 0)["pooled AP"]
    as_many, many = float(np.mean(found.values)), world.truth(np.random.default_rng(0))["pooled AP"]
    assert found.coverage(coverage.JACKKNIFE, as_many) > 93 > 90 > found.coverage(coverage.PERCENTILE, as_many)
    assert found.coverage(coverage.JACKKNIFE, many) < 90


def test_sign_flip_test_is_exact_only_for_symmetric_differences() -> None:
    for drawn, rejected in zip(coverage.DIFFERENCES.values(), (0.05, 0.10, 0.16), strict=True):
        tests = [sign_flip_test(row) for row in drawn(np.random.default_rng(0), (1500, 8))]
        assert np.mean([test is not None and test.p < ALPHA for test in tests]) == pytest.approx(rejected, abs=0.02)
