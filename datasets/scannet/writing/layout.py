"""Scenes in the exact layout of ScanNet: ``scans/<scan>/`` with recording, mesh and annotation, the label table above.

The recording is a ``.sens`` file here; the exports of the two original readers are in ``exports``.
"""

from __future__ import annotations

import shutil
import zlib
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.system.files import file_bytes
from su3d_bench.core.types import Float64Array, Frame
from su3d_bench.datasets.openscan import KEYS, RAW_NAME
from su3d_bench.datasets.recordings.joined_lists import JoinedList
from su3d_bench.datasets.rooms.attributes import attribute_words
from su3d_bench.datasets.scannet.labels import TABLE_NAME
from su3d_bench.datasets.scannet.sens.header import SensHeader
from su3d_bench.datasets.scannet.sens.read import FRAME_RECORD, MICROSECONDS, MOTION_RECORD
from su3d_bench.datasets.scannet.sens.write import SensFrame, write_sens
from su3d_bench.datasets.scannet.truth import meta_name, truth_names
from su3d_bench.datasets.scannet.writing.categories import categories, label_table_text, room_of, scan_name
from su3d_bench.datasets.scannet.writing.truth import annotation_id, write_scan_truth
from su3d_bench.datasets.writing import Layout, ScannedDataset, ScannedObject, SceneTarget, write_shared_text
from su3d_bench.formats.images import JPEG_QUALITY, depth_in_units, image_size, jpeg_bytes

LAYOUT_VERSION = 1  # raise it whenever the same scene is written as other bytes
DEPTH_SHIFT = 1000.0  # units a metre, of every recording of the release
SCANS_FOLDER = "scans"
SENSOR_NAME = "StructureSensor"  # as the release has it, readers may know it
PIECES = ".frames"


class ScannetLayout(Layout):
    """Rooms as scans ``scene9000_00`` and so on (see ``categories``); how frames are stored is for each to say."""

    reader = "scannet"

    @property
    def settings(self) -> Sequence[Any]:  # type: ignore[override]
        return LAYOUT_VERSION, self.name, DEPTH_SHIFT, JPEG_QUALITY

    @abstractmethod
    def holder(self, scan: str) -> str:
        """What holds the frames in the folder of the scan: ``SceneTarget.frames``."""

    def scenes_folder(self, out: Path) -> Path:
        return out / SCANS_FOLDER

    def scene_name(self, scene: str) -> str:
        return scan_name(scene)

    def target(self, scene: str, key: str, out: Path) -> SceneTarget:
        scan = scan_name(scene)
        folder = out / SCANS_FOLDER / scan
        names = (*truth_names(scan), meta_name(scan))
        truth = tuple(folder / name for name in names)
        attributes = JoinedList(".openscan.json", out / RAW_NAME, "scene_id")
        return SceneTarget(scene, key, folder, self.holder(scan), truth, joined=(attributes,))

    def marker_extras(self, names: Sequence[str]) -> dict[str, Any]:
        return {"rooms": {scan: room for scan in names if (room := room_of(scan)) is not None}}

    def write_shared(self, dataset: ScannedDataset, scene: str, out: Path) -> None:
        write_shared_text(out / TABLE_NAME, label_table_text(), "is another label table than that of the rooms")

    def write_truth(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        seen = write_scan_truth(dataset, target.scene, target.folder.name, target.partial)
        (attributes,) = target.joined
        attributes.stage(target.partial, [attribute_record(target.folder.name, known) for known in seen])


class SensLayout(ScannetLayout):
    """One ``.sens`` file: JPEG colour, zlib depth, no motion data; joined of the records that were written one by one.

    Time stamps are microseconds from the first frame.
    """

    name = "scannet"

    def holder(self, scan: str) -> str:
        return f"{scan}.sens"

    def frame_names(self, index: int) -> Sequence[str]:
        return (f"{PIECES}/{index:06d}.record",)

    def frame_files(self, frame: Frame) -> Sequence[bytes]:
        time = round(frame.timestamp_s * MICROSECONDS)
        depth = zlib.compress(depth_in_units(frame.depth_m, DEPTH_SHIFT).astype("<u2").tobytes())
        return (SensFrame(frame.camera_to_world, time, time, jpeg_bytes(frame.rgb), depth).stored,)

    def join(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        if not target.has_frames:
            n_frames = len(dataset.frames(target.scene, 1))
            pieces = [target.partial / name for index in range(n_frames) for name in self.frame_names(index)]
            header = sens_header(dataset.intrinsics, size_of(file_bytes(pieces[0])[FRAME_RECORD.itemsize :]))
            records = (file_bytes(piece) for piece in pieces)
            write_sens(target.partial / target.frames, header, records, np.zeros(0, MOTION_RECORD))
        if (target.partial / PIECES).exists():
            shutil.rmtree(target.partial / PIECES)


def attribute_record(scan: str, known: ScannedObject) -> dict[str, str]:
    """An object as OpenScan's raw validation set has it, under its id in the annotation of the scan."""
    words = attribute_words(known.class_name, known.material)
    name = categories()[known.class_name].raw_category
    row = {"scene_id": scan, "object_id": str(annotation_id(known)), "object_name": name}
    return row | {key: words.get(key, "none") for key in KEYS.values()}


def size_of(jpeg: bytes) -> tuple[int, int]:
    """Width and height of a colour image, and so of the depth image beside it."""
    size = image_size(jpeg)
    assert size is not None
    return size


def intrinsics_4x4(intrinsics: Float64Array) -> Float64Array:
    """The camera as ScanNet's files have it, fx 0 cx 0 / 0 fy cy 0 / 0 0 1 0 / 0 0 0 1, in the digits of float32."""
    matrix = np.eye(4)
    matrix[:3, :3] = intrinsics
    return matrix.astype(np.float32).astype(np.float64)


def sens_header(intrinsics: Float64Array, size: tuple[int, int]) -> SensHeader:
    """The header of a recording whose two cameras are one."""
    camera, (width, height) = intrinsics_4x4(intrinsics), size
    return SensHeader(
        sensor_name=SENSOR_NAME,
        intrinsic_colour=camera,
        extrinsic_colour=np.eye(4),
        intrinsic_depth=camera,
        extrinsic_depth=np.eye(4),
        colour_compression="jpeg",
        depth_compression="zlib",
        colour_width=width,
        colour_height=height,
        depth_width=width,
        depth_height=height,
        depth_shift=DEPTH_SHIFT,
    )
