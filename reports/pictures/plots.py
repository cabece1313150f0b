"""Plots, readable in black and white, of update times over map size, by stage, memory, and scores over time."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.core.types import Float64Array
from su3d_bench.formats.tables.table import signed
from su3d_bench.metrics.costs import MAP, UpdateTimes, pooled
from su3d_bench.numerics.statistics import growth_exponent
from su3d_bench.reports.pictures.canvas import Canvas, drawable, figure_bytes, write_figure
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
PANELS_A_ROW, LEGEND_COLUMNS = 3, 3
LETTERS_PER_INCH = 15  # at the font size of legends
TITLE_LETTERS_PER_INCH = 12
DPI = 150
MIB = 2**20
TITLE_SIZE = 10
NARROW = 6  # ratio of axis limits below which 1, 2, 5 per decade are too few ticks
POINTS, UPDATES = "number of map points", "number of updates"
MAX_TITLE_NAMES = 3  # method names; more are counted


def draw_timing(
    times: Sequence[Sequence[UpdateTimes]], anytime: Sequence[AnytimePoint], warm_up: int, folder: Path
) -> list[Path]:
    """Write the plots as PNG and PDF and return their paths.

    ``update-cost`` over map points, ``update-course`` over updates, ``memory``, ``stages`` and, if intermediate maps
    were scored, ``anytime``.
    """
    figures = {
        "update-cost": _update_cost(times, warm_up, POINTS),
        "update-course": _update_cost(times, warm_up, UPDATES),
        "memory": _memory(times),
        "stages": _stages(times, warm_up),
    }
    if _curves(anytime):
        figures["anytime"] = _anytime(anytime)
    paths = {folder / f"{name}.{kind}": figure for name, figure in figures.items() for kind in ("png", "pdf")}
    for path, figure in paths.items():
        write_figure(figure, path, DPI)
    return list(paths)


def _figure(width: float, height: float, n_axes: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure with ``n_axes`` panels of ``width`` x ``height`` inches, at most ``PANELS_A_ROW`` per row."""
    from matplotlib.figure import Figure

    columns = min(n_axes, PANELS_A_ROW)
    rows = -(-n_axes // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for spare in axes[n_axes:]:
        spare.remove()
    return figure, axes[:n_axes]


def _style(index: int) -> dict[str, Any]:
    """Return colour, marker and dash of the ``index``-th line; the pair of marker and dash is unique."""
    dash = DASHES[(index + index // len(MARKERS)) % len(DASHES)]
    return {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)], "linestyle": dash}


def draw_update_cost(times: Sequence[Sequence[UpdateTimes]], warm_up: int, kind: str) -> bytes:
    """Return the plot of update time over map points, as a ``png`` or ``pdf`` file."""
    return figure_bytes(_update_cost(times, warm_up, POINTS), kind, DPI)


def _label(method: str, run: str, several_runs: bool) -> str:
    # A dollar sign would start math mode.
    return printable(f"{method} ({run})" if several_runs else method, 60).replace("$", r"\$")


def _labels(times: Sequence[Sequence[UpdateTimes]]) -> list[str]:
    """Return the name of each method, with its run if a method occurs more than once."""
    several_runs = len({of_method[0].method for of_method in times}) < len(times)
    return [_label(of_method[0].method, of_method[0].run, several_runs) for of_method in times]


def _sizes(scene: UpdateTimes, against: str, warm_up: int) -> Float64Array | None:
    """Return the size at each update after the first ``warm_up``; None if it was not recorded."""
    if against == UPDATES:
        return np.arange(warm_up + 1, len(scene) + 1, dtype=np.float64)
    return scene.columns["n_points"][warm_up:] if "n_points" in scene.columns else None


def _update_cost(times: Sequence[Sequence[UpdateTimes]], warm_up: int, against: str) -> Figure:
    """Plot the time per update without perception over the size ``against``, on log-log axes.

    Each update is a dot; a method's line connects the medians of updates of similar size.
    """
    figure, (axes,) = _figure(7.0, 4.0 + 0.16 * len(times))
    found: dict[str, list[str]] = {}
    for index, (of_method, label) in enumerate(zip(times, _labels(times), strict=True)):
        sized = [(scene, size) for scene in of_method if (size := _sizes(scene, against, warm_up)) is not None]
        sizes = np.concatenate([size for _, size in sized] or [np.zeros(0)])
        costs = pooled([scene for scene, _ in sized], MAP, warm_up)
        usable = (sizes > 0) & (costs > 0)
        if not usable.any():
            continue
        growth = growth_exponent(sizes, costs)
        if growth is not None:
            found.setdefault(growth.words, []).append(label)
            label += f": exponent {growth.exponent:z.2f} [{growth.low:z.2f}, {growth.high:z.2f}], {growth.words}"
        sizes, costs, style = sizes[usable], costs[usable], _style(index)
        step = 1 + len(sizes) // MAX_DRAWN
        axes.plot(sizes[::step], costs[::step], ".", markersize=2, color=style["color"], alpha=0.4)
        _draw_medians(axes, sizes, costs, 5.5, label, style)
    axes.set(xscale="log", yscale="log", xlabel=against, ylabel="ms per update, without perception")
    _entitle(figure, axes, cost_sentence(found, against))
    _number_by_1_2_5(axes.xaxis)
    _number_by_1_2_5(axes.yaxis)
    axes.grid(True, which="major", color="0.85", linewidth=0.6)
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower center", fontsize=8, frameon=False, handlelength=4)
    return figure


def cost_sentence(found: Mapping[str, Sequence[str]], against: str) -> str:
    """Return the sentence on the growth of all methods; ``found``: words of the growth -> methods.

    >>> cost_sentence({"grows": ["a", "b"], "constant per update": ["c"]}, POINTS)
    'Time per update over map points: grows for a and b; constant for c'
    """
    verbs = {"grows": "grows for", "constant per update": "constant for", "not settled": "growth undetermined for"}
    parts = [f"{words} {_listed(found[kind])}" for kind, words in verbs.items() if kind in found]
    with_what = "Time per update over map points" if against == POINTS else "Time per update over updates"
    if not parts:
        return f"{with_what}: growth unknown (too few updates or too similar sizes)"
    return f"{with_what}: {'; '.join(parts)}"


def _listed(names: Sequence[str]) -> str:
    """Return the names as a list in words, or their number if there are many."""
    if len(names) > MAX_TITLE_NAMES:
        return f"{len(names)} methods"
    return " and ".join([*([", ".join(names[:-1])] if len(names) > 1 else []), names[-1]])


def _entitle(figure: Figure, axes: Axes, sentence: str) -> None:
    """Write the sentence above the panel, wrapped to its width."""
    inches = figure.get_figwidth() * axes.get_position().width
    lines = textwrap.wrap(sentence, max(30, int(inches * TITLE_LETTERS_PER_INCH)))
    axes.set_title("\n".join(lines), loc="left", fontsize=TITLE_SIZE)


def _number_by_1_2_5(axis: Axis) -> None:
    """Label a logarithmic axis with numbers such as 0.5, 200 k and 5 M at 1, 2 and 5 per decade."""
    from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    large = EngFormatter()
    low, high = axis.get_view_interval()
    is_narrow = low > 0 and high / low < NARROW
    axis.set_major_locator(MaxNLocator(5) if is_narrow else LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, place: large(value) if value >= 1000 else f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _draw_medians(
    axes: Axes, sizes: Float64Array, values: Float64Array, marker: float, label: str, style: Mapping[str, Any]
) -> float:
    """Draw a method's line through the medians of similar sizes and return the largest median."""
    x, y = medians_by_size(sizes, values)
    axes.plot(x, y, linewidth=1.2, markersize=marker, markerfacecolor="white", label=label, **style)
    return float(y.max())


def medians_by_size(sizes: Float64Array, costs: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the median size and cost in each of at most ``N_SIZES`` size ranges, equally wide on a log axis."""
    edges = np.geomspace(sizes.min(), sizes.max(), N_SIZES + 1)[1:-1]
    row = np.searchsorted(edges, sizes, side="right")
    filled = np.unique(row)
    x, y = (np.array([np.median(values[row == k]) for k in filled]) for values in (sizes, costs))
    return x, y


def _stages(times: Sequence[Sequence[UpdateTimes]], warm_up: int) -> Figure:
    """Plot the mean update time of each method, stacked by stage."""
    figure, (axes,) = _figure(7.0, 1.6 + 0.45 * len(times))
    stages = list(dict.fromkeys(stage for of_method in times for scene in of_method for stage in scene.stages))
    left = np.zeros(len(times))
    rows = np.arange(len(times))
    shares: dict[str, Float64Array] = {}
    for index, stage in enumerate(stages):
        steady = [pooled(of_method, stage, warm_up) for of_method in times]
        widths = np.array([values.mean() if len(values) else 0.0 for values in steady])
        hatch = HATCHES[(index + index // len(COLOURS)) % len(HATCHES)]
        style: dict[str, Any] = {"hatch": hatch, "color": COLOURS[index % len(COLOURS)]}
        axes.barh(rows, widths, left=left, edgecolor="white", label=stage, **style)
        left += widths
        shares[stage] = widths
    axes.set_yticks(rows, _labels(times))
    axes.invert_yaxis()
    axes.set_xlabel("mean ms per update")
    _entitle(figure, axes, stages_sentence(_labels(times), shares))
    figure.legend(loc="outside lower center", ncols=min(len(stages), 6), fontsize=8, frameon=False)
    return figure


def stages_sentence(labels: Sequence[str], shares: Mapping[str, Float64Array]) -> str:
    """Return the sentence on the slowest stages; ``shares``: stage -> mean ms (N,) of N methods.

    >>> stages_sentence(["a"], {"segment": np.array([75.0]), "match": np.array([25.0])})
    'Most of the update time of a is segment: 75 % of 100 ms'
    """
    total = np.sum([*shares.values()], axis=0) if shares else np.zeros(0)
    if not np.any(total):
        return "No update times were measured"
    largest = [max(shares, key=lambda stage: shares[stage][row]) for row in range(len(labels))]
    if len(labels) == 1:
        share = 100 * shares[largest[0]][0] / total[0]
        most = "Most" if share > 50 else "The largest part"
        return f"{most} of the update time of {labels[0]} is {largest[0]}: {share:.0f} % of {_rounded(total[0])} ms"
    slow, fast = int(np.argmax(total)), int(np.argmin(total))
    slowest, fastest = (f"{_rounded(total[row])} ms ({labels[row]}, mostly {largest[row]})" for row in (slow, fast))
    return f"Mean update: {fastest}; {slowest}"


def _rounded(value: float) -> str:
    """Format with three significant digits, without an exponent.

    >>> _rounded(12345.6), _rounded(4.5678), _rounded(0.00001)
    ('12,346', '4.57', 'under 0.001')
    """
    if value >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}" if value >= 0.001 else "under 0.001"


def _memory(times: Sequence[Sequence[UpdateTimes]]) -> Figure:
    """Plot MiB of the map over its points, if recorded, and MiB of the process over updates.

    Medians over the scenes.
    """
    timed = {column for of_method in times for scene in of_method for column in scene.columns}
    drawn = [("map_bytes", POINTS)] * ("map_bytes" in timed) + [("rss_bytes", UPDATES)]
    figure, panels = _figure(4.8, 3.2 + 0.16 * len(times), len(drawn))
    for axes, (column, against) in zip(panels, drawn, strict=True):
        most: dict[str, float] = {}
        for index, (of_method, label) in enumerate(zip(times, _labels(times), strict=True)):
            counted = [scene for scene in of_method if column in scene.columns]
            sized = [(scene, size) for scene in counted if (size := _sizes(scene, against, 0)) is not None]
            sizes = np.concatenate([size for _, size in sized] or [np.zeros(0)])
            values = np.concatenate([scene.columns[column] for scene, _ in sized] or [np.zeros(0)])
            if not (sizes > 0).any():
                continue
            most[label] = _draw_medians(axes, sizes[sizes > 0], values[sizes > 0] / MIB, 4.5, label, _style(index))
        what = "the map" if column == "map_bytes" else "the process"
        axes.margins(y=0.12)  # do not cut the markers at the top
        axes.set(xscale="log", xlabel=against, ylabel=f"MiB of {what}")
        axes.set_ylim(bottom=0)
        _entitle(figure, axes, memory_sentence(most, what))
        _number_by_1_2_5(axes.xaxis)
        axes.tick_params(axis="x", labelsize=8)
        axes.grid(True, which="major", color="0.85", linewidth=0.6)
    _one_legend(figure, panels)
    return figure


def memory_sentence(most: Mapping[str, float], what: str) -> str:
    """Return the sentence on peak memory; ``most``: method -> largest median in MiB.

    >>> memory_sentence({"a": 210.4, "b": 95.0}, "the map")
    'Peak memory of the map: 210 MiB (a), 95 MiB (b)'
    """
    if not most:
        return f"No method recorded the memory of {what}"
    high, low = max(most, key=most.__getitem__), min(most, key=most.__getitem__)
    text = f"Peak memory of {what}: {_rounded(most[high])} MiB ({high})"
    return text if high == low else f"{text}, {_rounded(most[low])} MiB ({low})"


def _one_legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """Draw one legend below all ``panels``, each line once."""
    named = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if not named:
        return
    letters = figure.get_figwidth() * LETTERS_PER_INCH - 10 * LEGEND_COLUMNS
    ncols = max(1, min(LEGEND_COLUMNS, int(letters / max(map(len, named)))))
    figure.legend([*named.values()], [*named], loc="outside lower center", ncols=ncols, fontsize=8, frameon=False)


def _curves(points: Sequence[AnytimePoint]) -> list[tuple[str, str]]:
    """Return the protocols and metrics with a value for any intermediate map."""
    defined = ((point.protocol, name) for point in points for name, value in point.metrics.items() if value is not None)
    return list(dict.fromkeys(defined))


def _anytime(points: Sequence[AnytimePoint]) -> Figure:
    """Plot each headline metric of each protocol over the seconds until the map was available."""
    panels = _curves(points)
    figure, all_axes = _figure(3.5, 3.4, len(panels))
    several = len({point.run for point in points}) > 1
    for axes, (protocol, name) in zip(all_axes, panels, strict=True):
        curves = dict.fromkeys((point.run, point.method) for point in points)
        best: dict[str, float] = {}
        for index, (run, method) in enumerate(curves):
            mine = [point for point in points if (point.run, point.method, point.protocol) == (run, method, protocol)]
            values = [100.0 * value if (value := point.metrics.get(name)) is not None else np.nan for point in mine]
            label = _label(method, run, several)
            if np.isfinite(values).any():
                best[label] = float(np.asarray(values)[np.isfinite(values)][-1])
            axes.plot([point.seconds for point in mine], values, markersize=4, label=label, **_style(index))
        axes.set(xlabel="seconds until the map was available", ylabel=f"{name} (%)")
        _entitle(figure, axes, anytime_sentence(protocol, name, best))
        axes.grid(True, color="0.85", linewidth=0.6)
    _one_legend(figure, all_axes)
    return figure


def anytime_sentence(protocol: str, metric: str, last: Mapping[str, float]) -> str:
    """Return the sentence on the final values of a metric; ``last``: method -> last value.

    >>> anytime_sentence("rooms-instance", "AP", {"a": 41.0, "b": 12.5})
    'rooms-instance: final AP is highest for a (41.0 %)'
    """
    highest = max(last.values())
    best = _listed([name for name, value in last.items() if value == highest])
    if len(last) == 1:
        return f"{protocol}: final {metric} of {best} is {highest:.1f} %"
    return f"{protocol}: final {metric} is highest for {best} ({highest:.1f} %)"


PANEL_WIDTH, ROW_HEIGHT, PANEL_EXTRA = 4.6, 0.34, 1.25  # inches
# Shades and hatches distinguish the bars in black and white.
STYLES: dict[str, dict[str, Any]] = {
    "gain": {"facecolor": "#4a7ab5", "edgecolor": "#1b2f4a"},
    "left": {"facecolor": "#ffffff", "edgecolor": "#555555", "hatch": "////"},
    "stage": {"facecolor": "#d9d9d9", "edgecolor": "#555555", "hatch": "...."},
}


def draw_attribution(attribution: Mapping[str, Any], path: Path) -> None:
    """Write the plot as PDF, PNG or SVG: one row of panels per protocol, one panel per metric."""
    protocols = attribution["protocols"]
    n_columns = max(len(protocol["values"]) for protocol in protocols)
    heights = [
        ROW_HEIGHT * len(_bars(protocol, next(iter(protocol["values"])))) + PANEL_EXTRA for protocol in protocols
    ]
    page = Canvas(1.6 + PANEL_WIDTH * n_columns, sum(heights) + 0.5, per_inch=1)
    figure = page.figure
    title = f"Gain from correcting one kind of error: {attribution['method']}, {attribution['run']}"
    figure.suptitle(drawable(title), fontsize=13, fontweight="bold", parse_math=False)
    grid = figure.add_gridspec(len(protocols), n_columns, height_ratios=heights)
    for row, protocol in enumerate(protocols):
        for column, name in enumerate(protocol["values"]):
            _draw_panel(figure.add_subplot(grid[row, column]), protocol, name, has_names=column == 0)
    figure.tight_layout(rect=(0, 0, 1, 0.98))
    page.write(path)


Bar = tuple[str, float, str, str]  # name, length, style, label


def _bars(protocol: Mapping[str, Any], metric: str) -> list[Bar]:
    value = protocol["values"][metric] or 0.0
    bars = []
    for kind, cause in protocol["causes"].items():
        gain = cause["gains"][metric]
        bars.append((kind, gain or 0.0, "gain", f"{signed(gain)}  ({n_text(cause['n'], protocol['n_scored'])})"))
    bars += [
        (shown, protocol[name][metric] or 0.0, "left", signed(protocol[name][metric])) for name, shown in LEFT.items()
    ]
    for stage, values in protocol["stages"].items():
        change = None if values[metric] is None else values[metric] - value
        bars.append((f"GT {stage}", change or 0.0, "stage", signed(change)))
    return bars


def _draw_panel(axes: Any, protocol: Mapping[str, Any], metric: str, *, has_names: bool) -> None:
    value = 100 * (protocol["values"][metric] or 0.0)
    bars = _bars(protocol, metric)
    places = range(len(bars))
    for place, (_, length, style, text) in zip(places, bars, strict=True):
        axes.barh(place, 100 * length, left=value, height=0.62, linewidth=0.8, **STYLES[style])
        end = max(value, value + 100 * length)
        free = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}  # keeps the line at 100 from crossing the number
        axes.text(end + 0.02 * _span(value), place, text, va="center", fontsize=8.5, color="#222222", bbox=free)
    axes.axvline(value, color="black", linewidth=1.2)
    axes.axvline(100, color="black", linewidth=0.8, linestyle=":")
    lowest = min([value, *(value + 100 * length for _, length, _, _ in bars)])
    axes.set_xlim(lowest - 0.04 * _span(value), 100 + 0.42 * _span(value))
    axes.set_xticks([tick for tick in axes.get_xticks() if lowest - 0.04 * _span(value) <= tick <= 100])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_yticks(list(places), [name for name, *_ in bars] if has_names else [""] * len(bars), fontsize=9.5)
    gains = {kind: cause["gains"][metric] or 0.0 for kind, cause in protocol["causes"].items()}
    worst = max(gains, key=gains.__getitem__, default=None)
    most = f", most costly: {worst}" if worst is not None and gains[worst] > 0 else ""
    title = drawable(f"{protocol['protocol']}: {metric} {value:.1f}{most}")
    axes.set_title(title, fontsize=10.5, loc="left", parse_math=False)
    _without_frame(axes, "score with only this corrected")


def _without_frame(axes: Any, title: str) -> None:
    axes.set_xlabel(title, fontsize=8.5, color="#444444")
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", labelsize=8.5)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _span(value: float) -> float:
    """Return the width available for bars, at least one point."""
    return max(1.0, 100 - value)


SHIFT_PANEL_WIDTH, SHIFT_ROW_HEIGHT, NAMES_WIDTH, EXTRA = 4.4, 0.42, 3.2, 1.5  # inches
ENDS, UP, DOWN = "#555555", "#2f6f4f", "#a4432f"  # hatches distinguish up and down without colours
MAX_NAME_CHARACTERS = 44  # characters


def draw_walk(apart: Mapping[str, Any], path: Path) -> None:
    """Write the plot as PDF, PNG or SVG: one panel per metric, from the first protocol (top) to the second (bottom)."""
    walk = apart["walk"]
    names = list(walk["start"])
    n_rows = len(walk["steps"]) + 2
    page = Canvas(NAMES_WIDTH + SHIFT_PANEL_WIDTH * len(names), SHIFT_ROW_HEIGHT * n_rows + EXTRA, per_inch=1)
    figure = page.figure
    title = f"{walk['run']}: {walk['method']}, from {apart['first']} to {apart['second']}"
    figure.suptitle(drawable(title), fontsize=12, fontweight="bold", parse_math=False)
    for column, name in enumerate(names):
        _draw_shift_panel(figure.add_subplot(1, len(names), column + 1), apart, name, has_names=column == 0)
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    page.write(path)


def _draw_shift_panel(axes: Any, apart: Mapping[str, Any], name: str, *, has_names: bool) -> None:
    walk = apart["walk"]
    start, end = 100 * walk["start"][name], 100 * walk["end"][name]
    places = [start]
    for step in walk["steps"]:
        places.append(places[-1] + 100 * step["adds"][name]["share"])
    low, high = min([*places, end]), max([*places, end])
    span = max(1.0, high - low)
    for row, step in enumerate(walk["steps"], 1):
        change = places[row] - places[row - 1]
        style = {"color": UP, "hatch": ""} if change >= 0 else {"color": DOWN, "hatch": "////"}
        axes.barh(row, change, left=places[row - 1], height=0.6, edgecolor="white", linewidth=0.5, **style)
        axes.plot([places[row - 1]] * 2, [row - 0.7, row + 0.3], color="#999999", linewidth=0.7)
        text = signed(step["adds"][name]["share"])
        axes.text(max(places[row - 1 : row + 1]) + 0.03 * span, row, text, va="center", fontsize=9, color="#222222")
    axes.plot([places[-1]] * 2, [len(places) - 0.7, len(places)], color="#999999", linewidth=0.7)
    for row, value in ((0, start), (len(places), end)):
        axes.plot(value, row, "D", color=ENDS, markersize=7)  # not a bar, because the axis does not start at 0
        axes.text(value + 0.03 * span, row, f"{value:.1f}", va="center", fontsize=9, fontweight="bold", color="#222222")
    axes.set_xlim(low - 0.1 * span, high + 0.3 * span)
    axes.set_ylim(len(places) + 0.6, -0.6)
    labels = [apart["first"], *(", ".join(step["rules"]) for step in walk["steps"]), apart["second"]]
    most = MAX_NAME_CHARACTERS
    shown = [drawable(text if len(text) <= most else text[: most - 3] + "...") for text in labels]
    axes.set_yticks(range(len(labels)), shown if has_names else [""] * len(labels), fontsize=9, parse_math=False)
    axes.set_title(f"{name}: {end - start:+.1f} points", fontsize=10.5, loc="left", parse_math=False)
    _without_frame(axes, "per cent")
