"""A small scan in ScanNet's file formats: a floor of two halves, seen from above, annotated by segments."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from places import CASES
from recording_files import HEIGHT_M, floor_image, grid, pose, write_files, write_mesh

from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.scannet.dataset import ScanNet, ScannetOptions
from su3d_bench.datasets.scannet.sens import SensFile, SensFrame, SensHeader, write_sens
from su3d_bench.datasets.scannet.truth import TABLE_NAME
from su3d_bench.formats.images import png_bytes

SCAN = "scene0000_00"
WHERE = f"scannet/{SCAN}"
COLOUR_SIZE, DEPTH_SIZE = (64, 48), (32, 24)
LOST = np.full((4, 4), -np.inf)

# As in the released table: raw category, id, nyu40id, nyu40class; "stool" has a different class in each label set.
TABLE_ROWS = (
    ("wall", 1, 1, "wall"),
    ("chair", 2, 5, "chair"),
    ("stack of chairs", 2, 5, "chair"),
    ("couch", 6, 6, "sofa"),
    ("stool", 38, 40, "otherprop"),
    ("piano", 90, 39, "otherfurniture"),
)


def table_text(rows: Sequence[tuple[str, int, int, str]] = TABLE_ROWS) -> str:
    """A label table with the relevant columns among others."""
    lines = ["id\traw_category\tcategory\tcount\tnyu40id\teigen13id\tnyuClass\tnyu40class"]
    lines += [f"{number}\t{raw}\t{raw} \t7\t{nyu40}\t4\t\t{name}" for raw, number, nyu40, name in rows]
    return "\n".join(lines) + "\n"


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
    """The four files of a scan's ground truth; ``groups`` are (id, raw category, segments)."""
    write_mesh(folder / f"{scan}_vh_clean_2.ply", *(mesh or grid()))
    write_mesh(folder / f"{scan}_vh_clean_2.labels.ply", *(mesh or grid()), np.array(labels))
    segments_file = f"{scan}_vh_clean_2.0.010000.segs.json"
    rows = [{"id": one, "objectId": one, "segments": list(parts), "label": word} for one, word, parts in groups]
    aggregation = {"sceneId": prefix + scan, "segGroups": rows, "segmentsFile": prefix + segments_file}
    segmentation = {"params": {"kThresh": "0.0100000000"}, "sceneId": scan, "segIndices": list(segments)}
    write_files(folder, {segments_file: segmentation, f"{scan}.aggregation.json": aggregation})


def write_floor_truth(folder: Path, scan: str = SCAN, spacing_m: float = 0.1) -> None:
    """A floor of 4 x 2 m whose left half is a chair and right half a couch, fine enough to be scored."""
    mesh = grid(round(4 / spacing_m) + 1, round(2 / spacing_m) + 1, spacing_m)
    is_left = mesh[0][:, 0] < 2
    segments, labels = np.where(is_left, 17, 40).tolist(), np.where(is_left, 5, 6).tolist()
    write_truth(folder, segments, [(0, "chair", [17]), (1, "couch", [40])], labels, scan=scan, mesh=mesh)


def header(colour_size: tuple[int, int] = COLOUR_SIZE, depth_size: tuple[int, int] = DEPTH_SIZE) -> SensHeader:
    """Pinholes that see 2 m of a floor 2 m below; the centre of the image looks straight ahead."""
    colour, depth = np.eye(4), np.eye(4)
    for matrix, size in ((colour, colour_size), (depth, depth_size)):
        matrix[0, 0] = matrix[1, 1] = size[0]
        matrix[:2, 2] = (size[0] - 1) / 2, (size[1] - 1) / 2
    eye = np.eye(4)
    return SensHeader("StructureSensor", colour, eye, depth, eye, "png", "zlib", *colour_size, *depth_size, 1000.0)


def positions(n_frames: int) -> Float64Array:
    """The position of the camera in each frame of a trajectory along the floor."""
    return np.linspace(1.0, 3.0, n_frames)


def write_recording(path: Path, n_frames: int = 5, lost: Sequence[int] = (), head: SensHeader | None = None) -> None:
    """A trajectory along the floor; frames in ``lost`` have no pose."""
    head = head or header()
    path.parent.mkdir(parents=True, exist_ok=True)
    depth = np.full((head.depth_height, head.depth_width), round(HEIGHT_M * 1000), "<u2")
    frames = []
    for i, x_m in enumerate(positions(n_frames)):
        time = 1_000_000 + 33_333 * i
        colour = png_bytes(floor_image((head.colour_width, head.colour_height), x_m))
        matrix = LOST if i in lost else pose(x_m)
        frames.append(SensFrame(matrix, time, time, colour, zlib.compress(depth.tobytes())).stored)
    write_sens(path, head, frames, b"")


def write_scan(root: Path, scan: str = SCAN, place: str = "scans", n_frames: int = 5, lost: Sequence[int] = ()) -> Path:
    """A scan with recording and ground truth; its folder."""
    folder = root / place / scan
    write_recording(folder / f"{scan}.sens", n_frames, lost)
    write_floor_truth(folder, scan)
    (folder / f"{scan}.txt").write_text("axisAlignment = 0 -1 0 5 1 0 0 6 0 0 1 7 0 0 0 1\ncolorHeight = 48\n")
    (root / TABLE_NAME).write_text(table_text())
    return folder


def dataset(root: Path, **options: Any) -> ScanNet:
    return ScanNet(root, ScannetOptions(**options))


# ---- the toy recording of the cases, as exported by both ScanNet readers

TOY = CASES / "sens01_toy.sens"
RECORDED = json.loads((CASES / "sens01_toy.json").read_text())
N_FRAMES = 4


def pgm_bytes(values: np.ndarray) -> bytes:
    """A PGM as written by the C++ reader, big-endian."""
    return b"P5\n%d %d\n65535\n" % (values.shape[1], values.shape[0]) + values.astype(">u2").tobytes()


def write_python_export(
    folder: Path, *, images: str = "", rest: str = "", cameras: str = "intrinsic", frame_skip: int = 1
) -> Path:
    """The toy recording as exported by ScanNet's Python reader, colour as in the recording; returns ``folder``."""
    toy, files = SensFile(TOY, WHERE), dict[str, Any]()
    for i in range(N_FRAMES):
        files[f"{images}color/{i * frame_skip}.jpg"] = toy.colour_bytes(i)
        files[f"{images}depth/{i * frame_skip}.png"] = png_bytes(toy.depth(i))
        files[f"{rest}pose/{i * frame_skip}.txt"] = RECORDED["pose_txt_py2"][str(i)]
    files |= {f"{rest}{cameras}/{name}": text for name, text in RECORDED["intrinsic_py2"].items()}
    write_files(folder, files)
    return folder


def write_cpp_export(folder: Path) -> Path:
    """The toy recording as exported by ScanNet's C++ reader; returns ``folder``."""
    toy, files = SensFile(TOY, WHERE), dict[str, Any]()
    for i in range(N_FRAMES):
        files[f"frame-{i:06d}.color.jpg"] = toy.colour_bytes(i)
        files[f"frame-{i:06d}.depth.pgm"] = pgm_bytes(toy.depth(i))
        files[f"frame-{i:06d}.pose.txt"] = RECORDED["pose_txt_cpp"][str(i)]
    write_files(folder, files | {"_info.txt": RECORDED["info_cpp"]})
    return folder
