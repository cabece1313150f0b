"""One scene under a protocol of kind ``retrieval``, ``annotation`` or ``reasoning``: the map, judged by the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import BoolArray, GroundTruth, Instances, Int64Array, Partition
from su3d_bench.metrics.instance.score import NO_OBJECT, Covered, covered_objects, score_of_masks
from su3d_bench.metrics.matching import nearest as transfer
from su3d_bench.metrics.matching.labelling import cosines, device_of, encoder_warning, text_features
from su3d_bench.metrics.protocols import VALUES_OF_METRIC, AnswerRules, MergeRules, ProtocolRules
from su3d_bench.metrics.questions.shares import ShareCounts
from su3d_bench.metrics.questions.truths import (
    AnnotationTruth,
    AskedText,
    GivenAnswer,
    ReasoningTruth,
    RetrievalTruth,
    TrueAnswer,
)
from su3d_bench.metrics.scene_score import SceneScore, n_predictions

WELL_MERGED, UNDER_MERGED, OVER_MERGED = "well-merged", "under-merged", "over-merged"


def score_retrieval(
    rules: ProtocolRules, truth: RetrievalTruth, prediction: Instances | Partition, encoder: Encoder | None
) -> SceneScore:
    """The additive counts of one scene: is the instance ranked first one that answers?"""
    covered = covered_objects(rules.transfer, truth.scene, prediction)
    first = first_instances(rules, [one.text for one in truth.asked], prediction, encoder)
    is_right = judge_retrieval(covered.main_object, first, truth.asked)
    found = set(covered.main_object.tolist()) - {NO_OBJECT}
    kinds = np.array([one.kind for one in truth.asked])
    rows = {kind: is_right[kinds == kind] for kind in VALUES_OF_METRIC[rules.metric][:4]}
    rows["all"] = is_right
    rows["reachable"] = np.array([not found.isdisjoint(one.answers) for one in truth.asked], bool)
    told = encoder_warning(rules, prediction, encoder)
    asked_for = [one for asked in truth.asked for one in asked.answers]
    return _scored(rules, truth.scene, asked_for, prediction, _counts(rules, rows), [told] if told else [])


def first_instances(
    rules: ProtocolRules, texts: Sequence[str], prediction: Instances | Partition, encoder: Encoder | None
) -> Int64Array:
    """The instance (Q,) whose feature is nearest to each text, the first of equals; -1 in an empty map."""
    if not n_predictions(prediction) or not texts:
        return np.full(len(texts), -1, np.int64)
    if prediction.features is None or encoder is None:
        raise PredictionError(f"{rules.name}: needs features and an encoder to compare texts with them")
    text = text_features(rules, list(texts), prediction.features, encoder)
    first: Int64Array = cosines(prediction.features, text, device_of(encoder)).argmax(axis=0)
    return first


def judge_retrieval(main_object: Int64Array, first: Int64Array, asked: Sequence[AskedText]) -> BoolArray:
    """Whether (Q,) the instance ``first`` (Q,) of each question stands for an object that answers it.

    >>> chair = AskedText("instance", "chair", (4, 5))
    >>> judge_retrieval(np.array([5, 9]), np.array([0, 1, -1]), [chair, chair, chair]).tolist()
    [True, False, False]
    """
    rows = zip(first, asked, strict=True)
    return np.array([bool(k >= 0 and int(main_object[k]) in one.answers) for k, one in rows], bool)


def score_annotation(rules: ProtocolRules, truth: AnnotationTruth, prediction: Instances) -> SceneScore:
    """The additive counts of one scene: names n and n' of its instances, and how their masks were merged.

    Judged are instances whose main object is among ``truth.object_ids``; an empty name is a wrong one.
    """
    assert rules.merging is not None
    covered = covered_objects(rules.transfer, truth.scene, prediction)
    objects = covered.main_object
    judged = np.flatnonzero(np.isin(objects, truth.object_ids))
    refined = truth.refined(prediction)
    merges = np.array(judge_merging(rules.merging, covered))[judged]
    rows = {
        "label n": _are_called(truth, labels_n(prediction), objects, judged),
        "label n'": np.zeros(0, bool) if refined is None else _are_called(truth, refined.names, objects, judged),
        **{name: merges == name for name in (WELL_MERGED, UNDER_MERGED, OVER_MERGED)},
    }
    warnings = ["no label n': the map keeps no names of views" if refined is None else f"n': {refined.source}"]
    if len(judged) < len(objects):
        warnings.append("not judged: instances that stand for no object, a small one, or a wall, floor or ceiling")
    return _scored(rules, truth.scene, truth.object_ids, prediction, _counts(rules, rows), warnings)


def labels_n(instances: Instances) -> tuple[str, ...]:
    """Label n of each instance: what the method itself decided, else the name that perception gave."""
    labels = instances.labels or ("",) * len(instances)
    return tuple(label or name for label, name in zip(labels, instances.names, strict=True))


def _are_called(truth: AnnotationTruth, names: Sequence[str], objects: Int64Array, judged: Int64Array) -> BoolArray:
    return np.array([truth.is_called(names[k], int(objects[k])) for k in judged], bool)


def judge_merging(rules: MergeRules, covered: Covered) -> tuple[str, ...]:
    """How each instance was merged; over-merged goes before under-merged, and what covers nothing is neither.

    >>> rules = MergeRules(over_merged_share=0.25, under_merged_share=0.5)
    >>> halves = Covered(np.array([1, 2]), np.array([[70, 0], [30, 0], [40, 60]]))
    >>> judge_merging(rules, halves)
    ('well-merged', 'under-merged', 'over-merged')
    """
    main = covered.main_object
    n_objects = covered.n_shared.sum(axis=1)
    answers = []
    for k, one in enumerate(main):
        if one == NO_OBJECT:
            answers.append(WELL_MERGED)
            continue
        column = int(np.searchsorted(covered.object_ids, one))
        n_own = int(covered.n_shared[k, column])
        n_of_all = int(covered.n_shared[main == one, column].sum())
        if n_objects[k] - n_own >= rules.over_merged_share * n_objects[k]:
            answers.append(OVER_MERGED)
        else:
            answers.append(UNDER_MERGED if n_own < rules.under_merged_share * n_of_all else WELL_MERGED)
    return tuple(answers)


def score_reasoning(
    rules: ProtocolRules, truth: ReasoningTruth, prediction: Instances, encoder: Encoder | None
) -> SceneScore:
    """The additive counts of one scene: is the answer right, and are the objects that it names right?"""
    assert rules.answers is not None
    main = covered_objects(rules.transfer, truth.scene, prediction).main_object
    given = truth.solve(prediction, encoder)
    pairs = list(zip(truth.asked, given, strict=True))
    rows = {
        "answer": np.array([is_answer_right(rules.answers, one, told, main) for one, told in pairs], bool),
        "objects": np.array([are_objects_right(one, told, main) for one, told in pairs if one.object_ids], bool),
    }
    n_open = sum(not told.is_settled for told in given)
    warnings = ["questions that the solver could not settle count as wrong"] if n_open else []
    named = [one for asked in truth.asked for one in asked.object_ids]
    return _scored(rules, truth.scene, named, prediction, _counts(rules, rows), warnings)


def is_answer_right(rules: AnswerRules, true: TrueAnswer, given: GivenAnswer, main_object: Int64Array) -> bool:
    """Whether counts and yes or no agree, a distance is near enough, or else the objects are right.

    >>> rules = AnswerRules(distance_m=0.25, distance_share=0.1)
    >>> given = GivenAnswer(2.2, np.zeros(0, np.int64), True)
    >>> is_answer_right(rules, TrueAnswer("how far?", "distance", 2.0, ()), given, np.zeros(0, np.int64))
    True
    """
    if not given.is_settled:
        return False
    if true.value is None or given.value is None:
        return true.value is given.value and are_objects_right(true, given, main_object)
    if isinstance(true.value, float):
        return abs(given.value - true.value) <= max(rules.distance_m, rules.distance_share * true.value)
    return type(given.value) is type(true.value) and given.value == true.value


def are_objects_right(true: TrueAnswer, given: GivenAnswer, main_object: Int64Array) -> bool:
    """Whether the instances named stand for exactly the objects that the true answer names."""
    return given.is_settled and {int(main_object[row]) for row in given.rows} == set(true.object_ids)


def _counts(rules: ProtocolRules, rows: dict[str, BoolArray]) -> ShareCounts:
    judged = [rows[name] for name in VALUES_OF_METRIC[rules.metric]]
    return ShareCounts(
        np.array([len(one) for one in judged], np.int64), np.array([int(one.sum()) for one in judged], np.int64)
    )


def _scored(
    rules: ProtocolRules,
    truth: GroundTruth,
    object_ids: Sequence[int],
    prediction: Instances | Partition,
    counts: ShareCounts,
    warnings: Sequence[str],
) -> SceneScore:
    """The score, with the coverage of the objects ``object_ids``, on which the counts rest."""
    masks = transfer.masks_of(prediction)
    wanted = np.isin(truth.instance, np.array([*object_ids], np.int64))
    return score_of_masks(rules, counts, prediction, masks, truth.points, wanted, warnings)
