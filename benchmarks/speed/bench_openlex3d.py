"""Time of OpenLex3D's category frequencies of one scene, compared with a loop over the points.

The loop does what the original does for each point: it counts the points of the object by comparing the whole array,
looks up its labels one by one, and computes similarities for each predicted point instead of each object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from su3d_bench.core.maps import Partition
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.metrics.matching.nearest import nearest
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectLabels, OpenLexTruth
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene

N_OBJECTS, N_PROMPTS, DIM = 200, 3407, 1024  # a scene of Replica, the longest prompt list, ViT-H-14
PROMPTS = tuple(f"prompt {n}" for n in range(N_PROMPTS))
RULES = load_protocol("openlex3d-topn")
LARGE, SMALL = 1_000_000, 10_000


@dataclass
class TableEncoder:
    """Texts by a table of random features."""

    name: str = "ViT-H-14/laion2b_s32b_b79k"
    digest: str = "table"
    dim: int = DIM

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("scoring uses no image")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.random.default_rng(7).normal(size=(len(texts), DIM)).astype(np.float32)


def scene(n_points: int) -> tuple[OpenLexTruth, Partition]:
    """Objects of 40 cm along a room, and a prediction on other points of them, with a feature each."""
    rng = np.random.default_rng(0)
    corners = rng.random((N_OBJECTS, 3)) * [8, 6, 2.5]
    ids = np.sort(rng.integers(0, N_OBJECTS, n_points))
    points, predicted = ((corners[ids] + rng.random((n_points, 3)) * 0.4).astype(np.float32) for _ in range(2))
    words = [[PROMPTS[w] for w in row] for row in rng.integers(0, N_PROMPTS, (N_OBJECTS, 5))]
    objects = {
        one: ObjectLabels((a, b, c), (d,), (e,), ((one + 1) % N_OBJECTS,)) for one, (a, b, c, d, e) in enumerate(words)
    }
    text = TableEncoder().encode_texts(PROMPTS)
    features = text[[PROMPTS.index(row[0]) for row in words]] + rng.normal(size=(N_OBJECTS, DIM)).astype(np.float32) * 2
    truth = OpenLexTruth(points, ids, objects, PROMPTS, RULES.ground_truth, "random")
    return truth, Partition(predicted, ids.astype(np.int32), features)


def frequencies(truth: OpenLexTruth, prediction: Partition) -> dict[str, float]:
    result = combine(RULES, {"scene": score_scene(RULES, truth, prediction, TableEncoder())})
    return {name: float(value) for name, value in result.metrics.items()}


def walk_over_points(truth: OpenLexTruth, prediction: Partition) -> dict[str, float]:
    """The original's loops; the nearest predicted point and its top labels are found as above but per point."""
    text = TableEncoder().encode_texts(truth.prompts).astype(np.float64)
    text /= np.linalg.norm(text, axis=1, keepdims=True)
    distance, found = nearest(prediction.points, truth.points)
    top: NDArray[Any] = np.empty((len(prediction.points), 5), np.int64)
    for point in range(len(prediction.points)):
        feature = prediction.features[prediction.instance[point]].astype(np.float64)
        top[point] = np.argsort(text @ feature)[-5:][::-1]
    share = dict.fromkeys(("synonyms", "depictions", "vis_sim", "clutter", "missing", "incorrect"), 0.0)
    seen = set()
    for row, one in enumerate(truth.object_of_point):
        n_points = int((truth.object_of_point == one).sum())
        labels = truth.objects[int(one)]
        category = "missing"
        if distance[row] <= 0.05:
            near = [truth.objects[other] for other in labels.clutter]
            clutter = [word for o in near for word in (*o.synonyms, *o.depictions, *o.vis_sim)]
            names = [truth.prompts[index] for index in top[found[row]]]
            tiers = zip(share, (labels.synonyms, labels.depictions, labels.vis_sim, clutter), strict=False)
            category = next((tier for tier, words in tiers if any(name in words for name in names)), "incorrect")
        share[category] += 1 / n_points
        seen.add(int(one))
    return {name: value / len(seen) for name, value in share.items()}


@pytest.mark.benchmark(group="OpenLex3D, top 5 labels of each point of a scene: 200 objects, 3407 prompts")
@pytest.mark.parametrize("n_points", [LARGE, SMALL])
def test_by_pairs_of_object_and_instance(benchmark: Any, n_points: int) -> None:
    values = benchmark.pedantic(frequencies, scene(n_points), rounds=3)
    assert sum(values.values()) == pytest.approx(1.0)


@pytest.mark.benchmark(group="OpenLex3D, top 5 labels of each point of a scene: 200 objects, 3407 prompts")
def test_loop_over_the_points(benchmark: Any) -> None:
    truth, prediction = scene(SMALL)
    values = benchmark.pedantic(walk_over_points, (truth, prediction), rounds=1)
    assert sum(values.values()) == pytest.approx(1.0)
    ours = frequencies(truth, prediction)  # on a grid of 5 cm, while the loop uses every predicted point
    assert values["synonyms"] == pytest.approx(ours["synonyms"], abs=0.2)
