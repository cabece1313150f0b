"""ReplicaSSG's scene graphs of Replica: ``objects.json``, ``relationships.json`` and ``replica_to_visual_genome.json``.

Source: files/ of Howardkhh/ReplicaSSG at 9419097 and Merging/evaluate.py of Howardkhh/FROSS at 645153b. The files stand
in ``ReplicaSSG/`` below the data root or beside the scenes. Objects whose label means none of the listed classes of
Visual Genome (``unknown``) are none of the graph.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError, GroundTruthMissing
from su3d_bench.core.types import GroundTruth, LabelSet, TrueGraph
from su3d_bench.datasets.replica.folders import LABEL_SPACE, ORIGINAL_FOLDERS, original_name
from su3d_bench.datasets.replica.truth import MAX_OBJECT_ID, MESH_NAME, AnnotatedMesh, shown
from su3d_bench.formats.arrays import parsed_json
from su3d_bench.formats.images import read_bytes

VARIANT = "replicassg"
OBJECTS, RELATIONS, CLASSES = "objects.json", "relationships.json", "replica_to_visual_genome.json"
FILES = (OBJECTS, RELATIONS, CLASSES)
UNKNOWN = "unknown"  # a label that means none of the listed classes
FOLDER_NAMES = ("ReplicaSSG", "ReplicaSSG/files", "replicassg")
URL = "https://github.com/Howardkhh/ReplicaSSG"
MOST_BYTES = 64 << 20  # the released ones have 0.3 MB
MOST_OBJECTS = 100_000


def find_graph_folder(root: Path) -> Path | None:
    """The folder of ReplicaSSG's annotation below ``root``."""
    places = [root / above / name for above in (".", *ORIGINAL_FOLDERS) for name in FOLDER_NAMES]
    return next((place for place in places if (place / RELATIONS).is_file()), None)


def graph_truth(root: Path, scene: str, mesh: AnnotatedMesh, where: str) -> GroundTruth:
    """The centre of each face with the class and instance of its object, and the annotated graph.

    Instance ids are ``object_id`` + 1; class ids the place in the list of Visual Genome's classes, from 1.
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
        raise DataError(f"{where}: {RELATIONS}: {error}; its objects need a label of {CLASSES}") from error
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


def _classes(path: Path, where: str) -> tuple[tuple[str, ...], Mapping[str, int]]:
    """The listed classes, and the id of that which each label of Replica means; labels of none of them are left out."""
    content = _content(path, where)
    listed, meant = content.get("VisualGenome_list"), content.get("Replica2VisualGenome")
    if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed) or not listed:
        raise DataError(f"{where}: has no list 'VisualGenome_list' of names")
    if not isinstance(meant, dict) or len(set(listed)) != len(listed):
        raise DataError(f"{where}: needs a table 'Replica2VisualGenome' and every class once")
    place = {name: number for number, name in enumerate(listed, 1)}
    return tuple(listed), {
        label: place[name] for label, name in meant.items() if isinstance(name, str) and name in place
    }


def _objects(path: Path, scan: str, class_of_label: Mapping[str, int], where: str) -> dict[int, int]:
    """Instance id -> class id of the objects of a scan that have one."""
    answer: dict[int, int] = {}
    for row in _rows(path, scan, "objects", where):
        number, label = (
            row.get("id") if isinstance(row, dict) else None,
            row.get("label") if isinstance(row, dict) else 0,
        )
        word = str(number)
        if not isinstance(label, str) or not (word.isascii() and word.isdigit() and len(word) < 10):
            raise DataError(f"{where}: {scan}: an object is {shown(row)}; expected an id and a label")
        if label in class_of_label and answer.setdefault(int(word) + 1, class_of_label[label]) != class_of_label[label]:
            raise DataError(f"{where}: {scan}: object {word} stands there twice, with two classes")
    return answer


def _relations(path: Path, scan: str, where: str) -> tuple[tuple[int, str, int], ...]:
    """Subject, predicate and object of each relation of a scan; the file has both objects before the predicate."""
    answer = []
    for row in _rows(path, scan, "relationships", where):
        is_row = isinstance(row, list) and len(row) == 4 and isinstance(row[3], str)
        if not is_row or not all(type(row[k]) is int and 0 <= row[k] < MAX_OBJECT_ID for k in (0, 1)):
            raise DataError(f"{where}: {scan}: a relation is {ascii(row)[:60]}; expected subject, object, number, name")
        answer.append((row[0] + 1, row[3], row[1] + 1))
    return tuple(answer)


def _rows(path: Path, scan: str, key: str, where: str) -> list[Any]:
    scans = _content(path, where).get("scans")
    if not isinstance(scans, list):
        raise DataError(f"{where}: has no list 'scans'")
    mine = [one for one in scans if isinstance(one, dict) and one.get("scan") == scan]
    if len(mine) != 1 or not isinstance(mine[0].get(key), list):
        raise DataError(f"{where}: has {len(mine)} entries of {scan} with a list '{key}'; expected one")
    rows: list[Any] = mine[0][key]
    if len(rows) > MOST_OBJECTS:
        raise DataError(f"{where}: {scan} has {len(rows)} {key}; expected at most {MOST_OBJECTS}")
    return rows


def _content(path: Path, where: str) -> dict[str, Any]:
    if path.is_file() and path.stat().st_size > MOST_BYTES:
        raise DataError(f"{where}: has more than {MOST_BYTES >> 20} MiB; copy the released file")
    content = parsed_json(read_bytes(path, where), where)
    if not isinstance(content, dict):
        raise DataError(f"{where}: holds {type(content).__name__}; expected the file of ReplicaSSG ({URL})")
    return content
