"""Pictures of a map for people: by instance, by class beside the ground truth, and as the heat map of a query."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from su3d_bench.core.types import (
    DenseFeatures,
    Float32Array,
    Float64Array,
    GroundTruth,
    Instances,
    Int32Array,
    Int64Array,
    Prediction,
    UInt8Array,
)
from su3d_bench.numerics.geometry import voxel_coordinates
from su3d_bench.reports.pictures.canvas import Canvas, hex_of
from su3d_bench.reports.pictures.render import Camera, View, colour, render, room_bounds, view_cameras
from su3d_bench.store.atomic import make_folder

VIEW_WIDTH, VIEW_HEIGHT = 640, 560
DRAWN_SPACING_M = 0.015  # one point a cell of this size is drawn
SQUARE_M = 2.6 * DRAWN_SPACING_M  # no gaps in a surface whose points lie up to two cells apart
PALE = "#555555"
NO_INSTANCE = (214, 214, 210)
# Surfaces of the room stay pale, so that the things in it stand out.
ROOM_SURFACES = {"wall": (226, 222, 214), "floor": (208, 203, 196), "ceiling": (236, 236, 232)}
LEGEND_ROWS = 26
VIEW_TITLES = ("from above", "from one corner", "from the other corner")
# The most similar instance dark red, the least similar dark blue, as in the paper's heat maps.
HEAT_STOPS = np.array(
    [[0, 0, 128], [0, 80, 255], [90, 215, 190], [250, 190, 40], [230, 50, 10], [128, 0, 0]], np.float64
)

Colour = tuple[int, int, int]
Scale = Literal["paper", "cividis"]
SCALES: tuple[Scale, ...] = ("paper", "cividis")
STEPS = 256


@dataclass(frozen=True)
class Cloud:
    """Points to draw and, a point each, the row of what they belong to (-1: nothing)."""

    points: Float32Array
    owner: Int32Array


@dataclass(frozen=True)
class Row:
    """A row of a picture: three views of one cloud in one colouring."""

    title: str
    pictures: tuple[UInt8Array, ...]


def draw_scene(prediction: Prediction, truth: GroundTruth | None, folder: Path, title: str) -> list[Path]:
    """Write ``instances.png`` and, where the map has names, ``classes.png`` with the truth below; their paths.

    Nothing is drawn of an empty map or of dense features, which have no instances.
    """
    if isinstance(prediction, DenseFeatures) or len(prediction.points) == 0:
        return []
    make_folder(folder)
    cloud = thinned(map_cloud(prediction))
    cameras = _cameras(cloud.points if truth is None else truth.points)
    views = _views(cloud, cameras)
    names = _names_of(prediction)
    row_colours = instance_colours(names)
    instances = folder / "instances.png"
    _write_picture(instances, f"{title}: {len(names)} instances", [Row("", _paint(views, cloud, row_colours))], {})
    if not any(names):
        return [instances]
    classes = folder / "classes.png"
    truth_cloud = None if truth is None else thinned(Cloud(truth.points, truth_owner(truth)))
    truth_names = () if truth is None else truth.labels.names
    used = _by_size(cloud, names) if truth_cloud is None else _by_size(truth_cloud, truth_names)
    palette = class_colours([*used, *(name for name in _by_size(cloud, names) if name not in used)])
    rows = [Row("map", _paint(views, cloud, [palette[name] for name in names]))]
    if truth_cloud is not None:
        colours = [palette.get(name, NO_INSTANCE) for name in truth_names]
        rows.append(Row("ground truth", _paint(_views(truth_cloud, cameras), truth_cloud, colours)))
    _write_picture(classes, f"{title}: classes", rows, palette)
    return [instances, classes]


def draw_heat_map(instances: Instances, similarity: Float64Array, path: Path, title: str, top: Sequence[str]) -> None:
    """Write the picture of a query: each instance in the colour of its similarity; ``top`` are lines of the legend."""
    make_folder(path.parent)
    cloud = thinned(map_cloud(instances))
    colours = heat_colours(similarity)
    pictures = _paint(_views(cloud, _cameras(cloud.points)), cloud, colours)
    order = np.argsort(-similarity, kind="stable")[: len(top)]
    _write_picture(path, title, [Row("", pictures)], {line: colours[k] for line, k in zip(top, order, strict=True)})


def heat_colours(similarity: Float64Array) -> list[Colour]:
    """Dark blue for the least, dark red for the greatest of ``similarity``; all alike: the middle."""
    if len(similarity) == 0:
        return []
    place = _places(similarity)
    stops = np.linspace(0.0, 1.0, len(HEAT_STOPS))
    channels = [np.rint(np.interp(place, stops, HEAT_STOPS[:, c])).astype(int) for c in range(3)]
    return [(int(r), int(g), int(b)) for r, g, b in zip(*channels, strict=True)]


def _places(similarity: Float64Array) -> Float64Array:
    """Where each value lies between the least and the greatest of them; all alike: in the middle."""
    low, high = float(similarity.min()), float(similarity.max())
    return np.full(len(similarity), 0.5) if high == low else (similarity - low) / (high - low)


def scale_stops(scale: Scale) -> UInt8Array:
    """The colours (256, 3) of a scale, the least similar first."""
    if scale == "cividis":  # Nunez, Anderton, Renslow 2018
        from matplotlib import colormaps

        colours: UInt8Array = (colormaps["cividis"](np.arange(STEPS), bytes=True))[:, :3].astype(np.uint8)
        return colours
    return np.array(heat_colours(np.linspace(0.0, 1.0, STEPS)), np.uint8)


def similarity_colours(similarity: Float64Array, scale: Scale = "paper") -> UInt8Array:
    """A colour (K, 3) a value, from the least to the greatest of them; all alike: the middle.

    >>> similarity_colours(np.array([0.2, 0.1, 0.3]))[1:].tolist()
    [[0, 0, 128], [128, 0, 0]]
    """
    if len(similarity) == 0:
        return np.zeros((0, 3), np.uint8)
    colours: UInt8Array = scale_stops(scale)[np.rint(_places(similarity) * (STEPS - 1)).astype(np.int64)]
    return colours


def instance_colours(names: Sequence[str]) -> list[Colour]:
    """One colour an instance, neighbours in the list far apart in hue; surfaces of the room pale."""
    return [ROOM_SURFACES.get(name) or _distinct(k) for k, name in enumerate(names)]


def class_colours(names: Sequence[str]) -> dict[str, Colour]:
    """Name -> colour in the order given, the first ones most distinct; surfaces of the room pale."""
    things = [name for name in names if name not in ROOM_SURFACES]
    return {name: ROOM_SURFACES[name] if name in ROOM_SURFACES else _distinct(things.index(name)) for name in names}


def _distinct(k: int) -> Colour:
    """The k-th of an endless list of colours: hues by the golden ratio, saturation and value in turns."""
    saturation, value = ((0.72, 0.86), (0.55, 0.95), (0.85, 0.62))[(k // 8) % 3]
    red, green, blue = colorsys.hsv_to_rgb((0.58 + k * 0.61803398875) % 1.0, saturation, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def _names_of(prediction: Prediction) -> tuple[str, ...]:
    if isinstance(prediction, Instances):
        labels = prediction.labels or prediction.names
        return tuple(label or name for label, name in zip(labels, prediction.names, strict=True))
    assert not isinstance(prediction, DenseFeatures)
    return ("",) * len(prediction.features)


def map_cloud(prediction: Prediction) -> Cloud:
    """The points of a map with their instances; of masks that overlap, the smaller one is seen."""
    assert not isinstance(prediction, DenseFeatures)
    if not isinstance(prediction, Instances):
        return Cloud(prediction.points, prediction.instance)
    owner = np.full(len(prediction.points), -1, np.int32)
    for k in np.argsort(-prediction.sizes, kind="stable"):
        owner[prediction.mask(int(k))] = k
    return Cloud(prediction.points, owner)


def truth_owner(truth: GroundTruth) -> Int32Array:
    """Row of ``truth.labels`` a point; -1 where unannotated."""
    row_of_id = {class_id: row for row, class_id in enumerate(truth.labels.ids)}
    ids, inverse = np.unique(truth.semantic, return_inverse=True)
    rows = np.array([row_of_id.get(int(class_id), -1) for class_id in ids], np.int32)
    return rows[inverse.reshape(-1)] if len(ids) else np.zeros(0, np.int32)


def thinned(cloud: Cloud) -> Cloud:
    """One point of each cell of ``DRAWN_SPACING_M``, which is all that a picture can show."""
    rows = thinned_rows(cloud.points)
    return Cloud(cloud.points[rows], cloud.owner[rows])


def thinned_rows(points: Float32Array) -> Int64Array:
    """The rows of ``points`` that are drawn."""
    cells = voxel_coordinates(points, DRAWN_SPACING_M)
    if len(cells) == 0:
        return np.zeros(0, np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    _, first = np.unique((cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2], return_index=True)
    return first


def _cameras(points: Float32Array) -> tuple[Camera, ...]:
    return view_cameras(room_bounds(points), VIEW_WIDTH, VIEW_HEIGHT)


def _views(cloud: Cloud, cameras: Sequence[Camera]) -> tuple[View, ...]:
    return tuple(render(cloud.points, SQUARE_M, camera) for camera in cameras)


def _paint(views: Sequence[View], cloud: Cloud, row_colours: Sequence[Colour]) -> tuple[UInt8Array, ...]:
    palette = np.array([*row_colours, NO_INSTANCE], np.uint8)
    return tuple(colour(view, palette[cloud.owner]) for view in views)


def _by_size(cloud: Cloud, names: Sequence[str]) -> list[str]:
    """Names of what is there, the largest surface first, each once."""
    counts = np.bincount(cloud.owner[cloud.owner >= 0], minlength=len(names))
    totals: dict[str, int] = {}
    for name, count in zip(names, counts, strict=True):
        totals[name] = totals.get(name, 0) + int(count)
    return sorted((name for name in totals if totals[name] > 0), key=lambda name: (-totals[name], name))


def _write_picture(path: Path, title: str, rows: Sequence[Row], legend: Mapping[str, Colour]) -> None:
    """Compose views and legend into a PNG; a legend that is too long ends with how many it leaves out."""
    header, side = 46, 250 if legend else 0
    page = Canvas(3 * VIEW_WIDTH + side, len(rows) * VIEW_HEIGHT + header)
    page.text(14, 16, title, 14, fontweight="bold")
    for r, row in enumerate(rows):
        for c, picture in enumerate(row.pictures):
            axes = page.picture(c * VIEW_WIDTH, header + r * VIEW_HEIGHT, VIEW_WIDTH, VIEW_HEIGHT, picture)
            label = f"{row.title} {VIEW_TITLES[c]}".strip()
            axes.text(14, VIEW_HEIGHT - 14, label, fontsize=10, color=PALE, va="bottom")
    left = 3 * VIEW_WIDTH
    for k, (name, rgb) in enumerate(list(legend.items())[:LEGEND_ROWS]):
        page.text(left + 8, header + 22 * k + 12, "\u25a0", 15, colour=hex_of(rgb), va="center")
        page.text(left + 30, header + 22 * k + 12, name, 10, va="center")
    if len(legend) > LEGEND_ROWS:
        rest = f"and {len(legend) - LEGEND_ROWS} more"
        page.text(left + 30, header + 22 * LEGEND_ROWS + 12, rest, 10, colour=PALE, va="center")
    page.write(path)
