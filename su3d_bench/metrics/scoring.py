"""Additive counts of one scene under one protocol, reported values from counts of scenes, and counts in files.

``METRICS`` is the only table of the kinds of metrics; all other code uses the metric from ``metric_of``.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.arguments import typed
from su3d_bench.core.errors import DataError, PredictionError, printable
from su3d_bench.core.files.atomic import DAMAGE, read_arrays
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances, Partition, Prediction
from su3d_bench.core.types import GroundTruth
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.graphs import ObjectMetric, PlaceMetric
from su3d_bench.metrics.instance.boxes import BoxMetric
from su3d_bench.metrics.instance.score import InstanceMetric
from su3d_bench.metrics.matching import transfer
from su3d_bench.metrics.matching.checks import LOW_COVERAGE, check_cloud, map_warnings
from su3d_bench.metrics.metric import MAX_COUNTED, Counts, Metric, SceneScore, scene_mean
from su3d_bench.metrics.open_vocabulary.openlex3d import OpenLexTruth
from su3d_bench.metrics.open_vocabulary.score import CategoriesMetric, QueryMetric, QueryTruth
from su3d_bench.metrics.protocols.model import Kind, ProtocolRules
from su3d_bench.metrics.questions import score as questions
from su3d_bench.metrics.questions.grounding import ChainMetric, GroundingMetric
from su3d_bench.metrics.questions.presence import PresenceMetric
from su3d_bench.metrics.relations import RelationMetric
from su3d_bench.metrics.semantic.panoptic import PanopticMetric
from su3d_bench.metrics.semantic.score import SemanticMetric
from su3d_bench.metrics.semantic.top_k import TopKMetric
from su3d_bench.numerics.statistics import jackknife_interval, leave_one_out

__all__ = [
    "EVERY_SCENE",
    "SceneScore",
    "Truth",
    "combine",
    "metric_of",
    "pack_scores",
    "score_scene",
    "unpack_scores",
]

EVERY_SCENE = "every scene"  # prefix of a warning that all scenes share, in place of the name of one
QuestionTruth = (
    questions.RetrievalTruth | questions.PresenceTruth | questions.AnnotationTruth | questions.ReasoningTruth
)
Truth = GroundTruth | OpenLexTruth | QueryTruth | QuestionTruth
METRICS: dict[Kind, type[Metric[Any]]] = {
    "semantic": SemanticMetric,
    "top-k": TopKMetric,
    "instance": InstanceMetric,
    "panoptic": PanopticMetric,
    "boxes": BoxMetric,
    "queries": QueryMetric,
    "categories": CategoriesMetric,
    "grounding": GroundingMetric,
    "object-chains": ChainMetric,
    "relations": RelationMetric,
    "objects": ObjectMetric,
    "places": PlaceMetric,
    "retrieval": questions.RetrievalMetric,
    "presence": PresenceMetric,
    "annotation": questions.AnnotationMetric,
    "reasoning": questions.ReasoningMetric,
}
_COUNTS: dict[str, type[Counts]] = {metric.counts.stored_as: metric.counts for metric in METRICS.values()}


def metric_of(rules: ProtocolRules) -> Metric[Any]:
    """The metric of a protocol's kind, with its rules."""
    return METRICS[rules.kind](rules)


