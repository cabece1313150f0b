"""Write scenes in the layout of ScanNet: ``scans/<scan>/`` with recording, mesh, annotation; label table above."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.files.atomic import make_folder, write_text
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float64Array, Frame, Int64Array, UInt8Array
from su3d_bench.datasets.scannet import sens, truth
from su3d_bench.datasets.writing import Layout, SceneTarget, write_shared_text
from su3d_bench.formats.images import JPEG_QUALITY, depth_in_units, jpeg_bytes, list_column, triangles_of
from su3d_bench.formats.ply import Column, PlyElement, write_ply

ROOM_NAME = re.compile(r"([a-z]+)(\d{1,2})")
# The columns of scannetv2-labels.combined.tsv in the order of the release.
TABLE_COLUMNS = (
    "id", "raw_category", "category", "count", "nyu40id", "eigen13id", "nyuClass", "nyu40class", "eigen13class",
    "ModelNet40", "ModelNet10", "ShapeNetCore55", "synsetoffset", "wnsynsetid", "wnsynsetkey", "mpcat40",
    "mpcat40index",
)  # fmt: skip

if TYPE_CHECKING:
    from su3d_bench.datasets.procedural.dataset import GeneratedScenes
    from su3d_bench.datasets.procedural.scan import SceneScan
    from su3d_bench.datasets.procedural.truth import SceneObject


@dataclass(frozen=True)
class Category:
    """A row of ScanNet's label table."""

    raw_category: str
    id: int
    nyu40id: int
    nyu40class: str


@cache
def _facts() -> Mapping[str, Any]:
    return parse_toml(file_text(Path(__file__).with_name("made_categories.toml")))


@cache
def categories() -> Mapping[str, Category]:
    """The ScanNet category of each class of generated scenes."""
    return {name: Category(*row) for name, row in _facts()["classes"].items()}


@cache
def nyu40_colours() -> tuple[tuple[int, int, int], ...]:
    """RGB of the NYU40 classes, 0 (no class) to 40."""
    return tuple((red, green, blue) for red, green, blue in _facts()["nyu40_colours"])


def scan_name(room: str) -> str:
    """The scan name of a room: bathroom7 is scene9407_00; raises ``DataError`` for a room beyond 99."""
    match = ROOM_NAME.fullmatch(room)
    if match is None or match[1] not in _facts()["kinds"]:
        raise DataError(f"{room}: has no scan name; choose a scene from 0 to 99 of its kind")
    return f"scene9{_facts()['kinds'][match[1]][0]}{int(match[2]):02d}_00"


def scene_type(room: str) -> str:
    """ScanNet's scene type for this kind of room."""
    match = ROOM_NAME.fullmatch(room)
    assert match is not None, room
    return str(_facts()["kinds"][match[1]][1])


def label_table_text() -> str:
    """``scannetv2-labels.combined.tsv`` with the rooms' categories; columns of other vocabularies are empty."""
    rows = ["\t".join(TABLE_COLUMNS)]
    for row in sorted(set(categories().values()), key=lambda row: row.id):
        known = {"id": row.id, "raw_category": row.raw_category, "category": row.raw_category, "count": 0}
        known |= {"nyu40id": row.nyu40id, "nyu40class": row.nyu40class}
        rows.append("\t".join(str(known.get(column, "")) for column in TABLE_COLUMNS))
    return "\n".join(rows) + "\n"


MIN_COSINE = 0.9  # faces at an angle above 26 degrees belong to different segments


def annotation_id(known: SceneObject) -> int:
    """The id of an object in the annotation, which starts at 0."""
    return known.id - 1


