"""Open-vocabulary retrieval: instances of a map by their similarity to a text, points where it has no instances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.files.atomic import row_blocks
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.matching.labelling import cosines
from su3d_bench.opensu3d.tracking import cosine

LEAST_SHARE = 0.6  # similarity_thresh of ConceptFusion's examples/demo_text_query.py (fa4e95b)
BLOCK_ROWS = 65536  # of features that are looked at together: the table may be larger than memory


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
    encoded = _encoded(texts, encoder, features.shape[1] if len(features) else None)
    rankings = []
    for text, feature in zip(texts, encoded, strict=True):
        similarity = cosine(features, feature) if len(features) else np.zeros(0)
        rankings.append(Ranking(text, np.argsort(-similarity, kind="stable"), similarity))
    return tuple(rankings)


def points_found(dense: DenseFeatures, texts: Sequence[str], encoder: Encoder) -> Instances:
    """An instance a text, of the points that ConceptFusion's own program shows for it.

    Similarities run from that of the least similar point, 0, to that of the most similar, 1; found is what reaches
    ``LEAST_SHARE`` of that. Points without a feature have no part; where all are equally similar nothing is found.
    """
    encoded = _encoded(texts, encoder, dense.features.shape[1] if len(dense.points) else None)
    low, high = np.full(len(texts), np.inf), np.full(len(texts), -np.inf)
    for _, found in _similarities(dense, encoded):
        low, high = np.minimum(low, found.min(axis=0)), np.maximum(high, found.max(axis=0))
    members: list[list[Int64Array]] = [[] for _ in texts]
    for rows, found in _similarities(dense, encoded):
        is_found = (found - low >= LEAST_SHARE * (high - low)) & (high > low)
        for k, own in enumerate(members):
            own.append(rows[is_found[:, k]])
    return Instances.of(dense.points, [np.concatenate([np.zeros(0, np.int64), *own]) for own in members])


def _similarities(dense: DenseFeatures, encoded: Float64Array) -> Iterator[tuple[Int64Array, Float64Array]]:
    """Rows (R,) of points that have a feature and their cosine (R, Q) with each text, block after block."""
    for rows, block in row_blocks(dense.features, BLOCK_ROWS):
        own = np.flatnonzero(np.any(block, axis=1))
        if len(own):
            yield own + rows.start, cosines(block[own], encoded)


def _encoded(texts: Sequence[str], encoder: Encoder, n_dimensions: int | None) -> Float64Array:
    """The features (Q, D) of the texts, which must have the dimensions of the map's."""
    encoded: Float64Array = encoder.encode_texts(list(texts)).astype(np.float64)
    if n_dimensions is not None and encoded.shape[1] != n_dimensions:
        raise PredictionError(
            f"query: the map's features have {n_dimensions} dimensions and encoder '{encoder.name}' gives "
            f"{encoded.shape[1]}; use the encoder that the map was made with"
        )
    return encoded
