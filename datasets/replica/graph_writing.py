"""Scene graphs of made scenes in ReplicaSSG's own files: objects, relations, and what Visual Genome calls the classes.

Objects are those that have faces; relations those that boxes give and that are predicates of the list, next to as near.
The sources are those of ``scene_graphs``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.files.atomic import json_text, make_folder
from su3d_bench.core.system.files import file_text
from su3d_bench.core.toml import parse_toml
from su3d_bench.datasets.recordings.joined_lists import JoinedList
from su3d_bench.datasets.replica.folders import original_name
from su3d_bench.datasets.replica.scene_graphs import CLASSES, FOLDER_NAMES, OBJECTS, RELATIONS, UNKNOWN
from su3d_bench.datasets.writing import ScannedObject, write_shared_text
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.numerics.relations import Relations

PROTOCOL = "replica-relations"  # which lists the classes and the predicates in their order
PREDICATE_OF = {"on": "on", "under": "under", "in": "in", "above": "above", "next to": "near"}


@cache
def meant_classes() -> Mapping[str, str]:
    """Which class of Visual Genome each class of the rooms means; those that mean none are left out."""
    table = parse_toml(file_text(Path(__file__).with_name("visual_genome.toml")))
    return {str(name): str(meant) for name, meant in table["classes"].items()}


def joined_graphs(out: Path) -> tuple[JoinedList, JoinedList]:
    """The files of objects and of relations, in which every scene has a row."""
    folder = out / FOLDER_NAMES[0]
    return (
        JoinedList(".objects.json", folder / OBJECTS, "scan", "scans", original_name),
        JoinedList(".relationships.json", folder / RELATIONS, "scan", "scans", original_name),
    )


def write_classes(out: Path, class_names: Sequence[str]) -> None:
    """The table of what each of Replica's classes means, with the lists of classes and predicates."""
    rules = load_protocol(PROTOCOL)
    table = {
        "Replica2VisualGenome": {name: meant_classes().get(name, UNKNOWN) for name in class_names},
        "VisualGenome_list": [entry.name for entry in rules.classes],
        "VisualGenome_rel": list(rules.predicates),
    }
    make_folder(out / FOLDER_NAMES[0])
    write_shared_text(out / FOLDER_NAMES[0] / CLASSES, json_text(table), "is another table than that of the rooms")


def graph_rows(scan: str, objects: Sequence[ScannedObject]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The rows of a scene among the objects and among the relations."""
    listed = [{"label": known.class_name, "id": str(known.id)} for known in objects]
    meant = [known for known in objects if known.class_name in meant_classes()]
    boxes = np.array([(known.box_min, known.box_max) for known in meant], np.float64)
    links = Relations(boxes, [known.class_name.rpartition("-")[2] for known in meant]).links()
    predicates = load_protocol(PROTOCOL).predicates
    rows = [
        [meant[link.subject].id, meant[link.object].id, predicates.index(name), name]
        for link in links
        if (name := PREDICATE_OF.get(link.relation)) is not None
    ]
    return {"scan": scan, "objects": listed}, {"scan": scan, "relationships": rows}
