"""Protocols of kind ``presence``: is there such a thing at all? The map answers by what its best instance resembles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import BoolArray, Float64Array, Int64Array
from su3d_bench.metrics.matching.labelling import encoder_warning, similarities
from su3d_bench.metrics.metric import ROWS, Counts, Metric, Pooled, SceneScore, Values, axes, n_predictions
from su3d_bench.metrics.protocols.model import PresenceRules
from su3d_bench.metrics.questions.score import PresenceQuery, PresenceTruth
from su3d_bench.numerics.statistics import ratio

SAMPLINGS = ("random", "popular", "adversarial")  # POPE's, of things that are not there
MEASURES = ("precision", "recall", "F1", "accuracy", "yes-rate", "AUROC")
_MAX_CELLS = 4_000_000  # of a (resamples, questions) block: 32 MB of float64


@dataclass(frozen=True)
class PresenceCounts(Counts):
    """What one scene, or several, adds: a row for each question.

    ``sampling`` (Q,) int64 is its place among ``SAMPLINGS``; ``is_there`` (Q,) and ``is_yes`` (Q,) are what is true
    and what the map says; ``similarity`` (Q,) float64 is that of the best instance with the text, -1 in an empty map.
    """

    stored_as = "presence"

    sampling: Int64Array = field(metadata=axes(ROWS))
    is_there: BoolArray = field(metadata=axes(ROWS))
    is_yes: BoolArray = field(metadata=axes(ROWS))
    similarity: Float64Array = field(metadata=axes(ROWS))

    def contradiction(self) -> str | None:
        """Samplings that there are not, and similarities that no cosine has."""
        if self.sampling.max(initial=-1) >= len(SAMPLINGS):
            return f"'sampling' counts beyond the {len(SAMPLINGS)} samplings"
        if not (np.abs(self.similarity) <= 1 + 1e-6).all():  # NaN too
            return "'similarity' has values that are no cosines"
        return None


def measured(counts: Sequence[PresenceCounts], weights: Int64Array) -> dict[str, Float64Array]:
    """Each measure of each sampling (R,) over the scenes drawn ``weights`` (R, S) times, as ``F1 random``.

    NaN where it is a share of nothing; where nothing that is there is said to be, F1 is 0, of which POPE's script makes
    an error.

    >>> said = np.array([True, False, True, False])
    >>> mine = PresenceCounts(np.zeros(4, np.int64), np.array([True, True, False, False]), said, np.arange(4) / 4)
    >>> values = measured([mine], np.ones((1, 1), np.int64))
    >>> values["F1 random"].tolist(), values["AUROC random"].tolist(), values["yes-rate popular"].tolist()
    ([0.5], [0.0], [nan])
    """
    answer: dict[str, Float64Array] = {}
    for place, sampling in enumerate(SAMPLINGS):
        rows = [_of_sampling(of_scene, place) for of_scene in counts]
        values = _shares(rows, weights) | {"AUROC": _auroc(rows, weights)}
        answer |= {f"{name} {sampling}": values[name] for name in MEASURES}
    return answer


def _of_sampling(counts: PresenceCounts, place: int) -> PresenceCounts:
    mine = counts.sampling == place
    return PresenceCounts(*(getattr(counts, name)[mine] for name in PresenceCounts.arrays()))


def _shares(rows: Sequence[PresenceCounts], weights: Int64Array) -> dict[str, Float64Array]:
    each = [np.bincount(2 * row.is_there + row.is_yes, minlength=4) for row in rows]
    true_no, false_yes, false_no, true_yes = (weights @ np.stack(each)).astype(np.float64).T
    n = true_yes + false_yes + true_no + false_no
    precision, recall = ratio(true_yes, true_yes + false_yes), ratio(true_yes, true_yes + false_no)
    f1 = np.where(true_yes > 0, ratio(2 * precision * recall, precision + recall), 0.0)
    return {
        "precision": precision,
        "recall": recall,
        "F1": np.where(true_yes + false_no > 0, f1, np.nan),
        "accuracy": ratio(true_yes + true_no, n),
        "yes-rate": ratio(true_yes + false_yes, n),
    }


def _auroc(rows: Sequence[PresenceCounts], weights: Int64Array) -> Float64Array:
    similarity = np.concatenate([row.similarity for row in rows])
    if not len(similarity):
        return np.full(len(weights), np.nan)
    order = np.argsort(similarity, kind="stable")
    scene = np.repeat(np.arange(len(rows)), [len(row.similarity) for row in rows])[order]
    is_there = np.concatenate([row.is_there for row in rows])[order]
    first = np.flatnonzero(np.append(True, np.diff(similarity[order]) > 0))  # of those that are equal
    areas = np.empty(len(weights))
    step = max(1, _MAX_CELLS // len(order))
    for start in range(0, len(weights), step):
        drawn = weights[start : start + step][:, scene].astype(np.float64)
        n_there = np.add.reduceat(drawn * is_there, first, axis=1)
        n_absent = np.add.reduceat(drawn * ~is_there, first, axis=1)
        n_below = np.cumsum(n_absent, axis=1) - n_absent
        n_won = (n_there * (n_below + 0.5 * n_absent)).sum(axis=1)
        areas[start : start + step] = ratio(n_won, n_there.sum(axis=1) * n_absent.sum(axis=1))
    return areas


EMPTY_MAP_SIMILARITY = -1.0  # the similarity of a text with the best instance of an empty map
_NOT_KNOWN = (
    "what the truth itself would score is not known: how well similarities tell what is there is up to the encoder"
)


class PresenceMetric(Metric[PresenceCounts]):
    """Yes where an instance is more like the text than like the canonical phrases, by as much as the rules say."""

    truth = PresenceTruth
    counts = PresenceCounts

    def per_scene(self, truth: PresenceTruth, prediction: Instances | Partition, encoder: Encoder | None) -> SceneScore:
        rules = self.rules.presence
        assert rules is not None
        similarity, relevancy = self._answers(truth.asked, prediction, encoder)
        counts = PresenceCounts(
            sampling=np.array([SAMPLINGS.index(thing.sampling) for thing in truth.asked], np.int64),
            is_there=np.array([thing.is_there for thing in truth.asked], bool),
            is_yes=relevancy > rules.relevancy,
            similarity=similarity,
        )
        warnings = [encoder_warning(self.rules, prediction, encoder), truth.source]
        # where in the scene an instance is does not count: there is no coverage
        return self.score(counts, prediction, np.zeros(0), warnings)

    def _answers(
        self, asked: Sequence[PresenceQuery], prediction: Instances | Partition, encoder: Encoder | None
    ) -> tuple[Float64Array, Float64Array]:
        """The greatest similarity and the greatest relevancy (Q,) that an instance has to each text."""
        rules = self.rules.presence
        assert rules is not None
        if not n_predictions(prediction) or not asked:
            return np.full(len(asked), EMPTY_MAP_SIMILARITY), np.zeros(len(asked))
        texts = list(dict.fromkeys(thing.text for thing in asked))
        cosine = similarities(self.rules, [*texts, *rules.canonical], prediction, encoder).clip(-1.0, 1.0)
        of_text = cosine[:, : len(texts)]
        relevant = relevancies(of_text, cosine[:, len(texts) :], rules)
        row = np.array([texts.index(thing.text) for thing in asked], np.int64)
        return of_text.max(axis=0)[row], relevant.max(axis=0)[row]

    @property
    def ceiling_remark(self) -> str | None:
        return _NOT_KNOWN

    @property
    def sizes(self) -> dict[str, int]:
        return {}

    def pooled(self, counts: Sequence[PresenceCounts]) -> Pooled:
        """The measures of each sampling, and beside them how many things were asked for, ``n_<sampling>``."""
        sampling = np.concatenate([of_scene.sampling for of_scene in counts])
        n_asked: Values = {f"n_{name}": int((sampling == place).sum()) for place, name in enumerate(SAMPLINGS)}
        return Pooled(self.values_once(counts) | n_asked)

    def resampled(self, counts: Sequence[PresenceCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        return measured(counts, weights)


def relevancies(cosine: Float64Array, canonical: Float64Array, rules: PresenceRules) -> Float64Array:
    """The relevancy (K, Q) of instances to texts from their cosines (K, Q) with these and (K, P) with the phrases.

    Source: ``get_relevancy`` of LERF (lerf/encoders/openclip_encoder.py, kerrj/lerf at db08d57). A relevancy above 0.5
    says that the text is nearer than every phrase, whatever the sharpness.

    >>> rules = PresenceRules(canonical=("object",), sharpness=10.0, relevancy=0.5, counted_over="rooms")
    >>> relevancies(np.array([[0.3, 0.1]]), np.array([[0.2]]), rules).round(3).tolist()
    [[0.731, 0.269]]
    """
    nearest = canonical.max(axis=1, keepdims=True)
    return np.asarray(1.0 / (1.0 + np.exp(rules.sharpness * (nearest - cosine))))
