"""Draw docs/pictures/relations.png: every relation rule on both sides of its threshold, as computed by the code.

python benchmarks draw_relations docs/pictures/relations.png
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from su3d_bench.numerics.relations import RELATIONS, Relation, Relations, is_between, may_be_between

SIDE, TOP = (0, 2), (0, 1)  # the axes of a panel
GREEN, RED, ORANGE, GREY, BLUE = "#2a8a4a", "#c0392b", "#b86a00", "#d9d9d9", "#4a6fa5"
NARROW = 0.3  # m: a box too narrow for a word
Box = tuple[float, float, float, float, float, float]  # lowest corner and sizes, metres


@dataclass(frozen=True)
class Panel:
    """A pair: is the first in ``relation`` to the second? ``others`` are drawn in grey."""

    relation: str
    text: str
    view: tuple[int, int]
    subject: Box
    other: Box
    others: tuple[Box, ...] = ()
    names: tuple[str, str] = ("a", "b")


TABLE: Box = (0, 0, 0, 1, 1, 0.7)
PICTURE: Box = (0.2, 0.97, 1.1, 0.6, 0.03, 0.5)
PANELS = (
    Panel("on", "rests on its top,\nat most 0.04 m apart", SIDE, (0.4, 0.4, 0.72, 0.2, 0.2, 0.2), TABLE),
    Panel("on", "0.06 m of air", SIDE, (0.4, 0.4, 0.76, 0.2, 0.2, 0.2), TABLE),
    Panel("on", "0.4 of its footprint", SIDE, (0.88, 0.4, 0.7, 0.3, 0.3, 0.2), TABLE),
    Panel("on", "0.2 of its footprint", SIDE, (0.94, 0.4, 0.7, 0.3, 0.3, 0.2), TABLE),
    Panel("on", "an inner board",
          SIDE, (0.2, 0.05, 0.5, 0.2, 0.2, 0.3), (0, 0, 0, 1, 0.3, 1.4), (), ("a", "shelf")),
    Panel("on", "an inner board, but\nno shelf or seat",
          SIDE, (0.2, 0.05, 0.2, 0.2, 0.2, 0.2), (0, 0, 0, 1, 0.3, 0.6), (), ("a", "stand")),
    Panel("in", "may stick out of\na container",
          SIDE, (0.36, 0.1, 0.1, 0.2, 0.2, 0.8), (0, 0, 0, 0.6, 0.5, 0.6), (), ("a", "basket")),
    Panel("under", "supports it", SIDE, TABLE, (0.4, 0.4, 0.7, 0.2, 0.2, 0.2)),
    Panel("under", "not through a slab",
          SIDE, (0, 0, 0, 1, 1, 0.6), (0.4, 0.4, 0.7, 0.2, 0.2, 0.2), ((-0.2, 0, 0.6, 1.4, 1, 0.1),)),
    Panel("under", "0.9 of its footprint\nis covered", SIDE, (0.73, 0.3, 0, 0.3, 0.3, 0.4), TABLE),
    Panel("under", "0.4 of its footprint\nis covered", SIDE, (0.88, 0.3, 0, 0.3, 0.3, 0.4), TABLE),
    Panel("above", "hangs over it,\nat most 1 m", SIDE, PICTURE, TABLE),
    Panel("above", "1.4 m of air", SIDE, (0.2, 0.97, 2.1, 0.6, 0.03, 0.5), TABLE),
    Panel("above", "neither half of it\nnor its middle", SIDE, (0.9, 0.97, 1.1, 0.6, 0.03, 0.5), TABLE),
    Panel("above", "something is between", SIDE, PICTURE, TABLE, ((0.2, 0.72, 0.7, 0.6, 0.26, 0.3),)),
    Panel("next to", "half the longer side\nof the smaller one", TOP, (1.19, 0.2, 0, 0.5, 0.5, 0.9), TABLE),
    Panel("next to", "half the longer side\nof the larger one", TOP, (1.45, 0.2, 0, 0.5, 0.5, 0.9), TABLE),
    Panel("next to", "farther", TOP, (1.65, 0.2, 0, 0.5, 0.5, 0.9), TABLE),
    Panel("next to", "something is between",
          TOP, (1.19, 0.2, 0, 0.5, 0.6, 0.9), TABLE, ((1.04, 0.4, 0, 0.11, 0.11, 0.3),)),
    Panel("next to", "one hangs, one stands",
          SIDE, (1.1, 0, 1.0, 0.15, 0.02, 0.2), (0, 0, 0, 0.9, 0.05, 2.0), (), ("switch", "door")),
    Panel("next to", "not on one support",
          SIDE, (1.1, 0.2, 0, 0.3, 0.3, 0.5), (0.75, 0.2, 0.7, 0.2, 0.2, 0.3), (TABLE,)),
    Panel("between", "on the way, on one level",
          TOP, (0.95, 0.15, 0, 0.2, 0.2, 0.4), (0, 0, 0, 0.5, 0.5, 0.5), ((1.6, 0, 0, 0.5, 0.5, 0.5),)),
    Panel("between", "in the lane",
          TOP, (0.95, 0.42, 0, 0.2, 0.2, 0.4), (0, 0, 0, 0.5, 0.5, 0.5), ((1.6, 0, 0, 0.5, 0.5, 0.5),)),
    Panel("between", "outside the lane",
          TOP, (0.95, 0.75, 0, 0.2, 0.2, 0.4), (0, 0, 0, 0.5, 0.5, 0.5), ((1.6, 0, 0, 0.5, 0.5, 0.5),)),
)  # fmt: skip


def bounds(box: Box) -> np.ndarray:
    low = np.array(box[:3], float)
    return np.array([low, low + np.array(box[3:])])


def answer(panel: Panel) -> str:
    """The code's answer for a panel: "is", "is not" or "may be"."""
    boxes = [bounds(box) for box in (panel.subject, panel.other, *panel.others)]
    if panel.relation == "between":
        return "is" if is_between(*boxes) else "may be" if may_be_between(*boxes) else "is not"
    floor = np.array([[-9.0, -9.0, -0.1], [9.0, 9.0, 0.0]])
    names = [*panel.names, *["thing"] * len(panel.others), "floor"]
    relation: Relation = next(name for name in RELATIONS if name == panel.relation)
    relations = Relations(np.array([*boxes, floor]), names)
    if relations.doubtful(relation)[0, 1]:
        return "may be"
    return "is" if relations.of(relation)[0, 1] else "is not"