def write_scan_truth(dataset: GeneratedScenes, scene: str, scan: str, folder: Path) -> list[SceneObject]:
    """Write the files of ``scene`` as ``scan`` into ``folder``; return the annotated objects."""
    make_folder(folder)
    surface, objects = dataset.scan(scene), dataset.objects(scene)
    owner, segments = object_of_vertex(surface), segment_of_vertex(surface)
    category_of = {known.id: categories()[known.class_name] for known in objects}
    nyu40_of = np.zeros(max(category_of, default=0) + 1, np.uint16)
    nyu40_of[list(category_of)] = [category.nyu40id for category in category_of.values()]
    labels = nyu40_of[owner]
    faces = triangles_of(surface.faces)
    face_element = PlyElement("face", len(faces), {"vertex_indices": list_column(faces)})
    write_ply(folder / truth.mesh_name(scan), [_vertices(surface, surface.colours, {}), face_element])
    label_colours = np.array(nyu40_colours(), np.uint8)[labels]
    write_ply(folder / truth.labels_name(scan), [_vertices(surface, label_colours, {"label": labels}), face_element])
    params = {"minCosine": str(MIN_COSINE)}
    _write_json(
        folder / truth.segments_name(scan), {"params": params, "sceneId": scan, "segIndices": segments.tolist()}
    )
    seen = [known for known in objects if (owner == known.id).any()]
    groups = [
        {"id": annotation_id(known), "objectId": annotation_id(known),
         "segments": np.unique(segments[owner == known.id]).tolist(), "label": category_of[known.id].raw_category}
        for known in seen
    ]  # fmt: skip
    aggregation = {"sceneId": f"scannet.{scan}", "appId": "su3d-bench", "segGroups": groups}
    _write_json(
        folder / truth.aggregation_name(scan), aggregation | {"segmentsFile": f"scannet.{truth.segments_name(scan)}"}
    )
    write_text(folder / truth.meta_name(scan), _facts_of(dataset, scene))
    return seen


def object_of_vertex(scan: SceneScan) -> Int64Array:
    """Object id (V,) of each vertex, from its last face; 0 if no face uses it."""
    owner = np.zeros(len(scan.vertices), np.int64)
    owner[scan.faces] = scan.object_id[:, None]
    return owner


