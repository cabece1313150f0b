"""Synthetic box problems, answered by both VoteNet's evaluation and this program.

A problem is a list of scenes. In a scene all boxes are rotated about y by one ``heading`` in radians: ``true`` boxes
with a class, centre and sizes in metres, and ``found`` ones also with a confidence, all different within a problem.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array, GroundTruth, LabelSet, ObjectBoxes, OrientedBox
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import score_scene

Scene = dict[str, Any]
Problem = list[Scene]
SLOTS = range(4)
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))


def turn(heading: float) -> Float64Array:
    """The rotation about y."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def names_of(rules: ProtocolRules) -> dict[int, tuple[int, str]]:
    """The id and name of the class of each slot."""
    return {k: (entry.id, entry.name) for k in SLOTS for entry in [rules.scored[5 * k + 2]]}


def scored(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene; an instance is given by the corners of its box."""
    classes, rotation = names_of(rules), turn(scene["heading"])
    labels = LabelSet(rules.label_space, *(tuple(column) for column in zip(*classes.values(), strict=True)))
    true = {k + 1: one for k, one in enumerate(scene["true"])}
    boxes = {k: OrientedBox(np.array(one["middle"]), np.array(one["sizes"]), rotation) for k, one in true.items()}
    of_instance = {k: classes[one["slot"]][0] for k, one in true.items()}
    none = np.zeros(0, np.int32)
    truth = GroundTruth(
        np.zeros((0, 3), np.float32), none, none, labels, rules.ground_truth, "made",
        boxes=ObjectBoxes(boxes, of_instance, labels),
    )  # fmt: skip
    found = scene["found"]
    corners = [(CORNERS * one["sizes"]) @ rotation.T + one["middle"] for one in found]
    points = np.concatenate([np.zeros((0, 3)), *corners]).astype(np.float32)
    masks = [np.arange(8 * k, 8 * k + 8) for k in range(len(found))]
    called = [classes[one["slot"]][1] for one in found]
    confidences = np.array([one["score"] for one in found], float)
    return score_scene(rules, truth, Instances.of(points, masks, confidences, labels=called), None)
