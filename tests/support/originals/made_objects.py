"""Made problems of objects that vote for the points near them, scored by this program."""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import score_scene


def scored(rules: ProtocolRules, scene: dict[str, Any]) -> Any:
    """The score of vertices of classes, -1 is void; a class is ``called`` on each, or of the objects of a map."""
    kinds = np.array(scene["truth"])
    places = np.array(scene.get("places_mm", [[1000 * k, 0, 0] for k in range(len(kinds))])) / 1000
    if "called" in scene:
        own, owner, of_object = places, np.array(scene["called"]), list(range(len(rules.classes)))
    else:
        own, owner, of_object = np.array(scene["own_mm"]) / 1000, np.array(scene["owner"]), scene["of_object"]
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
    names = [rules.classes[of_object[k]].name for k in there]
    return score_scene(
        rules, truth, Instances.of(own.astype(np.float32), masks, [1.0] * len(masks), labels=names), None
    )
