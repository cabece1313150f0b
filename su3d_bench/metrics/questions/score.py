"""Protocols of kind ``retrieval``, ``annotation`` and ``reasoning``: the map, judged by ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from su3d_bench.core.interfaces import Encoder, TrainedOnRelativeTexts
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import BoolArray, Float64Array, GroundTruth, Int64Array
from su3d_bench.metrics.instance.score import NO_OBJECT, CoveredObjects, covered_objects, score_of_masks
from su3d_bench.metrics.matching.labelling import encoder_warning, similarities
from su3d_bench.metrics.metric import Counts, Metric, Pooled, SceneScore, axes, n_predictions
from su3d_bench.metrics.protocols.model import AnswerRules, MergeRules, ProtocolRules
from su3d_bench.numerics.statistics import ratio

ROUNDING = 1e-6  # tolerance for sums of shares


@dataclass(frozen=True)
class ShareCounts(Counts):
    """The counts of one scene: ``n_judged`` and ``n_right`` (V,) int64 for each of the protocol's V values.

    ``by_chance`` (V,) float64: the number right by guessing; ``by_name``: the number right from the objects' names
    only; NaN if unknown.
    """

    stored_as = "shares"

    n_judged: Int64Array = field(metadata=axes("values"))
    n_right: Int64Array = field(metadata=axes("values"))
    by_chance: Float64Array = field(metadata=axes("values"))
    by_name: Float64Array = field(metadata=axes("values"))

    def contradiction(self) -> str | None:
        """More right answers, or right by guessing, than judged ones."""
        for name in ("n_right", "by_chance", "by_name"):
            right = getattr(self, name)
            beyond = np.flatnonzero(~np.isnan(right) & ~((right >= 0) & (right <= self.n_judged + ROUNDING)))
            if len(beyond):
                return f"'{name}' has {right[beyond[0]]:g} of {self.n_judged[beyond[0]]} judged"
        return None


def share_counts(
    n_judged: Sequence[int],
    n_right: Sequence[int],
    by_chance: Sequence[float] | None = None,
    by_name: Sequence[float] | None = None,
) -> ShareCounts:
    """The counts of a scene; the numbers right by guessing are unknown if not given."""
    unknown = np.full(len(n_judged), np.nan)
    return ShareCounts(
        np.array(n_judged, np.int64),
        np.array(n_right, np.int64),
        unknown if by_chance is None else np.array(by_chance, np.float64),
        unknown if by_name is None else np.array(by_name, np.float64),
    )


def shares(counts: ShareCounts) -> Float64Array:
    """The share (V,) of right answers, NaN if nothing was judged.

    >>> shares(share_counts([4, 0], [3, 0])).tolist()
    [0.75, nan]
    """
    return ratio(counts.n_right, counts.n_judged)


def resampled(counts: Sequence[ShareCounts], weights: Int64Array) -> Float64Array:
    """The shares (R, V) over the scenes drawn ``weights`` (R, S) times, NaN if nothing in them was judged.

    >>> a, b = share_counts([2], [1]), share_counts([1], [1])
    >>> resampled([a, b], np.array([[2, 0], [0, 2]])).tolist()
    [[0.5], [1.0]]
    """
    return ratio(*ShareCounts.drawn(counts, weights, "n_right", "n_judged").values())


@dataclass(frozen=True)
class TextTarget:
    """A text of a kind such as ``property``, and the ids of all objects that answer it.

    ``by_chance``: how often a random object answers; ``by_name``: how often a random one with the right name does.
    """

    kind: str
    text: str
    answers: tuple[int, ...]
    by_chance: float = float("nan")
    by_name: float = float("nan")


@dataclass(frozen=True)
class RetrievalTruth:
    """The objects of a scene and the texts that ask for them."""

    scene: GroundTruth
    asked: tuple[TextTarget, ...]


@dataclass(frozen=True)
class PresenceQuery:
    """A text that is present or absent in the scene; ``sampling``: the method that chose absent ones."""

    text: str
    sampling: str
    is_there: bool


@dataclass(frozen=True)
class PresenceTruth:
    """The objects of a scene and texts that are present or absent; ``source``: the rooms over which frequent objects,
    and objects that occur together, are counted."""

    scene: GroundTruth
    asked: tuple[PresenceQuery, ...]
    source: str


@dataclass(frozen=True)
class RefinedNames:
    """Labels n' of a map, one per instance, and their source.

    ``left_out``: why the filter of these labels excludes an instance, '' if it is kept; empty if all are kept.
    """

    names: tuple[str, ...]
    source: str
    left_out: tuple[str, ...] = ()

    @property
    def is_kept(self) -> BoolArray:
        """Whether (K,) an instance is kept with labels n'."""
        return np.array([not reason for reason in self.left_out or ("",) * len(self.names)], bool)