@typed
def score_scene(rules: ProtocolRules, truth: Truth, prediction: Prediction, encoder: Encoder | None) -> SceneScore:
    """The additive counts of one scene under one protocol.

    ``encoder`` classifies the features of predictions without labels. Raises ``PredictionError`` for a prediction that
    cannot be scored and ``DataError`` for a ground truth that does not fit the protocol.

    >>> import numpy as np, su3d_bench as su3d
    >>> rules = su3d.load_protocol("rooms-instance")
    >>> chair = rules.scored[0]
    >>> labels = su3d.LabelSet("replica", (chair.id,), (chair.name,))
    >>> points, ones = np.random.default_rng(0).random((200, 3)).astype(np.float32), np.ones(200, np.int32)
    >>> truth = su3d.GroundTruth(points, chair.id * ones, ones, labels, rules.ground_truth, "by hand")
    >>> half = su3d.Instances.of(points, [np.arange(120)], labels=[chair.name])
    >>> score = su3d.score_scene(rules, truth, half, None)
    >>> float(su3d.combine(rules, {"mine/room": score}).metrics["AP50"])  # IoU 0.6
    1.0
    """
    metric = metric_of(rules)
    base = truth.scene if isinstance(truth, QuestionTruth) else truth
    space = base.labels.space if isinstance(base, GroundTruth) else base.space
    if space != rules.label_space:
        raise DataError(f"{rules.name}: needs the label space '{rules.label_space}', ground truth has '{space}'")
    if base.variant != rules.ground_truth or not isinstance(truth, metric.truth):
        raise DataError(f"{rules.name}: needs ground truth '{rules.ground_truth}', this one is '{base.variant}'")
    reason = kind_incompatibility(rules, prediction)
    if reason:
        raise PredictionError(reason)
    _check_points(rules, prediction)
    score = metric.per_scene(truth, prediction, encoder)
    warnings = map_warnings(rules, base if isinstance(base, GroundTruth) else base.points, prediction, score)
    return replace(score, warnings=(*score.warnings, *warnings))


def score_located(rules: ProtocolRules, truth: Truth, prediction: Prediction, encoder: Encoder | None) -> SceneScore:
    """``score_scene`` of a map in the frame of the ground truth; ``PredictionError`` if it cannot be."""
    base = truth.scene if isinstance(truth, QuestionTruth) else truth
    outside = check_cloud(prediction.points, base.points)
    score = score_scene(rules, truth, prediction, encoder)
    if any(line.startswith(LOW_COVERAGE) for line in score.warnings):  # says the same
        return score
    return replace(score, warnings=(*score.warnings, *outside))


def _check_points(rules: ProtocolRules, prediction: Prediction) -> None:
    if prediction.points.ndim != 2 or prediction.points.shape[1] != 3 or not np.isfinite(prediction.points).all():
        raise PredictionError(f"{rules.name}: the map's points {prediction.points.shape} are not finite (M, 3) metres")
    if isinstance(prediction, Instances) and not np.isfinite(prediction.scores).all():
        bad = int(np.flatnonzero(~np.isfinite(prediction.scores))[0])
        raise PredictionError(
            f"{rules.name}: instance {bad} has the confidence {prediction.scores[bad]}; make it finite"
        )
    if isinstance(prediction, Partition):
        n = len(prediction.features)
        if prediction.instance.shape != (len(prediction.points),) or prediction.instance.max(initial=-1) >= n:
            raise PredictionError(f"{rules.name}: a partition needs one row of its {n} features per point, -1 for none")
    if isinstance(prediction, DenseFeatures) and len(prediction.features) != len(prediction.points):
        raise PredictionError(
            f"{rules.name}: {len(prediction.points)} points and {len(prediction.features)} features; give one per point"
        )


@dataclass(frozen=True)
class ProtocolResult:
    """The values of one method under one protocol, as fractions, NaN if undefined.

    ``metrics`` is ``pooled`` or ``scene_mean``, whichever the protocol reports; ``intervals`` are its confidence
    intervals for the headline metrics, ``None`` if ``jackknife_interval`` has none, as for a single scene.
    ``coverage``: by radius in metres, the share of scored points without a predicted point within it. ``groups`` has
    head, common and tail if the protocol has them.
    """

    protocol: str
    version: int
    headline: tuple[str, ...]
    scenes: tuple[str, ...]
    metrics: Mapping[str, float]
    pooled: Mapping[str, float]
    scene_mean: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float] | None]
    per_scene: Mapping[str, Mapping[str, float]]
    per_class: Mapping[str, Mapping[str, float]]
    groups: Mapping[str, Mapping[str, float]]
    coverage: Mapping[str, float]
    n_predictions: Mapping[str, int]
    warnings: tuple[str, ...]

    @property
    def n_scenes(self) -> int:
        return len(self.scenes)

    def to_json(self) -> dict[str, Any]:
        """Plain values for a JSON file, NaN as null."""
        names = (
            "protocol version headline n_scenes scenes metrics intervals pooled scene_mean per_scene per_class groups "
            "coverage n_predictions warnings"
        )
        return {name: plain_json(getattr(self, name)) for name in names.split()}


