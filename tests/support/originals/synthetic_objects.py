"""Synthetic problems of objects that vote for nearby points, answered by both OVO's script and this program.

A problem is a list of scenes. A scene has the ``truth`` of every vertex, a class index or -1 (void). Either a
class is ``called`` on each vertex, or ``places_mm`` are the vertex positions, ``own_mm`` the points of a map,
``owner`` the object of each (-1 for none), ``ids`` the numbers of the objects in the map's file, and ``of_object`` the
class of each. Predicted -1 is no class.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from prediction_files import write_ovo

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array, GroundTruth, LabelSet
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.predictions.dense import ovo

Problem = list[dict[str, Any]]
N_SLOTS, NONE = 8, -1
OVERALL = ("mIoU", "mAcc", "F-mIoU", "pAcc")
GROUPS = ("head", "common", "tail")


def slots_of(rules: ProtocolRules, problem: Problem) -> Problem:
    """The problem with a protocol's class indices."""
    named = [k for k, entry in enumerate(rules.classes) if entry.name != rules.unnamed]
    unnamed = next(k for k, entry in enumerate(rules.classes) if entry.name == rules.unnamed)
    index = np.array([*(named[(7 * k + 1) % len(named)] for k in range(N_SLOTS - 1)), unnamed, NONE])
    is_never_true = rules.unnamed == "background"
    true = np.where((index == unnamed) & is_never_true, NONE, index)
    of_key = {"truth": true, "called": index, "of_object": index}
    return [
        {key: of_key[key][values].tolist() if key in of_key else values for key, values in scene.items()}
        for scene in problem
    ]


def our_means(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """The means over all classes and over thirds of them; NaN if no class of a third is true or called."""
    found = combine(rules, {str(s): scored(rules, scene) for s, scene in enumerate(problem)}, with_intervals=False)
    of_groups = [found.groups[group][key] for group in GROUPS for key in OVERALL[:2]]
    return np.array([*(found.metrics[key] for key in OVERALL), *of_groups], float)


def scored(rules: ProtocolRules, scene: dict[str, Any]) -> Any:
    """The score of vertices with classes, -1 is void; a class is ``called`` on each, or given by the objects of a map,
    -1 for none."""
    kinds = np.array(scene["truth"])
    places = np.array(scene.get("places_mm", [[1000 * k, 0, 0] for k in range(len(kinds))])) / 1000
    if "called" in scene:
        own, owner, of_object = places, np.array(scene["called"]), [*range(len(rules.classes)), NONE]
        owner = np.where(owner < 0, len(rules.classes), owner)
    else:
        own, owner, of_object = _read_again(np.array(scene["own_mm"]) / 1000, scene)
    there = sorted(set(owner.tolist()) - {-1})
    labels = LabelSet(
        rules.label_space, tuple(entry.id for entry in rules.classes), tuple(entry.name for entry in rules.classes)
    )
    truth = GroundTruth(
        places.astype(np.float32),
        np.array([rules.classes[k].id if k >= 0 else 0 for k in kinds.tolist()], np.int32),
        np.zeros(len(kinds), np.int32),
        labels,
        rules.ground_truth,
        "made",
    )
    masks = [np.flatnonzero(owner == k) for k in there]
    names = [rules.classes[of_object[k]].name if of_object[k] >= 0 else "of no class" for k in there]
    return score_scene(
        rules, truth, Instances.of(own.astype(np.float32), masks, [1.0] * len(masks), labels=names), None
    )


def _read_again(own: Float64Array, scene: dict[str, Any]) -> tuple[Any, Any, list[int]]:
    """The points, the row of the object of each, and the class of each row, from the file of such a map."""
    numbers, axes = np.array([*scene["ids"], -1]), np.eye(len(scene["ids"]), dtype=np.float32)
    with tempfile.TemporaryDirectory() as folder:
        write_ovo(Path(folder), own, numbers[scene["owner"]], dict(zip(scene["ids"], axes, strict=True)))
        found: Any = ovo(Path(folder), "made")[0]
    return found.points, found.instance, [scene["of_object"][k] for k in found.features.argmax(axis=1)]
