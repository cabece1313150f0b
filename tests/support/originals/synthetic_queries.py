"""Synthetic text query problems, answered by both ScanNet's script and this program: runs of points, masks, cosines.

A problem is a list of scenes. A scene has ``objects`` as [id, length] of runs of points, -1 for none, ``queries`` as
lists of ids, ``masks`` as [start, end] and for each mask its ``cosines`` with the queries.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from su3d_bench.core.maps import Masks
from su3d_bench.metrics.instance.average_precision import InstanceAP, combine
from su3d_bench.metrics.open_vocabulary.score import TextQuery, per_scene
from su3d_bench.metrics.protocols.model import ProtocolRules

Scene = dict[str, Any]
Problem = list[Scene]


def objects_of(scene: Scene) -> Any:
    """The object (N,) of every point."""
    ids, lengths = (np.array(column, np.int64) for column in zip(*scene["objects"], strict=True))
    return np.repeat(ids, lengths)


def scored(rules: ProtocolRules, problem: Problem) -> InstanceAP:
    """AP over all scenes and queries."""
    assert rules.min_region_size is not None
    counts = []
    for scene in problem:
        rows = [np.arange(*mask) for mask in scene["masks"]]
        queries = [TextQuery(f"query {k}", tuple(ids)) for k, ids in enumerate(scene["queries"])]
        cosines = np.array(scene["cosines"], float).reshape(len(rows), len(queries))
        counts.append(
            per_scene(
                objects_of(scene), queries, Masks.of_sets(rows), cosines,
                min_region_size=rules.min_region_size, thresholds=rules.thresholds,
            )
        )  # fmt: skip
    return combine(counts, rules.thresholds)