def place_of_name(panel: Panel, box: Box, name: str) -> tuple[tuple[float, float], dict[str, str]]:
    """Position and alignment of a name so that nothing overlaps it.

    In the centre of its box; above a box narrower than the name; in the corner of a box that contains the other.
    """
    x, y = panel.view
    low, high = bounds(box)
    middle = (low + high) / 2
    if len(name) > 1 and high[x] - low[x] < NARROW:
        return (middle[x], high[y] + 0.03), {"ha": "center", "va": "bottom"}
    first = bounds(panel.subject)
    if box == panel.other and (np.minimum(high, first[1]) - np.maximum(low, first[0]))[[x, y]].min() > 0.01:
        return (low[x] + 0.03, high[y] - 0.03), {"ha": "left", "va": "top"}
    return (middle[x], middle[y]), {"ha": "center", "va": "center"}


def draw(path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    columns = 8
    rows = -(-len(PANELS) // columns)
    figure = Figure(figsize=(2.1 * columns, 2.5 * rows), layout="constrained")
    for panel, axes in zip(PANELS, figure.subplots(rows, columns).flat, strict=True):
        word = answer(panel)
        colour = {"is": GREEN, "is not": RED, "may be": ORANGE}[word]
        drawn = [(panel.subject, colour, panel.names[0]), (panel.other, BLUE, panel.names[1])]
        for box, shade, name in [*((box, GREY, "") for box in panel.others), *reversed(drawn)]:
            low, high = bounds(box)
            x, y = panel.view
            size = high - low
            axes.add_patch(Rectangle((low[x], low[y]), size[x], max(size[y], 0.02), facecolor=shade, alpha=0.75))
            place, ways = place_of_name(panel, box, name)
            axes.text(*place, name, fontsize=8, **ways)
        if panel.view == SIDE:
            axes.axhline(0, color="#555555", linewidth=1)
        axes.set_title(f"{word} {panel.relation}", fontsize=9, color=colour, fontweight="bold")
        axes.set_xlabel(f"{panel.text}\n({'side' if panel.view == SIDE else 'from above'})", fontsize=7.5)
        axes.margins(0.16)
        axes.set_aspect("equal", adjustable="datalim")  # so that all panels have one size
        axes.set_xticks([])
        axes.set_yticks([])
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures/relations.png"))
