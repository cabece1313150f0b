"""Worlds with known true values, from which ``coverage_of_intervals`` draws benchmarks.

A world consists of scenes: their classes and sizes, and the difficulty of scenes, classes and instances for two equally
good methods. Values and jackknife values come from the functions that score runs. The settings of all worlds except
``AlikeRooms`` are round numbers fixed before looking at any coverage; they make scenes differ more than the built-in
rooms do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.instance.average_precision import InstanceCounts, ap_columns, combine_each, resampled_ap
from su3d_bench.metrics.questions import score as asking
from su3d_bench.metrics.questions.score import ShareCounts, share_counts
from su3d_bench.metrics.semantic.confusion import SemanticCounts, resampled_semantic

N_TRUTH = 20_000  # scenes that represent the population
THRESHOLDS = (0.5, 0.75, 0.25)
QUALITY = np.array([0.5, -0.6, 1.3])  # added to an instance's quality, which decides at each threshold
Weights = Int64Array
Values = dict[str, Float64Array]


def sigmoid(value: Float64Array) -> Float64Array:
    return 1.0 / (1.0 + np.exp(-value))


class Semantic:
    """Confusion matrices of 30 classes: sizes and presence as uneven as in rooms, one class in ten is rare."""

    names = ("mAcc", "F-mIoU")
    n_classes = 30

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.presence = np.maximum(1 / np.arange(1, self.n_classes + 1) ** 0.6, 0.08)  # the first is in every scene
        self.difficulty = rng.normal(0, 0.8, self.n_classes)
        self.size = 2000 * rng.lognormal(0, 1.2, self.n_classes)

    def points(self, rng: np.random.Generator, n: int) -> tuple[Int64Array, list[tuple[Int64Array, Int64Array]]]:
        """Points of each class (n, C) and, for two methods, those predicted correctly and wrongly predicted as it."""
        shape = (n, self.n_classes)
        is_present = rng.random(shape) < self.presence
        n_true = np.where(is_present, self.size * rng.lognormal(0, 0.7, shape), 0).astype(np.int64)
        shared = 1.2 + self.difficulty + rng.normal(0, 0.6, (n, 1)) + rng.normal(0, 0.7, shape)
        methods = []
        for _ in range(2):
            recall = sigmoid(shared + rng.normal(0, 0.2, (n, 1)) + rng.normal(0, 0.7, shape))
            hit = (n_true * recall).astype(np.int64)
            wrong = rng.dirichlet(np.full(self.n_classes, 0.5), n) * is_present
            wrong /= np.maximum(wrong.sum(axis=1, keepdims=True), 1e-9)
            methods.append((hit, (0.7 * (n_true - hit).sum(axis=1, keepdims=True) * wrong).astype(np.int64)))
        return n_true, methods

    def draw(self, rng: np.random.Generator, n: int) -> list[list[SemanticCounts]]:
        n_true, methods = self.points(rng, n)
        return [[self._counts(*row) for row in zip(n_true, *of_method, strict=True)] for of_method in methods]

    def _counts(self, n_true: Int64Array, hit: Int64Array, wrong: Int64Array) -> SemanticCounts:
        """Rows and columns have the relevant sums; the pairs of confused classes do not matter."""
        confusion = np.zeros((self.n_classes + 1, self.n_classes + 1), np.int64)
        np.fill_diagonal(confusion, hit)
        confusion[: self.n_classes, -1] = n_true - hit
        for row, columns in ((0, slice(1, self.n_classes)), (1, slice(0, 1))):  # off the diagonal
            confusion[row, columns] += wrong[columns]
            confusion[row, -1] -= wrong[columns].sum()
        return SemanticCounts(confusion[: self.n_classes], n_true > 0)

    def values(self, counts: Sequence[SemanticCounts], weights: Weights) -> Values:
        return resampled_semantic(counts, weights, "conceptgraphs")

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        n_true, ((hit, wrong), _) = self.points(rng, 10 * N_TRUTH)
        totals = [part.sum(axis=0).astype(np.float64) for part in (n_true, hit, wrong)]
        iou = totals[1] / (totals[0] + totals[2])
        return {"mAcc": float((totals[1] / totals[0]).mean()), "F-mIoU": float(totals[0] @ iou / totals[0].sum())}


class SceneMeans(Semantic):
    """The mean over scenes of each scene's accuracy."""

    names = ("mean of scenes",)

    def draw(self, rng: np.random.Generator, n: int) -> Any:
        n_true, methods = self.points(rng, n)
        with np.errstate(invalid="ignore"):
            return [np.nanmean(np.where(n_true > 0, hit / n_true, np.nan), axis=1) for hit, _ in methods]

    def values(self, counts: Any, weights: Weights) -> Values:
        return {"mean of scenes": weights @ counts / weights.sum(axis=1)}

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        return {"mean of scenes": float(self.draw(rng, 10 * N_TRUTH)[0].mean())}


