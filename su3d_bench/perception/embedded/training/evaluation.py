"""What the exported encoder can tell on rooms that it never saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.interfaces import Encoder
from su3d_bench.core.types import BoolArray, Float32Array, Int64Array
from su3d_bench.perception.embedded.captions import Caption, CropTruth, class_words, fill, fixed_captions
from su3d_bench.perception.embedded.lexicon import ROOM_NAMES, SURFACES
from su3d_bench.perception.embedded.training.crops import CropSet

PROMPTS = ("an image of {a}", "{a} in a scene", "{}")
MIN_POSITIVES = 3


@dataclass(frozen=True)
class Figure:
    """One measured figure: ``value`` over ``n`` trials, beside ``chance``."""

    name: str
    value: float
    chance: float
    n: int


def measure(encoder: Encoder, crops: CropSet, features: Float32Array, class_names: Sequence[str]) -> tuple[Figure, ...]:
    """Every figure of the model card, for crops (N) with their ``features`` (N, D) and the classes of the prompts."""
    has_class = np.array([truth.class_name in set(class_names) for truth in crops.truths])
    tight = (crops.ratios > 0) & (crops.ratios <= 1.2)
    exact = has_class & tight & crops.is_exact
    groups = (
        ("exact boxes, ratio 0.8 to 1.2", exact),
        ("careless boxes and parts, ratio 0.8 to 1.2", has_class & tight & ~crops.is_exact),
        ("ratio 2", has_class & (crops.ratios == 2.0)),
        ("ratio 4", has_class & (crops.ratios == 4.0)),
    )
    figures: list[Figure] = []
    for prompt in PROMPTS:
        figures += _class_figures(encoder, crops, features, exact, class_names, prompt, groups[0][0])
    for label, chosen in groups[1:]:
        figures += _class_figures(encoder, crops, features, chosen, class_names, PROMPTS[1], label)
    figures += _colour_figures(encoder, crops, features, exact, class_names)
    figures += _retrieval_figures(encoder, crops, features, exact, has_class & (crops.ratios > 0))
    figures.append(_room_figure(encoder, crops, features))
    return tuple(figure for figure in figures if figure.n)


def _class_figures(
    encoder: Encoder,
    crops: CropSet,
    features: Float32Array,
    chosen: BoolArray,
    class_names: Sequence[str],
    prompt: str,
    label: str,
) -> list[Figure]:
    texts = encoder.encode_texts([fill(prompt, name) for name in class_names])
    rows = np.flatnonzero(chosen)
    truth = np.array([class_names.index(crops.truths[row].class_name) for row in rows], np.int64)
    rank = _ranks(features[rows] @ texts.T, truth)
    by_class = [float((rank[truth == name] == 0).mean()) for name in np.unique(truth)]
    what = f"class of {len(class_names)}, prompt '{prompt.replace('{a}', 'a {}')}', {label}"
    mean = f"mean over classes of top-1: {what}"
    return [
        *_tops(what, rank, len(class_names), (1, 5)),
        Figure(mean, float(np.mean(by_class or [0.0])), 1.0 / len(class_names), len(rows)),
    ]


def _tops(what: str, rank: Int64Array, n_candidates: int, places: Sequence[int] = (1,)) -> list[Figure]:
    """How often the true one of ``n_candidates`` is among the first of each of ``places``."""
    n_candidates = max(1, n_candidates)
    return [Figure(f"top-{k}: {what}", _mean(rank < k), k / n_candidates, len(rank)) for k in places]


def _colour_figures(
    encoder: Encoder, crops: CropSet, features: Float32Array, chosen: BoolArray, class_names: Sequence[str]
) -> list[Figure]:
    rows = np.flatnonzero(chosen)
    colours = sorted({truth.colour for truth in crops.truths} - {""})
    pairs = [(colour, name) for name in class_names for colour in colours]
    texts = encoder.encode_texts([f"a {colour} {name.replace('-', ' ')}" for colour, name in pairs])
    similarity = features[rows] @ texts.T
    colour = np.array([colours.index(crops.truths[row].colour) for row in rows], np.int64)
    name = np.array([class_names.index(crops.truths[row].class_name) for row in rows], np.int64)
    of_own_class = similarity.reshape(len(rows), len(class_names), len(colours))[np.arange(len(rows)), name]
    rank = _ranks(similarity, name * len(colours) + colour)
    anything = encoder.encode_texts([f"a {word} object" for word in colours])
    what = f"colour of {len(colours)}, 'a {{colour}} "
    return [
        *_tops(f"{what}{{class}}' with the true class, exact boxes", _ranks(of_own_class, colour), len(colours)),
        *_tops(f"{what}object', exact boxes", _ranks(features[rows] @ anything.T, colour), len(colours)),
        *_tops(f"colour and class of {len(pairs)}, exact boxes", rank, len(pairs), (1, 5)),
    ]


def _retrieval_figures(
    encoder: Encoder, crops: CropSet, features: Float32Array, exact: BoolArray, shown: BoolArray
) -> list[Figure]:
    names = {truth.class_name for truth in crops.truths} - {""}
    classes = [Caption(word, classes=(name,)) for name in sorted(names) for word in class_words(name)]
    colours = sorted({(truth.colour, truth.class_name) for truth in crops.truths if truth.class_name})
    properties = [
        Caption(f"{colour} {class_words(name)[0]}", classes=(name,), colour=colour) for colour, name in colours
    ]
    relative = _relative_captions([crops.truths[row] for row in np.flatnonzero(shown)])
    return [
        _average_precision("instance words", encoder, classes, crops, features, exact),
        _average_precision("affordances and group words", encoder, list(fixed_captions()), crops, features, exact),
        _average_precision("colour and class", encoder, properties, crops, features, exact),
        _average_precision("relations", encoder, relative, crops, features, shown),
        _relation_choice(encoder, crops, features, shown),
    ]


def _relative_captions(truths: Sequence[CropTruth]) -> list[Caption]:
    found = {
        (truth.class_name, near.relation, near.class_name)
        for truth in truths
        for near in truth.neighbours
        if near.class_name not in SURFACES
    }
    return [
        Caption(
            f"{class_words(name)[0]} {relation} {class_words(other)[0]}",
            classes=(name,),
            relation=relation,
            others=(other,),
        )
        for name, relation, other in sorted(found)
    ]


def _average_precision(
    label: str,
    encoder: Encoder,
    captions: Sequence[Caption],
    crops: CropSet,
    features: Float32Array,
    chosen: BoolArray,
) -> Figure:
    """Mean average precision of crops ranked by each caption; chance is the mean share of true crops."""
    rows = np.flatnonzero(chosen)
    similarity = encoder.encode_texts([caption.text for caption in captions]) @ features[rows].T
    precisions, shares = [], []
    for caption, of_caption in zip(captions, similarity, strict=True):
        is_true = np.array([caption.is_true_of(crops.truths[row]) for row in rows])
        if is_true.sum() >= MIN_POSITIVES:
            hits = is_true[np.argsort(-of_caption, kind="stable")]
            precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
            precisions.append(float(precision[hits].mean()))
            shares.append(float(is_true.mean()))
    name = f"mean average precision: text to crop, {label}"
    return Figure(name, _mean(np.array(precisions)), _mean(np.array(shares)), len(precisions))


def _relation_choice(encoder: Encoder, crops: CropSet, features: Float32Array, shown: BoolArray) -> Figure:
    """How often the true neighbour's caption beats that of a neighbour which the same class has elsewhere."""
    rows = [row for row in np.flatnonzero(shown) if crops.truths[row].neighbours]
    captions = _relative_captions([crops.truths[row] for row in rows])
    texts = encoder.encode_texts([caption.text for caption in captions])
    by_subject: dict[tuple[str, str], list[int]] = {}
    for index, caption in enumerate(captions):
        by_subject.setdefault((caption.classes[0], caption.relation), []).append(index)
    wins = []
    for row in rows:
        truth = crops.truths[row]
        for relation in sorted({near.relation for near in truth.neighbours}):
            candidates = by_subject.get((truth.class_name, relation), [])
            is_true = np.array([captions[index].is_true_of(truth) for index in candidates], bool)
            if is_true.any() and not is_true.all():
                scores = texts[candidates] @ features[row]
                wins.append(float((scores[is_true][:, None] > scores[~is_true][None]).mean()))
    return Figure("pairwise: true neighbour before a false one", _mean(np.array(wins)), 0.5, len(wins))


def _room_figure(encoder: Encoder, crops: CropSet, features: Float32Array) -> Figure:
    rows = np.flatnonzero(crops.ratios == 0)
    kinds = sorted({crops.truths[row].room for row in rows})
    texts = encoder.encode_texts([fill("an image of {a}", ROOM_NAMES.get(kind, (kind,))[0]) for kind in kinds])
    truth = np.array([kinds.index(crops.truths[row].room) for row in rows], np.int64)
    rank = _ranks(features[rows] @ texts.T, truth)
    return _tops(f"room of {len(kinds)}, whole image", rank, len(kinds))[0]


def _ranks(similarity: Float32Array, truth: Int64Array) -> Int64Array:
    """How many candidates stand before the true one in each row."""
    own = similarity[np.arange(len(truth)), truth]
    return np.asarray((similarity > own[:, None]).sum(axis=1), np.int64)


def _mean(values: NDArray[Any]) -> float:
    return float(np.mean(values, dtype=np.float64)) if len(values) else 0.0