@dataclass(frozen=True)
class AnnotationTruth:
    """The objects of a scene and their valid names.

    ``object_ids``: the judged ones; ``is_called`` states whether a label names the object of an id; ``refined`` returns
    labels n' of a map, None if it has none.
    """

    scene: GroundTruth
    object_ids: tuple[int, ...]
    is_called: Callable[[str, int], bool]
    refined: Callable[[Instances], RefinedNames | None]


@dataclass(frozen=True)
class TrueAnswer:
    """``value``: a count, metres, or yes or no; None if the objects are the answer. ``object_ids`` are named.

    ``by_chance``: how often a guess is right; ``by_name``: how often an answer from the objects' names only is.
    """

    text: str
    kind: str
    value: float | int | bool | None
    object_ids: tuple[int, ...]
    by_chance: float = float("nan")
    by_name: float = float("nan")


@dataclass(frozen=True)
class SolverAnswer:
    """A solver's answer from a map: ``rows`` are the instances that it names; empty if not ``is_decided``."""

    value: float | int | bool | None
    rows: Int64Array
    is_decided: bool


@dataclass(frozen=True)
class ReasoningTruth:
    """Questions with true answers, and how they are put to a map; ``solver`` is the name of the answerer."""

    scene: GroundTruth
    asked: tuple[TrueAnswer, ...]
    solve: Callable[[Instances, Encoder | None], Sequence[SolverAnswer]]
    solver: str


BY_NAME = ("property by name", "relative by name")  # kinds of text that the name alone answers
MERGES = WELL_MERGED, UNDER_MERGED, OVER_MERGED = "well-merged", "under-merged", "over-merged"
REFINED_BY, ANSWERED_BY = "n': ", "answers by "  # prefixes of the remarks that name the source
RELATIVE = "relative: "  # prefix of the remark on queries of that kind