class Shares:
    """Shares of correctly answered questions, about 10 to 40 per scene."""

    names = ("correct answers",)

    def draw(self, rng: np.random.Generator, n: int) -> list[list[ShareCounts]]:
        n_asked, shared = rng.integers(10, 41, n), 0.8 + rng.normal(0, 0.6, n)
        right = [rng.binomial(n_asked, sigmoid(shared + rng.normal(0, 0.3, n))) for _ in range(2)]
        return [[share_counts([a], [r]) for a, r in zip(n_asked, of_method, strict=True)] for of_method in right]

    def values(self, counts: Sequence[ShareCounts], weights: Weights) -> Values:
        return {"correct answers": asking.resampled(counts, weights)[:, 0]}

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        counts = asking.ShareCounts.joined(self.draw(rng, 10 * N_TRUTH)[0])
        return {"correct answers": float(asking.shares(counts)[0])}


class Instances:
    """Precision-recall rows of 8 classes, from 4 instances per scene to one in four scenes."""

    names = ("pooled AP", "pooled AP50")
    rate = np.array([4, 3, 2, 1.5, 1, 0.6, 0.4, 0.25])
    scene_deviation, method_deviation = 0.5, 0.2  # of the difficulty of scenes, and of scenes for one method
    false_per_instance = 0.6
    class_confidence, scene_confidence = 0.0, 0.0  # standard deviations of what all confidences of one have in common

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.difficulty = rng.normal(0, 0.6, len(self.rate))
        self.confidence = rng.normal(0, self.class_confidence, len(self.rate))

    def n_truth(self, rng: np.random.Generator) -> Int64Array:
        """The number of instances (C,) of each class in one scene."""
        return rng.poisson(self.rate)

    def draw(self, rng: np.random.Generator, n: int) -> list[list[InstanceCounts]]:
        methods: list[list[InstanceCounts]] = [[], []]
        for _ in range(n):
            n_truth, of_scene = self.n_truth(rng), rng.normal(0, self.scene_deviation)
            confidence = self.confidence + (rng.normal(0, self.scene_confidence) if self.scene_confidence else 0.0)
            of_class = np.repeat(np.arange(len(self.rate)), n_truth)
            shared = of_scene + self.difficulty[of_class] + rng.normal(0, 0.7, len(of_class))
            for method in methods:
                quality = shared + rng.normal(0, self.method_deviation) + rng.normal(0, 0.7, len(of_class))
                method.append(self._counts(rng, n_truth, of_class, quality, of_scene, confidence))
        return methods

    def _counts(
        self,
        rng: np.random.Generator,
        n_truth: Int64Array,
        of_class: Int64Array,
        quality: Float64Array,
        of_scene: float,
        confidence: Float64Array,
    ) -> InstanceCounts:
        n_false = rng.poisson(self.false_per_instance * self.rate * np.exp(-0.5 * of_scene))
        classes = np.concatenate([of_class, np.repeat(np.arange(len(self.rate)), n_false)])
        sure = np.concatenate([0.5 + 0.7 * quality, np.full(int(n_false.sum()), -0.5)]) + confidence[classes]
        score = sigmoid(sure + rng.normal(0, 0.8, len(sure)))
        is_true = np.zeros((len(THRESHOLDS), len(classes)), bool)
        is_true[:, : len(quality)] = quality + QUALITY[:, None] > 0
        n_found = np.array([np.bincount(of_class[row[: len(quality)]], minlength=len(self.rate)) for row in is_true])
        return InstanceCounts(
            class_index=np.tile(classes, len(THRESHOLDS)).astype(np.int32),
            threshold_index=np.repeat(np.arange(len(THRESHOLDS)), len(classes)).astype(np.int32),
            score=np.tile(score, len(THRESHOLDS)),
            is_true=is_true.ravel(),
            n_missed=n_truth[:, None] - n_found.T,
            n_truth=n_truth.astype(np.int64),
            n_small_truth=np.zeros(len(self.rate), np.int64),
            n_predictions=n_truth + n_false,
        )

    def values(self, counts: Sequence[InstanceCounts], weights: Weights) -> Values:
        found = resampled_ap(counts, weights, THRESHOLDS)
        return {"pooled AP": found["AP"], "pooled AP50": found["AP50"]}

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        found = self.values(self.draw(rng, N_TRUTH)[0], np.ones((1, N_TRUTH), np.int64))
        return {name: float(value[0]) for name, value in found.items()}

    def class_values(self, counts: Sequence[InstanceCounts]) -> Values:
        """The values (1 + S, C) of each class: over all scenes, then without each; NaN without an instance."""
        groups = [counts, *([*counts[:s], *counts[s + 1 :]] for s in range(len(counts)))]
        tables = np.array([one.table for one in combine_each([InstanceCounts.joined(g) for g in groups], THRESHOLDS)])
        return {"pooled AP": tables[:, :, ap_columns(THRESHOLDS)].mean(axis=2), "pooled AP50": tables[:, :, 0]}


