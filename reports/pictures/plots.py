"""Plots of times, memory and scores of runs and the cost of errors; readable in grey."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from su3d_bench.core.errors import counted, printable
from su3d_bench.core.types import Float64Array
from su3d_bench.formats.tables.table import signed
from su3d_bench.metrics.costs import MAP, UpdateTimes, pooled
from su3d_bench.numerics.statistics import growth_exponent
from su3d_bench.reports.pictures.canvas import (
    DPI,
    LETTERS_PER_INCH,
    LINE_IN,
    WIDTHS_IN,
    Width,
    drawable,
    figure_bytes,
    figure_style,
    fitted,
    write_figure,
)
from su3d_bench.reports.tables.costs import COSTS, RATE, CostRow, comparable_rows, front_of, points_of
from su3d_bench.reports.tables.instances import LEFT, n_text
from su3d_bench.reports.tables.timing import AnytimePoint

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


# Okabe and Ito's colour-blind safe palette; marker and dash distinguish the methods in black and white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", ":")
HATCHES = ("", "///", "...", "xxx", "\\\\\\", "+++", "ooo", "---")
MAX_DRAWN = 2000  # points per method; more only enlarge the file
N_SIZES = 10  # markers per method along the size axis
PANELS_PER_ROW: dict[Width, int] = {"8cm": 1, "17cm": 2}  # so that a panel is about 8 cm wide
LEGEND_COLUMNS, HANDLE_LETTERS = 3, 7
MIB = 2**20
NARROW, WIDE = 6, 60  # ratio of axis limits below and above which 1, 2, 5 per decade are too few and too many ticks
POINTS, UPDATES = "number of map points", "number of updates"


@figure_style()
def draw_timing(
    times: Sequence[Sequence[UpdateTimes]],
    anytime: Sequence[AnytimePoint],
    costs: Sequence[CostRow],
    warm_up: int,
    folder: Path,
    width: Width = "17cm",
) -> list[Path]:
    """Write the plots as PNG and PDF and return their paths.

    ``update-cost`` over map points (if a method counts them), ``update-course`` over updates, ``memory``, ``stages``,
    ``anytime`` if intermediate maps were scored, and one ``cost-quality`` per machine, protocol and set of scenes.
    """
    figures = {
        "update-cost": _update_cost(times, warm_up, POINTS, width),
        "update-course": _update_cost(times, warm_up, UPDATES, width),
        "memory": _memory(times, width),
        "stages": _stages(times, warm_up, width),
    }
    if not figures["update-cost"].axes[0].lines:
        del figures["update-cost"]
    if _curves(anytime):
        figures["anytime"] = _anytime(anytime, width)
    figures |= {f"cost-quality-{k}": _costs(rows, width) for k, rows in enumerate(comparable_rows(costs), 1)}
    paths = {folder / f"{name}.{kind}": figure for name, figure in figures.items() for kind in ("png", "pdf")}
    for path, figure in paths.items():
        write_figure(figure, path)
    return list(paths)


def figure_with_panels(width: Width, *panels_in: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels of at least these heights."""
    from matplotlib.figure import Figure

    columns = min(len(panels_in), PANELS_PER_ROW[width])
    rows_in = [max(panels_in[k : k + columns]) for k in range(0, len(panels_in), columns)]
    figure = Figure(figsize=(WIDTHS_IN[width], sum(rows_in)), layout="constrained", dpi=DPI)
    axes = list(figure.subplots(len(rows_in), columns, squeeze=False, height_ratios=rows_in).flat)
    for spare in axes[len(panels_in) :]:
        spare.remove()
    return figure, axes[: len(panels_in)]


def style_of_line(index: int) -> dict[str, Any]:
    """Return colour, marker and dash of the ``index``-th line; the pair of marker and dash is unique."""
    dash = DASHES[(index + index // len(MARKERS)) % len(DASHES)]
    return {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)], "linestyle": dash}


@figure_style()
def draw_update_cost(times: Sequence[Sequence[UpdateTimes]], warm_up: int, kind: str) -> bytes:
    """Return the plot of update time over map points, as a ``png`` or ``pdf`` file."""
    return figure_bytes(_update_cost(times, warm_up, POINTS, "17cm"), kind)


def _label(method: str, run: str, several_runs: bool) -> str:
    return printable(f"{method} ({run})" if several_runs else method, 60)


def _labels(times: Sequence[Sequence[UpdateTimes]]) -> list[str]:
    """Return the name of each method, with its run if a method occurs more than once."""
    several_runs = len({of_method[0].method for of_method in times}) < len(times)
    return [_label(of_method[0].method, of_method[0].run, several_runs) for of_method in times]


