"""The plot of an attribution: from the value as it is, a bar for what correcting each kind of error adds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from su3d_bench.formats.tables.table import signed
from su3d_bench.reports.pictures.canvas import Canvas, drawable
from su3d_bench.reports.tables.attribution import LEFT, n_text

PANEL_WIDTH, ROW_HEIGHT, PANEL_EXTRA = 4.6, 0.34, 1.25  # inches
# Grey and hatches tell bars apart on a printer without colours.
STYLES: dict[str, dict[str, Any]] = {
    "gain": {"facecolor": "#4a7ab5", "edgecolor": "#1b2f4a"},
    "left": {"facecolor": "#ffffff", "edgecolor": "#555555", "hatch": "////"},
    "stage": {"facecolor": "#d9d9d9", "edgecolor": "#555555", "hatch": "...."},
}


def draw_attribution(attribution: Mapping[str, Any], path: Path) -> None:
    """Write the plot as a PNG: a row of panels a protocol, a panel a metric."""
    protocols = attribution["protocols"]
    n_columns = max(len(protocol["values"]) for protocol in protocols)
    heights = [
        ROW_HEIGHT * len(_bars(protocol, next(iter(protocol["values"])))) + PANEL_EXTRA for protocol in protocols
    ]
    page = Canvas(1.6 + PANEL_WIDTH * n_columns, sum(heights) + 0.5, per_inch=1)
    figure = page.figure
    title = f"What correcting one kind of error alone adds to {attribution['method']} in {attribution['run']}"
    figure.suptitle(drawable(title), fontsize=13, fontweight="bold", parse_math=False)
    grid = figure.add_gridspec(len(protocols), n_columns, height_ratios=heights)
    for row, protocol in enumerate(protocols):
        for column, name in enumerate(protocol["values"]):
            _draw_panel(figure.add_subplot(grid[row, column]), protocol, name, has_names=column == 0)
    figure.tight_layout(rect=(0, 0, 1, 0.98))
    page.write(path)


Bar = tuple[str, float, str, str]  # name, length, style, what stands beside it


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
        bars.append((f"true {stage}", change or 0.0, "stage", signed(change)))
    return bars


def _draw_panel(axes: Any, protocol: Mapping[str, Any], metric: str, *, has_names: bool) -> None:
    value = 100 * (protocol["values"][metric] or 0.0)
    bars = _bars(protocol, metric)
    places = range(len(bars))
    for place, (_, length, style, text) in zip(places, bars, strict=True):
        axes.barh(place, 100 * length, left=value, height=0.62, linewidth=0.8, **STYLES[style])
        end = max(value, value + 100 * length)
        free = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}  # the line at 100 does not cross the number
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
    most = f", the costliest kind: {worst}" if worst is not None and gains[worst] > 0 else ""
    title = drawable(f"{protocol['protocol']}: {metric} {value:.1f}{most}")
    axes.set_title(title, fontsize=10.5, loc="left", parse_math=False)
    axes.set_xlabel("value with this alone corrected", fontsize=8.5, color="#444444")
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", labelsize=8.5)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _span(value: float) -> float:
    """The width that bars may take, at least one point."""
    return max(1.0, 100 - value)
