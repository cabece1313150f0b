"""Synthetic problems with one class per point, answered by both original evaluators and this program.

A problem is a list of scenes. A scene has the ``truth`` of every point and its prediction ``called``: 0 to 7 are scored
classes, 8 is not scored, 9 an id above every list, 10 one between those of it, -1 void or nothing. ``places_mm`` are
the positions of the true points, ``own_mm`` of predicted points and ``seen_mm`` of scored points, if these differ.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.maps import Instances
from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.evaluation.ground_truth import VertexTruth
from su3d_bench.evaluation.scoring import score_on_vertices
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import score_scene
from su3d_bench.predictions.base import VertexLabels

Scene = dict[str, Any]
Problem = list[Scene]
VOID, OTHER, BEYOND, BETWEEN = -1, 8, 9, 10


def classes_of(rules: ProtocolRules) -> dict[int, tuple[int, str]]:
    """A protocol's id and name of each slot except void."""
    left = [(entry.id, entry.name) for entry in rules.classes if rules.is_ignored(entry.name)]
    scored = {k: rules.scored[(3 * k + 1) % len(rules.scored)] for k in range(OTHER)}
    return {
        **{k: (entry.id, entry.name) for k, entry in scored.items()},
        OTHER: left[0] if left else (9999, "none such"),
    }


def ids_of(rules: ProtocolRules) -> dict[int, int]:
    """A protocol's id of each slot, 0 for void."""
    known = {entry.id for entry in rules.classes}
    between = next(one for one in range(1, len(known) + 2) if one not in known)
    return {slot: one for slot, (one, _) in classes_of(rules).items()} | {VOID: 0, BEYOND: 70000, BETWEEN: between}


def scored_text(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene under a point protocol, as from text files."""
    ids = ids_of(rules)
    labels, called = (np.array([ids[k] for k in scene[name]], np.int64) for name in ("truth", "called"))
    content = VertexLabels(called.astype(np.int32))
    return score_on_vertices(rules, VertexTruth(labels, labels, ()), "made", content, None).score


def scored(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene under a point protocol."""
    of_slot, id_of = classes_of(rules), ids_of(rules)
    of_slot |= {slot: (id_of[slot], f"nothing {slot}") for slot in (BEYOND, BETWEEN)}
    kinds, called = np.array(scene["truth"]), np.array(scene["called"])
    places = np.array(scene.get("places_mm", [[1000 * k, 0, 0] for k in range(len(kinds))])) / 1000
    own = np.array(scene["own_mm"]) / 1000 if "own_mm" in scene else places
    ids, names = zip(*of_slot.values(), strict=True)
    truth = GroundTruth(
        places.astype(np.float32),
        np.array([id_of[k] for k in kinds.tolist()], np.int32),
        np.zeros(len(kinds), np.int32),
        LabelSet(rules.label_space, ids, names),
        rules.ground_truth,
        "made",
        evaluation_points=(np.array(scene["seen_mm"]) / 1000).astype(np.float32) if "seen_mm" in scene else None,
    )
    there = sorted(set(called.tolist()) - {VOID})
    masks = [np.flatnonzero(called == k) for k in there]
    found = Instances.of(own.astype(np.float32), masks, [1.0] * len(masks), labels=[of_slot[k][1] for k in there])
    return score_scene(rules, truth, found, None)