def _sizes(scene: UpdateTimes, against: str, warm_up: int) -> Float64Array | None:
    """Return the size at each update after the first ``warm_up``; None if it was not recorded."""
    if against == UPDATES:
        return np.arange(warm_up + 1, len(scene) + 1, dtype=np.float64)
    return scene.columns["n_points"][warm_up:] if "n_points" in scene.columns else None


def _update_cost(times: Sequence[Sequence[UpdateTimes]], warm_up: int, against: str, width: Width) -> Figure:
    """Plot the time per update without perception over the size ``against``, on log-log axes.

    Each update is a dot; a method's line connects the medians of updates of similar size.
    """
    figure, (axes,) = figure_with_panels(width, 2.2 + (2 if width == "8cm" else 1) * LINE_IN * len(times))
    for index, (of_method, label) in enumerate(zip(times, _labels(times), strict=True)):
        sized = [(scene, size) for scene in of_method if (size := _sizes(scene, against, warm_up)) is not None]
        sizes = np.concatenate([size for _, size in sized] or [np.zeros(0)])
        costs = pooled([scene for scene, _ in sized], MAP, warm_up)
        usable = (sizes > 0) & (costs > 0)
        if not usable.any():
            continue
        growth = growth_exponent(sizes, costs)
        if growth is not None:
            label += f": slope {growth.exponent:z.2f} [{growth.low:z.2f}, {growth.high:z.2f}]"
        sizes, costs, style = sizes[usable], costs[usable], style_of_line(index)
        step = 1 + len(sizes) // MAX_DRAWN
        axes.plot(sizes[::step], costs[::step], ".", markersize=2, color=style["color"], alpha=0.4)
        _draw_medians(axes, sizes, costs, label, style)
    axes.set(xscale="log", yscale="log", xlabel=against, ylabel="time per update (ms),\nwithout perception")
    _number_by_1_2_5(axes.xaxis)
    _number_by_1_2_5(axes.yaxis)
    axes.grid(True, which="major")
    draw_legend(figure, [axes])
    return figure


