"""A small scan in the files of ScanNet: a floor of two halves, seen from above, annotated by segments."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.types import Float64Array, UInt8Array
from su3d_bench.datasets.scannet.sens import ColourCompression, DepthCompression, SensFrame, SensHeader, write_sens
from su3d_bench.formats.images import UInt16Array, jpeg_bytes, png_bytes
from su3d_bench.formats.ply import ListColumn, PlyElement, write_ply

SCAN = "scene0000_00"
COLUMNS, ROWS, SPACING_M = 6, 4, 0.5  # of the vertices of the small mesh
COLOUR_SIZE, DEPTH_SIZE = (64, 48), (32, 24)
LEFT, RIGHT = (200, 60, 40), (40, 80, 200)
HEIGHT_M = 2.0
LOST = np.full((4, 4), -np.inf)

# As in the released table: raw category, id, nyu40id, nyu40class; "stool" has another class in each set of labels.
TABLE_ROWS = (
    ("wall", 1, 1, "wall"),
    ("chair", 2, 5, "chair"),
    ("stack of chairs", 2, 5, "chair"),
    ("couch", 6, 6, "sofa"),
    ("stool", 38, 40, "otherprop"),
    ("piano", 90, 39, "otherfurniture"),
)


def table_text(rows: Sequence[tuple[str, int, int, str]] = TABLE_ROWS, end: str = "\n") -> str:
    """A label table with the columns that matter among others."""
    lines = ["id\traw_category\tcategory\tcount\tnyu40id\teigen13id\tnyuClass\tnyu40class"]
    lines += [f"{number}\t{raw}\t{raw} \t7\t{nyu40}\t4\t\t{name}" for raw, number, nyu40, name in rows]
    return end.join(lines) + end


def grid(columns: int = COLUMNS, rows: int = ROWS, spacing_m: float = SPACING_M) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a floor, row by row, and two triangles a cell."""
    points = np.array([(x, y, 0) for y in range(rows) for x in range(columns)], np.float32) * np.float32(spacing_m)
    triangles = []
    for y in range(rows - 1):
        for x in range(columns - 1):
            a, b = y * columns + x, (y + 1) * columns + x
            triangles += [(a, a + 1, b), (a + 1, b + 1, b)]
    return points, np.array(triangles, np.int32)


def write_mesh(path: Path, points: np.ndarray, triangles: np.ndarray, labels: np.ndarray | None = None) -> None:
    columns: dict[str, Any] = {axis: points[:, i].copy() for i, axis in enumerate("xyz")}
    columns |= {channel: np.full(len(points), 90, np.uint8) for channel in ("red", "green", "blue", "alpha")}
    if labels is not None:
        columns["label"] = labels.astype(np.uint16)
    indptr = np.arange(len(triangles) + 1) * 3
    face = PlyElement("face", len(triangles), {"vertex_indices": ListColumn(indptr, triangles.reshape(-1))})
    write_ply(path, [PlyElement("vertex", len(points), columns), face])


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content), encoding="utf-8")


