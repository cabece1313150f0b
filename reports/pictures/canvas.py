"""A white page on which pictures and words are put, drawn by matplotlib and measured from its upper left corner."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from su3d_bench.core.files.atomic import make_folder, write_bytes
from su3d_bench.core.types import UInt8Array

DPI = 100
DARK, GREY = "#222222", "#666666"
METADATA = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {"Software": None}}  # one figure, one file


class Canvas:
    """A page of ``width`` by ``height``, of which ``per_inch`` make an inch: pixels unless it is told otherwise."""

    def __init__(self, width: float, height: float, *, per_inch: float = DPI, dpi: int = DPI) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / per_inch, height / per_inch), dpi=dpi, facecolor="white")
        FigureCanvasAgg(self.figure)

    def text(self, x: float, y: float, text: str, size: float, *, colour: str = DARK, **more: Any) -> None:
        """Write ``text``, never as mathematics, its upper left corner at this place."""
        style: dict[str, Any] = {"va": "top", "fontsize": size, "color": colour, "parse_math": False} | more
        self.figure.text(x / self.width, 1 - y / self.height, drawable(text), **style)

    def axes(self, x: float, y: float, width: float, height: float) -> Any:
        """Axes without a frame at this place."""
        box = (x / self.width, 1 - (y + height) / self.height, width / self.width, height / self.height)
        axes = self.figure.add_axes(box)
        axes.set_axis_off()
        return axes

    def picture(self, x: float, y: float, width: float, height: float, pixels: UInt8Array) -> Any:
        """Axes at this place whose unit is a pixel of the picture that fills them."""
        axes = self.axes(x, y, width, height)
        axes.imshow(pixels, interpolation="nearest", aspect="auto")
        axes.set_xlim(-0.5, pixels.shape[1] - 0.5)
        axes.set_ylim(pixels.shape[0] - 0.5, -0.5)
        return axes

    def write(self, path: Path) -> None:
        """Write the page as a PNG, with its folder."""
        make_folder(path.parent)
        write_bytes(path, figure_bytes(self.figure, "png"))


def figure_bytes(figure: Any, kind: str, dpi: float | None = None) -> bytes:
    """The file of a figure: the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi or "figure", metadata=METADATA[kind])
    return buffer.getvalue()


def drawable(text: str) -> str:
    """``text`` with what the font cannot draw written as its escape."""
    from matplotlib.font_manager import findfont, get_font

    known = get_font(findfont("DejaVu Sans")).get_charmap()
    return "".join(c if ord(c) in known else c.encode("unicode_escape").decode("ascii") for c in text)


def paper(edge: str = "none", pad: float = 0.15, alpha: float = 0.85, **more: Any) -> dict[str, Any]:
    """The white box with round corners on which words stand in a picture."""
    return {"boxstyle": f"round,pad={pad}", "facecolor": "white", "edgecolor": edge, "alpha": alpha} | more


def hex_of(colour: tuple[int, ...]) -> str:
    """A colour as matplotlib takes it.

    >>> hex_of((255, 0, 16))
    '#ff0010'
    """
    return "#{:02x}{:02x}{:02x}".format(*colour)
