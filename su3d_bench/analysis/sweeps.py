"""Sweeps over corruptions: which methods of a run are cells, and the mean change of a score in each family."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from su3d_bench.corruptions.apply import Cell, cell_of
from su3d_bench.runs.finished import FinishedRun


def cells_of(methods: Iterable[str]) -> dict[str, list[Cell]]:
    """The cells of each method that is also clean among ``methods``, in their order."""
    names = dict.fromkeys(methods)
    found = [cell for name in names if (cell := cell_of(name)) is not None and cell.method in names]
    return {method: own for method in names if (own := [cell for cell in found if cell.method == method])}


def without_cells(run: FinishedRun) -> FinishedRun:
    """The run with its clean methods only; the run itself if it is no sweep."""
    cells = {cell.name for own in cells_of(run.methods).values() for cell in own}
    methods = tuple(method for method in run.methods if method not in cells)
    results = {key: result for key, result in run.results.items() if key[0] not in cells}
    unscored = tuple(reason for reason in run.record.unscored if reason.method not in cells)
    return replace(run, record=replace(run.record, methods=methods, unscored=unscored), results=results)


def family_means(values: Mapping[Cell, float]) -> dict[str, float]:
    """The mean of each family over severities, then over corruptions; NaN if a value is.

    >>> cells = [cell_of(f"m~{name}") for name in ("depth-holes-1", "depth-holes-5", "depth-scale-1")]
    >>> family_means(dict(zip(cells, (1.0, 2.0, 0.5))))
    {'depth': 1.0}
    """
    families: dict[str, dict[str, list[float]]] = {}
    for cell, value in values.items():
        families.setdefault(cell.family, {}).setdefault(cell.corruption, []).append(value)
    return {family: float(np.mean([np.mean(one) for one in own.values()])) for family, own in families.items()}
