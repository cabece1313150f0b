"""One scene under one protocol to additive counts, and counts of scenes to numbers.

The steps around a metric: which points are scored, what the prediction is called there, and what a reader must know to
trust the number. Ratios are formed in ``combine`` alone.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.errors import DataError, PredictionError
from su3d_bench.metrics import instance_ap, semantic, transfer
from su3d_bench.metrics.labelling import (
    candidate_classes,
    class_index_of_ids,
    classes_of_prediction,
    encoder_warning,
)
from su3d_bench.metrics.results import Counts, ProtocolResult, form_result
from su3d_bench.protocols import ProtocolRules
from su3d_bench.types import (
    BoolArray,
    DenseFeatures,
    Encoder,
    Float64Array,
    GroundTruth,
    Instances,
    Int64Array,
    Partition,
    Prediction,
)

DUPLICATE_IOU = 0.9  # pairs above it are the same object twice; duplicates can raise AP under constant confidences


@dataclass(frozen=True)
class SceneScore:
    """What one scene adds to a protocol's numbers, with what a reader must know about it.

    ``n_scored`` points of the truth count; ``n_farther`` (3,) of them have no predicted point within 2.5, 5 and 10 cm.
    """

    protocol: str
    version: int
    counts: Counts
    n_predictions: int
    n_scored: int
    n_farther: Int64Array
    warnings: tuple[str, ...]


def why_not_scorable(rules: ProtocolRules, prediction: Prediction) -> str | None:
    """A sentence where this kind of prediction cannot be scored under the protocol at all."""
    if rules.kind == "instance" and isinstance(prediction, DenseFeatures):
        return f"{rules.name}: needs instances, and the method gives one feature a point"
    return None


def score_scene(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> SceneScore:
    """The additive counts of one scene under one protocol.

    ``encoder`` names the features of predictions that bring no labels. Raises ``PredictionError`` for a prediction that
    cannot be scored and ``DataError`` for a truth that does not fit the protocol.
    """
    if truth.labels.space != rules.label_space:
        raise DataError(
            f"{rules.name}: scores the label space '{rules.label_space}', the truth has '{truth.labels.space}'"
        )
    if truth.variant != rules.ground_truth:
        raise DataError(f"{rules.name}: scores the truth '{rules.ground_truth}', this one is '{truth.variant}'")
    reason = why_not_scorable(rules, prediction)
    if reason:
        raise PredictionError(reason)
    _check_points(rules, prediction)
    score = _score_semantic if rules.kind == "semantic" else _score_instances
    return score(rules, truth, prediction, encoder)


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
            raise PredictionError(f"{rules.name}: the partition needs one row of its {n} features a point, -1 for none")
    if isinstance(prediction, DenseFeatures) and len(prediction.features) != len(prediction.points):
        raise PredictionError(
            f"{rules.name}: {len(prediction.points)} points and {len(prediction.features)} features; give one a point"
        )


def _score_semantic(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> SceneScore:
    class_of_label = class_index_of_ids(rules, truth.semantic)
    is_scored = _scored_classes(rules)
    is_present = _present(class_of_label, len(rules.classes)) & is_scored
    targets, true_class = truth.points, class_of_label
    if truth.evaluation_points is not None:
        targets = truth.evaluation_points
        _, found = transfer.nearest(truth.points, targets)
        true_class = np.where(found >= 0, class_of_label[found], -1)
    # the ScanNet script counts every class; ConceptGraphs those that the scene contains
    counted = is_present if rules.metric == "conceptgraphs" else is_scored
    wanted = (true_class >= 0) & counted[true_class]

    classes = classes_of_prediction(rules, prediction, encoder, candidate_classes(rules, is_present))
    values, rank = _point_classes(prediction, classes, is_scored)
    predicted, distance = transfer.transfer_values(prediction.points, values, rank, targets, wanted)
    if rules.transfer.cap_m is not None:
        predicted = np.where(distance <= rules.transfer.cap_m, predicted, -1)
    warnings = [encoder_warning(rules, prediction, encoder)]
    without_points = np.flatnonzero(is_present & ~_present(true_class[wanted], len(rules.classes)))
    if len(without_points):
        names = ", ".join(f"'{rules.classes[index].name}'" for index in without_points)
        warnings.append(f"the ground truth has {names}, but no scored point does; such a class counts 0 in this scene")
    return SceneScore(
        protocol=rules.name,
        version=rules.version,
        counts=semantic.per_scene(true_class, predicted, counted),
        n_predictions=_n_predictions(prediction),
        n_scored=int(wanted.sum()),
        n_farther=transfer.n_farther(distance[wanted]),
        warnings=tuple(warning for warning in warnings if warning),
    )


def _point_classes(prediction: Prediction, classes: Int64Array, is_scored: BoolArray) -> tuple[Int64Array, Int64Array]:
    """Class and rank of each point of the prediction; rank -1 where a point takes no part.

    What was named as an ignored class is left out, as ConceptGraphs does not load its background objects. A point that
    several instances share belongs to the first.
    """
    takes_part = (classes < 0) | is_scored[classes]
    if isinstance(prediction, DenseFeatures):
        return classes, np.where(takes_part & _has_feature(prediction), 0, -1)
    if isinstance(prediction, Partition):
        owner = prediction.instance.astype(np.int64)
        owner[(owner >= 0) & ~takes_part[owner]] = -1
    else:
        kept = np.flatnonzero(takes_part)
        first = transfer.first_owner(transfer.select(transfer.masks_of(prediction), kept), len(prediction.points))
        owner = np.where(first >= 0, kept[first], -1) if len(kept) else first
    return np.where(owner >= 0, classes[owner], -1) if len(classes) else owner, owner


def _has_feature(prediction: DenseFeatures) -> BoolArray:
    has_feature = np.empty(len(prediction.points), bool)
    for start in range(0, len(has_feature), 65536):  # the table may be larger than memory
        has_feature[start : start + 65536] = np.any(prediction.features[start : start + 65536], axis=1)
    return has_feature


def _score_instances(
    rules: ProtocolRules, truth: GroundTruth, prediction: Prediction, encoder: Encoder | None
) -> SceneScore:
    assert rules.min_region_size is not None
    assert not isinstance(prediction, DenseFeatures)
    if truth.evaluation_points is not None:
        raise DataError(f"{rules.name}: the truth '{truth.variant}' has no instances on its evaluation points")
    is_present = _present(class_index_of_ids(rules, truth.semantic), len(rules.classes)) & _scored_classes(rules)
    classes = classes_of_prediction(rules, prediction, encoder, candidate_classes(rules, is_present))
    if isinstance(prediction, Instances):
        masks, scores = transfer.masks_of(prediction), np.asarray(prediction.scores, np.float64)
    else:
        masks, scores = transfer.masks_of_partition(prediction.instance, len(classes)), np.ones(len(classes))
    moved = transfer.transfer_masks(
        prediction.points, masks, truth.points, rules.transfer.cap_m, rules.transfer.evaluation_voxel_m
    )
    values = instance_ap.encode_ground_truth(truth.semantic, truth.instance)
    scored_ids = [entry.id for entry in rules.scored]
    ids = np.array([entry.id for entry in rules.classes] or [0])
    counts = instance_ap.per_scene(
        values,
        moved.indptr,
        moved.indices,
        np.where(classes >= 0, ids[classes], 0),
        np.ones(len(scores)) if rules.confidence == "ones" else scores,
        scored_ids,
        rules.min_region_size,
        rules.thresholds,
    )
    wanted = np.isin(values // instance_ap.INSTANCES_PER_CLASS, scored_ids)
    covered = np.zeros(len(prediction.points), np.int64) - 1
    covered[masks.indices] = 0
    reach = max(transfer.COVERAGE_RADII_M)
    _, distance = transfer.transfer_values(prediction.points, covered, covered, truth.points, wanted, reach)
    return SceneScore(
        protocol=rules.name,
        version=rules.version,
        counts=counts,
        n_predictions=_n_predictions(prediction),
        n_scored=int(wanted.sum()),
        n_farther=transfer.n_farther(distance[wanted]),
        warnings=_instance_warnings(rules, truth, moved, scores, encoder_warning(rules, prediction, encoder)),
    )


def _instance_warnings(
    rules: ProtocolRules, truth: GroundTruth, moved: transfer.Masks, scores: Float64Array, encoder: str | None
) -> tuple[str, ...]:
    assert rules.min_region_size is not None
    warnings = [encoder] if encoder else []
    if rules.confidence == "prediction" and len(scores) > 1 and (scores == scores[0]).all():
        warnings.append(f"every confidence is {scores[0]:g}: AP of a class is then recall (1 + precision) / 2")
    large = np.flatnonzero(np.diff(moved.indptr) >= rules.min_region_size)
    pairs = transfer.duplicate_pairs(transfer.select(moved, large), len(truth.points), DUPLICATE_IOU)
    if pairs:
        first, second = large[list(pairs[0])]
        what = "1 pair of predictions overlaps" if len(pairs) == 1 else f"{len(pairs)} pairs of predictions overlap"
        warnings.append(
            f"{what} with IoU above {DUPLICATE_IOU} (first {first} and {second}); duplicates can raise or lower AP"
        )
    return tuple(warnings)


def _scored_classes(rules: ProtocolRules) -> BoolArray:
    return np.array([not rules.is_ignored(entry.name) for entry in rules.classes])


def _present(class_index: Int64Array, n_classes: int) -> BoolArray:
    return np.bincount(class_index[class_index >= 0], minlength=n_classes) > 0


def _n_predictions(prediction: Prediction) -> int:
    return len(prediction) if isinstance(prediction, Instances) else len(prediction.features)


def combine(rules: ProtocolRules, scores: Mapping[str, SceneScore]) -> ProtocolResult:
    """The protocol's numbers over the scenes of ``scores``, whose order does not matter."""
    if not scores:
        raise DataError(f"{rules.name}: no scene was scored; nothing to combine")
    for scene, score in scores.items():
        if (score.protocol, score.version) != (rules.name, rules.version):
            raise DataError(
                f"{scene}: was scored under {score.protocol} version {score.version}, not {rules.name} version "
                f"{rules.version}; score it again"
            )
    ordered = [(scene, scores[scene]) for scene in sorted(scores)]
    n_scored = sum(score.n_scored for _, score in ordered)
    n_beyond = np.sum([score.n_farther for _, score in ordered], axis=0)
    return form_result(
        rules,
        [scene for scene, _ in ordered],
        [score.counts for _, score in ordered],
        coverage={
            f"{radius:g}": float(n_beyond[i] / n_scored) if n_scored else float("nan")
            for i, radius in enumerate(transfer.COVERAGE_RADII_M)
        },
        n_predictions={scene: score.n_predictions for scene, score in ordered},
        warnings=_gathered({scene: score.warnings for scene, score in ordered}),
    )


