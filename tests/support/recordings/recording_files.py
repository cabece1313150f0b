"""Write the files of a synthetic recording, and the floor shown by most of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.formats.images import UInt16Array, jpeg_bytes, png_bytes
from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply

LEFT, RIGHT = (200, 60, 40), (40, 80, 200)
HEIGHT_M = 2.0
WIDTH, HEIGHT = 12, 8  # of images whose depth identifies the pixel


def depth_values(index: int) -> UInt16Array:
    """A depth image of frame ``index``, with a different value in each pixel."""
    return np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * np.uint16(600) + np.uint16(index)


def text_of(matrix: np.ndarray) -> str:
    """One row per line, in full precision."""
    return "\n".join(" ".join(repr(float(value)) for value in row) for row in matrix) + "\n"


def write_files(root: Path, files: Mapping[str, Any]) -> None:
    """Write files below ``root``: bytes, texts, and by file extension JSON, images, clouds and tables."""
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        match path.suffix if not isinstance(content, bytes) else "bytes":
            case "bytes":
                path.write_bytes(content)
            case ".png" | ".jpg":
                path.write_bytes(png_bytes(content) if path.suffix == ".png" else jpeg_bytes(content))
            case ".json":
                path.write_text(json.dumps(content))
            case ".ply":
                columns = {axis: np.array(content)[:, i] for i, axis in enumerate("xyz")}
                write_ply(path, [PlyElement("vertex", len(content), columns)])
            case ".h5":
                with h5py.File(path, "w") as file:
                    file.create_dataset(path.stem, data=content)
            case _:
                path.write_text(content)


def turn(index: int) -> Float64Array:
    """A pose that moves and rotates."""
    matrix, angle = np.eye(4), 0.1 * index
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = index, 1 / 3, -index
    return matrix


def pose(x_m: float) -> Float64Array:
    """Above the floor at ``x_m``, 1 m from its edge, looking down."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[:3, 3] = x_m, 1.0, HEIGHT_M
    return matrix


def floor_image(size: tuple[int, int], x_m: float) -> UInt8Array:
    """The view of a camera at ``pose(x_m)``: ``LEFT`` of x = 2 m and ``RIGHT`` of it."""
    u = (np.arange(size[0]) - (size[0] - 1) / 2) / size[0]
    row = np.where((u * HEIGHT_M + x_m < 2.0)[:, None], LEFT, RIGHT).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(row, (size[1], *row.shape)))


def grid(columns: int = 6, rows: int = 4, spacing_m: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a floor, row by row, and two triangles per cell."""
    y, x = np.mgrid[:rows, :columns]
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float32) * np.float32(spacing_m)
    a = (y * columns + x)[:-1, :-1].reshape(-1)
    b = a + columns
    return points, np.stack([a, a + 1, b, a + 1, b + 1, b], axis=-1).reshape(-1, 3).astype(np.int32)


def write_mesh(path: Path, points: np.ndarray, triangles: np.ndarray, labels: np.ndarray | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    columns: dict[str, Any] = {axis: points[:, i].copy() for i, axis in enumerate("xyz")}
    columns |= {channel: np.full(len(points), 90, np.uint8) for channel in ("red", "green", "blue", "alpha")}
    columns |= {} if labels is None else {"label": labels.astype(np.uint16)}
    corners = ListColumn(np.arange(len(triangles) + 1) * 3, triangles.reshape(-1))
    faces = PlyElement("face", len(triangles), {"vertex_indices": corners})
    write_ply(path, [PlyElement("vertex", len(points), columns), faces])
