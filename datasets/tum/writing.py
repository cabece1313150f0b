"""Scenes in the layout of the TUM RGB-D benchmark, with the camera in ``camera.txt``; it has no truth of objects."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from su3d_bench.core.files.atomic import make_folder, write_json, write_text
from su3d_bench.core.types import Frame
from su3d_bench.datasets.recordings.made_rooms import MARKER
from su3d_bench.datasets.writing import FRAMES_PER_SECOND, Layout, ScannedDataset, SceneTarget
from su3d_bench.formats.images import depth_in_units, png_bytes

LAYOUT_VERSION = 1  # raise it whenever the same scene is written as other bytes
UNITS_PER_METRE = 5000.0  # the benchmark's page "file formats"
FOLDER = "tum"


class TumLayout(Layout):
    """``tum/<scene>/`` with ``rgb``, ``depth``, their lists, ``groundtruth.txt`` and ``associate.txt``.

    The scenes share nothing: each has a camera of its own.
    """

    name = "tum"
    reader = "tum"
    settings = (LAYOUT_VERSION, "tum", UNITS_PER_METRE)

    def scenes_folder(self, out: Path) -> Path:
        return out / FOLDER

    def target(self, scene: str, key: str, out: Path) -> SceneTarget:
        folder = out / FOLDER / scene
        names = ("rgb.txt", "depth.txt", "associate.txt", "groundtruth.txt", "camera.txt", MARKER)
        return SceneTarget(scene, key, folder, "rgb", tuple(folder / name for name in names))

    def frame_names(self, index: int) -> Sequence[str]:
        return _image_names(_time(index))

    def frame_files(self, frame: Frame) -> Sequence[bytes]:
        return png_bytes(frame.rgb), png_bytes(depth_in_units(frame.depth_m, UNITS_PER_METRE))

    def write_truth(self, dataset: ScannedDataset, target: SceneTarget) -> None:
        """The lists, the trajectory and the camera; a marker in the sequence itself, which may be moved about."""
        from scipy.spatial.transform import Rotation

        make_folder(target.partial)
        poses, k = dataset.trajectory(target.scene), dataset.intrinsics
        times = [_time(index) for index in range(len(poses))]
        images = [_image_names(time) for time in times]
        named = f"# file: '{target.scene}'\n"
        rows = [(time, *names) for time, names in zip(times, images, strict=True)]
        lists = {
            "rgb.txt": f"# color images\n{named}# timestamp filename\n" + _lines((t, rgb) for t, rgb, _ in rows),
            "depth.txt": f"# depth maps\n{named}# timestamp filename\n" + _lines((t, depth) for t, _, depth in rows),
            "associate.txt": _lines((time, rgb, time, depth) for time, rgb, depth in rows),
        }
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()  # x y z w
        # The benchmark prints four decimals, a tenth of a millimetre; nine lose nothing that a reader could use.
        lists["groundtruth.txt"] = f"# ground truth trajectory\n{named}# timestamp tx ty tz qx qy qz qw\n" + _lines(
            (time, *(f"{value:.9f}" for value in (*pose[:3, 3], *turn)))
            for time, pose, turn in zip(times, poses, turns, strict=True)
        )
        lists["camera.txt"] = " ".join(repr(float(v)) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])) + "\n"
        for name, text in lists.items():
            write_text(target.partial / name, text)
        marker = {"generator": f"su3d-bench {dataset.name}", "version": LAYOUT_VERSION}
        write_json(target.partial / MARKER, marker | {"scenes": {target.folder.name: target.key}})


def _time(index: int) -> str:
    return f"{index / FRAMES_PER_SECOND:.6f}"


def _image_names(time: str) -> tuple[str, str]:
    return f"rgb/{time}.png", f"depth/{time}.png"


def _lines(rows: Iterable[Sequence[str]]) -> str:
    return "".join(" ".join(row) + "\n" for row in rows)