def plain_json(value: Any) -> Any:
    """``value`` with None for non-finite numbers, and tuples as lists."""
    if isinstance(value, Mapping):
        return {key: plain_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@typed
def combine(rules: ProtocolRules, scores: Mapping[str, SceneScore], *, with_intervals: bool = True) -> ProtocolResult:
    """The protocol's values over the scenes of ``scores``, whose order does not matter.

    ``intervals`` are None if not wanted.

    ``DataError`` without scenes, or if one was scored with other rules. The values are fractions.

    >>> import su3d_bench as su3d
    >>> su3d.combine(su3d.load_protocol("rooms-instance"), {})
    Traceback (most recent call last):
    su3d_bench.core.errors.DataError: rooms-instance: no scene was scored; nothing to combine
    """
    metric, ordered = metric_of(rules), _ordered(rules, scores)
    counts = [score.counts for score in ordered.values()]
    pooled, rows = metric.pooled(counts), metric.combine_each(counts)
    mean = scene_mean(rows)
    intervals: dict[str, tuple[float, float] | None] = dict.fromkeys(rules.headline)
    if with_intervals and len(ordered) > 1:
        without_each = metric.resampled_headline(counts, rows, leave_one_out(len(ordered)))
        intervals = {
            name: jackknife_interval(without_each[name], ~np.isnan([row[name] for row in rows]))
            for name in rules.headline
        }
    return ProtocolResult(
        protocol=rules.name,
        version=rules.version,
        headline=rules.headline,
        scenes=tuple(ordered),
        metrics=pooled.values if rules.aggregate == "pooled" else mean,
        pooled=pooled.values,
        scene_mean=mean,
        intervals=intervals,
        per_scene=dict(zip(ordered, rows, strict=True)),
        per_class=pooled.classes,
        groups=pooled.groups,
        coverage=_coverage(ordered.values()),
        n_predictions={scene: score.n_predictions for scene, score in ordered.items()},
        warnings=(*_gathered({scene: score.warnings for scene, score in ordered.items()}), *pooled.warnings),
    )


def combined_metrics(rules: ProtocolRules, scores: Mapping[str, SceneScore]) -> Mapping[str, float]:
    """Only the ``metrics`` of ``combine``, without intervals, classes and scenes."""
    return metric_of(rules).reported([score.counts for score in _ordered(rules, scores).values()])


def _ordered(rules: ProtocolRules, scores: Mapping[str, SceneScore]) -> dict[str, SceneScore]:
    """The scenes by name; ``DataError`` if there is none, or if one was scored with other rules."""
    if not scores:
        raise DataError(f"{rules.name}: no scene was scored; nothing to combine")
    metric = metric_of(rules)
    for scene, score in scores.items():
        if (score.protocol, score.version) != (rules.name, rules.version):
            raise DataError(
                f"{scene}: was scored under {score.protocol} version {score.version}, not {rules.name} version "
                f"{rules.version}; score it again"
            )
        metric.check(scene, score.counts)
    return {scene: scores[scene] for scene in sorted(scores)}


def _coverage(scores: Collection[SceneScore]) -> dict[str, float]:
    """By radius, the share of scored points without a predicted point within it."""
    n_scored = sum(score.n_scored for score in scores)
    n_beyond = np.sum([score.n_farther for score in scores], axis=0)
    shares = n_beyond / n_scored if n_scored else np.full(len(n_beyond), np.nan)
    return {f"{radius:g}": float(share) for radius, share in zip(transfer.COVERAGE_RADII_M, shares, strict=True)}


def _gathered(warnings: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Each warning with its scene, or once if every scene has it.

    >>> _gathered({"a": ("x", "y"), "b": ("x",)})
    ['every scene: x', 'a: y']
    """
    sentences = dict.fromkeys(sentence for of_scene in warnings.values() for sentence in of_scene)
    shared = [s for s in sentences if len(warnings) > 1 and all(s in of_scene for of_scene in warnings.values())]
    single = [f"{scene}: {s}" for scene, of_scene in warnings.items() for s in of_scene if s not in shared]
    return [f"{EVERY_SCENE}: {sentence}" for sentence in shared] + single


def pack_scores(scores: Mapping[str, SceneScore]) -> bytes:
    """The npz file of a scene's scores under several protocols; equal scores give equal bytes.

    >>> from su3d_bench.metrics.semantic.confusion import SemanticCounts
    >>> counts = SemanticCounts(np.zeros((1, 2), np.int64), np.ones(1, bool))
    >>> score = SceneScore("p", 1, counts, 3, 0, np.zeros(3, np.int64), ())
    >>> unpack_scores(pack_scores({"p": score}))["p"].n_predictions
    3
    """
    arrays: dict[str, NDArray[Any]] = {}
    for name in sorted(scores):
        score = scores[name]
        about = {
            "protocol": score.protocol,
            "version": score.version,
            "kind": score.counts.stored_as,
            "n_predictions": score.n_predictions,
            "n_scored": score.n_scored,
            "n_farther": score.n_farther.tolist(),
            "warnings": score.warnings,
        }
        arrays[f"{name}/about"] = np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)
        arrays |= {f"{name}/{array}": getattr(score.counts, array) for array in score.counts.arrays()}
    # numpy dates every member 1980-01-01, so the bytes do not depend on the time of writing
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def unpack_scores(data: bytes) -> dict[str, SceneScore]:
    """The scores packed by ``pack_scores``; raises ``DataError`` for anything else."""
    try:
        arrays = read_arrays(io.BytesIO(data))
        names = [key.removesuffix("/about") for key in arrays if key.endswith("/about")]
        if unknown := [key for key in arrays if key.rpartition("/")[0] not in names]:
            raise DataError(f"counts: '{printable(unknown[0], 80)}' belongs to no protocol; score the scene again")
        return {name: _unpack_one(name, arrays) for name in names}
    except DAMAGE as error:
        raise DataError(f"counts: are damaged or of another version ({error}); score the scene again") from error


def _unpack_one(name: str, arrays: Mapping[str, NDArray[Any]]) -> SceneScore:
    about = json.loads(arrays[f"{name}/about"].tobytes())
    n_farther = np.array(about["n_farther"], np.int64)
    if n_farther.shape != (len(transfer.COVERAGE_RADII_M),):
        raise DataError(f"counts: 'n_farther' has the shape {n_farther.shape}; score the scene again")
    if about["protocol"] != name:
        raise DataError(f"counts: '{name}' contains those of '{about['protocol']}'; score the scene again")
    for key in ("version", "n_predictions", "n_scored"):
        if type(about[key]) is not int or not 0 <= about[key] < MAX_COUNTED:
            raise DataError(f"counts: '{key}' is {about[key]}; score the scene again")
    if not (np.diff([about["n_scored"], *n_farther, 0]) <= 0).all():
        raise DataError(
            f"counts: 'n_farther' is {n_farther.tolist()} of {about['n_scored']} scored points; score the scene again"
        )
    kind = _COUNTS[about["kind"]]
    return SceneScore(
        protocol=about["protocol"],
        version=about["version"],
        counts=kind.checked({array: arrays[f"{name}/{array}"] for array in kind.arrays()}),
        n_predictions=about["n_predictions"],
        n_scored=about["n_scored"],
        n_farther=n_farther,
        warnings=tuple(about["warnings"]),
    )