def write_truth(
    folder: Path,
    segments: Sequence[int | str],
    groups: Sequence[tuple[Any, str, Sequence[int | str]]],
    labels: Sequence[int],
    *,
    scan: str = SCAN,
    prefix: str = "scannet.",
    mesh: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """The four files of a scan's truth; ``groups`` are (id, raw category, segments)."""
    folder.mkdir(parents=True, exist_ok=True)
    points, triangles = mesh or grid()
    write_mesh(folder / f"{scan}_vh_clean_2.ply", points, triangles)
    write_mesh(folder / f"{scan}_vh_clean_2.labels.ply", points, triangles, np.array(labels))
    segments_file = f"{scan}_vh_clean_2.0.010000.segs.json"
    parameters = {"kThresh": "0.0100000000", "segMinVerts": "20"}
    write_json(folder / segments_file, {"params": parameters, "sceneId": scan, "segIndices": list(segments)})
    rows = [{"id": one, "objectId": one, "segments": list(parts), "label": word} for one, word, parts in groups]
    aggregation = {"sceneId": prefix + scan, "appId": "Aggregator.v2", "segGroups": rows}
    write_json(folder / f"{scan}.aggregation.json", aggregation | {"segmentsFile": prefix + segments_file})


def write_floor_truth(folder: Path, scan: str = SCAN, spacing_m: float = 0.1) -> None:
    """A floor of 4 x 2 m whose left half is a chair and right half a couch, fine enough to be scored."""
    columns, rows = round(4 / spacing_m) + 1, round(2 / spacing_m) + 1
    points, triangles = grid(columns, rows, spacing_m)
    is_left = points[:, 0] < 2
    write_truth(
        folder,
        np.where(is_left, 17, 40).tolist(),
        [(0, "chair", [17]), (1, "couch", [40])],
        np.where(is_left, 5, 6).tolist(),
        scan=scan,
        mesh=(points, triangles),
    )


def camera(size: tuple[int, int]) -> Float64Array:
    """A pinhole that sees 2 m of a floor 2 m below; the centre of the image looks straight ahead."""
    matrix = np.eye(4)
    matrix[0, 0] = matrix[1, 1] = size[0]
    matrix[:2, 2] = (size[0] - 1) / 2, (size[1] - 1) / 2
    return matrix


def header(
    colour_size: tuple[int, int] = COLOUR_SIZE,
    depth_size: tuple[int, int] = DEPTH_SIZE,
    extrinsic: Float64Array | None = None,
) -> SensHeader:
    return SensHeader(
        sensor_name="StructureSensor",
        intrinsic_colour=camera(colour_size),
        extrinsic_colour=np.eye(4),
        intrinsic_depth=camera(depth_size),
        extrinsic_depth=np.eye(4) if extrinsic is None else extrinsic,
        colour_compression="png",
        depth_compression="zlib",
        colour_width=colour_size[0],
        colour_height=colour_size[1],
        depth_width=depth_size[0],
        depth_height=depth_size[1],
        depth_shift=1000.0,
    )


def pose(x_m: float) -> Float64Array:
    """Above the floor at ``x_m``, 1 m from its edge, looking down."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[:3, 3] = x_m, 1.0, HEIGHT_M
    return matrix


def floor_image(size: tuple[int, int], x_m: float) -> UInt8Array:
    """What a camera at ``pose(x_m)`` sees: ``LEFT`` of x = 2 m and ``RIGHT`` of it."""
    u = (np.arange(size[0]) - (size[0] - 1) / 2) / size[0]
    is_left = u * HEIGHT_M + x_m < 2.0
    row = np.where(is_left[:, None], LEFT, RIGHT).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(row, (size[1], *row.shape)))


def positions(n_frames: int) -> Float64Array:
    """Where the camera is in each frame of a walk along the floor."""
    return np.linspace(1.0, 3.0, n_frames)


def colour_content(rgb: UInt8Array, compression: ColourCompression) -> bytes:
    """A colour image (H, W, 3) RGB as a ``.sens`` file stores it."""
    if compression == "raw":
        return rgb.tobytes()
    return jpeg_bytes(rgb) if compression == "jpeg" else png_bytes(rgb)


def depth_content(values: UInt16Array, compression: DepthCompression) -> bytes:
    """A depth image (H, W) as a ``.sens`` file stores it."""
    raw = values.astype("<u2").tobytes()
    return zlib.compress(raw) if compression == "zlib" else raw


def write_recording(
    path: Path,
    n_frames: int = 5,
    lost: Sequence[int] = (),
    head: SensHeader | None = None,
    depth: UInt16Array | None = None,
) -> None:
    """A walk along the floor; frames in ``lost`` have no pose, ``depth`` (H, W) is that of every frame."""
    head = head or header()
    path.parent.mkdir(parents=True, exist_ok=True)
    colour_size, depth_size = (head.colour_width, head.colour_height), (head.depth_width, head.depth_height)
    if depth is None:
        depth = np.full((depth_size[1], depth_size[0]), round(HEIGHT_M * 1000), np.uint16)
    write_sens(
        path,
        head,
        (
            SensFrame(
                LOST if i in lost else pose(x_m),
                1_000_000 + 33_333 * i,
                1_000_000 + 33_333 * i,
                colour_content(floor_image(colour_size, x_m), head.colour_compression),
                depth_content(depth, head.depth_compression),
            ).stored
            for i, x_m in enumerate(positions(n_frames))
        ),
    )
