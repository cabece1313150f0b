"""Folders of a user's program: the frames it gets, and the prediction it writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from su3d_bench.core.config import write_toml
from su3d_bench.core.errors import DataError, PredictionError, printable
from su3d_bench.core.files.atomic import make_folder, write_bytes, write_text
from su3d_bench.core.maps import Instances, Prediction
from su3d_bench.core.types import Float64Array, Frame, SceneInfo, Surface
from su3d_bench.formats.images import depth_in_units, jpeg_bytes, list_column, png_bytes
from su3d_bench.formats.ply import PlyElement, write_ply
from su3d_bench.metrics.matching.transfer import select
from su3d_bench.metrics.protocols.loading import load_protocol, protocols_for
from su3d_bench.predictions.base import Content, ScenePrediction, VertexLabels, VertexMasks

LAYOUT_VERSION = 1
MILLIMETRES = 1000.0
ColourFormat = Literal["png", "jpg"]

# Description of the folder for the dataset `rgbd`; {index} is the frame number.
DESCRIPTION = """colour = "colour/{{index}}.{colour}"
depth = "depth/{{index}}.png"
pose = "pose/{{index}}.txt"
depth_unit_m = 0.001
intrinsics_file = "intrinsics.txt"
"""


@dataclass
class FrameFolder:
    """Writes frames one by one; ``close`` completes the folder for the frames so far and may be called after each."""

    path: Path
    scene: SceneInfo
    colour: ColourFormat = "png"
    surface: Surface | None = None
    _numbers: list[int] = field(default_factory=list)
    _times_s: list[float] = field(default_factory=list)
    _intrinsics: list[Float64Array] = field(default_factory=list)
    _size: tuple[int, int] = (0, 0)

    def open(self) -> None:
        for name in ("colour", "depth", "pose"):
            make_folder(self.path / name)
        if self.surface is not None:
            write_mesh(self.path / "mesh.ply", self.surface)

    def add(self, frame: Frame) -> None:
        """Write the files of one frame, named by its number in the sequence."""
        size = (frame.rgb.shape[1], frame.rgb.shape[0])
        if self._numbers and size != self._size:
            raise DataError(
                f"{self.scene.dataset}/{self.scene.scene} frame {frame.index}: is {size[0]}x{size[1]}, previous "
                f"frames are {self._size[0]}x{self._size[1]}; all frames of a program must have one size"
            )
        self._size = size
        name = f"{frame.index:06d}"
        encode = jpeg_bytes if self.colour == "jpg" else png_bytes
        depth_m = np.maximum(np.nan_to_num(frame.depth_m, posinf=0.0, neginf=0.0), 0.0)
        write_bytes(self.path / "colour" / f"{name}.{self.colour}", encode(frame.rgb))
        write_bytes(self.path / "depth" / f"{name}.png", png_bytes(depth_in_units(depth_m, MILLIMETRES)))
        write_text(self.path / "pose" / f"{name}.txt", matrix_text(frame.camera_to_world))
        self._numbers.append(frame.index)
        self._times_s.append(float(frame.timestamp_s))
        self._intrinsics.append(frame.intrinsics)

    def close(self) -> None:
        """Write what applies to all frames so far; ``DataError`` without a frame."""
        if not self._numbers:
            raise DataError(f"{self.scene.dataset}/{self.scene.scene}: no frames for the program")
        write_text(self.path / "intrinsics.txt", matrix_text(self._intrinsics[0]))
        differ = any(not np.array_equal(matrix, self._intrinsics[0]) for matrix in self._intrinsics)
        if differ:
            make_folder(self.path / "intrinsics")
            for number, matrix in zip(self._numbers, self._intrinsics, strict=True):
                write_text(self.path / "intrinsics" / f"{number:06d}.txt", matrix_text(matrix))
        mesh = "" if self.surface is None else 'mesh = "mesh.ply"\n'
        write_text(self.path / "rgbd.toml", DESCRIPTION.format(colour=self.colour) + mesh)
        write_text(self.path / "scene.toml", self._scene_text(intrinsics_differ=differ))

    def _scene_text(self, *, intrinsics_differ: bool) -> str:
        first = self._intrinsics[0]
        values: list[tuple[str, object, str]] = [
            ("layout", LAYOUT_VERSION, "version of this folder's layout"),
            ("dataset", printable(self.scene.dataset), "dataset of the scene"),
            ("scene", printable(self.scene.scene), "its name in the dataset"),
            ("image_domain", self.scene.image_domain, "rendered-rooms or camera"),
            ("stride", self.scene.stride, "every n-th frame of the sequence is in this folder"),
            ("seed", self.scene.seed, "for the program's random numbers"),
            ("n_frames", len(self._numbers), "frames in this folder"),
            ("width", self._size[0], "pixels"),
            ("height", self._size[1], "pixels"),
            ("colour", f"colour/NNNNNN.{self.colour}", "8-bit RGB"),
            ("depth", "depth/NNNNNN.png", "16-bit, along the optical axis, 0 for no depth"),
            ("depth_unit_m", 0.001, "metres of one unit"),
            ("pose", "pose/NNNNNN.txt", "4x4, camera to world, metres; x right, y down, z forward"),
            ("intrinsics", "intrinsics.txt", "3x3, pixels"),
            ("intrinsics_differ", intrinsics_differ, "if true, intrinsics/NNNNNN.txt has those of each frame"),
            ("fx", float(first[0, 0]), "pixels"),
            ("fy", float(first[1, 1]), "pixels"),
            ("cx", float(first[0, 2]), "pixels"),
            ("cy", float(first[1, 2]), "pixels"),
            ("mesh", "mesh.ply" if self.surface is not None else None, "the scan's mesh, without labels"),
            ("n_vertices", 0 if self.surface is None else len(self.surface.vertices), "of the mesh"),
            ("frames", self._numbers, "the numbers NNNNNN, in the order of the updates"),
            ("times_s", self._times_s, "seconds, one per frame"),
        ]
        return write_toml([((key,), value, remark) for key, value, remark in values])


def matrix_text(matrix: Float64Array) -> str:
    """A matrix, one row per line, with enough digits to restore the same float64."""
    return "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in matrix)


def write_mesh(path: Path, surface: Surface) -> None:
    """The mesh as binary PLY, vertices in order, because masks refer to that order."""
    axes = {axis: surface.vertices[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
    corners = list_column(surface.triangles)
    vertices = PlyElement("vertex", len(surface.vertices), axes)
    write_ply(path, [vertices, PlyElement("face", len(corners), {"vertex_indices": corners})])


def read_output(folder: Path, scene: str, format: str | None) -> ScenePrediction:
    """The only prediction in ``folder``, or that of ``scene`` if there are several."""
    from su3d_bench.predictions.formats import recognise  # imports every format: slow for a list of methods

    files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    if not files:
        raise PredictionError("it reports no error but wrote nothing to {output}")
    reader = recognise(folder, format)
    names = list(reader.scenes(folder))
    if not names:
        raise PredictionError(f"{{output}} has no prediction in the format {reader.name}")
    if len(names) > 1 and scene not in names:
        shown = printable(", ".join(names[:4]), 200)
        raise PredictionError(f"it wrote predictions of {len(names)} scenes ({shown}), none of them '{scene}'")
    return reader.read(folder, scene if scene in names else names[0])


def as_prediction(content: Content, surface: Surface | None, names: Mapping[int, str]) -> Prediction:
    """``content`` as a map; masks and labels without points refer to the vertices of ``surface``.

    ``names`` are the names of the class numbers of such masks.
    """
    if not isinstance(content, VertexMasks | VertexLabels):
        return content
    if surface is None:
        raise PredictionError("its masks have no points and the dataset has no mesh; use a format with points")
    n = len(surface.vertices)
    n_points = len(content.class_ids) if isinstance(content, VertexLabels) else content.n_points
    if n_points not in {None, n}:
        raise PredictionError(f"its masks are over {n_points} points, the mesh has {n} vertices; they must match")
    masks = content.masks() if isinstance(content, VertexLabels) else content
    numbers, kept = masks.class_numbers, np.arange(len(masks))
    if isinstance(content, VertexLabels) and numbers is not None:
        # ids below 1 are not classes, nor are list indices below 0
        kept = np.flatnonzero(numbers >= (content.numbering == "id"))
    return Instances.of(
        surface.vertices,
        select(masks, kept),
        masks.scores[kept],
        None if masks.features is None else masks.features[kept],
        labels=None if numbers is None else [names.get(one, f"class {one}") for one in numbers[kept].tolist()],
        names=[printable(masks.keys[k], 200) for k in kept],
        ids=range(1, len(kept) + 1),
    )


def class_names(content: Content, dataset: str, protocol: str | None) -> dict[int, str]:
    """The names of the class numbers of ``content``: in ``protocol``, or in all default protocols of the dataset.

    Empty if it has none. Raises ``PredictionError`` if the protocols give one number different names.
    """
    if not isinstance(content, VertexMasks | VertexLabels):
        return {}
    if isinstance(content, VertexMasks) and (content.class_numbers is None or not len(content)):
        return {}
    own = [load_protocol(protocol)] if protocol is not None else list(map(load_protocol, protocols_for(dataset)))
    own = [rules for rules in own if rules.classes]
    pairs = {(entry.id, entry.name) for rules in own for entry in rules.classes}
    if content.numbering != "id":
        lists = [rules.classes for rules in own]
        if content.numbering == "index":
            lists = [rules.scored for rules in own if rules.kind == "instance"]
        pairs = {(number, entry.name) for entries in lists for number, entry in enumerate(entries)}
    if not pairs or len(pairs) > len({number for number, _ in pairs}):
        known = ", ".join(rules.name for rules in own) or "any with classes"
        raise PredictionError(f"its class numbers are ambiguous; set classes_of to a protocol (known: {known})")
    return dict(pairs)
