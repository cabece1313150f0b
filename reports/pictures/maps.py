"""Pictures of a map: by instance, by class next to the ground truth, and as the heat map of a query."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import printable
from su3d_bench.core.files.atomic import make_folder
from su3d_bench.core.geometry import voxel_coordinates
from su3d_bench.core.maps import DenseFeatures, Instances, Prediction
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, GroundTruth, Int32Array, Int64Array, UInt8Array
from su3d_bench.formats.images import png_bytes
from su3d_bench.reports.pictures import canvas
from su3d_bench.reports.pictures.items import OUTLINE, draw_outline

PALE_GREY = 232
RENDERED = 1.5  # render scale; a room fills only a part of a corner view
BORDER = 4  # pixels around the content


@dataclass(frozen=True)
class MapView:
    """One view of a map; ``view.point`` holds rows of the drawn points, ``camera`` renders at twice the size.

    Only the part ``box`` (x0, y0, x1, y1 in pixels of the picture) is shown.
    """

    camera: canvas.Camera
    view: canvas.View
    box: tuple[int, int, int, int]

    @cached_property
    def shown(self) -> canvas.View:
        """The visible part of ``view``."""
        x0, y0, x1, y1 = (canvas.OVERSAMPLING * side for side in self.box)
        part = slice(y0, y1), slice(x0, x1)
        return canvas.View(np.ascontiguousarray(self.view.point[part]), np.ascontiguousarray(self.view.shade[part]))

    def shows(self, is_member: BoolArray) -> BoolArray:
        """Return the mask (h, w) of the picture pixels that show a point with ``is_member``."""
        point, known = self.shown.point, np.append(is_member, False)
        seen: BoolArray = (
            known[point[:: canvas.OVERSAMPLING, :: canvas.OVERSAMPLING]]
            | known[point[1 :: canvas.OVERSAMPLING, 1 :: canvas.OVERSAMPLING]]
        )
        return seen

    def project(self, points: Float64Array) -> Float64Array:
        """Project world points to columns and rows (N, 2), as fractions of the shown width and height."""
        x0, y0, x1, y1 = self.box
        shares: Float64Array = (canvas.project(self.camera, points) - np.array([x0, y0])) / np.array([x1 - x0, y1 - y0])
        return shares


@dataclass(frozen=True)
class DrawnMap:
    """A map downsampled for drawing: ``rows`` of the drawn points, ``owner``: the smallest instance of each."""

    instances: Instances
    rows: Int64Array
    owner: Int32Array

    def members(self, instance_rows: Sequence[int]) -> BoolArray:
        """Return the mask of the drawn points that belong to any of these instances."""
        is_member = np.zeros(len(self.instances.points), np.bool_)
        for k in instance_rows:
            is_member[self.instances.mask(int(k))] = True
        members: BoolArray = is_member[self.rows]
        return members

    def view(self, camera: canvas.Camera) -> MapView:
        return view_of(self.instances.points[self.rows], camera)

    def cameras(self, width: int, height: int) -> tuple[canvas.Camera, canvas.Camera, canvas.Camera]:
        """Return cameras from above and from two opposite corners, for views of this aspect and at least this size."""
        return cameras_of(self.instances.points, width, height)

    def paint(self, view: MapView, colours: UInt8Array) -> UInt8Array:
        """Return the picture of a view, instance k in ``colours[k]``."""
        palette = np.concatenate([colours.reshape(-1, 3), np.array([canvas.NO_INSTANCE], np.uint8)])
        return self.paint_points(view, palette[self.owner])

    def paint_points(self, view: MapView, colours: UInt8Array) -> UInt8Array:
        """Return the picture of a view, each drawn point in its colour (N, 3)."""
        return canvas.colour(view.shown, colours)


def view_of(points: Float32Array, camera: canvas.Camera) -> MapView:
    """Render ``points`` with a camera, cropped to the content."""
    view = canvas.render(points, SQUARE_M, camera)
    return MapView(camera, view, _filled_part(view, camera.width / camera.height))


def cameras_of(points: Float32Array, width: int, height: int) -> tuple[canvas.Camera, canvas.Camera, canvas.Camera]:
    """Return cameras from above and from two opposite corners, for views of this aspect and at least this size."""
    return canvas.view_cameras(canvas.room_bounds(points), round(RENDERED * width), round(RENDERED * height))


def drawn_map(instances: Instances) -> DrawnMap:
    """Downsample the map of ``instances`` for drawing; where masks overlap, the smaller one is visible."""
    rows = thinned_rows(instances.points)
    return DrawnMap(instances, rows, map_cloud(instances).owner[rows])


def _filled_part(view: canvas.View, aspect: float) -> tuple[int, int, int, int]:
    """Return the smallest part of a view, with this aspect ratio, that contains everything drawn."""
    height, width = (side // canvas.OVERSAMPLING for side in view.point.shape)
    rows, columns = np.nonzero(view.point >= 0)
    if not len(rows):
        return 0, 0, width, height
    left, right = columns.min() / canvas.OVERSAMPLING - BORDER, columns.max() / canvas.OVERSAMPLING + BORDER
    upper, lower = rows.min() / canvas.OVERSAMPLING - BORDER, rows.max() / canvas.OVERSAMPLING + BORDER
    tall = min(max(lower - upper, (right - left) / aspect), float(height), width / aspect)
    wide = tall * aspect
    x0 = int(np.clip((left + right - wide) / 2, 0, width - wide))
    y0 = int(np.clip((upper + lower - tall) / 2, 0, height - tall))
    return x0, y0, x0 + int(wide), y0 + int(tall)


def pale(colours: UInt8Array, share: float) -> UInt8Array:
    """Blend ``colours`` with light grey; ``share`` of the colour remains."""
    return np.rint(share * colours.astype(np.float64) + (1 - share) * PALE_GREY).astype(np.uint8)


VIEW_WIDTH, VIEW_HEIGHT = 640, 560
THUMBNAIL = (240, 180)  # pixels
DRAWN_SPACING_M = 0.015  # one point per cell of this size is drawn
SQUARE_M = 2.6 * DRAWN_SPACING_M  # no gaps between surface points up to two cells apart
LEGEND_STEP, COLUMN_WIDTH, MAX_COLUMNS = 22, 250, 10  # pixels; layout of the legend
MAX_NAME = 26  # characters per name in the legend
CELLS_PER_ROW: dict[canvas.Width, int] = {"8cm": 2, "17cm": 4}  # three views and the ranking; a cell is 4 cm wide
BAR_IN = 0.1
MAX_RANKS = 10  # drawn on instances; more would hide them
RANK_RADIUS, SMALL_PIXELS = 36, 20_000  # a rank would hide an instance with fewer pixels
PALE = "#555555"
VIEW_TITLES = ("from above", "from one corner", "from the other corner")


@dataclass(frozen=True)
class Cloud:
    """Points to draw and, per point, the row of its instance or class (-1: none)."""

    points: Float32Array
    owner: Int32Array


def draw_scene(prediction: Prediction, truth: GroundTruth | None, folder: Path, title: str) -> list[Path]:
    """Write ``instances.png`` and, for maps with names, ``classes.png`` with ground truth below; return the paths.

    Nothing is written for an empty map or dense features, which have no instances.
    """
    if isinstance(prediction, DenseFeatures) or len(prediction.points) == 0:
        return []
    make_folder(folder)
    cloud = thinned(map_cloud(prediction))
    cameras = _cameras(cloud.points if truth is None else truth.points)
    views = _views(cloud, cameras)
    names = names_of(prediction)
    row_colours = canvas.instance_colours(names)
    instances = folder / "instances.png"
    _write_picture(instances, f"{title}: {len(names)} instances", [("", _paint(views, cloud, row_colours))], {})
    if not any(names):
        return [instances]
    classes = folder / "classes.png"
    truth_cloud = None if truth is None else thinned(Cloud(truth.points, truth_owner(truth)))
    truth_names = () if truth is None else truth.labels.names
    used = [] if truth_cloud is None else _by_size(truth_cloud, truth_names)
    used += [name for name in _by_size(cloud, names) if name not in used]
    palette = canvas.class_colours([*used, *names])
    rows = [("map", _paint(views, cloud, [palette[name] for name in names]))]
    if truth_cloud is not None:
        colours = [palette.get(name, canvas.NO_INSTANCE) for name in truth_names]
        rows.append(("ground truth", _paint(_views(truth_cloud, cameras), truth_cloud, colours)))
    legend = {name or "unnamed": palette[name] for name in used}
    if (cloud.owner < 0).any():
        legend["no instance"] = canvas.NO_INSTANCE
    _write_picture(classes, f"{title}: classes", rows, legend)
    return [instances, classes]


def thumbnail(prediction: Prediction) -> bytes | None:
    """Return a small PNG of a map from one corner, in the colours of its classes; None without instances."""
    if isinstance(prediction, DenseFeatures) or len(prediction.points) == 0:
        return None
    cloud, names = thinned(map_cloud(prediction)), names_of(prediction)
    camera = canvas.view_cameras(canvas.room_bounds(cloud.points), *THUMBNAIL)[1]
    palette = canvas.class_colours(names)
    colours = [palette[name] for name in names] if any(names) else canvas.instance_colours(names)
    (picture,) = _paint([canvas.render(cloud.points, SQUARE_M, camera)], cloud, colours)
    return png_bytes(picture)


@canvas.figure_style()
def draw_heat_map(
    instances: Instances, similarity: Float64Array, path: Path, caption: str, top: Sequence[str],
    width: canvas.Width = "17cm",
) -> None:  # fmt: skip
    """Write the heat map of a query: each instance in the colour of its similarity, the best one outlined.

    ``top``: texts of the most similar instances, best first; their ranks are drawn on them.
    """
    cloud = thinned(map_cloud(instances))
    views = _views(cloud, _cameras(cloud.points))
    order = np.argsort(-similarity, kind="stable")[: len(top)]
    pictures = _paint(views, cloud, canvas.heat_colours(similarity))
    owner_of = np.append(cloud.owner, np.int32(-1))  # per pixel (h, w) the instance shown, -1 for none
    seen: list[Int32Array] = [owner_of[view.point[:: canvas.OVERSAMPLING, :: canvas.OVERSAMPLING]] for view in views]
    panels = canvas.Panels(width, CELLS_PER_ROW[width], 4, VIEW_HEIGHT / VIEW_WIDTH)
    for k, (picture, owners) in enumerate(zip(pictures, seen, strict=True)):
        for best in order[:1]:
            draw_outline(picture, owners == best, 4)
        _write_ranks(panels.draw(k, VIEW_TITLES[k], picture), owners, order[:MAX_RANKS])
    _write_ranking(panels, similarity, top)
    panels.page.write(path, caption)


def _write_ranks(axes: Any, owners: Int32Array, order: Int64Array) -> None:
    """Draw the rank of each visible instance at its centre, or next to it if other ranks are in the way."""
    taken: list[Float64Array] = []
    for rank, row in enumerate(order, start=1):
        places = np.argwhere(owners == row)[:, ::-1]
        if not len(places):
            continue
        middle = np.median(places, axis=0)
        middle = places[np.argmin(((places - middle) ** 2).sum(axis=1))].astype(np.float64)  # on the instance
        at = _free_place(middle, taken, is_beside=len(places) < SMALL_PIXELS)
        taken.append(at)
        if not np.array_equal(at, middle):
            axes.plot(*np.stack([middle, at]).T, color=canvas.DARK, linewidth=0.6)
        shade = canvas.hex_of(OUTLINE) if rank == 1 else canvas.DARK
        axes.text(*at, str(rank), color=canvas.DARK, ha="center", va="center", fontweight="bold",
                  bbox=canvas.paper(shade, 0.15, 0.92, linewidth=1.2 if rank == 1 else 0.6))  # fmt: skip


def _free_place(wanted: Float64Array, taken: Sequence[Float64Array], *, is_beside: bool) -> Float64Array:
    """Return the position nearest to ``wanted``, on rings around it, that does not overlap those ``taken``.

    ``is_beside``: not ``wanted`` itself, where the rank would hide the instance.
    """
    low, high = np.full(2, RANK_RADIUS), np.array([VIEW_WIDTH, VIEW_HEIGHT]) - RANK_RADIUS
    for ring in range(2 if is_beside else 0, 14):
        for turn in np.arange(0.0, 2 * np.pi, np.pi / (4 * max(1, ring))):
            away = 1.5 * RANK_RADIUS * ring * np.array([np.cos(turn), -np.sin(turn)])
            at = np.clip(wanted + away, low, high)
            if all(np.abs(at - other).max() >= 2 * RANK_RADIUS for other in taken):
                return at if ring else wanted
    return wanted


def _write_ranking(panels: canvas.Panels, similarity: Float64Array, lines: Sequence[str]) -> None:
    """Draw the colour bar of similarity with its range, and the list of the most similar instances below."""
    page, (left, upper), wide = panels.page, panels.places[-1], panels.width - 0.12
    left += 0.08
    page.text(left, upper, "cosine similarity")
    if len(similarity):
        low, high = float(similarity.min()), float(similarity.max())
        is_one = high == low
        colours = np.array(canvas.heat_colours(similarity[:1]), np.uint8) if is_one else canvas.scale_stops("paper")
        page.axes(left, upper + canvas.LINE_IN, wide, BAR_IN).imshow(colours[None], aspect="auto")
        numbers = upper + canvas.LINE_IN + BAR_IN + 0.02
        page.text(left, numbers, f"{low:.3f}")
        if not is_one:
            page.text(left + wide, numbers, f"{high:.3f}", ha="right")
    first = upper + 2 * canvas.LINE_IN + BAR_IN + 0.08
    room = int((page.height - first) / canvas.LINE_IN)
    if len(lines) > room:
        lines = [*lines[: room - 1], f"and {len(lines) - room + 1} more"]
    for k, line in enumerate(lines):
        weight = "bold" if k == 0 else "normal"
        shown = printable(line, int(wide * canvas.LETTERS_PER_INCH))
        page.text(left, first + canvas.LINE_IN * k, shown, fontweight=weight)


def names_of(prediction: Prediction) -> tuple[str, ...]:
    """Return the shown name of each instance: the method's label, otherwise the name given by perception."""
    if isinstance(prediction, Instances):
        labels = prediction.labels or prediction.names
        return tuple(label or name for label, name in zip(labels, prediction.names, strict=True))
    return () if isinstance(prediction, DenseFeatures) else ("",) * len(prediction.features)


