"""From features to labels, with a protocol's vocabulary, prompt and encoder: argmax, the first maximum wins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from su3d_bench.core.errors import PredictionError
from su3d_bench.core.files.atomic import row_blocks
from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.maps import Instances, Prediction
from su3d_bench.core.types import BoolArray, Float32Array, Float64Array, Int64Array
from su3d_bench.metrics.matching.rows import rows_of
from su3d_bench.metrics.metric import n_predictions
from su3d_bench.metrics.protocols.model import ProtocolRules

if TYPE_CHECKING:
    from torch import Tensor

CPU = "cpu"
# Sums of 4096 products of unit vectors differ between two orders by less than 1e-12; 1e-9 leaves a margin.
CERTAIN_GAP = 1e-9
_BLOCK_ROWS = 8192  # 34 MB of float64 at 512 dimensions, independent of the size of the map


def scored_classes(rules: ProtocolRules) -> BoolArray:
    """Which classes of the label set count (C,)."""
    return np.array([not rules.is_ignored(entry.name) for entry in rules.classes], bool)


def places_among_scored(rules: ProtocolRules) -> Int64Array:
    """The index (C + 1,) of each class among the scored ones, -1 for others; the last entry is for no class."""
    is_scored = scored_classes(rules)
    return np.append(np.where(is_scored, np.cumsum(is_scored) - 1, -1), -1)


def candidate_classes(rules: ProtocolRules, is_present: BoolArray) -> Int64Array:
    """Indices of the classes that the classifier can choose from in a scene that contains ``is_present`` (C,)."""
    if rules.vocabulary == "all":
        return np.arange(len(rules.classes))
    is_scored = scored_classes(rules)
    return np.flatnonzero(is_scored & is_present if rules.vocabulary == "scene" else is_scored)


def classes_of_prediction(
    rules: ProtocolRules, prediction: Prediction, encoder: Encoder | None, is_present: BoolArray
) -> Int64Array:
    """A class index for each instance, row of features or point; -1 if not one of the protocol's classes.

    Labels of the method itself are used unchanged; otherwise features are classified among the candidates of a scene
    that contains ``is_present`` (C,).
    """
    candidates = candidate_classes(rules, is_present)
    labels = getattr(prediction, "labels", None)
    if labels is None:
        return _classes_of_features(rules, prediction, encoder, candidates)
    index_of = {entry.name: index for index, entry in enumerate(rules.classes)}
    classes = np.array([index_of.get(label, -1) for label in labels], np.int64)
    if prediction.features is not None and not has_every_label(prediction):
        is_open = np.array([label == "" for label in labels])
        classes[is_open] = _classes_of_features(rules, prediction, encoder, candidates)[is_open]
    return classes


def ranked_classes(
    rules: ProtocolRules, prediction: Prediction, encoder: Encoder | None, is_present: BoolArray, k: int
) -> Int64Array:
    """The ``k`` most likely classes (K, k) of each instance, row of features or point, best first, padded with -1.

    The labels of the method itself, in its order; otherwise the most similar candidates of a scene that contains
    ``is_present`` (C,).
    """
    candidates = candidate_classes(rules, is_present)
    ranked = np.full((n_predictions(prediction), k), -1, np.int64)
    labels = getattr(prediction, "labels", None)
    if len(ranked):
        ranked[:, 0] = classes_of_prediction(rules, prediction, encoder, is_present)
    if labels is not None:
        index_of = {entry.name: index for index, entry in enumerate(rules.classes)}
        for row, further in enumerate(getattr(prediction, "further_labels", None) or ()):
            for rank, label in enumerate(further[: k - 1], start=1):
                ranked[row, rank] = index_of.get(label, -1)
    if prediction.features is not None and encoder is not None and len(ranked) and len(candidates):
        is_open = np.array([labels is None or labels[row] == "" for row in range(len(ranked))], bool)
        if is_open.any():
            text = text_features(rules, _names(rules, candidates), prediction.features, encoder)
            best = _with_distractors(rules, candidates)[most_similar_each(prediction.features, text, k)]
            ranked[is_open, : best.shape[1]] = best[is_open]
    return ranked


def has_every_label(prediction: object) -> bool:
    """Whether the method itself assigned all labels."""
    labels = getattr(prediction, "labels", None)
    return labels is not None and all(labels)


def _classes_of_features(
    rules: ProtocolRules, prediction: Prediction, encoder: Encoder | None, candidates: Int64Array
) -> Int64Array:
    if prediction.features is None and isinstance(prediction, Instances) and not len(prediction):
        return np.zeros(0, np.int64)
    features, encoder = needed_features(rules, prediction, encoder)
    if not len(candidates) or not len(features):
        return np.full(len(features), -1, np.int64)
    text = text_features(rules, _names(rules, candidates), features, encoder)
    return _with_distractors(rules, candidates)[most_similar(features, text, device_of(encoder))]


def _names(rules: ProtocolRules, candidates: Int64Array) -> list[str]:
    return [*(rules.classes[index].name for index in candidates), *rules.distractors]


def _with_distractors(rules: ProtocolRules, candidates: Int64Array) -> Int64Array:
    """The class of each of ``_names``, -1 for a distractor."""
    return np.append(candidates, np.full(len(rules.distractors), -1, np.int64))


def text_features(
    rules: ProtocolRules, names: Sequence[str], features: NDArray[Any], encoder: Encoder
) -> Float32Array | Float64Array:
    """The feature (C, D) of each name: that of its prompt, or the mean of the normalised features of its prompts.

    Raises ``PredictionError`` if ``features`` (K, D) come from an encoder with another number of dimensions.
    """
    texts = [rules.texts_of(name) for name in names]
    encoded = _encoded(encoder, [text for of_name in texts for text in of_name])
    if encoded.shape[1] != features.shape[1]:
        raise PredictionError(
            f"{rules.name}: features have {features.shape[1]} dimensions, the encoder '{encoder.name}' has "
            f"{encoded.shape[1]}; use the encoder that made them"
        )
    n_prompts = len(texts[0])
    if n_prompts == 1:
        return encoded
    directions = _normalised(np.asarray(encoded, np.float64))
    return np.asarray(directions.reshape(len(names), n_prompts, -1).mean(axis=1))


def _encoded(encoder: Encoder, texts: list[str]) -> Float32Array:
    return encoder.encode_texts(texts)


def needed_features(
    rules: ProtocolRules, prediction: Prediction, encoder: Encoder | None
) -> tuple[Float32Array | NDArray[np.float16], Encoder]:
    """The features of a prediction and the encoder; ``PredictionError`` if one of them is missing."""
    if prediction.features is None or encoder is None:
        raise PredictionError(f"{rules.name}: needs features and an encoder, or labels if it has classes")
    return prediction.features, encoder


def similarities(
    rules: ProtocolRules,
    texts: Sequence[str],
    prediction: Prediction,
    encoder: Encoder | None,
    rows: Int64Array | slice = slice(None),
) -> Float64Array:
    """The cosine similarity (K, Q) of a prediction's features, all or some ``rows``, with those of texts."""
    features, encoder = needed_features(rules, prediction, encoder)
    return cosines(features[rows], text_features(rules, texts, features, encoder), device_of(encoder))


