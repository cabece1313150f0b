"""The toy recording of the cases, as both readers of ScanNet export it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from places import CASES

from su3d_bench.datasets.scannet.sens import SensFile
from su3d_bench.formats.images import png_bytes

TOY = CASES / "sens01_toy.sens"
SCENE = "scene0000_00"
WHERE = f"scannet/{SCENE}"
RECORDED = json.loads((CASES / "sens01_toy.json").read_text())
N_FRAMES = 4


def pgm_bytes(values: np.ndarray) -> bytes:
    """A PGM as the C++ reader writes it, big-endian."""
    return b"P5\n%d %d\n65535\n" % (values.shape[1], values.shape[0]) + values.astype(">u2").tobytes()


def _write(folder: Path, files: dict[str, bytes | str]) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return folder


def write_python_export(
    folder: Path, *, images: str = "", rest: str = "", cameras: str = "intrinsic", frame_skip: int = 1
) -> Path:
    """The toy recording as ScanNet's Python reader exports it, colour as in the recording; returns ``folder``."""
    toy, files = SensFile(TOY, WHERE), dict[str, bytes | str]()
    for i in range(N_FRAMES):
        files[f"{images}color/{i * frame_skip}.jpg"] = toy.colour_bytes(i)
        files[f"{images}depth/{i * frame_skip}.png"] = png_bytes(toy.depth(i))
        files[f"{rest}pose/{i * frame_skip}.txt"] = RECORDED["pose_txt_py2"][str(i)]
    files |= {f"{rest}{cameras}/{name}": text for name, text in RECORDED["intrinsic_py2"].items()}
    return _write(folder, files)


def write_cpp_export(folder: Path) -> Path:
    """The toy recording as ScanNet's C++ reader exports it; returns ``folder``."""
    toy, files = SensFile(TOY, WHERE), dict[str, bytes | str]()
    for i in range(N_FRAMES):
        files[f"frame-{i:06d}.color.jpg"] = toy.colour_bytes(i)
        files[f"frame-{i:06d}.depth.pgm"] = pgm_bytes(toy.depth(i))
        files[f"frame-{i:06d}.pose.txt"] = RECORDED["pose_txt_cpp"][str(i)]
    return _write(folder, files | {"_info.txt": RECORDED["info_cpp"]})
