"""Which of a scan's folders has its recording, what a quick look at it says, and a key of its content."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from su3d_bench.core.digests import digest_bytes, digest_file
from su3d_bench.core.errors import DataError
from su3d_bench.core.types import Float64Array
from su3d_bench.datasets.recordings.source import RgbdSource
from su3d_bench.datasets.scannet.recordings import INFO, SourceKind, python_layout, read_info
from su3d_bench.datasets.scannet.sens.header import MAX_HEADER_BYTES, header_bytes, parse_header
from su3d_bench.datasets.scannet.sens.read import SensSource

TEXT = ".txt"


def folder_of_recording(folders: Sequence[Path], scene: str, kind: SourceKind) -> Path:
    """The first of a scan's folders that holds a recording of that kind; the first of all where none does."""
    return next((folder for folder in folders if _recording_in(folder, scene, kind) is not None), folders[0])


def _recording_in(folder: Path, scene: str, kind: SourceKind) -> Path | None:
    """The ``.sens`` file, else what one of the exports is known by: its folder of poses, or ``_info.txt``."""
    sens = folder / f"{scene}.sens"
    if kind in ("auto", "sens") and sens.exists():
        return sens
    places = [folder / name for name in ("", "exported", scene)]
    for place in places if kind in ("auto", "python") else ():
        if (layout := python_layout(place)) is not None:
            return place / layout.pose
    for place in places if kind in ("auto", "cpp") else ():
        if (place / INFO).exists():
            return place / INFO
    return None


def describe_recording(folder: Path, scene: str, where: str, kind: SourceKind) -> str:
    """How many frames there are, lost ones among them, without reading more than a header or a list of names."""
    found = _recording_in(folder, scene, kind)
    if found is None:
        return "no recording"
    try:
        if found.suffix == ".sens":
            with found.open("rb") as stream:
                _, n_frames, _ = parse_header(stream.read(MAX_HEADER_BYTES), f"{where}: {found.name}")
            return f"{n_frames} frames"
        if found.name == INFO:
            return f"{read_info(found, where)[1]} exported frames"
        return f"{sum(name.endswith(TEXT) for name in os.listdir(found))} exported frames"
    except OSError as error:
        raise DataError(f"{where}: {found.name} cannot be read: {error.strerror}") from error


def digest_recording(source: RgbdSource, poses: Float64Array) -> str:
    """A key of a recording's cameras, poses and time stamps, of the sizes of all images, and of the first and last."""
    total = hashlib.sha256()
    if isinstance(source, SensSource):
        file = source.file
        total.update(header_bytes(file.header, len(file)) + file.records().tobytes())
        for i in (0, len(file) - 1):
            total.update(digest_bytes(file.colour_bytes(i) + file.depth_bytes(i)).encode())
        return f"sens {total.hexdigest()}"
    images = [path for path in source.files() if path.suffix != TEXT]
    camera = source.camera
    matrices = camera.colour_intrinsics, camera.depth_intrinsics, camera.colour_extrinsic, camera.depth_extrinsic
    total.update(f"{camera.colour_size} {camera.depth_size} {camera.depth_shift!r}\n".encode())
    total.update(b"".join(matrix.astype(np.float64).tobytes() for matrix in (*matrices, poses)))
    try:
        for path in source.files():
            total.update(f"{path.parent.name}/{path.name} {path.stat().st_size}\n".encode())
        for path in (*images[:2], *images[-2:]):
            total.update(digest_file(path).encode())
    except OSError as error:
        raise DataError(f"{source.where}: {error.filename} cannot be read: {error.strerror}") from error
    return f"export {total.hexdigest()}"
