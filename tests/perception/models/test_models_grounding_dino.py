"""GroundingDINO around its network: texts, boxes and names, compared with hand-computed values and transformers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tiny_models import DINO_PX, blocks, tiny_dino, tiny_tokenizer

from su3d_bench.core.types import Float32Array
from su3d_bench.perception.models.masks.grounding_dino import (
    CONCEPTGRAPHS_BOXES,
    BoxConfig,
    GroundingDino,
    text_prompt,
)

RGB = blocks(40, 60)
TAGS = ("cat", "coffee table", "sofa")


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return tiny_tokenizer(tmp_path_factory.mktemp("tokenizer"))


@pytest.fixture(scope="module")
def detector(tokenizer: Any) -> GroundingDino:
    return GroundingDino(tiny_dino(), tokenizer, *DINO_PX)


@pytest.mark.parametrize("size", [(40, 60), (60, 40), (40, 100), (48, 48)])
def test_image_is_prepared_as_in_transformers(detector: GroundingDino, size: tuple[int, int]) -> None:
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import GroundingDinoImageProcessorPil

    processor = GroundingDinoImageProcessorPil(size={"shortest_edge": DINO_PX[0], "longest_edge": DINO_PX[1]})
    rgb = blocks(*size)
    theirs = processor(rgb, return_tensors="np")["pixel_values"][0]
    np.testing.assert_allclose(detector.pixels(rgb), theirs, atol=2e-6)


def transformers_answer(detector: GroundingDino, box: float, text: float) -> dict[str, Any]:
    """Boxes, scores and phrases by transformers' own postprocessing of the same network output."""
    import torch
    from transformers.models.grounding_dino.processing_grounding_dino import GroundingDinoProcessor

    tokens = detector.tokenizer(text_prompt(TAGS), return_tensors="pt", return_token_type_ids=True)
    pixels = torch.from_numpy(detector.pixels(RGB)[None])
    with torch.inference_mode():
        outputs = tiny_dino()(pixel_values=pixels, **tokens)
    processor = SimpleNamespace(batch_decode=detector.tokenizer.batch_decode)
    read = GroundingDinoProcessor.post_process_grounded_object_detection
    answer: dict[str, Any] = read(processor, outputs, tokens["input_ids"], box, text, [RGB.shape[:2]])[0]
    return answer


@pytest.mark.parametrize(("box", "text"), [(0.25, 0.25), (0.5, 0.7), (0.9, 0.999)])
def test_boxes_scores_and_phrases_match_transformers(detector: GroundingDino, box: float, text: float) -> None:
    theirs = transformers_answer(detector, box, text)
    found = detector.detect(RGB, TAGS, BoxConfig(box_threshold=box, text_threshold=text, nms_iou=1.0))
    phrases = [" ".join(one.replace(".", "").replace("[SEP]", "").split()) for one in theirs["text_labels"]]
    order = np.argsort(-theirs["scores"].numpy(), kind="stable")
    order = np.array([k for k in order if phrases[k]])
    assert len(order) > 1
    assert found.names == tuple(phrases[k] for k in order)
    np.testing.assert_allclose(found.scores, theirs["scores"].numpy()[order], atol=1e-5)
    np.testing.assert_allclose(found.boxes, theirs["boxes"].numpy()[order], atol=1e-3)


class Told(GroundingDino):
    """A detector whose network returns given token probabilities and boxes."""

    def __init__(
        self, tokenizer: Any, probabilities: Float32Array, boxes: Float32Array, longest_text: int = 32
    ) -> None:
        self.tokenizer = tokenizer
        self._sides_px = DINO_PX
        self._max_tokens = longest_text
        self._told = probabilities, boxes
        self.texts: list[str] = []

    def answer(self, pixels: Float32Array, text: str) -> tuple[Float32Array, Float32Array, list[int]]:
        self.texts.append(text)
        return (*self._told, self.tokenizer(text)["input_ids"])


# [CLS] cat . coffee table . [SEP]
PROBABILITIES = np.array(
    [
        [0, 0.6, 0.9, 0.0, 0.0, 0.0, 0.0, 0],  # cat .
        [0, 0.1, 0.0, 0.1, 0.8, 0.0, 0.0, 0],  # table
        [0, 0.0, 0.0, 0.26, 0.3, 0.0, 0.0, 0],  # coffee table, at the position of the previous one
        [0, 0.0, 0.7, 0.0, 0.0, 0.0, 0.0, 0],  # a full stop alone
        [0, 0.25, 0.0, 0.0, 0.0, 0.0, 0.0, 0],  # not above 0.25
    ],
    np.float32,
)
CENTRES = np.array(
    [[0.25, 0.5, 0.5, 1], [0.75, 0.5, 0.5, 1], [0.75, 0.5, 0.5, 0.5], [0.5, 0.5, 0.1, 0.1], [0.5, 0.5, 1, 1]],
    np.float32,
)


def test_boxes_are_thresholded_suppressed_and_named_by_phrase(tokenizer: Any) -> None:
    result = Told(tokenizer, PROBABILITIES, CENTRES)
    found = result.detect(RGB, ["Cat", "coffee table", "cat"], BoxConfig())
    assert result.texts == ["cat. coffee table."], "each tag is requested once"
    # The third overlaps the second by exactly one half, more than 0.4; the fourth has no name.
    assert found.names == ("cat", "table")
    np.testing.assert_allclose(found.scores, [0.9, 0.8])
    np.testing.assert_allclose(found.boxes, [[0, 0, 30, 40], [30, 0, 60, 40]])


def test_conceptgraphs_names_boxes_by_first_word_of_phrase(tokenizer: Any) -> None:
    found = Told(tokenizer, PROBABILITIES, CENTRES).detect(RGB, ["cat", "coffee table"], CONCEPTGRAPHS_BOXES)
    # "table" is in "coffee table", which overlaps it by one half, allowed by 0.5; a full stop alone is the first tag.
    assert found.names == ("cat", "coffee table", "cat", "coffee table", "cat")
    np.testing.assert_allclose(found.scores, [0.9, 0.8, 0.7, 0.3, 0.25])


def test_box_matched_by_start_token_has_first_tag_or_no_name(
    tokenizer: Any,
) -> None:
    probabilities = np.zeros((1, 8), np.float32)
    probabilities[0, [0, 3]] = 0.9  # [CLS] coffee
    result = Told(tokenizer, probabilities, CENTRES[:1])
    assert result.detect(RGB, ["cat", "coffee table"], CONCEPTGRAPHS_BOXES).names == ("cat",)
    assert result.detect(RGB, ["cat", "coffee table"], BoxConfig()).names == ("coffee",)


def test_box_is_named_by_complete_tag_or_dropped(tokenizer: Any) -> None:
    config = CONCEPTGRAPHS_BOXES.model_copy(update={"names": "tag"})
    found = Told(tokenizer, PROBABILITIES, CENTRES).detect(RGB, ["cat", "coffee table"], config)
    assert found.names == ("cat", "coffee table", "cat")
    np.testing.assert_allclose(found.scores, [0.9, 0.3, 0.25])


def test_tags_beyond_text_limit_use_a_second_prompt(tokenizer: Any) -> None:
    result = Told(tokenizer, PROBABILITIES, CENTRES, longest_text=7)
    result.detect(RGB, ["cat", "coffee table", "sofa", "lamp", "book"], BoxConfig())
    assert result.texts == ["cat. coffee table.", "sofa. lamp.", "book."]
