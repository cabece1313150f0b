"""The toy recording of the cases, as both readers of ScanNet export it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from places import CASES

from su3d_bench.datasets.recordings.source import RgbdSource
from su3d_bench.datasets.scannet.sens import SensFile, SensSource

TOY = CASES / "sens01_toy.sens"
SCENE = "scene0000_00"
WHERE = f"scannet/{SCENE}"
RECORDED = json.loads((CASES / "sens01_toy.json").read_text())
N_FRAMES = 4


def png_bytes(values: np.ndarray) -> bytes:
    return cv2.imencode(".png", values)[1].tobytes()


def pgm_bytes(values: np.ndarray) -> bytes:
    """A PGM as the C++ reader writes it, big-endian."""
    return b"P5\n%d %d\n65535\n" % (values.shape[1], values.shape[0]) + values.astype(">u2").tobytes()


def write_python_export(
    folder: Path, *, images: str = "", rest: str = "", cameras: str = "intrinsic", frame_skip: int = 1
) -> Path:
    """The toy recording as ScanNet's Python reader exports it, colour as in the recording; returns ``folder``."""
    toy = SensFile(TOY, WHERE)
    for base, name in ((images, "color"), (images, "depth"), (rest, "pose"), (rest, cameras)):
        (folder / base / name).mkdir(parents=True)
    for i in range(N_FRAMES):
        (folder / images / f"color/{i * frame_skip}.jpg").write_bytes(toy.colour_bytes(i))
        (folder / images / f"depth/{i * frame_skip}.png").write_bytes(png_bytes(toy.depth(i)))
        (folder / rest / f"pose/{i * frame_skip}.txt").write_text(RECORDED["pose_txt_py2"][str(i)])
    for name, text in RECORDED["intrinsic_py2"].items():
        (folder / rest / cameras / name).write_text(text)
    return folder


def write_cpp_export(folder: Path) -> Path:
    """The toy recording as ScanNet's C++ reader exports it; returns ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    toy = SensFile(TOY, WHERE)
    for i in range(N_FRAMES):
        (folder / f"frame-{i:06d}.color.jpg").write_bytes(toy.colour_bytes(i))
        (folder / f"frame-{i:06d}.depth.pgm").write_bytes(pgm_bytes(toy.depth(i)))
        (folder / f"frame-{i:06d}.pose.txt").write_text(RECORDED["pose_txt_cpp"][str(i)])
    (folder / "_info.txt").write_text(RECORDED["info_cpp"])
    return folder


def assert_is_the_toy(source: RgbdSource, digits: float) -> None:
    """The source gives what the toy recording gives; poses and cameras to ``digits``, images exactly."""
    toy = SensSource(TOY, WHERE)
    assert (len(source), source.where) == (N_FRAMES, WHERE)
    np.testing.assert_allclose(source.poses(), toy.poses(), rtol=digits, atol=digits)
    for i in range(N_FRAMES):
        np.testing.assert_array_equal(source.pose(i), source.poses()[i])
        np.testing.assert_array_equal(source.colour(i), toy.colour(i))
        np.testing.assert_array_equal(source.depth(i), toy.depth(i))
    assert np.isneginf(source.pose(2)).all()
    ours, theirs = source.camera, toy.camera
    for name in ("colour_size", "depth_size", "depth_shift"):
        assert getattr(ours, name) == getattr(theirs, name)
    for name in ("colour_intrinsics", "depth_intrinsics", "colour_extrinsic", "depth_extrinsic"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=digits, atol=digits)
