"""Synthetic instance problems, answered by both original evaluators and this program: runs of points and masks.

A problem is a list of scenes. A scene has its ``truth`` as [class, number, length] of runs of points and ``masks`` with
a class, a score and runs [start, end]. Classes are slots: four that are scored, -2 one that is not, -1 void, -3 none,
for objects without a class, and -4 an id above every list. If it has an ``order``, the points are shuffled by that
seed; ``masked`` [start, end] are points that ScanNet++ leaves out.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array, GroundTruth, Int64Array, LabelSet
from su3d_bench.evaluation.ground_truth import VertexTruth
from su3d_bench.evaluation.scoring import score_on_vertices
from su3d_bench.evaluation.text_ground_truth import TruthValues
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import score_scene
from su3d_bench.predictions.base import vertex_masks

Scene = dict[str, Any]
Problem = list[Scene]
VOID, LEFT_OUT, NO_CLASS, BEYOND = -1, -2, -3, -4
SCORED = (0, 1, 2, 3)
UNKNOWN = {VOID: 0, NO_CLASS: 0, BEYOND: 1999}  # the ids of what is in no list


def columns_of(scene: Scene) -> tuple[Int64Array, Int64Array]:
    """The slot (N,) and instance number (N,) of every point."""
    slot, number, length = (np.array(column) for column in zip(*scene["truth"], strict=True))
    order = _order(scene)
    return np.repeat(slot, length)[order], np.repeat(number, length)[order]


def members_of(scene: Scene) -> list[Int64Array]:
    """The points of each mask, ascending."""
    order, members = _order(scene), []
    for mask in scene["masks"]:
        is_in = np.zeros(len(order), bool)
        for first, last in mask["runs"]:
            is_in[first:last] = True
        members.append(np.flatnonzero(is_in[order]))
    return members


def masked_of(scene: Scene) -> Int64Array:
    """The points left out, ascending."""
    first, last = scene.get("masked", (0, 0))
    order = _order(scene)
    return np.flatnonzero((order >= first) & (order < last))


def _order(scene: Scene) -> Int64Array:
    n = sum(length for *_, length in scene["truth"])
    return np.arange(n) if scene.get("order") is None else np.random.default_rng(scene["order"]).permutation(n)


def values_of(scene: Scene, ids: dict[int, int], *, are_numbers: bool = False) -> Int64Array:
    """The values (N,) of a text file: id * 1000 + number, 0 for void; or numbers only, the same object with 1000."""
    slots, numbers = columns_of(scene)
    values = np.array([ids[one] for one in slots.tolist()]) * 1000 + numbers
    if are_numbers:
        values = np.select([slots == BEYOND, slots == LEFT_OUT], [values, 1000 + numbers], numbers)
    return np.where(slots == VOID, 0, values)


def is_text_only(rules: ProtocolRules, scene: Scene) -> bool:
    """Whether only a text file can state the ground truth: an object of the number 0, or a value that is no number."""
    no_number = {BEYOND} if rules.class_agnostic == "numbered" else set[int]()
    return any(slot in no_number or (number == 0 and slot != VOID) for slot, number, _ in scene["truth"])


def scored_text(rules: ProtocolRules, problem: Problem) -> list[SceneScore]:
    """The scores of the scenes of a problem under an instance protocol, as from text files."""
    ids, _ = classes_of(rules)
    values = [values_of(scene, ids, are_numbers=rules.class_agnostic == "numbered") for scene in problem]
    form = TruthValues.of(values, None if rules.class_agnostic == "numbered" else "instances")
    scores = []
    for scene, one in zip(problem, values, strict=True):
        masks = scene["masks"]
        content = vertex_masks(
            "made",
            [members.astype(np.int32) for members in members_of(scene)],
            len(one),
            scores=np.array([mask["score"] for mask in masks], float),
            class_numbers=np.array([ids[mask["slot"]] for mask in masks], np.int32),
        )
        truth = VertexTruth(*form.read(one, rules), ())
        scores.append(score_on_vertices(rules, truth, "made", content, None).score)
    return scores


def scored(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene under an instance protocol, from points with labels."""
    ids, names = classes_of(rules)
    slots, numbers = columns_of(scene)
    known = [one for one in ids if ids[one]]
    labels = LabelSet(rules.label_space, tuple(ids[one] for one in known), tuple(names[one] for one in known))
    points = _points(len(slots))
    semantic = np.array([ids[one] for one in slots.tolist()], np.int32)
    if rules.label_space == "scannetpp":
        semantic[masked_of(scene)] = -1
    truth = GroundTruth(points, semantic, numbers.astype(np.int32), labels, rules.ground_truth, "made")
    confidences = np.array([mask["score"] for mask in scene["masks"]], float)
    called = [names[mask["slot"]] for mask in scene["masks"]]
    return score_scene(rules, truth, Instances.of(points, members_of(scene), confidences, labels=called), None)


def _points(n: int) -> Float32Array:
    """One point per metre, so that each has one neighbour within reach: itself."""
    points = np.zeros((n, 3), np.float32)
    points[:, 0] = np.arange(n)
    return points


def classes_of(rules: ProtocolRules) -> tuple[dict[int, int], dict[int, str]]:
    """A protocol's ids and names of the slots."""
    unknown = {slot: f"nothing {slot}" for slot in UNKNOWN}
    if not rules.classes:
        return UNKNOWN | {LEFT_OUT: 1, 0: 4, 1: 7, 2: 11, 3: 21}, unknown | {one: f"c{one}" for one in (-2, *SCORED)}
    first = 0 if rules.name == "scannet200-instance" else 3
    step = 3 if rules.name.startswith("openscan") else 7  # the next would repeat the first among 21
    entries = {k: rules.scored[(step * k + first) % len(rules.scored)] for k in SCORED}
    left = [entry for entry in rules.classes if rules.is_ignored(entry.name)]
    return (
        UNKNOWN | {LEFT_OUT: left[0].id if left else 900, **{k: one.id for k, one in entries.items()}},
        unknown | {LEFT_OUT: left[0].name if left else "nothing", **{k: one.name for k, one in entries.items()}},
    )