# How many of Replica's eight rooms have each of OpenMask3D's 48 classes, and how many objects of it they have together.
# Facts from the dataset's habitat/info_semantic.json, as listed in files/objects.json of Howardkhh/ReplicaSSG at
# 9419097; the classes of each room are those of ConceptGraphs' list.
REPLICA = {
    "basket": (2, 2), "bed": (1, 1), "bench": (2, 4), "bin": (5, 10), "blanket": (3, 7), "blinds": (6, 25),
    "book": (2, 10), "bottle": (4, 6), "box": (2, 6), "bowl": (1, 1), "camera": (4, 4), "cabinet": (2, 2),
    "candle": (1, 1), "chair": (7, 38), "clock": (4, 4), "cloth": (1, 1), "comforter": (1, 1), "cushion": (3, 18),
    "desk": (1, 1), "desk-organizer": (3, 3), "door": (8, 8), "indoor-plant": (4, 5), "lamp": (8, 36),
    "monitor": (1, 1), "nightstand": (1, 2), "panel": (6, 10), "picture": (2, 2), "pillar": (3, 4), "pillow": (2, 9),
    "pipe": (1, 3), "plant-stand": (2, 2), "plate": (3, 5), "pot": (1, 1), "sculpture": (1, 2), "shelf": (1, 1),
    "sofa": (4, 6), "stool": (2, 5), "switch": (6, 9), "table": (7, 16), "tablet": (3, 4), "tissue-paper": (4, 4),
    "tv-screen": (3, 3), "tv-stand": (1, 1), "vase": (3, 7), "vent": (8, 16), "wall-plug": (8, 32), "window": (6, 24),
    "rug": (4, 4),
}  # fmt: skip


class ReplicaRooms(Instances):
    """48 classes, as frequent as in Replica: 13 occur in one of eight rooms; confidences differ by class and scene."""

    n_rooms, n_objects = np.array(list(REPLICA.values()), np.int64).T
    rate = n_objects / 8
    class_confidence, scene_confidence = 0.5, 0.3

    def n_truth(self, rng: np.random.Generator) -> Int64Array:
        more = rng.poisson(self.n_objects / self.n_rooms - 1)
        return np.where(rng.random(len(more)) < self.n_rooms / 8, 1 + more, 0)


class AlikeRooms(ReplicaRooms):
    """The least favourable of the settings tried: equally difficult rooms, so AP hardly varies; many false positives.

    With 4 instead of 0.6 false positives per instance, AP of few instances is biased most.
    """

    scene_deviation, method_deviation = 0.0, 0.0
    false_per_instance = 4.0
    class_confidence, scene_confidence = 1.0, 0.5
