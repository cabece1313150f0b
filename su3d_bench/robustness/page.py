"""The section Robustness of the HTML report: the scores of sweeps, and pictures of one scene at each severity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from su3d_bench.analysis.sweeps import cells_of
from su3d_bench.core.errors import Su3dError, printable, printable_json
from su3d_bench.corruptions.apply import Cell
from su3d_bench.reports.page.maps import jpeg_text
from su3d_bench.reports.pictures.items import fitted
from su3d_bench.robustness.measures import sweep_result
from su3d_bench.robustness.pictures import clean_inputs, tiles
from su3d_bench.robustness.tables import is_of_embedded, sweep_notes
from su3d_bench.runs.finished import FinishedRun, read_run
from su3d_bench.runs.verify import read_checked

PICTURE, JPEG_QUALITY = (160, 120), 60  # width and height


def page_sweeps(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """JSON values of each of ``folders`` that is a sweep: its results by protocol, and pictures of its first scene.

    ``run`` is the index of the folder. What cannot be computed or drawn has a ``reason``.
    """
    found = []
    for index, folder in enumerate(dict.fromkeys(folders)):
        if cells := [cell for own in cells_of(read_run(folder).methods).values() for cell in own]:
            run = read_checked(folder)
            found.append({"run": index, "n_cells": len(cells), **_results(run), **_conditions(run, cells)})
    return found


def _results(run: FinishedRun) -> dict[str, Any]:
    results = []
    try:
        for protocol in run.protocols:
            if any(run.results[method, protocol].result for method in run.methods):
                result = sweep_result(run, protocol, run.rules(protocol).headline[0])
                results.append({**result.to_json(), "notes": sweep_notes(result, of_embedded=is_of_embedded(run))})
    except Su3dError as error:
        return {"results": [], "reason": printable(str(error), 400)}
    return {"results": printable_json(results), "reason": None}


def _conditions(run: FinishedRun, cells: Sequence[Cell]) -> dict[str, Any]:
    """Each condition with its corruption and highest severity, each corruption with its pictures."""
    conditions = {
        cell.suffix[1:]: (cell.corruption, max(condition.severity for condition in cell.conditions)) for cell in cells
    }
    corruptions: dict[str, dict[str, Any]] = {}
    inputs, reason = None, None
    try:
        inputs = clean_inputs(run.dataset(run.scenes[0]), run.scenes[0].partition("/")[2], None)
    except Su3dError as error:
        reason = printable(str(error), 400)
    for cell in cells:
        own = [condition.corruption for condition in cell.conditions]
        about: dict[str, Any] = {"family": cell.family, "unit": " + ".join(one.unit for one in own), "pictures": []}
        if cell.corruption in corruptions:
            continue
        corruptions[cell.corruption] = about
        if inputs is not None and len(own) == 1:
            severities = sorted({0.0, *(severity for name, severity in conditions.values() if name == cell.corruption)})
            drawn = tiles(own[0], inputs, severities)
            about["pictures"] = [
                [title.removeprefix(f"{cell.corruption} "), jpeg_text(fitted(picture, PICTURE), JPEG_QUALITY)]
                for title, picture in drawn.items()
            ]
    return {
        "conditions": conditions,
        "corruptions": corruptions,
        "scene": printable(run.scenes[0], 200),
        "no_pictures": reason,
    }
