"""What a sweep shows: drops with paired intervals, means over families, and the summary values of Robo3D.

The drop of a condition is the clean value minus the value under it, in points; intervals are jackknife intervals over
scenes of the difference, tests are exact sign-flip tests with Holm's correction over the conditions of a family.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from su3d_bench.analysis.comparison import Difference, difference_of
from su3d_bench.analysis.sides import Numbers, Side, SideNumbers, headline_numbers
from su3d_bench.analysis.sweeps import cells_of
from su3d_bench.core.errors import ConfigError
from su3d_bench.corruptions.apply import Cell
from su3d_bench.metrics.scoring import plain_json
from su3d_bench.numerics.statistics import holm
from su3d_bench.runs.finished import FinishedRun


@dataclass(frozen=True)
class CellResult:
    """The value of a method under a condition; ``drop`` is the negative of its ``difference``."""

    cell: Cell
    difference: Difference

    @property
    def drop(self) -> float:
        return -self.difference.difference


@dataclass(frozen=True)
class MethodResult:
    """A method of a sweep: its clean value, its cells, and the mean difference of each family.

    ``families`` means over severities, then over corruptions; ``mean`` over families. ``mce`` is the mean corruption
    error relative to the baseline's, ``resilience`` the mean share of the clean value that is kept, both as Robo3D
    (Kong et al., ICCV 2023) defines them; None if undefined.
    """

    method: str
    clean: float
    cells: tuple[CellResult, ...]
    families: Mapping[str, Difference]
    mean: Difference
    mce: float | None
    resilience: float | None


@dataclass(frozen=True)
class SweepResult:
    """All methods of a sweep under one metric of a protocol; ``baseline`` is the one of ``mce``."""

    protocol: str
    metric: str
    scenes: tuple[str, ...]
    baseline: str
    methods: tuple[MethodResult, ...]

    def to_json(self) -> dict[str, Any]:
        """JSON values in full precision, null if undefined."""
        return {
            **plain_json({name: value for name, value in vars(self).items() if name != "methods"}),
            "methods": [_method_json(method) for method in self.methods],
        }


def _method_json(method: MethodResult) -> dict[str, Any]:
    cells = {one.cell.suffix[1:]: _difference_json(one.difference) for one in method.cells}
    families = {family: _difference_json(difference) for family, difference in method.families.items()}
    own: dict[str, Any] = plain_json({**vars(method), "cells": None, "families": None, "mean": None})
    return own | {"cells": cells, "families": families, "mean": _difference_json(method.mean)}


def _difference_json(difference: Difference) -> dict[str, Any]:
    names = ("right", "difference", "interval", "p_of_all")
    found: dict[str, Any] = plain_json({name: getattr(difference, name) for name in names})
    return {"value": found.pop("right"), **found}


def sweep_result(run: FinishedRun, protocol: str, metric: str, baseline: str | None = None) -> SweepResult:
    """The measures of the methods of a finished sweep that have scores under ``protocol``.

    Raises ``ConfigError`` if it has no cells or the baseline is not in it.
    """
    cells = {
        method: own for method, own in cells_of(run.methods).items() if run.results[method, protocol].result is not None
    }
    methods = list(cells)
    if not methods:
        raise ConfigError(f"{run.name}: has no method with and without corruptions; use su3d-bench robustness run")
    baseline = baseline or methods[0]
    if baseline not in methods:
        raise ConfigError(f"--baseline {baseline}: expected one of {', '.join(methods)}")
    names = [*methods, *(cell.name for own in cells.values() for cell in own)]
    found = SideNumbers().over_common(protocol, [Side(run, name) for name in names])
    if not found:
        raise ConfigError(f"{run.name}: the methods have no common scene scored under {protocol}")
    numbers = {name: headline_numbers([one], metric) for name, one in zip(names, found, strict=True)}
    errors = {
        method: {cell.name.removeprefix(method): numbers[cell.name].value for cell in own}
        for method, own in cells.items()
    }
    scenes = tuple(found[0].result.scenes)
    results = [_method_result(method, own, numbers, scenes) for method, own in cells.items()]
    return SweepResult(
        protocol, metric, scenes, baseline,
        tuple(replace(result, mce=_mce(result, errors[baseline])) for result in results),
    )  # fmt: skip


def _method_result(
    method: str, cells: Sequence[Cell], numbers: Mapping[str, Numbers], scenes: Sequence[str]
) -> MethodResult:
    clean = numbers[method]
    of_cells = {cell: difference_of(clean, numbers[cell.name], scenes) for cell in cells}
    of_family: dict[str, list[Numbers]] = {}
    for family, own in _grouped(cells, lambda cell: cell.family):
        of_corruptions = [
            mean_of([numbers[cell.name] for cell in group]) for _, group in _grouped(own, lambda cell: cell.corruption)
        ]
        of_family[family] = of_corruptions
        tests = [of_cells[cell].test for cell in own]
        corrected = holm([None if test is None else test.p for test in tests])
        for cell, p in zip(own, corrected, strict=True):
            of_cells[cell] = replace(of_cells[cell], p_of_all=p)
    means = {family: mean_of(own) for family, own in of_family.items()}
    kept = [own.value / clean.value for all_of in of_family.values() for own in all_of] if clean.value > 0 else []
    return MethodResult(
        method,
        clean.value,
        tuple(CellResult(cell, of_cells[cell]) for cell in cells),
        {family: difference_of(clean, mean, scenes) for family, mean in means.items()},
        difference_of(clean, mean_of(list(means.values())), scenes),
        None,
        float(np.mean(kept)) if kept else None,
    )


def _mce(result: MethodResult, of_baseline: Mapping[str, float]) -> float | None:
    """Mean over corruptions of the error summed over severities, relative to that of the baseline."""
    ratios = []
    for _, group in _grouped(result.cells, lambda one: one.cell.corruption):
        own = sum(1 - one.difference.right for one in group)
        other = sum(1 - of_baseline.get(one.cell.name.removeprefix(result.method), np.nan) for one in group)
        ratios.append(own / other if other > 0 else np.nan)
    mean = float(np.mean(ratios))
    return None if np.isnan(mean) else mean


def mean_of(numbers: Sequence[Numbers]) -> Numbers:
    """The mean of values over the same scenes."""
    return Numbers(
        float(np.mean([one.value for one in numbers])),
        np.mean([one.of_scenes for one in numbers], axis=0),
        np.mean([one.without_each for one in numbers], axis=0),
        None,
    )


Item = TypeVar("Item")


def _grouped(items: Iterable[Item], key: Callable[[Item], str]) -> list[tuple[str, list[Item]]]:
    """The items by key, in the order of the first of each."""
    groups: dict[str, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return list(groups.items())
