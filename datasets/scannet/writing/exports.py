"""Recordings of ScanNet as its two readers export them: a folder a kind of file (Python), or one folder (C++).

Names and digits are those of the readers, SensReader/python/SensorData.py and SensReader/c++/sensorData.h of ScanNet at
commit 3830fce. One thing is not: the Python reader decodes the colour image and encodes it anew; here it is the JPEG of
the recording, byte by byte.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.files.atomic import make_folder, write_text
from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Float64Array, Frame
from su3d_bench.datasets.scannet.writing.layout import DEPTH_SHIFT, SENSOR_NAME, ScannetLayout, intrinsics_4x4, size_of
from su3d_bench.datasets.writing import ScannedDataset, SceneTarget
from su3d_bench.formats.images import UInt16Array, depth_in_units, jpeg_bytes, png_bytes

INFO = "_info.txt"


class PythonExportLayout(ScannetLayout):
    """``color/<i>.jpg``, ``depth/<i>.png``, ``pose/<i>.txt``, ``intrinsic/``."""

    name = "scannet-python"

    def holder(self, scan: str) -> str:
        return "color"

    def frame_names(self, index: int) -> Sequence[str]:
        return f"color/{index}.jpg", f"depth/{index}.png", f"pose/{index}.txt"

    def frame_files(self, frame: Frame) -> Sequence[bytes]:
        depth = png_bytes(depth_in_units(frame.depth_m, DEPTH_SHIFT))
        return jpeg_bytes(frame.rgb), depth, matrix_text(frame.camera_to_world, "f").encode()

    def join(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        folder, camera = target.partial / "intrinsic", intrinsics_4x4(dataset.intrinsics)
        make_folder(folder)
        for sensor in ("color", "depth"):
            write_text(folder / f"intrinsic_{sensor}.txt", matrix_text(camera, "f"))
            write_text(folder / f"extrinsic_{sensor}.txt", matrix_text(np.eye(4), "f"))


class CppExportLayout(ScannetLayout):
    """``frame-000000.color.jpg``, ``.depth.pgm``, ``.pose.txt`` and so on, and ``_info.txt``."""

    name = "scannet-cpp"

    def holder(self, scan: str) -> str:
        return INFO

    def frame_names(self, index: int) -> Sequence[str]:
        return tuple(f"frame-{index:06d}.{kind}" for kind in ("color.jpg", "depth.pgm", "pose.txt"))

    def frame_files(self, frame: Frame) -> Sequence[bytes]:
        depth = pgm_bytes(depth_in_units(frame.depth_m, DEPTH_SHIFT))
        return jpeg_bytes(frame.rgb), depth, matrix_text(frame.camera_to_world, "g").encode()

    def join(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        if target.has_frames:
            return
        camera = intrinsics_4x4(dataset.intrinsics)
        width, height = size_of(file_bytes(target.partial / self.frame_names(0)[0]))
        facts = {"m_versionNumber": "4", "m_sensorName": SENSOR_NAME}
        facts |= {f"m_{sensor}{side}": str(n) for sensor in ("color", "depth")
                  for side, n in (("Width", width), ("Height", height))}  # fmt: skip
        facts["m_depthShift"] = f"{DEPTH_SHIFT:g}"
        for sensor in ("Color", "Depth"):
            for kind, matrix in (("Intrinsic", camera), ("Extrinsic", np.eye(4))):
                facts[f"m_calibration{sensor}{kind}"] = "".join(f"{value:g} " for value in matrix.reshape(-1))
        facts["m_frames.size"] = str(len(dataset.frames(target.scene, 1)))
        write_text(target.partial / INFO, "".join(f"{key} = {value}\n" for key, value in facts.items()))


def matrix_text(matrix: Float64Array, digits: str) -> str:
    """Four lines of four numbers of float32: with six decimals (``f``), or six digits (``g``)."""
    rows = matrix.astype(np.float32).astype(np.float64)
    return "".join(" ".join(format(value, digits) for value in row) + "\n" for row in rows)


def pgm_bytes(image: UInt16Array) -> bytes:
    """A binary PGM of 16 bits, which are big-endian."""
    height, width = image.shape
    return f"P5\n{width} {height}\n65535\n".encode() + image.astype(">u2").tobytes()
