"""Which caption is true of which crop, for whole batches at once: ``Caption.is_true_of`` as matrix products."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.types import BoolArray, Float32Array
from su3d_bench.perception.embedded.captions import Caption, CropTruth

Names = dict[str, int]

# The words that a caption and a crop have in common.
_WORDS = (attrgetter("colour"), attrgetter("material"), attrgetter("size_word"), attrgetter("room"))


class TruthTable:
    """The truths of N crops as numbers, so that ``matches`` of a batch takes a millisecond."""

    def __init__(self, truths: Sequence[CropTruth]) -> None:
        self.class_names = tuple(sorted({truth.class_name for truth in truths} - {""}))
        self._classes = _numbers(self.class_names)
        self._words = [_numbers(sorted({word_of(truth) for truth in truths} - {""})) for word_of in _WORDS]
        pairs = {(near.relation, near.class_name, near.colour) for truth in truths for near in truth.neighbours}
        self._pairs = {pair: index for index, pair in enumerate(sorted(pairs))}
        self._pairs_by_key: dict[tuple[str, str, str], list[int]] = {}
        for (relation, name, colour), index in self._pairs.items():
            for key in ((relation, name, colour), (relation, name, ""), (relation, "", colour), (relation, "", "")):
                self._pairs_by_key.setdefault(key, []).append(index)
        self.class_of = np.array([self._classes.get(truth.class_name, -1) for truth in truths], np.int64)
        self._word_of = np.array(
            [
                [numbers.get(word_of(truth), -1) for truth in truths]
                for numbers, word_of in zip(self._words, _WORDS, strict=True)
            ],
            np.int64,
        )
        self._pairs_of = [
            np.array([self._pairs[near.relation, near.class_name, near.colour] for near in truth.neighbours], np.int64)
            for truth in truths
        ]

    def matches(self, captions: Sequence[Caption], crops: NDArray[np.int64]) -> BoolArray:
        """(T, B): whether caption t is true of the crop at ``crops[b]``."""
        is_whole = self.class_of[crops] < 0
        result = np.array([caption.is_whole_image for caption in captions])[:, None] == is_whole[None]
        classes = np.zeros((len(captions), len(self._classes) + 1), bool)
        for row, caption in enumerate(captions):
            if caption.classes:
                classes[row, [self._classes[name] for name in caption.classes if name in self._classes]] = True
            else:
                classes[row] = True
        result &= classes[:, self.class_of[crops]]
        for numbers, of_crop, word_of in zip(self._words, self._word_of, _WORDS, strict=True):
            wanted = np.array([numbers.get(word_of(caption), -2) if word_of(caption) else -1 for caption in captions])
            result &= (wanted[:, None] == -1) | (wanted[:, None] == of_crop[crops][None])
        return np.asarray(result & self._relations(captions, crops))

    def _relations(self, captions: Sequence[Caption], crops: NDArray[np.int64]) -> BoolArray:
        shown = np.zeros((len(crops), len(self._pairs)), np.float32)
        for column, crop in enumerate(crops):
            shown[column, self._pairs_of[crop]] = 1.0
        result = np.ones((len(captions), len(crops)), bool)
        related = [row for row, caption in enumerate(captions) if caption.relation]
        wanted: Float32Array = np.zeros((len(related), len(self._pairs)), np.float32)
        for row, index in enumerate(related):
            wanted[row, self._wanted_pairs(captions[index])] = 1.0
        result[related] = wanted @ shown.T > 0
        return result

    def _wanted_pairs(self, caption: Caption) -> list[int]:
        keys = [(caption.relation, name, caption.other_colour) for name in caption.others or ("",)]
        return [pair for key in keys for pair in self._pairs_by_key.get(key, ())]


def _numbers(words: Iterable[str]) -> Names:
    return {word: index for index, word in enumerate(words)}