def _gathered(warnings: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Each sentence with its scene, or once for all where every scene has it.

    >>> _gathered({"a": ("x", "y"), "b": ("x",)})
    ['every scene: x', 'a: y']
    """
    sentences = dict.fromkeys(sentence for of_scene in warnings.values() for sentence in of_scene)
    shared = [s for s in sentences if len(warnings) > 1 and all(s in of_scene for of_scene in warnings.values())]
    single = [f"{scene}: {s}" for scene, of_scene in warnings.items() for s in of_scene if s not in shared]
    return [f"every scene: {sentence}" for sentence in shared] + single


def pack_scores(scores: Mapping[str, SceneScore]) -> bytes:
    """The npz file of a scene's scores under several protocols; equal scores give equal bytes.

    >>> counts = semantic.SemanticCounts(np.zeros((1, 2), np.int64), np.ones(1, bool))
    >>> score = SceneScore("p", 1, counts, 3, 0, np.zeros(3, np.int64), ())
    >>> unpack_scores(pack_scores({"p": score}))["p"].n_predictions
    3
    """
    arrays: dict[str, NDArray[Any]] = {}
    for name in sorted(scores):
        score = scores[name]
        is_semantic = isinstance(score.counts, semantic.SemanticCounts)
        about = {
            "protocol": score.protocol,
            "version": score.version,
            "kind": "semantic" if is_semantic else "instance",
            "n_predictions": score.n_predictions,
            "n_scored": score.n_scored,
            "n_farther": score.n_farther.tolist(),
            "warnings": score.warnings,
        }
        arrays[f"{name}/about"] = np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)
        for field in fields(score.counts):
            arrays[f"{name}/{field.name}"] = getattr(score.counts, field.name)
    # numpy dates every member 1980-01-01, so the bytes say nothing of when they were written
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def unpack_scores(data: bytes) -> dict[str, SceneScore]:
    """What ``pack_scores`` packed; raises ``DataError`` for anything else."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        names = [key.removesuffix("/about") for key in arrays if key.endswith("/about")]
        return {name: _unpack_one(name, arrays) for name in names}
    except (ValueError, KeyError, TypeError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise DataError(f"counts: are damaged or of another version ({error}); score the scene again") from error


def _unpack_one(name: str, arrays: Mapping[str, NDArray[Any]]) -> SceneScore:
    about = json.loads(arrays[f"{name}/about"].tobytes())
    kind = semantic.SemanticCounts if about["kind"] == "semantic" else instance_ap.InstanceCounts
    return SceneScore(
        protocol=about["protocol"],
        version=about["version"],
        counts=kind(**{field.name: arrays[f"{name}/{field.name}"] for field in fields(kind)}),
        n_predictions=about["n_predictions"],
        n_scored=about["n_scored"],
        n_farther=np.array(about["n_farther"], np.int64),
        warnings=tuple(about["warnings"]),
    )