def segment_of_vertex(scan: SceneScan) -> Int64Array:
    """Segment (V,) of each vertex, named after its first vertex: a connected, nearly flat piece of one object.

    A vertex has the direction of its first face, so that a box is split into its sides.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n, faces = len(scan.vertices), scan.faces.astype(np.int64)
    first_face = np.zeros(n, np.int64)
    first_face[faces[::-1]] = np.arange(len(faces))[::-1, None]
    normals, owner = _face_normals(scan)[first_face], object_of_vertex(scan)
    left, right = faces[:, [0, 1, 2, 3]].reshape(-1), faces[:, [1, 2, 3, 0]].reshape(-1)
    is_one = (np.einsum("ij,ij->i", normals[left], normals[right]) >= MIN_COSINE) & (owner[left] == owner[right])
    left, right = left[is_one], right[is_one]
    graph = coo_matrix((np.ones(len(left), np.int8), (left, right)), shape=(n, n))
    n_pieces, piece = connected_components(graph, directed=False)
    first_vertex = np.zeros(n_pieces, np.int64)
    first_vertex[piece[::-1]] = np.arange(n)[::-1]
    segments: Int64Array = first_vertex[piece]
    return segments


def _face_normals(scan: SceneScan) -> Float64Array:
    a, b, c, d = (scan.vertices[scan.faces[:, k]].astype(np.float64) for k in range(4))
    normals = np.cross(c - a, d - b)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)
    return normals


def _vertices(scan: SceneScan, colours: UInt8Array, more: dict[str, Column]) -> PlyElement:
    columns: dict[str, Column] = {name: scan.vertices[:, i].astype(np.float32) for i, name in enumerate("xyz")}
    columns |= {name: colours[:, i] for i, name in enumerate(("red", "green", "blue"))}
    columns["alpha"] = np.full(len(scan.vertices), 255, np.uint8)
    return PlyElement("vertex", len(scan.vertices), columns | more)


def _facts_of(dataset: GeneratedScenes, scene: str) -> str:
    """The content of ``<scan>.txt``, keys in the order of the release."""
    frames = dataset.frames(scene, 1)
    height, width = frames[0].depth_m.shape
    k, identity = dataset.intrinsics, " ".join(f"{value:f}" for value in np.eye(4).reshape(-1))
    facts: dict[str, Any] = {"axisAlignment": identity, "colorHeight": height, "colorToDepthExtrinsics": identity}
    facts |= {"colorWidth": width, "depthHeight": height, "depthWidth": width}
    for name, value in (("fx", k[0, 0]), ("fy", k[1, 1]), ("mx", k[0, 2]), ("my", k[1, 2])):
        facts |= {f"{name}_{sensor}": f"{value:f}" for sensor in ("color", "depth")}
    facts |= {"numColorFrames": len(frames), "numDepthFrames": len(frames), "numIMUmeasurements": 0}
    facts["sceneType"] = scene_type(scene)
    return "".join(f"{key} = {value}\n" for key, value in facts.items())


def _write_json(path: Path, value: Any) -> None:
    """JSON on one line: a mesh has one number per vertex."""
    write_text(path, json.dumps(value, separators=(",", ":")) + "\n")


LAYOUT_VERSION = 1  # increase it when the written bytes of a scene change
DEPTH_SHIFT = 1000.0  # units per metre, in every recording of the release
SCANS_FOLDER = "scans"
SENSOR_NAME = "StructureSensor"  # as in the release; readers may depend on it


class ScannetLayout(Layout):
    """Scenes as scans ``scene9000_00`` etc., each with one ``.sens`` file: JPEG colour, zlib depth, no motion data.

    Time stamps are microseconds from the first frame.
    """

    name = "scannet"
    reader = "scannet"
    settings = (LAYOUT_VERSION, "scannet", DEPTH_SHIFT, JPEG_QUALITY)

    def scenes_folder(self, out: Path) -> Path:
        return out / SCANS_FOLDER

    def scene_name(self, scene: str) -> str:
        return scan_name(scene)

    def target(self, scene: str, key: str, out: Path) -> SceneTarget:
        scan = scan_name(scene)
        folder = out / SCANS_FOLDER / scan
        names = f"{scan}.sens", *truth.truth_names(scan), truth.meta_name(scan)
        return SceneTarget(scene, key, folder, tuple(folder / name for name in names))

    def write_shared(self, dataset: GeneratedScenes, scene: str, out: Path) -> None:
        write_shared_text(out / truth.TABLE_NAME, label_table_text(), "differs from the label table of the rooms")

    def write_truth(self, dataset: GeneratedScenes, target: SceneTarget, folder: Path) -> None:
        write_scan_truth(dataset, target.scene, target.folder.name, folder)

    def write_frames(
        self, frames: Iterator[Frame], dataset: GeneratedScenes, target: SceneTarget, folder: Path
    ) -> None:
        height, width = dataset.frames(target.scene, 1)[0].depth_m.shape
        header = sens_header(dataset.intrinsics, (width, height))
        sens.write_sens(folder / f"{target.folder.name}.sens", header, map(_record, frames))


def _record(frame: Frame) -> bytes:
    time = round(frame.timestamp_s * sens.MICROSECONDS)
    depth = zlib.compress(depth_in_units(frame.depth_m, DEPTH_SHIFT).astype("<u2").tobytes())
    return sens.SensFrame(frame.camera_to_world, time, time, jpeg_bytes(frame.rgb), depth).stored


def intrinsics_4x4(intrinsics: Float64Array) -> Float64Array:
    """The camera as in ScanNet's files, fx 0 cx 0 / 0 fy cy 0 / 0 0 1 0 / 0 0 0 1, in float32 precision."""
    matrix = np.eye(4)
    matrix[:3, :3] = intrinsics
    return matrix.astype(np.float32).astype(np.float64)


def sens_header(intrinsics: Float64Array, size: tuple[int, int]) -> sens.SensHeader:
    """The header of a recording whose two cameras are identical."""
    camera, (width, height) = intrinsics_4x4(intrinsics), size
    return sens.SensHeader(
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
