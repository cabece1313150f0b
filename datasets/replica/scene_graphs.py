"""ReplicaSSG's scene graphs of Replica: ``objects.json``, ``relationships.json`` and ``replica_to_visual_genome.json``.

Source: files/ of Howardkhh/ReplicaSSG at 9419097 and Merging/evaluate.py of Howardkhh/FROSS at 645153b. The files are
in ``ReplicaSSG/`` below the data root or next to the scenes. Objects whose label is not one of the listed classes of
Visual Genome (``unknown``) are excluded from the graph.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, Strict

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import GroundTruth, LabelSet, TrueGraph
from su3d_bench.datasets.replica.folders import LABEL_SPACE, ORIGINAL_FOLDERS, original_name
from su3d_bench.datasets.replica.truth import MAX_OBJECT_ID, MESH_NAME, AnnotatedMesh
from su3d_bench.formats.arrays import parsed_json
from su3d_bench.formats.images import read_bytes
from su3d_bench.formats.json_models import FileModel, WholeNumber, checked_json

VARIANT = "replicassg"
OBJECTS, RELATIONS, CLASSES = "objects.json", "relationships.json", "replica_to_visual_genome.json"
FILES = (OBJECTS, RELATIONS, CLASSES)
UNKNOWN = "unknown"  # a label outside the listed classes
FOLDER_NAMES = ("ReplicaSSG", "ReplicaSSG/files", "replicassg")
URL = "https://github.com/Howardkhh/ReplicaSSG"
MAX_BYTES = 64 << 20  # released files have 0.3 MB
Content = TypeVar("Content")


def find_graph_folder(root: Path) -> Path | None:
    """The folder of ReplicaSSG's annotation below ``root``."""
    places = [root / above / name for above in (".", *ORIGINAL_FOLDERS) for name in FOLDER_NAMES]
    return next((place for place in places if (place / RELATIONS).is_file()), None)


def graph_truth(root: Path, scene: str, mesh: AnnotatedMesh, where: str) -> GroundTruth:
    """The centre of each face with its object's class and instance, and the annotated graph.

    Instance ids are ``object_id`` + 1; class ids are positions in the list of Visual Genome's classes, from 1.
    """
    folder = find_graph_folder(root)
    if folder is None:
        raise GroundTruthMissing(
            f"{where}: no ground truth '{VARIANT}'; expected ReplicaSSG/{RELATIONS}, {OBJECTS} and {CLASSES} ({URL}, "
            f"files/) in {root}"
        )
    names, class_of_label = _classes(folder / CLASSES, f"{where}: {CLASSES}")
    class_of_object = _objects(folder / OBJECTS, original_name(scene), class_of_label, f"{where}: {OBJECTS}")
    triples = _relations(folder / RELATIONS, original_name(scene), f"{where}: {RELATIONS}")
    try:
        graph = TrueGraph(class_of_object, triples)
    except DataError as error:
        raise DataError(f"{where}: {RELATIONS}: {error}; its objects need a label in {CLASSES}") from error
    instance = np.where(mesh.object_of_face < MAX_OBJECT_ID, mesh.object_of_face + 1, 0).astype(np.int32)
    ids, row = np.unique(instance, return_inverse=True)
    semantic = np.array([class_of_object.get(key, 0) for key in ids.tolist()], np.int32)[row]
    starts = np.append(0, np.cumsum(mesh.corners.lengths))[:-1]
    sums = np.add.reduceat(mesh.vertices[mesh.corners.values].astype(np.float64), starts, axis=0)
    return GroundTruth(
        (sums / mesh.corners.lengths[:, None]).astype(np.float32),
        semantic,
        np.where(semantic > 0, instance, 0).astype(np.int32),
        LabelSet(LABEL_SPACE, tuple(range(1, len(names) + 1)), names),
        VARIANT,
        f"centres of the faces of {MESH_NAME}, each with its object, and the relations of ReplicaSSG",
        graph=graph,
    )


class ClassLists(FileModel):
    listed: Annotated[list[str], Field(min_length=1)] = Field(alias="VisualGenome_list")
    meant: dict[str, Any] = Field(alias="Replica2VisualGenome")


class GraphObject(FileModel):
    id: WholeNumber
    label: str


class Scans(FileModel):
    scans: list[dict[str, Any]]


def _classes(path: Path, where: str) -> tuple[tuple[str, ...], Mapping[str, int]]:
    """The listed classes, and the class id of each Replica label; labels outside the list are omitted."""
    content = _read(path, where, ClassLists)
    place = {name: number for number, name in enumerate(content.listed, 1)}
    if len(place) != len(content.listed):
        raise DataError(f"{where}: needs every class of 'VisualGenome_list' once")
    return tuple(place), {
        label: place[name] for label, name in content.meant.items() if isinstance(name, str) and name in place
    }


def _objects(path: Path, scan: str, class_of_label: Mapping[str, int], where: str) -> dict[int, int]:
    """Instance id -> class id of the objects of a scan that have one."""
    answer: dict[int, int] = {}
    for row in _rows(path, scan, "objects", list[GraphObject], where):
        class_id = class_of_label.get(row.label)
        if class_id is not None and answer.setdefault(row.id + 1, class_id) != class_id:
            raise DataError(f"{where}: {scan}: object {row.id} is listed twice, with two classes")
    return answer


def _relations(path: Path, scan: str, where: str) -> tuple[tuple[int, str, int], ...]:
    """Subject, predicate and object of each relation of a scan; in the file the predicate comes last."""
    kind = list[Annotated[tuple[WholeNumber, WholeNumber, Any, str], Strict(False)]]
    rows = _rows(path, scan, "relationships", kind, where)
    return tuple((subject + 1, predicate, other + 1) for subject, other, _, predicate in rows)


def _rows(path: Path, scan: str, key: str, kind: type[Content], where: str) -> Content:
    """The list under ``key`` of a scan's one entry; entries of other scans are ignored."""
    mine = [one for one in _read(path, where, Scans).scans if one.get("scan") == scan]
    if len(mine) != 1:
        raise DataError(f"{where}: has {len(mine)} entries for {scan}; expected one")
    return checked_json(mine[0].get(key), f"{where}: {scan}: {key}", kind)


def _read(path: Path, where: str, kind: type[Content]) -> Content:
    return checked_json(parsed_json(read_bytes(path, where, most=MAX_BYTES), where), where, kind)