def map_cloud(prediction: Prediction) -> Cloud:
    """Return the points of a map with their instances; where masks overlap, the smaller one."""
    assert not isinstance(prediction, DenseFeatures)
    if not isinstance(prediction, Instances):
        return Cloud(prediction.points, prediction.instance)
    owner = np.full(len(prediction.points), -1, np.int32)
    for k in np.argsort(-prediction.sizes, kind="stable"):
        owner[prediction.mask(int(k))] = k
    return Cloud(prediction.points, owner)


def truth_owner(truth: GroundTruth) -> Int32Array:
    """Return the row of ``truth.labels`` per point; -1 if unannotated."""
    row_of_id = {class_id: row for row, class_id in enumerate(truth.labels.ids)}
    ids, inverse = np.unique(truth.semantic, return_inverse=True)
    rows = np.array([row_of_id.get(int(class_id), -1) for class_id in ids], np.int32)
    return rows[inverse.reshape(-1)] if len(ids) else np.zeros(0, np.int32)


def thinned(cloud: Cloud) -> Cloud:
    """Downsample to one point per cell of ``DRAWN_SPACING_M``, the resolution of pictures."""
    rows = thinned_rows(cloud.points)
    return Cloud(cloud.points[rows], cloud.owner[rows])


def thinned_rows(points: Float32Array) -> Int64Array:
    """Return the rows of ``points`` that are drawn: one per cell."""
    cells = voxel_coordinates(points, DRAWN_SPACING_M)
    if len(cells) == 0:
        return np.zeros(0, np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    _, first = np.unique((cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2], return_index=True)
    return first


def _cameras(points: Float32Array) -> tuple[canvas.Camera, ...]:
    return canvas.view_cameras(canvas.room_bounds(points), VIEW_WIDTH, VIEW_HEIGHT)


def _views(cloud: Cloud, cameras: Sequence[canvas.Camera]) -> tuple[canvas.View, ...]:
    return tuple(canvas.render(cloud.points, SQUARE_M, camera) for camera in cameras)


def _paint(views: Sequence[canvas.View], cloud: Cloud, row_colours: Sequence[canvas.Colour]) -> tuple[UInt8Array, ...]:
    palette = np.array([*row_colours, canvas.NO_INSTANCE], np.uint8)
    return tuple(canvas.colour(view, palette[cloud.owner]) for view in views)


def _by_size(cloud: Cloud, names: Sequence[str]) -> list[str]:
    """Return the distinct names that have points, largest surface first."""
    counts = np.bincount(cloud.owner[cloud.owner >= 0], minlength=len(names))
    totals: dict[str, int] = {}
    for name, count in zip(names, counts, strict=True):
        totals[name] = totals.get(name, 0) + int(count)
    return sorted((name for name in totals if totals[name] > 0), key=lambda name: (-totals[name], name))


def _write_picture(
    path: Path, title: str, rows: Sequence[tuple[str, tuple[UInt8Array, ...]]], legend: Mapping[str, canvas.Colour]
) -> None:
    """Compose views and legend into a PNG; the legend uses as many columns as needed."""
    header = 46
    height = len(rows) * VIEW_HEIGHT + header
    a_column = (height - header) // LEGEND_STEP
    n_columns = min(MAX_COLUMNS, -(-len(legend) // a_column))
    page = canvas.Canvas(3 * VIEW_WIDTH + n_columns * COLUMN_WIDTH, height)
    page.text(14, 16, printable(title, 150), 14, fontweight="bold")
    for r, (name, pictures) in enumerate(rows):
        _place_views(page, header + r * VIEW_HEIGHT, name, pictures)
    shown = list(legend.items())
    most = n_columns * a_column
    if len(shown) > most:
        shown = [*shown[: most - 1], (f"and {len(shown) - most + 1} more", canvas.NO_INSTANCE)]
    for k, (name, rgb) in enumerate(shown):
        column, row_of = divmod(k, a_column)
        left, middle = 3 * VIEW_WIDTH + column * COLUMN_WIDTH, header + LEGEND_STEP * row_of + 12
        page.text(left + 8, middle, "\u25a0", 15, colour=canvas.hex_of(rgb), va="center")
        page.text(left + 30, middle, printable(name, MAX_NAME), 10, va="center")
    page.write(path)


def _place_views(page: canvas.Canvas, top: float, name: str, pictures: Sequence[UInt8Array]) -> list[Any]:
    """Return the axes of the three labelled views of a row."""
    placed = []
    for c, picture in enumerate(pictures):
        axes = page.picture(c * VIEW_WIDTH, top, VIEW_WIDTH, VIEW_HEIGHT, picture)
        label = f"{name} {VIEW_TITLES[c]}".strip()
        axes.text(14, VIEW_HEIGHT - 14, label, fontsize=10, color=PALE, va="bottom", bbox=canvas.paper())
        placed.append(axes)
    return placed
