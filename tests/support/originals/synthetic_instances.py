"""Synthetic instance problems, answered by both original evaluators and this program: runs of points and masks.

A problem is a list of scenes. A scene has its ``truth`` as [class, number, length] of runs of points and ``masks`` with
a class, a score and runs [start, end]. Classes are slots: four that are scored, -2 one that is not, -1 void.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array, GroundTruth, Int64Array, LabelSet
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import score_scene

Scene = dict[str, Any]
Problem = list[Scene]
VOID, LEFT_OUT = -1, -2
SCORED = (0, 1, 2, 3)


def members(mask: dict[str, Any]) -> Int64Array:
    """The points of a mask, ascending."""
    return np.concatenate([np.zeros(0, np.int64), *(np.arange(*run) for run in mask["runs"])])


def columns_of(scene: Scene) -> tuple[Int64Array, Int64Array]:
    """The slot (N,) and instance number (N,) of every point."""
    slot, number, length = (np.array(column) for column in zip(*scene["truth"], strict=True))
    return np.repeat(slot, length), np.repeat(number, length)


def scored(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene under an instance protocol."""
    ids, names = classes_of(rules)
    slots, numbers = columns_of(scene)
    known = [one for one in ids if one != VOID]
    labels = LabelSet(rules.label_space, tuple(ids[one] for one in known), tuple(names[one] for one in known))
    points = _points(len(slots))
    semantic = np.array([ids[one] for one in slots.tolist()], np.int32)
    truth = GroundTruth(points, semantic, numbers.astype(np.int32), labels, rules.ground_truth, "made")
    masks = [members(mask) for mask in scene["masks"]]
    confidences = np.array([mask["score"] for mask in scene["masks"]], float)
    called = [names[mask["slot"]] for mask in scene["masks"]]
    return score_scene(rules, truth, Instances.of(points, masks, confidences, labels=called), None)


def _points(n: int) -> Float32Array:
    """One point per metre, so that each has one neighbour within reach: itself."""
    points = np.zeros((n, 3), np.float32)
    points[:, 0] = np.arange(n)
    return points


def classes_of(rules: ProtocolRules) -> tuple[dict[int, int], dict[int, str]]:
    """A protocol's ids and names of the slots."""
    if not rules.classes:
        return {VOID: 0, LEFT_OUT: 1, 0: 4, 1: 7, 2: 11, 3: 21}, {one: f"c{one}" for one in (LEFT_OUT, VOID, *SCORED)}
    first = 0 if rules.name == "scannet200-instance" else 3
    step = 3 if rules.name.startswith("openscan") else 7  # the next would repeat the first among 21
    entries = {k: rules.scored[(step * k + first) % len(rules.scored)] for k in SCORED}
    left = [entry for entry in rules.classes if rules.is_ignored(entry.name)]
    return (
        {VOID: 0, LEFT_OUT: left[0].id if left else 900, **{k: one.id for k, one in entries.items()}},
        {LEFT_OUT: left[0].name if left else "nothing", **{k: one.name for k, one in entries.items()}},
    )