class ShareMetric(Metric[ShareCounts]):
    """The common part of kinds whose values are shares of judged answers."""

    counts = ShareCounts
    guessed: ClassVar[tuple[str, ...]] = ()  # values that a guess can get right

    @property
    def sizes(self) -> dict[str, int]:
        return {"values": len(self.rules.value_names)}

    def pooled(self, counts: Sequence[ShareCounts]) -> Pooled:
        """The share of right answers under each value's name, with their number and the baselines.

        ``n_<name>``: their number; ``chance_<name>``: the share right by guessing; ``names-alone_<name>``: the share
        right from the objects' names only, both for values that a guess can get right.
        """
        whole, names = ShareCounts.joined(counts), self.rules.value_names
        values = dict(zip(names, shares(whole).tolist(), strict=True))
        values |= {f"n_{name}": n for name, n in zip(names, whole.n_judged.tolist(), strict=True)}
        for prefix, right in (("chance", whole.by_chance), ("names-alone", whole.by_name)):
            cheap = ratio(right, whole.n_judged)
            values |= {f"{prefix}_{name}": float(cheap[names.index(name)]) for name in self.guessed}
        return Pooled(values)

    def resampled(self, counts: Sequence[ShareCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        return dict(zip(self.rules.value_names, resampled(counts, weights).T, strict=True))

    def _score(
        self,
        truth: GroundTruth,
        object_ids: Sequence[int],
        prediction: Instances | Partition,
        rows: Mapping[str, BoolArray],
        warnings: Sequence[str | None],
        cheap: Mapping[str, Float64Array] | None = None,
    ) -> SceneScore:
        """The score, with ``rows`` of what is right, and the coverage of the objects that it depends on.

        ``cheap``: for some values, the share (2, n) of each judgement right by guessing and from names only.
        """
        names = self.rules.value_names
        judged = [rows[name] for name in names]
        known = {} if cheap is None else {name: shares_of.sum(axis=1) for name, shares_of in cheap.items()}
        of_guess = [known.get(name, np.full(2, np.nan)) for name in names]
        counts = share_counts(
            [len(row) for row in judged], [int(row.sum()) for row in judged], *np.array(of_guess).T.tolist()
        )
        wanted = np.isin(truth.instance, np.array([*object_ids], np.int64))
        return score_of_masks(self, counts, prediction, truth.points, wanted, warnings)


class RetrievalMetric(ShareMetric):
    """Whether the first instance answers the query."""

    truth = RetrievalTruth
    guessed = ("instance", "affordance", "property", "relative", "all", "by name")

    def per_scene(
        self, truth: RetrievalTruth, prediction: Instances | Partition, encoder: Encoder | None
    ) -> SceneScore:
        covered = covered_objects(self.rules.transfer, truth.scene, prediction)
        first = first_instances(self.rules, [question.text for question in truth.asked], prediction, encoder)
        is_right = judge_retrieval(covered.main_object, first, truth.asked)
        in_map = set(covered.main_object.tolist()) - {NO_OBJECT}
        kinds = np.array([question.kind for question in truth.asked])
        rows = {kind: is_right[kinds == kind] for kind in self.rules.value_names[:4]}
        is_plain = ~np.isin(kinds, BY_NAME)
        rows["all"], rows["by name"] = is_right[is_plain], is_right[~is_plain]
        rows["reachable"] = np.array([not in_map.isdisjoint(question.answers) for question in truth.asked], bool)
        warnings = [encoder_warning(self.rules, prediction, encoder), relative_remark(encoder)]
        asked_for = [answer for question in truth.asked for answer in question.answers]
        each = np.array([(question.by_chance, question.by_name) for question in truth.asked]).reshape(-1, 2).T
        cheap = {kind: each[:, kinds == kind] for kind in self.rules.value_names[:4]}
        cheap |= {"all": each[:, is_plain], "by name": each[:, ~is_plain]}
        return self._score(truth.scene, asked_for, prediction, rows, warnings, cheap)


def relative_remark(encoder: object) -> str | None:
    """A warning on the values of relative queries; None if the encoder was not trained on such texts."""
    return f"{RELATIVE}{encoder.relative_remark}" if isinstance(encoder, TrainedOnRelativeTexts) else None


def first_instances(
    rules: ProtocolRules, texts: Sequence[str], prediction: Instances | Partition, encoder: Encoder | None
) -> Int64Array:
    """The instance (Q,) whose feature is nearest to each text, the first on ties; -1 in an empty map."""
    if not n_predictions(prediction) or not texts:
        return np.full(len(texts), -1, np.int64)
    return np.asarray(similarities(rules, list(texts), prediction, encoder).argmax(axis=0))


def judge_retrieval(main_object: Int64Array, first: Int64Array, questions: Sequence[TextTarget]) -> BoolArray:
    """Whether (Q,) the instance ``first`` (Q,) of each question is assigned to an object that answers it.

    >>> chair = TextTarget("instance", "chair", (4, 5))
    >>> judge_retrieval(np.array([5, 9]), np.array([0, 1, -1]), [chair, chair, chair]).tolist()
    [True, False, False]
    """
    rows = zip(first, questions, strict=True)
    return np.array([bool(k >= 0 and int(main_object[k]) in question.answers) for k, question in rows], bool)


class AnnotationMetric(ShareMetric):
    """Whether the names n and n' of instances are right, and how their masks were merged.

    Judged are instances whose main object is among ``truth.object_ids``; an empty name is wrong. With n' the instances
    that the filter of these labels excludes are not in the map, for both ``label n'`` and ``well-merged n'``.
    """

    truth = AnnotationTruth

    def per_scene(self, truth: AnnotationTruth, prediction: Instances, encoder: Encoder | None) -> SceneScore:
        assert self.rules.merging is not None
        covered = covered_objects(self.rules.transfer, truth.scene, prediction)
        objects = covered.main_object
        judged = np.flatnonzero(np.isin(objects, truth.object_ids))
        refined = truth.refined(prediction)
        names = [""] * len(objects) if refined is None else refined.names
        kept = np.flatnonzero([] if refined is None else refined.is_kept)
        still = kept[np.isin(objects[kept], truth.object_ids)]
        merges = np.array(judge_merging(self.rules.merging, covered), object)
        after = np.full(len(objects), "", object)
        after[kept] = judge_merging(self.rules.merging, replace(covered, n_shared=covered.n_shared[kept]))
        rows = {
            "label n": _are_called(truth, labels_n(prediction), objects, judged),
            "label n'": _are_called(truth, names, objects, still),
            **{name: merges[judged] == name for name in MERGES},
            **{f"{name} n'": after[still] == name for name in MERGES},
        }
        warnings = [
            "no label n': the map has no names per view" if refined is None else f"{REFINED_BY}{refined.source}"
        ]
        if refined is not None and len(kept) < len(objects):
            reasons = ", ".join(dict.fromkeys(reason for reason in refined.left_out if reason))
            warnings.append(f"n' excludes {len(objects) - len(kept)} of {len(objects)} instances: {reasons}")
        if len(judged) < len(objects):
            warnings.append("not judged: instances assigned to no object, a small one, or a wall, floor or ceiling")
        return self._score(truth.scene, truth.object_ids, prediction, rows, warnings)


def remarks_starting(warnings: Sequence[str], start: str) -> tuple[str, ...]:
    """The rest of the remarks that begin with ``start`` after the name of their scenes, without repeats.

    >>> remarks_starting(["a/b: n': the vote", "every scene: answers by gpt", "c/d: n': the vote"], REFINED_BY)
    ('the vote',)
    """
    parts = [warning.partition(start) for warning in warnings]
    return tuple(dict.fromkeys(who for before, _, who in parts if who and (not before or before.endswith(": "))))


def labels_n(instances: Instances) -> tuple[str, ...]:
    """Label n of each instance: the method's own, otherwise the name from perception."""
    labels = instances.labels or ("",) * len(instances)
    return tuple(label or name for label, name in zip(labels, instances.names, strict=True))


def _are_called(truth: AnnotationTruth, names: Sequence[str], objects: Int64Array, judged: Int64Array) -> BoolArray:
    return np.array([truth.is_called(names[k], int(objects[k])) for k in judged], bool)


def judge_merging(rules: MergeRules, covered: CoveredObjects) -> tuple[str, ...]:
    """How each instance was merged; over-merged has priority, and an instance that covers nothing is neither.

    >>> rules = MergeRules(over_merged_share=0.25, under_merged_share=0.5)
    >>> halves = CoveredObjects(np.array([1, 2]), np.array([[70, 0], [30, 0], [40, 60]]))
    >>> judge_merging(rules, halves)
    ('well-merged', 'under-merged', 'over-merged')
    """
    main = covered.main_object
    n_objects = covered.n_shared.sum(axis=1)
    answers = []
    for k, object_id in enumerate(main):
        if object_id == NO_OBJECT:
            answers.append(WELL_MERGED)
            continue
        column = int(np.searchsorted(covered.object_ids, object_id))
        n_own = int(covered.n_shared[k, column])
        n_of_all = int(covered.n_shared[main == object_id, column].sum())
        if n_objects[k] - n_own >= rules.over_merged_share * n_objects[k]:
            answers.append(OVER_MERGED)
        else:
            answers.append(UNDER_MERGED if n_own < rules.under_merged_share * n_of_all else WELL_MERGED)
    return tuple(answers)


class ReasoningMetric(ShareMetric):
    """Whether the answer is right, and whether the objects that it names are."""

    truth = ReasoningTruth
    guessed = ("answer",)

    def per_scene(self, truth: ReasoningTruth, prediction: Instances, encoder: Encoder | None) -> SceneScore:
        rules = self.rules.answers
        assert rules is not None
        main = covered_objects(self.rules.transfer, truth.scene, prediction).main_object
        answers = truth.solve(prediction, encoder)
        pairs = list(zip(truth.asked, answers, strict=True))
        rows = {
            "answer": np.array([is_answer_right(rules, question, given, main) for question, given in pairs], bool),
            "objects": np.array([are_objects_right(*pair, main) for pair in pairs if pair[0].object_ids], bool),
        }
        is_open = any(not given.is_decided for given in answers)
        warnings = [f"{ANSWERED_BY}{truth.solver}"]
        if is_open:
            warnings.append("questions that the solver could not answer count as wrong")
        named = [object_id for question in truth.asked for object_id in question.object_ids]
        cheap = {"answer": np.array([(q.by_chance, q.by_name) for q in truth.asked]).reshape(-1, 2).T}
        return self._score(truth.scene, named, prediction, rows, warnings, cheap)


def is_answer_right(rules: AnswerRules, true: TrueAnswer, given: SolverAnswer, main_object: Int64Array) -> bool:
    """Whether counts and yes or no agree, a distance is within the tolerance, or otherwise the objects are right.

    >>> rules = AnswerRules(distance_m=0.25, distance_share=0.1)
    >>> given = SolverAnswer(2.2, np.zeros(0, np.int64), True)
    >>> is_answer_right(rules, TrueAnswer("how far?", "distance", 2.0, ()), given, np.zeros(0, np.int64))
    True
    """
    if not given.is_decided:
        return False
    if true.value is None or given.value is None:
        return true.value is given.value and are_objects_right(true, given, main_object)
    if isinstance(true.value, float):
        return abs(given.value - true.value) <= max(rules.distance_m, rules.distance_share * true.value)
    return type(given.value) is type(true.value) and given.value == true.value


def are_objects_right(true: TrueAnswer, given: SolverAnswer, main_object: Int64Array) -> bool:
    """Whether the named instances are assigned to exactly the objects that the true answer names."""
    return given.is_decided and {int(main_object[row]) for row in given.rows} == set(true.object_ids)
