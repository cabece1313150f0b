"""Assemble the detections of a frame from its regions, for all profiles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.english import head_phrases, words
from su3d_bench.core.interfaces import Encoder, StageTimer
from su3d_bench.core.types import Detections, Float32Array, Frame, PerceptionNeeds, Regions
from su3d_bench.perception.cache import CropEncoder, FrameCache
from su3d_bench.perception.embedded.lexicon import Namer, colour_word, scene_caption

# Phrases that end in the same noun but mean something else.
_OTHER_THINGS = frozenset((("coffee", "ground"), ("video", "wall")))


def is_background(name: str, background_names: Iterable[str]) -> bool:
    """Whether everything that ``name`` names is one of ``background_names``, with any modifiers before it.

    >>> names = ("Brick walls", "hardwood flooring", "wall lamp", "floor mat")
    >>> [is_background(name, ("wall", "floor")) for name in names]
    [True, True, False, False]
    """
    phrases = head_phrases(name)
    background = [words(one) for one in background_names]
    return bool(phrases) and all(_ends_in_one(phrase, background) for phrase in phrases)


def _ends_in_one(phrase: tuple[str, ...], background: list[tuple[str, ...]]) -> bool:
    # Flooring counts as floor and roofing as roof.
    spoken = phrase, (*phrase[:-1], phrase[-1].removesuffix("ing"))
    return phrase[-2:] not in _OTHER_THINGS and any(
        one and each[-len(one) :] == one for one in background for each in spoken
    )


# Returns the kept regions with their names and captions.
Describe = Callable[[Frame, Regions, StageTimer], Regions]


def captioned(frame: Frame, regions: Regions, timer: StageTimer) -> Regions:
    """``regions`` with the template caption of their names, unless they already have captions."""
    if regions.captions is not None:
        return regions
    return replace(regions, captions=tuple(scene_caption(name) for name in regions.names or ()))


def captioned_by_colour(frame: Frame, regions: Regions, timer: StageTimer) -> Regions:
    """``regions`` with the template caption of their names and colours."""
    with timer.stage("encode"):
        colours = [colour_word(frame.rgb, mask) for mask in regions.masks]
    pairs = zip(regions.names or (), colours, strict=True)
    return replace(regions, captions=tuple(scene_caption(name, colour) for name, colour in pairs))


class Assembler:
    """Builds detections from named regions: filtering, captions, crop features and the image feature."""

    def __init__(
        self, encoder: Encoder, cache: FrameCache, score_scale: Literal["published", "own"] = "published"
    ) -> None:
        self._encoder = encoder
        self._crops = CropEncoder(encoder, cache)
        self._score_scale = score_scale
        self._feature_of_text: dict[str, Float32Array] = {}

    def assemble(
        self,
        frame: Frame,
        regions: Regions,
        needs: PerceptionNeeds,
        timer: StageTimer,
        *,
        describe: Describe = captioned,
        known: Mapping[float, Float32Array] | None = None,
        global_feature: Float32Array | None = None,
    ) -> Detections:
        """The named ``regions`` that ``needs`` requests, with names and captions from ``describe``.

        ``known`` features, by crop ratio for all regions (K, D), and the ``global_feature`` are not computed again.
        """
        assert regions.names is not None
        kept = regions_to_keep(regions.names, regions.boxes, frame.depth_m.shape, needs)
        chosen = describe(frame, _at(regions, kept), timer)
        assert chosen.names is not None and chosen.captions is not None
        boxes = grown_boxes(regions.boxes, needs.crop_padding_px)
        return Detections(
            frame_index=frame.index,
            masks=chosen.masks,
            boxes=chosen.boxes,
            scores=chosen.scores,
            names=chosen.names,
            captions=chosen.captions,
            crop_ratios=needs.crop_ratios,
            crop_features=self._crops.crops(frame, boxes, kept, needs.crop_ratios, timer, known or {}),
            global_feature=self._crops.whole(frame, timer) if global_feature is None else global_feature,
            name_features=self.text_features(chosen.names) if needs.name_features else None,
            score_scale=self._score_scale,
            rows=chosen.rows,
        )

    def named(
        self, frame: Frame, regions: Regions, namer: Namer, needs: PerceptionNeeds, timer: StageTimer
    ) -> tuple[Regions, Mapping[float, Float32Array]]:
        """``regions`` named by ``namer``, scored by its confidence, and the features computed for that.

        A region with a name (other than "") keeps it, with a confidence of 1.
        """
        everything = np.arange(len(regions.boxes))
        best_fit = self._crops.crops(frame, regions.boxes, everything, (1.0,), timer, {})[:, 0]
        with timer.stage("encode"):
            guessed = namer.name(best_fit)
        given = regions.names or ("",) * len(everything)
        names = tuple(name or guess for name, guess in zip(given, guessed.names, strict=True))
        confidences = np.where([not name for name in given], guessed.confidences, 1.0)
        scores = (regions.scores * confidences).astype(np.float32)
        return replace(regions, names=names, scores=scores), {} if needs.crop_padding_px else {1.0: best_fit}

    def text_features(self, texts: Sequence[str]) -> Float32Array:
        """Features (K, D) of ``texts``, each encoded once."""
        new = [text for text in dict.fromkeys(texts) if text not in self._feature_of_text]
        if new:
            self._feature_of_text |= dict(zip(new, self._encoder.encode_texts(new), strict=True))
        features = [self._feature_of_text[text] for text in texts]
        return np.array(features, np.float32).reshape(len(texts), self._encoder.dim)


def regions_to_keep(
    names: Sequence[str], boxes: Float32Array, image_shape: tuple[int, ...], needs: PerceptionNeeds
) -> NDArray[np.intp]:
    """Indices of the regions without a background name whose box is not too large a share of the image."""
    exact = {name.lower() for name in needs.background_names}
    is_left_out = {
        name: is_background(name, needs.background_names) if needs.background_by_head else name.lower() in exact
        for name in set(names)
    }
    is_named = np.array([not is_left_out[name] for name in names], bool)
    areas = (boxes[:, 2] - boxes[:, 0]).astype(np.float64) * (boxes[:, 3] - boxes[:, 1])
    is_small = areas <= needs.max_box_fraction * image_shape[0] * image_shape[1]
    return np.flatnonzero(is_named & is_small)


def grown_boxes(boxes: Float32Array, padding_px: int) -> Float32Array:
    """``boxes`` (K, 4) with every side moved outwards by ``padding_px``; crops are clipped to the image later."""
    return boxes + np.array([-padding_px, -padding_px, padding_px, padding_px], np.float32)


def _at(regions: Regions, rows: NDArray[np.intp]) -> Regions:
    names, captions = (
        None if texts is None else tuple(texts[row] for row in rows) for texts in (regions.names, regions.captions)
    )
    sources = rows.astype(np.int64) if regions.rows is None else regions.rows[rows]
    return Regions(regions.masks[rows], regions.boxes[rows], regions.scores[rows], names, captions, sources)
