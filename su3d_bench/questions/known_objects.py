"""The objects of a ground truth as a map with true names, from which questions and their answers are made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from su3d_bench.core.types import GroundTruth, Int64Array
from su3d_bench.perception.embedded.lexicon import GROUPS
from su3d_bench.perception.embedded.text import words
from su3d_bench.questions.reasoning.named_objects import meant_by
from su3d_bench.questions.reasoning.relations import is_room_surface
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap

STRAY_PERCENT = 1.0  # ours: of an object's vertices at either end of an axis, which in a scan are often a neighbour's


def known_objects(truth: GroundTruth, min_vertices: int, captions: Mapping[int, str] | None = None) -> SceneMap:
    """The objects of at least ``min_vertices`` vertices, without the room's own surfaces, by ascending id.

    An object's class is that of most of its vertices. ``captions``: words on an object, such as its colour.
    """
    objects = []
    for instance, rows in instance_rows(truth, min_vertices):
        classes = np.bincount(truth.semantic[rows].clip(min=0))
        class_id = int(classes.argmax())
        if class_id == 0:
            continue
        name = plain_name(truth.labels.name_of(class_id))
        if not is_room_surface(name):
            points = truth.points[rows].astype(np.float64)
            box = np.percentile(points, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
            objects.append(MapObject(instance, name, (captions or {}).get(instance, ""), points.mean(axis=0), box))
    return SceneMap(tuple(objects))


def instance_rows(truth: GroundTruth, min_vertices: int) -> Iterator[tuple[int, Int64Array]]:
    """Id and rows, both ascending, of each instance of the truth with at least ``min_vertices`` vertices."""
    order = np.argsort(truth.instance, kind="stable")
    ids, starts = np.unique(truth.instance[order], return_index=True)
    for instance, rows in zip(ids.tolist(), np.split(order, starts[1:]), strict=True):
        if instance > 0 and len(rows) >= min_vertices:
            yield instance, rows


def plain_name(name: str) -> str:
    """A class name as people say it.

    >>> plain_name("indoor-plant")
    'indoor plant'
    """
    return " ".join(name.replace("-", " ").replace("_", " ").split())


def is_called(label: str, class_name: str) -> bool:
    """Whether a label is right for an object of a class, by the lexicon's other names and by what it is a kind of.

    A more special name is right ("office chair" for a chair), a more general one too ("chair" for an office chair), a
    word for many classes ("furniture") is not.

    >>> is_called("couch", "sofa"), is_called("paper towel", "towel"), is_called("furniture", "sofa")
    (True, False, False)
    """
    label_words, class_words = words(label), words(class_name)
    if not label_words or not class_words:
        return False
    if label_words == class_words:
        return True
    if " ".join(label_words) in GROUPS:
        return False
    return bool(meant_by(class_name, _only(label)).objects) or bool(meant_by(label, _only(class_name)).objects)


def _only(name: str) -> SceneMap:
    nowhere = np.zeros(3)
    return SceneMap((MapObject(1, name, "", nowhere, np.zeros((2, 3))),))
