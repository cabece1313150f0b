"""The files of a scan beside its recording, as ScanNet releases them: facts, mesh, labels, segments and objects.

Of the two meshes only the decimated one, ``_vh_clean_2``, is written, with the segments and the objects that refer to
it. A room is along the axes already: its axisAlignment is the identity.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.files.atomic import make_folder, write_text
from su3d_bench.core.types import Float64Array, Int64Array, UInt8Array
from su3d_bench.datasets.scannet.annotations import aggregation_name, segments_name
from su3d_bench.datasets.scannet.truth import labels_name, mesh_name, meta_name
from su3d_bench.datasets.scannet.writing.categories import categories, nyu40_colours, scene_type
from su3d_bench.datasets.writing import Scan, ScannedDataset, ScannedObject
from su3d_bench.formats.images import list_column, triangles_of
from su3d_bench.formats.ply import Column, PlyElement, write_ply

MIN_COSINE = 0.9  # faces that meet at more than 26 degrees belong to two segments


def annotation_id(known: ScannedObject) -> int:
    """The id of an object in the annotation, which counts from 0."""
    return known.id - 1


def write_scan_truth(dataset: ScannedDataset, scene: str, scan: str, folder: Path) -> list[ScannedObject]:
    """Write the files of ``scene`` under the name ``scan`` into ``folder``; the objects that are annotated."""
    make_folder(folder)
    surface, objects = dataset.scan(scene), dataset.objects(scene)
    owner, segments = object_of_vertex(surface), segment_of_vertex(surface)
    category_of = {known.id: categories()[known.class_name] for known in objects}
    nyu40_of = np.zeros(max(category_of, default=0) + 1, np.uint16)
    nyu40_of[list(category_of)] = [category.nyu40id for category in category_of.values()]
    labels = nyu40_of[owner]
    faces = triangles_of(surface.faces)
    face_element = PlyElement("face", len(faces), {"vertex_indices": list_column(faces)})
    write_ply(folder / mesh_name(scan), [_vertices(surface, surface.colours, {}), face_element])
    label_colours = np.array(nyu40_colours(), np.uint8)[labels]
    write_ply(folder / labels_name(scan), [_vertices(surface, label_colours, {"label": labels}), face_element])
    params = {"minCosine": str(MIN_COSINE)}
    _write_json(folder / segments_name(scan), {"params": params, "sceneId": scan, "segIndices": segments.tolist()})
    seen = [known for known in objects if (owner == known.id).any()]
    groups = [
        {"id": annotation_id(known), "objectId": annotation_id(known),
         "segments": np.unique(segments[owner == known.id]).tolist(), "label": category_of[known.id].raw_category}
        for known in seen
    ]  # fmt: skip
    aggregation = {"sceneId": f"scannet.{scan}", "appId": "su3d-bench", "segGroups": groups}
    _write_json(folder / aggregation_name(scan), aggregation | {"segmentsFile": f"scannet.{segments_name(scan)}"})
    write_text(folder / meta_name(scan), _facts_of(dataset, scene))
    return seen


def object_of_vertex(scan: Scan) -> Int64Array:
    """Object id (V,) of each vertex, that of its last face; 0 where no face uses it."""
    owner = np.zeros(len(scan.vertices), np.int64)
    owner[scan.faces] = scan.object_id[:, None]
    return owner


def segment_of_vertex(scan: Scan) -> Int64Array:
    """Segment (V,) of each vertex, named after its first vertex: a connected piece of one object that bends little.

    A vertex has the direction of its first face, so that a box falls apart into its sides.
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


def _face_normals(scan: Scan) -> Float64Array:
    a, b, c, d = (scan.vertices[scan.faces[:, k]].astype(np.float64) for k in range(4))
    normals = np.cross(c - a, d - b)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)
    return normals


def _vertices(scan: Scan, colours: UInt8Array, more: dict[str, Column]) -> PlyElement:
    columns: dict[str, Column] = {name: scan.vertices[:, i].astype(np.float32) for i, name in enumerate("xyz")}
    columns |= {name: colours[:, i] for i, name in enumerate(("red", "green", "blue"))}
    columns["alpha"] = np.full(len(scan.vertices), 255, np.uint8)
    return PlyElement("vertex", len(scan.vertices), columns | more)


def _facts_of(dataset: ScannedDataset, scene: str) -> str:
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
    """JSON on one line: a mesh has a number a vertex."""
    write_text(path, json.dumps(value, separators=(",", ":")) + "\n")
