"""Open-vocabulary retrieval: instances of a map by their similarity to a text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.opensu3d.feature_fusion import cosine


@dataclass(frozen=True)
class Ranking:
    """Instances by similarity to ``text``: ``order`` (K,) rows, best first; ``similarity`` (K,) cosine of each row."""

    text: str
    order: Int64Array
    similarity: Float64Array


def rank(instances: Instances, text: str, encoder: Encoder) -> Ranking:
    """The ranking of all instances for one text; equal similarities keep the order of the map."""
    return rank_all(instances, [text], encoder)[0]


def rank_all(instances: Instances, texts: Sequence[str], encoder: Encoder) -> tuple[Ranking, ...]:
    """One ranking a text; an instance whose feature is zero has similarity 0."""
    if instances.features is None:
        raise PredictionError("query: this map has no features to compare a text with; choose a method that makes them")
    features = instances.features.astype(np.float64)
    encoded = encoder.encode_texts(list(texts)).astype(np.float64)
    if len(features) and encoded.shape[1] != features.shape[1]:
        raise PredictionError(
            f"query: the map's features have {features.shape[1]} dimensions and encoder '{encoder.name}' gives "
            f"{encoded.shape[1]}; use the encoder that the map was made with"
        )
    rankings = []
    for text, feature in zip(texts, encoded, strict=True):
        similarity = cosine(features, feature) if len(features) else np.zeros(0)
        rankings.append(Ranking(text, np.argsort(-similarity, kind="stable"), similarity))
    return tuple(rankings)