def device_of(encoder: Encoder) -> str:
    """The device of ``encoder``, on which its features are also compared: ``cpu`` or a torch device."""
    return str(getattr(encoder, "device", CPU))


def cosines(features: NDArray[Any], text: NDArray[Any], device: str = CPU) -> Float64Array:
    """The cosine (K, C) of each row of ``features`` with each row of ``text``, 0 if either has no direction.

    On a device other than ``cpu`` a cosine differs from that of the CPU by less than 1e-12.

    >>> cosines(np.array([[0.0, 2.0], [0.0, 0.0]]), np.array([[1.0, 0.0], [0.0, 3.0]])).tolist()
    [[0.0, 1.0], [0.0, 0.0]]
    """
    if device != CPU:
        there, text_there = (_directions_on(device, rows) for rows in (features, text))
        return np.asarray((there @ text_there.T).cpu().numpy(), np.float64)
    # one thread: the last bit of a cosine must not depend on the machine's number of cores
    with threadpool_limits(1, user_api="blas"):
        product: Float64Array = (
            _normalised(np.asarray(features, np.float64)) @ _normalised(np.asarray(text, np.float64)).T
        )
    return product


def most_similar(features: np.ndarray, text: np.ndarray, device: str = CPU) -> Int64Array:
    """For each row of ``features`` (K, D) the row of ``text`` (C, D) of highest cosine, the first on ties.

    A row of zeros, or with non-finite values, has no direction: all its cosines are 0, so it gets row 0.
    On a device other than ``cpu`` the result is the same; blocks with a close choice are computed on the CPU.

    >>> most_similar(np.array([[0.0, 2.0], [3.0, 1.0], [0.0, 0.0]]), np.array([[1.0, 0.0], [0.0, 1.0]])).tolist()
    [1, 0, 0]
    """
    directions = _normalised(np.asarray(text, np.float64))
    there = None if device == CPU else _directions_on(device, text)
    best = np.empty(len(features), np.int64)
    # one thread and blocks of one size: the last bit of a cosine must not depend on the machine's number of cores
    with threadpool_limits(1, user_api="blas"):
        for rows, block in row_blocks(features, _BLOCK_ROWS):
            chosen = None if there is None else _sure_most_similar(_directions_on(device, block), there)
            if chosen is None:
                chosen = (_normalised(np.asarray(block, np.float64)) @ directions.T).argmax(axis=1)
            best[rows] = chosen
    return best