def _number_by_1_2_5(axis: Axis) -> None:
    """Label a logarithmic axis with numbers such as 0.5, 200 k and 5 M, at 1, 2 and 5 per decade or fewer."""
    from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    large = EngFormatter()
    low, high = axis.get_view_interval()
    is_narrow = low > 0 and high / low < NARROW
    steps = (1, 2, 5) if high < WIDE * low else (1, 3) if high < WIDE**2 * low else (1,)
    axis.set_major_locator(MaxNLocator(5) if is_narrow else LogLocator(subs=steps))
    axis.set_major_formatter(FuncFormatter(lambda value, place: large(value) if value >= 1000 else f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _draw_medians(axes: Axes, sizes: Float64Array, values: Float64Array, label: str, style: Mapping[str, Any]) -> None:
    """Draw a method's line through the medians of similar sizes."""
    x, y = medians_by_size(sizes, values)
    axes.plot(x, y, markerfacecolor="white", label=label, **style)


def medians_by_size(sizes: Float64Array, costs: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the median size and cost in each of at most ``N_SIZES`` size ranges, equally wide on a log axis."""
    edges = np.geomspace(sizes.min(), sizes.max(), N_SIZES + 1)[1:-1]
    row = np.searchsorted(edges, sizes, side="right")
    filled = np.unique(row)
    x, y = (np.array([np.median(values[row == k]) for k in filled]) for values in (sizes, costs))
    return x, y


def _stages(times: Sequence[Sequence[UpdateTimes]], warm_up: int, width: Width) -> Figure:
    """Plot the mean update time of each method, stacked by stage."""
    labels = _labels(times)
    stages = list(dict.fromkeys(stage for of_method in times for scene in of_method for stage in scene.stages))
    columns = _legend_columns(WIDTHS_IN[width], stages)
    figure, (axes,) = figure_with_panels(width, 0.7 + 2.2 * LINE_IN * len(times) + LINE_IN * -(-len(stages) // columns))
    left = np.zeros(len(times))
    rows = np.arange(len(times))
    for index, stage in enumerate(stages):
        steady = [pooled(of_method, stage, warm_up) for of_method in times]
        widths = np.array([values.mean() if len(values) else 0.0 for values in steady])
        hatch = HATCHES[(index + index // len(COLOURS)) % len(HATCHES)]
        style: dict[str, Any] = {"hatch": hatch, "color": COLOURS[index % len(COLOURS)]}
        axes.barh(rows, widths, left=left, edgecolor="white", label=stage, **style)
        left += widths
    axes.set_yticks(rows, [fitted(label, 0.3 * WIDTHS_IN[width]) for label in labels])
    axes.invert_yaxis()
    axes.set_xlabel("mean ms per update")
    figure.legend(loc="outside lower center", ncols=columns, frameon=False)
    return figure


def _memory(times: Sequence[Sequence[UpdateTimes]], width: Width) -> Figure:
    """Plot MiB of the map over its points, if recorded, and MiB of the process over updates.

    Medians over the scenes.
    """
    timed = {column for of_method in times for scene in of_method for column in scene.columns}
    drawn = [("map_bytes", POINTS)] * ("map_bytes" in timed) + [("rss_bytes", UPDATES)]
    figure, panels = figure_with_panels(width, *[2.2 + LINE_IN * len(times) / len(drawn)] * len(drawn))
    for axes, (column, against) in zip(panels, drawn, strict=True):
        for index, (of_method, label) in enumerate(zip(times, _labels(times), strict=True)):
            counted = [scene for scene in of_method if column in scene.columns]
            sized = [(scene, size) for scene in counted if (size := _sizes(scene, against, 0)) is not None]
            sizes = np.concatenate([size for _, size in sized] or [np.zeros(0)])
            values = np.concatenate([scene.columns[column] for scene, _ in sized] or [np.zeros(0)])
            if not (sizes > 0).any():
                continue
            _draw_medians(axes, sizes[sizes > 0], values[sizes > 0] / MIB, label, style_of_line(index))
        what = "the map" if column == "map_bytes" else "the process"
        axes.margins(y=0.12)  # do not cut the markers at the top
        axes.set(xscale="log", xlabel=against, ylabel=f"memory of {what} (MiB)")
        axes.set_ylim(bottom=0)
        _number_by_1_2_5(axes.xaxis)
        axes.grid(True, which="major")
    draw_legend(figure, panels)
    return figure


def draw_legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """Draw one legend below all ``panels``, each line once."""
    named = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if not named:
        return
    width = figure.get_figwidth()
    most_in = width - HANDLE_LETTERS / LETTERS_PER_INCH
    parts = [label.split(": ") if len(label) > most_in * LETTERS_PER_INCH else [label] for label in named]
    labels = [":\n".join(fitted(part, most_in) for part in each) for each in parts]
    figure.legend(
        [*named.values()], labels, loc="outside lower center", ncols=_legend_columns(width, labels), frameon=False,
        handlelength=2.5,
    )  # fmt: skip


def _legend_columns(width_in: float, labels: Sequence[str]) -> int:
    """Return how many labels fit side by side."""
    longest = max((len(line) for label in labels for line in label.splitlines()), default=0)
    return max(1, min(len(labels), LEGEND_COLUMNS, int(width_in * LETTERS_PER_INCH / (longest + HANDLE_LETTERS))))


def _curves(points: Sequence[AnytimePoint]) -> list[tuple[str, str]]:
    """Return the protocols and metrics with a value for any intermediate map."""
    defined = ((point.protocol, name) for point in points for name, value in point.metrics.items() if value is not None)
    return list(dict.fromkeys(defined))


def _anytime(points: Sequence[AnytimePoint], width: Width) -> Figure:
    """Plot each headline metric of each protocol over the seconds until the map was available."""
    panels = _curves(points)
    figure, all_axes = figure_with_panels(width, *[2.2] * len(panels))
    several = len({point.run for point in points}) > 1
    truths = dict.fromkeys(point.truth for point in points)
    for axes, (protocol, name) in zip(all_axes, panels, strict=True):
        curves = dict.fromkeys((point.run, point.method, point.truth) for point in points)
        for index, (run, method, truth) in enumerate(curves):
            of_curve = run, method, truth, protocol
            mine = [point for point in points if (point.run, point.method, point.truth, point.protocol) == of_curve]
            values = [100.0 * value if (value := point.metrics.get(name)) is not None else np.nan for point in mine]
            label = _label(method, run, several) + (f", {truth}" if len(truths) > 1 else "")
            axes.plot([point.seconds for point in mine], values, label=label, **style_of_line(index))
        axes.set(xlabel="seconds until the map was available", ylabel=f"{protocol}: {name} (%)")
        axes.grid(True)
    draw_legend(figure, all_axes)
    return figure


def _costs(rows: Sequence[CostRow], width: Width) -> Figure:
    """Plot the first headline metric over each cost, with the Pareto front.

    Markers without filling are in real time; a line connects the rates of a method.
    """
    drawn = [cost for cost in COSTS if not cost.startswith("n_") and points_of(rows, cost)]
    figure, panels = figure_with_panels(width, *[2.2] * len(drawn))
    for axes, cost in zip(panels, drawn, strict=True):
        if cost != RATE:
            x, y, _ = zip(*front_of(rows, cost), strict=True)
            axes.step(x, y, where="post", color="0.75", linewidth=3, label="Pareto front")
        for index, method in enumerate(dict.fromkeys(row.score.method for row in rows)):
            points = points_of([row for row in rows if row.score.method == method], cost)
            style = style_of_line(index) | {"linewidth": float(cost == RATE), "label": printable(method, 60)}
            axes.plot([x for x, _, _ in points], [y for _, y, _ in points], **style)
            live = [(x, y) for x, y, row in points if row.costs[RATE] is not None]
            axes.plot(*np.reshape(live, (-1, 2)).T, style["marker"], color=style["color"], markerfacecolor="white")
        axes.set(xscale="log", xlabel=COSTS[cost], ylabel=f"{rows[0].score.protocol}:\n{rows[0].score.headline[0]} (%)")
        _number_by_1_2_5(axes.xaxis)
        axes.grid(True)
    figure.suptitle(fitted(rows[0].machine, WIDTHS_IN[width]), fontsize=8)
    draw_legend(figure, panels)
    return figure


# Shades and hatches distinguish the bars in black and white.
BARS: dict[str, dict[str, Any]] = {
    "gain": {"facecolor": COLOURS[0], "edgecolor": "black"},
    "left": {"facecolor": "white", "edgecolor": "black", "hatch": "////"},
    "stage": {"facecolor": "0.85", "edgecolor": "black", "hatch": "...."},
}
Bar = tuple[str, float, str, str]  # name, length, style, label


@figure_style()
def draw_attribution(attribution: Mapping[str, Any], path: Path, width: Width = "17cm") -> None:
    """Write the plot as PDF, PNG or SVG: one panel per protocol and metric, the most costly error first."""
    panels = [(protocol, metric) for protocol in attribution["protocols"] for metric in protocol["values"]]
    figure, all_axes = figure_with_panels(width, *(0.7 + 2.2 * LINE_IN * len(_bars(*panel)) for panel in panels))
    for axes, (protocol, metric) in zip(all_axes, panels, strict=True):
        _draw_errors(axes, protocol, metric)
    caption = (
        f"Cost of errors of {attribution['method']} in {attribution['run']}: the score if only this kind of error is "
        "corrected, most costly first; hatched: what no single correction recovers; dotted: stages from ground truth"
    )
    write_figure(figure, path, caption)


def _bars(protocol: Mapping[str, Any], metric: str) -> list[Bar]:
    """Return the bars of a panel, the most costly kind of error first."""
    value = protocol["values"][metric] or 0.0
    n, causes = protocol["n_scored"], protocol["causes"].items()
    n_of = {k: f"{n_text(c['n'], n)} of points" if n is not None else counted(c["n"], "error") for k, c in causes}
    gains = {kind: cause["gains"][metric] for kind, cause in protocol["causes"].items()}
    order = sorted(gains, key=lambda kind: -(gains[kind] or 0.0))
    bars = [(f"{kind}\n{n_of[kind]}", gains[kind] or 0.0, "gain", signed(gains[kind])) for kind in order]
    bars += [
        (shown, protocol[name][metric] or 0.0, "left", signed(protocol[name][metric])) for name, shown in LEFT.items()
    ]
    for stage, values in protocol["stages"].items():
        change = None if values[metric] is None else values[metric] - value
        bars.append((f"GT {stage}", change or 0.0, "stage", signed(change)))
    return bars


def _draw_errors(axes: Any, protocol: Mapping[str, Any], metric: str) -> None:
    value = 100 * (protocol["values"][metric] or 0.0)
    bars = _bars(protocol, metric)
    span = max(1.0, 100 - value)
    for place, (_, length, style, text) in enumerate(bars):
        axes.barh(place, 100 * length, left=value, height=0.62, **BARS[style])
        end = max(value, value + 100 * length)
        free = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}  # keeps the line at 100 from crossing the number
        axes.text(end + 0.02 * span, place, text, va="center", bbox=free)
    axes.axvline(value, color="black")
    axes.axvline(100, color="black", linewidth=0.6, linestyle=":")
    lowest = min([value, *(value + 100 * length for _, length, _, _ in bars)]) - 0.04 * span
    axes.set_xlim(lowest, 100 + 0.25 * span)
    axes.set_xticks([tick for tick in axes.get_xticks() if lowest <= tick <= 100])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_yticks(range(len(bars)), [name for name, *_ in bars])
    _without_frame(axes, f"{drawable(protocol['protocol'])}: {metric} (%), now {value:.1f}\nwith only this corrected")


def _without_frame(axes: Any, label: str) -> None:
    axes.set_xlabel(label)
    axes.tick_params(axis="y", length=0)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
