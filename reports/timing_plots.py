"""What updates cost, as plots that read in black and white: against the map, by stage, and quality against time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from su3d_bench.plain_text import printable
from su3d_bench.reports.timing_tables import AnytimePoint
from su3d_bench.statistics import growth_exponent
from su3d_bench.store import write_bytes
from su3d_bench.types import Float64Array
from su3d_bench.update_times import MAP, UpdateTimes, pooled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours for the colour-blind; marker and dash tell the methods apart where there is no colour.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", ":")
HATCHES = ("", "///", "...", "xxx", "\\\\\\", "+++", "ooo", "---")
MAX_DRAWN = 2000  # points a method; more only make the file large


def draw_timing(
    times: Sequence[Sequence[UpdateTimes]], anytime: Sequence[AnytimePoint], warm_up: int, folder: Path
) -> list[Path]:
    """Write ``update-cost``, ``stages`` and, where maps were scored midway, ``anytime`` as PNG and PDF; their paths."""
    figures = {"update-cost": _update_cost(times, warm_up), "stages": _stages(times, warm_up)}
    if anytime:
        figures["anytime"] = _anytime(anytime)
    return [_save(figure, folder / f"{name}.{kind}") for name, figure in figures.items() for kind in ("png", "pdf")]


def _figure(width: float, height: float, n_axes: int = 1) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, n_axes, squeeze=False)[0]
    return figure, list(axes)


def draw_update_cost(times: Sequence[Sequence[UpdateTimes]], warm_up: int, kind: str) -> bytes:
    """The cost of an update against the points of the map, as a ``png`` or ``pdf`` file."""
    return _rendered(_update_cost(times, warm_up), kind)


def _save(figure: Figure, path: Path) -> Path:
    write_bytes(path, _rendered(figure, path.suffix[1:]))
    return path


def _rendered(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    # Without dates, so that one run gives one file.
    figure.savefig(buffer, format=kind, dpi=150, metadata={"CreationDate": None} if kind == "pdf" else None)
    return buffer.getvalue()


def _label(times: Sequence[UpdateTimes], several_runs: bool) -> str:
    # A dollar sign would start mathematics.
    name = f"{times[0].method} ({times[0].run})" if several_runs else times[0].method
    return printable(name, 60).replace("$", r"\$")


def _several_runs(times: Sequence[Sequence[UpdateTimes]]) -> bool:
    """Whether a method stands there more than once, so that its name alone does not tell it."""
    return len({one[0].method for one in times}) < len(times)


def _update_cost(times: Sequence[Sequence[UpdateTimes]], warm_up: int) -> Figure:
    """Milliseconds of the map's share of an update against the points of the map, both axes logarithmic."""
    figure, (axes,) = _figure(7.0, 4.8)
    for index, of_method in enumerate(times):
        with_points = [one for one in of_method if "n_points" in one.columns]
        sizes = np.concatenate([one.columns["n_points"][warm_up:] for one in with_points] or [np.zeros(0)])
        costs = pooled(with_points, MAP, warm_up)
        usable = (sizes > 0) & (costs > 0)
        if not usable.any():
            continue
        growth = growth_exponent(sizes, costs)
        label = _label(of_method, _several_runs(times))
        if growth is not None:
            label += f": exponent {growth.exponent:.2f} [{growth.low:.2f}, {growth.high:.2f}], {growth.words}"
        _scatter(axes, sizes[usable], costs[usable], index, label)
        if growth is not None:
            _line(axes, sizes[usable], costs[usable], growth.exponent, index)
    axes.set(xscale="log", yscale="log", xlabel="points of the map", ylabel="ms per update, without perception")
    axes.grid(True, which="major", color="0.85", linewidth=0.6)
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower center", fontsize=8, frameon=False)
    return figure


def _scatter(axes: Axes, x: Float64Array, y: Float64Array, index: int, label: str) -> None:
    step = 1 + len(x) // MAX_DRAWN
    style: dict[str, Any] = {"marker": MARKERS[index % len(MARKERS)], "color": COLOURS[index % len(COLOURS)]}
    axes.plot(x[::step], y[::step], linestyle="", markersize=3.5, markerfacecolor="none", label=label, **style)


def _line(axes: Axes, x: Float64Array, y: Float64Array, exponent: float, index: int) -> None:
    ends = np.array([x.min(), x.max()])
    level = np.mean(np.log(y)) - exponent * np.mean(np.log(x))
    style: dict[str, Any] = {"color": COLOURS[index % len(COLOURS)], "linestyle": DASHES[index % len(DASHES)]}
    axes.plot(ends, np.exp(level) * ends**exponent, linewidth=1.2, **style)


def _stages(times: Sequence[Sequence[UpdateTimes]], warm_up: int) -> Figure:
    """The mean update of each method, stacked by stage."""
    figure, (axes,) = _figure(7.0, 1.6 + 0.45 * len(times))
    stages = list(dict.fromkeys(stage for of_method in times for one in of_method for stage in one.stages))
    left = np.zeros(len(times))
    rows = np.arange(len(times))
    for index, stage in enumerate(stages):
        steady = [pooled(of_method, stage, warm_up) for of_method in times]
        widths = np.array([values.mean() if len(values) else 0.0 for values in steady])
        style: dict[str, Any] = {"hatch": HATCHES[index % len(HATCHES)], "color": COLOURS[index % len(COLOURS)]}
        axes.barh(rows, widths, left=left, edgecolor="white", label=stage, **style)
        left += widths
    axes.set_yticks(rows, [_label(of_method, _several_runs(times)) for of_method in times])
    axes.invert_yaxis()
    axes.set_xlabel("mean ms per update")
    figure.legend(loc="outside lower center", ncols=min(len(stages), 6), fontsize=8, frameon=False)
    return figure


def _anytime(points: Sequence[AnytimePoint]) -> Figure:
    """Each headline metric of each protocol against the seconds until the map was there."""
    panels = list(dict.fromkeys((one.protocol, name) for one in points for name in one.metrics))
    figure, all_axes = _figure(1.0 + 3.2 * len(panels), 3.8, len(panels))
    several = len({one.run for one in points}) > 1
    for axes, (protocol, name) in zip(all_axes, panels, strict=True):
        curves = dict.fromkeys((one.run, one.method) for one in points)
        for index, (run, method) in enumerate(curves):
            mine = [one for one in points if (one.run, one.method, one.protocol) == (run, method, protocol)]
            values = [100.0 * value if (value := one.metrics.get(name)) is not None else np.nan for one in mine]
            label = printable(f"{method} ({run})" if several else method, 60).replace("$", r"\$")
            style: dict[str, Any] = {"marker": MARKERS[index % len(MARKERS)], "color": COLOURS[index % len(COLOURS)]}
            style["linestyle"] = DASHES[index % len(DASHES)]
            axes.plot([one.seconds for one in mine], values, markersize=4, label=label, **style)
        axes.set(xlabel="seconds", ylabel=f"{name} (%)", title=protocol)
        axes.grid(True, color="0.85", linewidth=0.6)
    handles, labels = all_axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure
