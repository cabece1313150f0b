"""Made problems of text queries, which ScanNet's script and this program both answer: runs of points, masks, cosines.

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


def drawn(seed: int, index: int) -> Problem:
    """Problem ``index``: objects of several queries and of none, equal cosines, masks twice, on nothing."""
    rng = np.random.default_rng([seed, index])
    scenes = []
    for _ in range(rng.integers(1, 3)):
        ids = [int(one) for one in rng.permutation(rng.integers(2, 7))]
        objects = [[one if rng.random() < 0.85 else -1, int(rng.integers(1, 12))] for one in ids]
        starts = np.cumsum([0, *(length for _, length in objects)]).tolist()
        there = [one for one, _ in objects if one >= 0] or [99]  # an object that no point has
        queries = [sorted(rng.choice(there, min(len(there), n), replace=False).tolist()) for n in rng.integers(1, 4, 3)]
        masks: list[list[int]] = []
        for _ in range(rng.choice([0, 2, 4, 7])):
            run = int(rng.integers(len(objects)))
            start = int(rng.integers(max(0, starts[run] - 1), starts[run] + 2))
            end = int(rng.integers(start + 1, starts[run + 1] + 3))
            near = [min(start, starts[-1] - 1), min(max(end, start + 1), starts[-1])]
            masks.append(masks[-1] if masks and rng.random() < 0.15 else near)
        cosines = np.round(rng.uniform(-1, 1, (len(masks), len(queries))), 1).tolist()
        scenes.append({"objects": objects, "queries": queries, "masks": masks, "cosines": cosines})
    return scenes


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
