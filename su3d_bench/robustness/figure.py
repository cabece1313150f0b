"""The figure of a sweep: the score of every method against the severity, one panel per family."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from su3d_bench.corruptions.model import MAX_SEVERITY
from su3d_bench.reports.pictures.canvas import figure_style, write_figure
from su3d_bench.reports.pictures.plots import figure_with_panels, style_of_line
from su3d_bench.robustness.measures import MethodResult, SweepResult

PANEL_HEIGHT_IN = 2.2


@figure_style()
def draw_sweep(result: SweepResult, path: Path) -> None:
    """Write the figure as the format of ``path``, ``.png`` or ``.pdf``."""
    families = list(dict.fromkeys(family for method in result.methods for family in method.families))
    figure, axes = figure_with_panels("17cm", *[PANEL_HEIGHT_IN] * len(families))
    for family, panel in zip(families, axes, strict=True):
        for index, method in enumerate(result.methods):
            severities, values = _curve(method, family)
            panel.plot(severities, values, label=method.method, markersize=4, **style_of_line(index))
        panel.set_title(family)
        panel.set_xlim(0, MAX_SEVERITY)
        panel.set_ylim(0, 1.05 * 100 * max(method.clean for method in result.methods) or 1)
        panel.set_xlabel("severity")
        panel.set_ylabel(f"{result.metric}, %")
    axes[0].legend(fontsize=7)
    write_figure(figure, path)


def _curve(method: MethodResult, family: str) -> tuple[list[float], list[float]]:
    """The mean value over the corruptions of a family at each severity, from the clean one on, in per cent."""
    values: dict[float, list[float]] = {0.0: [method.clean]}
    for one in method.cells:
        if one.cell.family == family:
            severity = max(condition.severity for condition in one.cell.conditions)
            values.setdefault(severity, []).append(one.difference.right)
    severities = sorted(values)
    return severities, [100 * float(np.mean(values[severity])) for severity in severities]
