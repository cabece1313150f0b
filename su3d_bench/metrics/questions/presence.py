"""Protocols of kind ``presence``: is there such a thing at all? The map answers by what its best instance resembles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Partition
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.matching.labelling import cosines, device_of, encoder_warning, text_features
from su3d_bench.metrics.metric import Metric, Pooled, SceneScore, Values, n_predictions
from su3d_bench.metrics.protocols.model import PresenceRules
from su3d_bench.metrics.questions import presence_counts
from su3d_bench.metrics.questions.presence_counts import SAMPLINGS, PresenceCounts
from su3d_bench.metrics.questions.truths import AskedThing, PresenceTruth

NOWHERE = -1.0  # the similarity of a text with the best instance of an empty map
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
            says_yes=relevancy > rules.relevancy,
            similarity=similarity,
        )
        warnings = [encoder_warning(self.rules, prediction, encoder), truth.source]
        # where in the scene an instance is does not count: there is no coverage
        return self.score(counts, prediction, np.zeros(0), warnings)

    def _answers(
        self, asked: Sequence[AskedThing], prediction: Instances | Partition, encoder: Encoder | None
    ) -> tuple[Float64Array, Float64Array]:
        """The greatest similarity and the greatest relevancy (Q,) that an instance has to each text."""
        rules = self.rules.presence
        assert rules is not None
        if not n_predictions(prediction) or not asked:
            return np.full(len(asked), NOWHERE), np.zeros(len(asked))
        if prediction.features is None or encoder is None:
            raise PredictionError(f"{self.rules.name}: needs features and an encoder to compare texts with them")
        texts = list(dict.fromkeys(thing.text for thing in asked))
        known = text_features(self.rules, [*texts, *rules.canonical], prediction.features, encoder)
        cosine = np.clip(cosines(prediction.features, known, device_of(encoder)), -1.0, 1.0)
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
        values = presence_counts.measured(counts, np.ones((1, len(counts)), np.int64))
        return Pooled({name: float(value[0]) for name, value in values.items()} | n_asked)

    def resampled(self, counts: Sequence[PresenceCounts], weights: Int64Array) -> Mapping[str, Float64Array]:
        return presence_counts.measured(counts, weights)


def relevancies(cosine: Float64Array, canonical: Float64Array, rules: PresenceRules) -> Float64Array:
    """The relevancy (K, Q) of instances to texts from their cosines (K, Q) with these and (K, P) with the phrases.

    Source: ``get_relevancy`` of LERF (lerf/encoders/openclip_encoder.py, kerrj/lerf at db08d57). A relevancy above 0.5
    says that the text is nearer than every phrase, whatever the sharpness.

    >>> rules = PresenceRules(canonical=("object",), sharpness=10.0, relevancy=0.5, counted_over="rooms")
    >>> relevancies(np.array([[0.3, 0.1]]), np.array([[0.2]]), rules).round(3).tolist()
    [[0.731, 0.269]]
    """
    nearest = canonical.max(axis=1, keepdims=True)
    answer: Float64Array = 1.0 / (1.0 + np.exp(rules.sharpness * (nearest - cosine)))
    return answer