def most_similar_each(features: np.ndarray, text: np.ndarray, k: int) -> Int64Array:
    """For each row of ``features`` (K, D) the ``k`` rows of ``text`` (C, D) of highest cosine (K, min(k, C)).

    The best comes first, and the first on ties, as in ``most_similar``.

    >>> most_similar_each(np.array([[0.0, 2.0], [3.0, 1.0], [0.0, 0.0]]), np.eye(3, 2), 2).tolist()
    [[1, 0], [0, 1], [0, 1]]
    """
    directions = _normalised(np.asarray(text, np.float64))
    best = np.empty((len(features), min(k, len(directions))), np.int64)
    # as in most_similar: one thread and blocks of one size
    with threadpool_limits(1, user_api="blas"):
        for rows, block in row_blocks(features, _BLOCK_ROWS):
            cosine = _normalised(np.asarray(block, np.float64)) @ directions.T
            best[rows] = np.argsort(-cosine, axis=1, kind="stable")[:, : best.shape[1]]
    return best


def _directions_on(device: str, rows: NDArray[Any]) -> Tensor:
    """``rows`` (N, D) at length 1 on ``device``; rows without a direction, or with non-finite values, are 0."""
    import torch

    there = torch.from_numpy(np.require(rows, requirements=["C", "W"])).to(device).double()
    there = torch.where(there.isfinite().all(dim=1, keepdim=True), there, 0.0)
    length = (there * there).sum(dim=1, keepdim=True).sqrt()
    return there / torch.where(length > 0, length, 1.0)


def _sure_most_similar(features: Tensor, text: Tensor) -> Int64Array | None:
    """For each direction of ``features`` (K, D) that of ``text`` (C, D) of highest cosine; row 0 for a zero row.

    None if the two highest of a row are so close that another order of summation could choose the other.
    """
    import torch

    n_highest = min(2, len(text))
    highest, index = (features @ text.T).topk(n_highest, dim=1)
    has_none = (features == 0).all(dim=1)
    if n_highest == 2 and bool((~has_none & (highest[:, 0] - highest[:, 1] < CERTAIN_GAP)).any()):
        return None
    return np.asarray(torch.where(has_none, 0, index[:, 0]).cpu().numpy(), np.int64)


def _normalised(rows: Float64Array) -> Float64Array:
    rows = np.where(np.isfinite(rows).all(axis=1, keepdims=True), rows, 0.0)
    length = np.sqrt((rows * rows).sum(axis=1, keepdims=True))
    return rows / np.where(length > 0, length, 1.0)


def encoder_warning(rules: ProtocolRules, prediction: Prediction, encoder: Encoder | None) -> str | None:
    """A warning if the features were classified with another encoder than the protocol's."""
    if has_every_label(prediction) or encoder is None or rules.encoder in (None, encoder.name):
        return None
    return f"labels come from the encoder '{encoder.name}', the protocol's is '{rules.encoder}'"


def class_index_of_ids(rules: ProtocolRules, ids: Sequence[int] | np.ndarray) -> Int64Array:
    """The class index of each class id, -1 for ids that are not in the protocol."""
    values = np.asarray(ids, np.int64)
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    if high - low < len(values):  # a table of all ids in between is smaller than the result
        index_of = np.full(high - low + 1, -1, np.int64)
        for index, entry in enumerate(rules.classes):
            if low <= entry.id <= high:
                index_of[entry.id - low] = index
        return index_of[values - low]
    known = np.array([entry.id for entry in rules.classes], np.int64)
    order = np.argsort(known)
    return np.append(order, -1)[rows_of(known[order], values)]
