"""Synthetic problems of vertices with several labels and ranked classes, for ScanNet++'s script and this program.

A problem is a list of scenes. A scene has the ``labels`` of every vertex, three lines of the list of classes or -1 for
none, its ``ranked`` classes, one line or three, and the vertices that are ``left_out``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.types import GroundTruth, LabelSet
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import score_scene
from su3d_bench.predictions.base import VertexLabels

Scene = dict[str, Any]


def scored(rules: ProtocolRules, scene: Scene) -> SceneScore:
    """The score of a scene under a protocol of kind ``top-k``."""
    labels, ranked = np.array(scene["labels"]), np.array(scene["ranked"], np.int32)
    ids = np.array([entry.id for entry in rules.classes] + [0], np.int32)  # the last for none
    every = ids[labels]
    every[scene["left_out"]] = -1
    points = np.column_stack([np.arange(len(labels)), np.zeros((len(labels), 2))]).astype(np.float32)
    space = LabelSet(rules.label_space, *zip(*((one.id, one.name) for one in rules.classes), strict=True))
    truth = GroundTruth(
        points, every[:, 0], np.zeros(len(labels), np.int32), space, rules.ground_truth, "made", every_semantic=every
    )
    further = ranked[:, 1:] if ranked.shape[1] > 1 else None
    prediction = VertexLabels(ranked[:, 0], further, "line").on(points, rules)
    return score_scene(rules, truth, prediction, None)
