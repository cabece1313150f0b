"""Synthetic problems of labelled points in segments of things and stuff, for both the originals and this program.

A problem is a list of scenes. A scene has the ``truth`` of every point, its ``instance`` (0 for none), its ``owner``
among the predicted masks (-1 for none) and the class ``called`` of each mask. 0-2 are things, 3-4 stuff, 5 is a class
that is not scored, -1 no label, -2 a point excluded by evaluations if the dataset has such points.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array, GroundTruth, LabelSet
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import combine, score_scene
from su3d_bench.metrics.semantic.panoptic import QUALITIES

Scene = dict[str, Any]
Problem = list[Scene]
N_THINGS, N_SCORED, OTHER, UNLABELLED, LEFT_OUT = 3, 5, 5, -1, -2
PARTS = ("", " things", " stuff")


def classes_of(rules: ProtocolRules) -> dict[int, tuple[int, str]]:
    """A protocol's id and name of each slot of a class."""
    things = [entry for entry in rules.scored if entry.name not in rules.stuff]
    stuff = [entry for entry in rules.scored if entry.name in rules.stuff]
    left = [(entry.id, entry.name) for entry in rules.classes if rules.is_ignored(entry.name)]
    chosen = [*(things[(7 * k + 2) % len(things)] for k in range(N_THINGS)), *stuff[: N_SCORED - N_THINGS]]
    return dict(enumerate([*((entry.id, entry.name) for entry in chosen), *(left[:1] or [(9999, "none such")])]))


def has_left_out(rules: ProtocolRules) -> bool:
    """Whether the ground truth has points excluded from evaluation; otherwise they have no label."""
    return rules.label_space == "scannetpp"


def scored(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene, with points one metre apart."""
    of_slot = classes_of(rules)
    id_of = {slot: number for slot, (number, _) in of_slot.items()}
    id_of |= {UNLABELLED: 0, LEFT_OUT: -1 if has_left_out(rules) else 0}
    n, owner = len(scene["truth"]), np.array(scene["owner"])
    points = np.column_stack([np.arange(n), np.zeros((n, 2))]).astype(np.float32)
    truth = GroundTruth(
        points,
        np.array([id_of[slot] for slot in scene["truth"]], np.int32),
        np.array(scene["instance"], np.int32),
        LabelSet(rules.label_space, *zip(*of_slot.values(), strict=True)),
        rules.ground_truth,
        "made",
    )
    names = [of_slot[slot][1] for slot in scene["called"]]
    masks = [np.flatnonzero(owner == k) for k in range(len(names))]
    return score_scene(rules, truth, Instances.of(points, masks, None, labels=names), None)


def our_qualities(rules: ProtocolRules, problem: Problem) -> Float64Array:
    """PQ, SQ and RQ of all classes, of things, of stuff, and of each slot, 0 if a class does not occur."""
    found = combine(rules, {str(s): scored(rules, scene) for s, scene in enumerate(problem)}, with_intervals=False)
    means = [found.metrics[name + part] for part in PARTS for name in QUALITIES]
    slots = [name for _, name in classes_of(rules).values()][:N_SCORED]
    of_slots = [found.per_class[slot][name] for slot in slots for name in QUALITIES]
    return np.array([*means, *np.nan_to_num(of_slots)], float)
