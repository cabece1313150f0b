"""The plot of a walk from one protocol to another: a step a rule between the two numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from su3d_bench.formats.tables.table import signed
from su3d_bench.reports.pictures.canvas import Canvas, drawable

PANEL_WIDTH, ROW_HEIGHT, NAMES_WIDTH, EXTRA = 4.4, 0.42, 3.2, 1.5  # inches
ENDS, UP, DOWN = "#555555", "#2f6f4f", "#a4432f"  # hatches tell up and down apart without colours
MOST_OF_A_NAME = 44  # characters


def draw_walk(apart: Mapping[str, Any], path: Path) -> None:
    """Write the plot as a PNG: a panel a value, from the first protocol's above to the second's below."""
    walk = apart["walk"]
    names = list(walk["start"])
    n_rows = len(walk["steps"]) + 2
    page = Canvas(NAMES_WIDTH + PANEL_WIDTH * len(names), ROW_HEIGHT * n_rows + EXTRA, per_inch=1)
    figure = page.figure
    title = f"{walk['run']}: {walk['method']}, from {apart['first']} to {apart['second']}"
    figure.suptitle(drawable(title), fontsize=12, fontweight="bold", parse_math=False)
    for column, name in enumerate(names):
        _draw_panel(figure.add_subplot(1, len(names), column + 1), apart, name, has_names=column == 0)
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    page.write(path)


def _draw_panel(axes: Any, apart: Mapping[str, Any], name: str, *, has_names: bool) -> None:
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
        axes.plot(value, row, "D", color=ENDS, markersize=7)  # no bar, for the axis does not begin at 0
        axes.text(value + 0.03 * span, row, f"{value:.1f}", va="center", fontsize=9, fontweight="bold", color="#222222")
    axes.set_xlim(low - 0.1 * span, high + 0.3 * span)
    axes.set_ylim(len(places) + 0.6, -0.6)
    labels = [apart["first"], *(", ".join(step["rules"]) for step in walk["steps"]), apart["second"]]
    shown = [drawable(text if len(text) <= MOST_OF_A_NAME else text[: MOST_OF_A_NAME - 3] + "...") for text in labels]
    axes.set_yticks(range(len(labels)), shown if has_names else [""] * len(labels), fontsize=9, parse_math=False)
    axes.set_title(f"{name}: {end - start:+.1f} points", fontsize=10.5, loc="left", parse_math=False)
    axes.set_xlabel("per cent", fontsize=8.5, color="#444444")
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", labelsize=8.5)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
