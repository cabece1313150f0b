"""A scene with OpenLex3D's labels and queries, and perfect and empty predictions of it, for tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scored_room import instances

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float32Array, UInt8Array
from su3d_bench.metrics.open_vocabulary.openlex3d import ObjectLabels, OpenLexTruth
from su3d_bench.metrics.open_vocabulary.score import QueryTruth, TextQuery

OBJECTS = {
    7: ObjectLabels(("chair", "seat"), ("flower",), ("stool",), (12,)),
    12: ObjectLabels(("table",), (), ("desk",), (7,)),
    30: ObjectLabels(("lamp", "light", "lantern")),
    31: ObjectLabels(("vase",), ("bird", "leaf"), ("jug",)),
    40: ObjectLabels(("wall",)),
}
FILLERS = tuple(f"word {n}" for n in range(12))
PROMPTS = (
    "chair", "seat", "flower", "stool", "table", "desk", "lamp", "light", "lantern", "vase", "bird", "leaf", "jug",
    "wall", "pot", *FILLERS,
)  # fmt: skip


@dataclass
class WordEncoder:
    """Each prompt has its own axis; any other text points along the last one."""

    name: str = "words"
    digest: str = "words"
    dim: int = len(PROMPTS) + 1

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("scoring uses no image")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.stack([self.feature({text: 1.0}) for text in texts])

    def feature(self, weights: dict[str, float]) -> Float32Array:
        direction = np.zeros(self.dim, np.float32)
        for word, weight in weights.items():
            direction[PROMPTS.index(word) if word in PROMPTS else self.dim - 1] = weight
        return direction


ENCODER: Encoder = WordEncoder()


def cloud(seed: int = 0, n_each: int = 60) -> tuple[Float32Array, np.ndarray]:
    """Points of the five objects, 40 cm boxes half a metre apart, and some outside."""
    rng = np.random.default_rng(seed)
    points = [rng.random((n_each + 5 * i, 3)) * 0.4 + [i * 0.9, 0, 0] for i in range(len(OBJECTS))]
    ids = np.repeat([*OBJECTS, -1], [*(len(part) for part in points), 10])
    return np.concatenate([*points, rng.random((10, 3)) - 3]).astype(np.float32), ids.astype(np.int64)


def lex_truth(seed: int = 0) -> OpenLexTruth:
    points, ids = cloud(seed)
    return OpenLexTruth(points, ids, OBJECTS, PROMPTS, "openlex3d-visible", "made for a test")


def query_truth(seed: int = 0) -> QueryTruth:
    points, ids = cloud(seed)
    asked = (("seat", (7,)), ("light", (30,)), ("pot", (31, 12)), ("none", (999,)))
    queries = tuple(TextQuery(text, objects) for text, objects in asked)
    return QueryTruth(points, ids, queries, "openlex3d-face-corners", "made for a test")


def instances_with(
    points: Float32Array,
    masks: Sequence[np.ndarray],
    features: Float32Array | None,
    labels: Sequence[str] | None = None,
) -> Instances:
    return instances(points, masks, labels, features)


def perfect(truth: OpenLexTruth | QueryTruth, *, first: str | None = None, second: float = 1.0) -> Instances:
    """The objects as masks, each with a feature that ranks its labels in order; ``first`` may outrank them."""
    masks = [np.flatnonzero(truth.object_of_point == one) for one in OBJECTS]
    features = []
    for labels in OBJECTS.values():
        words = (*labels.synonyms, *labels.depictions, *labels.vis_sim)
        weights = {word: second * (1 - 0.05 * place) for place, word in enumerate(words)}
        features.append(WordEncoder().feature(({first: 1.0} if first else {}) | weights))
    return instances_with(truth.points, masks, np.stack(features))


def labels_of(truth: OpenLexTruth) -> list[str]:
    return [labels.synonyms[0] for labels in truth.objects.values()]


def nothing_at(truth: OpenLexTruth | QueryTruth) -> Instances:
    return instances_with(truth.points, [], None)
