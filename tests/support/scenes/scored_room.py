"""A small room, its ground truth as a prediction, and noisy scenes, for tests of scoring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Prediction
from su3d_bench.core.types import Float32Array, GroundTruth, LabelSet, UInt8Array
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, score_scene

SEMANTIC = ("rooms-semantic", "replica-mesh-ex6")
INSTANCE = ("rooms-instance", "replica-openmask3d")
ROOM = load_protocol("rooms-semantic")
LABELS = LabelSet("replica", tuple(c.id for c in ROOM.classes), tuple(c.name for c in ROOM.classes))
ID = {entry.name: entry.id for entry in ROOM.classes}


@dataclass
class OneHotEncoder:
    """Each known class name has its own axis: a prompt points along the axis of the longest name in it."""

    name: str = "one-hot"
    digest: str = "one-hot"
    dim: int = len(LABELS.names) + 1

    def encode_images(self, images: Sequence[UInt8Array]) -> Float32Array:
        raise AssertionError("scoring uses no image")

    def encode_texts(self, texts: Sequence[str]) -> Float32Array:
        return np.stack([self.feature(text) for text in texts])

    def feature(self, text: str) -> Float32Array:
        inside = [name for name in LABELS.names if name in text]
        axis = LABELS.names.index(max(inside, key=len)) if inside else self.dim - 1
        direction = np.zeros(self.dim, np.float32)
        direction[axis] = 1
        return direction


ENCODER: Encoder = OneHotEncoder()
NAMES = ("wall", "chair", "chair", "table", "lamp", "cushion", "book", "backpack")


def room(seed: int = 0, n_each: int = 150) -> GroundTruth:
    """Eight objects in a row, each a separate cloud of points, and some unannotated points."""
    rng = np.random.default_rng(seed)
    points = np.concatenate(
        [rng.random((n_each, 3)) * [0.8, 0.8, 0.8] + [i, 0, 0] for i in range(len(NAMES))] + [rng.random((20, 3)) - 2]
    ).astype(np.float32)
    semantic = np.concatenate([np.full(n_each, ID[name]) for name in NAMES] + [np.zeros(20)]).astype(np.int32)
    instance = np.concatenate([np.full(n_each, i + 1) for i in range(len(NAMES))] + [np.zeros(20)]).astype(np.int32)
    return GroundTruth(points, semantic, instance, LABELS, "mesh-vertices", "made for a test")


def instances(
    points: Float32Array,
    masks: Sequence[np.ndarray],
    labels: Sequence[str] | None,
    features: Float32Array | None = None,
    scores: Sequence[float] | None = None,
) -> Instances:
    confidences = np.linspace(0.9, 0.5, len(masks)) if scores is None else scores
    return Instances.of(points, list(masks), confidences, features, labels=labels)


def truth_as_prediction(truth: GroundTruth, *, with_labels: bool) -> Instances:
    ids = [int(i) for i in np.unique(truth.instance) if i]
    names = [truth.labels.name_of(int(truth.semantic[truth.instance == i][0])) for i in ids]
    features = None if with_labels else np.stack([OneHotEncoder().feature(name) for name in names])
    masks = [np.flatnonzero(truth.instance == i) for i in ids]
    return instances(truth.points, masks, names if with_labels else None, features)


def nothing(truth: GroundTruth) -> Instances:
    return instances(truth.points, [], None)


def headline(name: str, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None = ENCODER) -> list[float]:
    rules = load_protocol(name)
    result = combine(rules, {"room": score_scene(rules, truth, prediction, encoder)})
    return [result.metrics[key] for key in rules.headline]


def noisy(seed: int) -> tuple[GroundTruth, Instances]:
    rng = np.random.default_rng(seed)
    truth = room(seed, n_each=150 + 25 * (seed % 3))
    whole = truth_as_prediction(truth, with_labels=True)
    masks = [whole.mask(k)[rng.random(len(whole.mask(k))) < rng.uniform(0.4, 1)] for k in range(len(whole))]
    labels = [str(rng.choice(NAMES)) if rng.random() < 0.3 else name for name in NAMES]
    return truth, instances(truth.points, masks, labels, scores=list(rng.integers(1, 5, len(masks)) / 5))


def noisy_scores(name: str, n_scenes: int) -> dict[str, SceneScore]:
    rules = load_protocol(name)
    return {f"rooms/{seed}": score_scene(rules, *noisy(seed), None) for seed in range(n_scenes)}
