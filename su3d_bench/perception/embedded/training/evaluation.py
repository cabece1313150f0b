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
    held_out = _HeldOut(encoder, crops, features, class_names)
    figures: list[Figure] = []
    for prompt in PROMPTS:
        figures += held_out.class_figures(exact, prompt, groups[0][0])
    for label, chosen in groups[1:]:
        figures += held_out.class_figures(chosen, PROMPTS[1], label)
    figures += held_out.colour_figures(exact)
    figures += held_out.retrieval_figures(exact, has_class & (crops.ratios > 0))
    figures.append(held_out.room_figure())
    return tuple(figure for figure in figures if figure.n)


@dataclass(frozen=True)
class _HeldOut:
    """Crops with their features, and the classes of the prompts."""

    encoder: Encoder
    crops: CropSet
    features: Float32Array
    class_names: Sequence[str]

    def similarity(self, rows: NDArray[np.intp], texts: Sequence[str]) -> Float32Array:
        """Cosines (R, T) of crops ``rows`` with texts."""
        return self.features[rows] @ self.encoder.encode_texts(texts).T

    def places(self, rows: NDArray[np.intp], names: Sequence[str], field: str) -> Int64Array:
        """Where among ``names`` the truths of crops ``rows`` stand."""
        return np.array([names.index(getattr(self.crops.truths[row], field)) for row in rows], np.int64)

    def class_figures(self, chosen: BoolArray, prompt: str, label: str) -> list[Figure]:
        rows, names = np.flatnonzero(chosen), self.class_names
        truth = self.places(rows, names, "class_name")
        rank = _ranks(self.similarity(rows, [fill(prompt, name) for name in names]), truth)
        by_class = [float((rank[truth == name] == 0).mean()) for name in np.unique(truth)]
        what = f"class of {len(names)}, prompt '{prompt.replace('{a}', 'a {}')}', {label}"
        mean = f"mean over classes of top-1: {what}"
        return [
            *_tops(what, rank, len(names), (1, 5)),
            Figure(mean, float(np.mean(by_class or [0.0])), 1.0 / len(names), len(rows)),
        ]

    def colour_figures(self, chosen: BoolArray) -> list[Figure]:
        rows, names = np.flatnonzero(chosen), self.class_names
        colours = sorted({truth.colour for truth in self.crops.truths} - {""})
        pairs = [(colour, name) for name in names for colour in colours]
        similarity = self.similarity(rows, [f"a {colour} {name.replace('-', ' ')}" for colour, name in pairs])
        colour, name = self.places(rows, colours, "colour"), self.places(rows, names, "class_name")
        of_own_class = similarity.reshape(len(rows), len(names), len(colours))[np.arange(len(rows)), name]
        of_anything = self.similarity(rows, [f"a {word} object" for word in colours])
        of_pair = _ranks(similarity, name * len(colours) + colour)
        what = f"colour of {len(colours)}, 'a {{colour}} "
        return [
            *_tops(f"{what}{{class}}' with the true class, exact boxes", _ranks(of_own_class, colour), len(colours)),
            *_tops(f"{what}object', exact boxes", _ranks(of_anything, colour), len(colours)),
            *_tops(f"colour and class of {len(pairs)}, exact boxes", of_pair, len(pairs), (1, 5)),
        ]

    def room_figure(self) -> Figure:
        rows = np.flatnonzero(self.crops.ratios == 0)
        kinds = sorted({self.crops.truths[row].room for row in rows})
        texts = [fill("an image of {a}", ROOM_NAMES.get(kind, (kind,))[0]) for kind in kinds]
        rank = _ranks(self.similarity(rows, texts), self.places(rows, kinds, "room"))
        return _tops(f"room of {len(kinds)}, whole image", rank, len(kinds))[0]

    def retrieval_figures(self, exact: BoolArray, shown: BoolArray) -> list[Figure]:
        names = {truth.class_name for truth in self.crops.truths} - {""}
        classes = [Caption(word, classes=(name,)) for name in sorted(names) for word in class_words(name)]
        colours = sorted({(truth.colour, truth.class_name) for truth in self.crops.truths if truth.class_name})
        properties = [
            Caption(f"{colour} {class_words(name)[0]}", classes=(name,), colour=colour) for colour, name in colours
        ]
        relative = _relative_captions([self.crops.truths[row] for row in np.flatnonzero(shown)])
        return [
            self.average_precision("instance words", classes, exact),
            self.average_precision("affordances and group words", fixed_captions(), exact),
            self.average_precision("colour and class", properties, exact),
            self.average_precision("relations", relative, shown),
            self.relation_choice(shown),
        ]

    def average_precision(self, label: str, captions: Sequence[Caption], chosen: BoolArray) -> Figure:
        """Mean average precision of crops ranked by each caption; chance is the mean share of true crops."""
        rows = np.flatnonzero(chosen)
        similarity = self.similarity(rows, [caption.text for caption in captions])
        precisions, shares = [], []
        for caption, of_caption in zip(captions, similarity.T, strict=True):
            is_true = np.array([caption.is_true_of(self.crops.truths[row]) for row in rows])
            if is_true.sum() >= MIN_POSITIVES:
                hits = is_true[np.argsort(-of_caption, kind="stable")]
                precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
                precisions.append(float(precision[hits].mean()))
                shares.append(float(is_true.mean()))
        name = f"mean average precision: text to crop, {label}"
        return Figure(name, _mean(np.array(precisions)), _mean(np.array(shares)), len(precisions))

    def relation_choice(self, shown: BoolArray) -> Figure:
        """How often the true neighbour's caption beats that of a neighbour which the same class has elsewhere."""
        rows = [row for row in np.flatnonzero(shown) if self.crops.truths[row].neighbours]
        captions = _relative_captions([self.crops.truths[row] for row in rows])
        texts = self.encoder.encode_texts([caption.text for caption in captions])
        by_subject: dict[tuple[str, str], list[int]] = {}
        for index, caption in enumerate(captions):
            by_subject.setdefault((caption.classes[0], caption.relation), []).append(index)
        wins = []
        for row in rows:
            truth = self.crops.truths[row]
            for relation in sorted({near.relation for near in truth.neighbours}):
                candidates = by_subject.get((truth.class_name, relation), [])
                is_true = np.array([captions[index].is_true_of(truth) for index in candidates], bool)
                if is_true.any() and not is_true.all():
                    scores = texts[candidates] @ self.features[row]
                    wins.append(float((scores[is_true][:, None] > scores[~is_true][None]).mean()))
        return Figure("pairwise: true neighbour before a false one", _mean(np.array(wins)), 0.5, len(wins))


def _relative_captions(truths: Sequence[CropTruth]) -> list[Caption]:
    relations = {
        (truth.class_name, near.relation, near.class_name)
        for truth in truths
        for near in truth.neighbours
        if near.class_name not in SURFACES
    }
    return [
        Caption(
            f"{class_words(name)[0]} {relation} {class_words(other)[0]}", (name,), relation=relation, others=(other,)
        )
        for name, relation, other in sorted(relations)
    ]


def _tops(what: str, rank: Int64Array, n_candidates: int, places: Sequence[int] = (1,)) -> list[Figure]:
    """How often the true one of ``n_candidates`` is among the first of each of ``places``."""
    n_candidates = max(1, n_candidates)
    return [Figure(f"top-{k}: {what}", _mean(rank < k), k / n_candidates, len(rank)) for k in places]


def _ranks(similarity: Float32Array, truth: Int64Array) -> Int64Array:
    """How many candidates stand before the true one in each row."""
    own = similarity[np.arange(len(truth)), truth]
    return np.asarray((similarity > own[:, None]).sum(axis=1), np.int64)


def _mean(values: NDArray[Any]) -> float:
    return float(np.mean(values, dtype=np.float64)) if len(values) else 0.0
