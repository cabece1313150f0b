"""Data model of questions, their ground-truth answers, and the answers to score."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.files.atomic import row_blocks
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import DenseFeatures, Instances
from su3d_bench.core.system.files import file_text, parse_toml
from su3d_bench.core.types import Float64Array, Int64Array
from su3d_bench.metrics.matching.labelling import cosines
from su3d_bench.opensu3d.tracking import cosine

KINDS = ("instance", "affordance", "property", "relative")
# Properties and relations that all objects of the name have: the name alone gives the answer.
BY_NAME = {"property": "property by name", "relative": "relative by name"}
GENERATED_KINDS = (*KINDS, *BY_NAME.values())
REASONING = "reasoning"
ALL_KINDS = (*GENERATED_KINDS, REASONING)


def question_id(scene: str, kind: str, text: str) -> str:
    """A short key that depends only on scene, kind and text.

    >>> question_id("rooms/living0", "instance", "chair")
    '3f6958fff541'
    """
    return hashlib.sha256("\0".join((scene, kind, text)).encode()).hexdigest()[:12]


@cache
def word_table(section: str) -> Mapping[str, tuple[str, ...]]:
    """A section of words.toml, such as ``names``: class -> its other names."""
    table = parse_toml(file_text(Path(__file__).with_name("words.toml")))
    return {phrase: tuple(entries) for phrase, entries in table[section].items()}


@dataclass(frozen=True)
class Question:
    """One question about one scene.

    ``scene``: ``<dataset>/<scene>``; ``kind``: one of ``KINDS``, or ``reasoning``; ``answers``: ids of all correct
    ground-truth instances, ascending, None if unknown; ``source``: where the question comes from. ``reply``: the
    correct answer in words, if a question has one besides objects; ``name`` and ``groups`` as in ``TextQuery``.
    """

    id: str
    scene: str
    kind: str
    text: str
    answers: tuple[int, ...] | None
    source: str
    reply: str = ""
    name: str = ""
    groups: tuple[str, ...] = ()

    @property
    def is_known(self) -> bool:
        """Whether answer objects are known."""
        return bool(self.answers)


def new_question(
    scene: str, kind: str, text: str, answers: tuple[int, ...] | None, source: str, reply: str = ""
) -> Question:
    """A question with its id computed from scene, kind and text."""
    ascending = None if answers is None else tuple(sorted(set(answers)))
    return Question(question_id(scene, kind, text), scene, kind, text, ascending, source, reply)


@dataclass(frozen=True)
class Answer:
    """``text`` is the answer in words, ``object_ids`` the answer objects, ``reference_ids`` the reference objects.

    ``value`` is a count, a distance in metres, or the boolean answer of a yes-no question, otherwise None; ``notes``
    list assumptions. If ``is_decided`` is false, ``text`` is the reason.
    """

    text: str
    object_ids: tuple[int, ...] = ()
    reference_ids: tuple[int, ...] = ()
    value: float | int | bool | None = None
    kind: str = ""
    is_decided: bool = True
    notes: tuple[str, ...] = ()
    solver: Literal["built-in", "llm"] = "built-in"

    def as_value(self, like: float | int | bool) -> float | int | bool | None:
        """The answer as a value like ``like``, read from its text if it has no value; None if there is none."""
        value = self.value
        if value is None and isinstance(like, bool):
            word = re.search(r"\b(yes|no)\b", self.text.lower())
            return None if word is None else word[1] == "yes"
        if value is None and (number := re.search(r"(?<![\w#.])\d+(?:\.\d+)?", self.text)):
            value = float(number[0])
        is_count = value is not None and not isinstance(like, float | bool) and value == int(value)
        return int(value) if is_count and value is not None else value

    def to_json(self) -> dict[str, Any]:
        fields = asdict(self)
        return {"answer": fields.pop("text"), **fields}


def undecided(reason: str, notes: tuple[str, ...] = ()) -> Answer:
    """The answer if geometry does not settle the question."""
    return Answer(f"I cannot settle this: {reason}", notes=notes, is_decided=False)


MIN_SHARE = 0.6  # similarity_thresh of ConceptFusion's examples/demo_text_query.py (fa4e95b)
BLOCK_ROWS = 65536  # features per block: the table may be larger than memory


@dataclass(frozen=True)
class Ranking:
    """Instances by similarity to ``text``: ``order`` (K,) rows, best first; ``similarity`` (K,) cosine of each row."""

    text: str
    order: Int64Array
    similarity: Float64Array


@dataclass(frozen=True)
class RankedInstance:
    """An instance in a ranking: ``rank`` from 1, its ``id``, cosine with the text, and ``centroid`` in metres."""

    rank: int
    id: int
    name: str
    similarity: float
    centroid: tuple[float, ...]


def best_of(instances: Instances, ranking: Ranking, n: int) -> tuple[RankedInstance, ...]:
    """The first ``n`` instances of a ranking."""
    return tuple(
        RankedInstance(
            place,
            int(instances.ids[k]) if len(instances.ids) else int(k),
            instances.names[k],
            float(ranking.similarity[k]),
            tuple(instances.centroids[k].tolist()),
        )
        for place, k in enumerate(ranking.order[:n], start=1)
    )


def rank(instances: Instances, text: str, encoder: Encoder) -> Ranking:
    """The ranking of all instances for one text; equal similarities keep the order of the map."""
    return rank_all(instances, [text], encoder)[0]


def rank_all(instances: Instances, texts: Sequence[str], encoder: Encoder) -> tuple[Ranking, ...]:
    """One ranking per text; an instance with a zero feature has similarity 0."""
    if instances.features is None:
        raise PredictionError("query: the map has no features to compare with text; choose a method that computes them")
    features = instances.features.astype(np.float64)
    encoded = _encoded(texts, encoder, features.shape[1] if len(features) else None)
    rankings = []
    for text, feature in zip(texts, encoded, strict=True):
        similarity = cosine(features, feature) if len(features) else np.zeros(0)
        rankings.append(Ranking(text, np.argsort(-similarity, kind="stable"), similarity))
    return tuple(rankings)


def retrieved_points(dense: DenseFeatures, texts: Sequence[str], encoder: Encoder) -> Instances:
    """One instance per text, of the points that ConceptFusion's own program shows for it.

    Similarities are scaled from 0 (least similar point) to 1 (most similar); points reaching ``MIN_SHARE`` are found.
    Points without a feature are ignored; if all points are equally similar, none is found.
    """
    encoded = _encoded(texts, encoder, dense.features.shape[1] if len(dense.points) else None)
    low, high = np.full(len(texts), np.inf), np.full(len(texts), -np.inf)
    for _, found in _similarities(dense, encoded):
        low, high = np.minimum(low, found.min(axis=0)), np.maximum(high, found.max(axis=0))
    members: list[list[Int64Array]] = [[] for _ in texts]
    for rows, found in _similarities(dense, encoded):
        is_found = (found - low >= MIN_SHARE * (high - low)) & (high > low)
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
            f"query: the map's features have {n_dimensions} dimensions, encoder '{encoder.name}' has "
            f"{encoded.shape[1]}; use the encoder of the map"
        )
    return encoded
