"""The objects of a ground truth as a map with true names, from which questions and their answers are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from su3d_bench.core.english import last_word, words
from su3d_bench.core.types import Float64Array, GroundTruth, Int64Array, WholeObject
from su3d_bench.perception.embedded.lexicon import GROUPS
from su3d_bench.questions.looks import looks_of
from su3d_bench.questions.reasoning.named_objects import meant_by
from su3d_bench.questions.reasoning.scene_map import MapObject, SceneMap, is_room_surface
from su3d_bench.questions.sight import WITHOUT_COLOUR, Sight, instance_rows

STRAY_PERCENT = 1.0  # ours: of an object's vertices at either end of an axis, which in a scan are often a neighbour's


def known_objects(
    truth: GroundTruth,
    min_vertices: int,
    whole: Sequence[WholeObject] | None = None,
    seen: Mapping[int, Sight] | None = None,
) -> SceneMap:
    """The objects of a scene without the room's own surfaces, by ascending id.

    Those of the truth with at least ``min_vertices`` vertices; an object's class is that of most of them. ``whole``
    gives all objects of the scene as they are. Where ``seen`` says what frames show, colours are in the captions and
    what is not plain to see is not to be asked about; nor is a cabinet where there are base cabinets too.
    """
    rows_of = dict(instance_rows(truth, min_vertices))
    objects = [_of_vertices(truth, instance, rows) for instance, rows in rows_of.items()] if whole is None else whole
    names = {known.name for known in objects if known is not None}
    things = []
    for known in objects:
        if known is None or is_room_surface(known.name):
            continue
        sight = None if seen is None else seen.get(known.id)
        is_asked = known.id in rows_of and (seen is None or (sight is not None and sight.is_plain))
        is_asked &= not any(name.endswith(f" {known.name}") for name in names)
        is_cut = whole is None and sight is not None and sight.is_cut
        looks = None
        if whole is None and seen is not None:
            looks = looks_of(known.name, _without_strays(truth, rows_of[known.id]), sight, is_cut=is_cut)
        things.append(
            MapObject(
                known.id,
                known.name,
                " ".join((*_colour(known, sight), *known.adjectives)),
                known.box.mean(axis=0),
                known.box,
                is_asked=is_asked,
                is_whole=whole is not None,
                is_cut=is_cut,
                looks=looks,
            )
        )
    return SceneMap(tuple(things))


def _colour(known: WholeObject, sight: Sight | None) -> tuple[str, ...]:
    """The word for what frames show, where it is what the thing was made in, or nobody knows and it is plain."""
    if sight is None or not sight.colour or last_word(known.name) in WITHOUT_COLOUR:
        return ()
    return (sight.colour,) if known.colour == sight.colour or (not known.colour and sight.is_sure_colour) else ()


def _of_vertices(truth: GroundTruth, instance: int, rows: Int64Array) -> WholeObject | None:
    class_id = int(np.bincount(truth.semantic[rows].clip(min=0)).argmax())
    if class_id == 0:
        return None
    return WholeObject(instance, plain_name(truth.labels.name_of(class_id)), _box_of(truth, rows))


def _box_of(truth: GroundTruth, rows: Int64Array) -> Float64Array:
    box: Float64Array = np.percentile(
        truth.points[rows].astype(np.float64), [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0
    )
    return box


def _without_strays(truth: GroundTruth, rows: Int64Array) -> Float64Array:
    """The points of an object within the box that is taken for it."""
    points, (low, high) = truth.points[rows].astype(np.float64), _box_of(truth, rows)
    kept: Float64Array = points[((points >= low) & (points <= high)).all(axis=1)]
    return kept


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
