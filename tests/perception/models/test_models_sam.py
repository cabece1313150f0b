"""Segment Anything around its network: inputs and outputs compared with transformers' own steps."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from perception_fakes import CountingEncoder
from tiny_models import SAM_PX, blocks, frame_of, tiny_sam

from su3d_bench.core.errors import DataError
from su3d_bench.core.types import BoolArray, Float32Array, UInt8Array
from su3d_bench.perception.models.masks.grounded_sam import Networks, SamRegions, WordTagger
from su3d_bench.perception.models.masks.sam import Prompts, Sam, TorchSam, fill_sam

RGB = blocks(40, 60)
BOXES = np.array([[5, 5, 30, 30], [0, 0, 60, 40], [22.5, 3.25, 41, 39]], np.float32)


@pytest.fixture(scope="module")
def sam() -> Sam:
    return Sam(TorchSam(tiny_sam()))


def processor() -> Any:
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil

    side = {"height": SAM_PX, "width": SAM_PX}
    return SamImageProcessorPil(size={"longest_edge": SAM_PX}, pad_size=side)


@pytest.mark.parametrize("size", [(40, 60), (61, 37), (64, 64), (200, 130)])
def test_image_is_prepared_as_in_transformers(size: tuple[int, int]) -> None:
    seen: list[Float32Array] = []

    class Looking:
        image_px = SAM_PX

        def embed(self, pixels: Float32Array) -> Any:
            seen.append(pixels)

        def decode(self, embedding: Any, prompts: Prompts, is_single: bool) -> tuple[Any, Any]:
            raise AssertionError("nothing is asked")

    rgb = blocks(*size)
    image = Sam(Looking()).look(rgb)
    theirs = processor()(rgb, return_tensors="np")
    np.testing.assert_allclose(seen[0], theirs["pixel_values"][0], atol=2e-6)
    assert image.seen_size == tuple(theirs["reshaped_input_sizes"][0])
    assert image.size == size


def transformers_masks(multiple: bool, **prompt: Any) -> tuple[BoolArray, Float32Array]:
    """Masks (B, M, H, W) and scores (B, M) by transformers' processor and model; prompts in pixels of RGB."""
    import torch
    from transformers.models.sam.image_processing_pil_sam import _normalize_coordinates

    images = processor()
    inputs = images(RGB, return_tensors="pt")
    asked = {
        name: torch.from_numpy(_normalize_coordinates(SAM_PX, values, (40, 60), name == "input_boxes")).float()[None]
        for name, values in prompt.items()
    }
    with torch.inference_mode():
        answer = tiny_sam()(pixel_values=inputs["pixel_values"], multimask_output=multiple, **asked)
    masks = images.post_process_masks(answer.pred_masks, inputs["original_sizes"], inputs["reshaped_input_sizes"])
    return masks[0].numpy(), answer.iou_scores[0].numpy()


def test_box_masks_are_the_best_of_three_as_in_transformers(sam: Sam) -> None:
    masks, scores = sam.from_boxes(sam.look(RGB), BOXES, is_single=False)
    theirs, predicted = transformers_masks(True, input_boxes=BOXES)
    best = predicted.argmax(axis=1)
    assert best.any(), "the first mask is always the best, so that nothing is selected"
    np.testing.assert_allclose(scores, predicted.max(axis=1), atol=1e-5)
    assert (masks != theirs[np.arange(3), best]).mean() < 1e-3
    assert 0.05 < masks.mean() < 0.95


def test_single_masks_of_boxes_and_points_match_transformers(sam: Sam) -> None:
    image = sam.look(RGB)
    masks, scores = sam.from_boxes(image, BOXES, is_single=True)
    theirs, predicted = transformers_masks(False, input_boxes=BOXES)
    np.testing.assert_allclose(scores, predicted[:, 0], atol=1e-5)
    assert (masks != theirs[:, 0]).mean() < 1e-3
    points = np.array([[10, 12], [33, 20], [50.5, 39]], np.float32)
    mask, score = sam.from_points(image, points)
    theirs, predicted = transformers_masks(False, input_points=points[None])
    assert score == pytest.approx(float(predicted[0, 0]), abs=1e-5)
    assert (mask != theirs[0, 0]).mean() < 1e-3


def test_regions_on_demand_encode_each_frame_once() -> None:
    looks: list[UInt8Array] = []

    class Counting(Sam):
        def look(self, rgb: UInt8Array) -> Any:
            looks.append(rgb)
            return super().look(rgb)

    counting = Counting(TorchSam(tiny_sam()))
    encoder = CountingEncoder()
    networks = Networks(WordTagger(encoder, ("cat",), 1), lambda: None, lambda: counting, "tiny")  # type: ignore[arg-type, return-value]
    regions = SamRegions(networks, encoder)
    first, second = frame_of(RGB), frame_of(blocks(40, 60, seed=1), index=1)
    masks = [regions.mask_at(frame, np.array([[10, 10], [12, 30]])) for frame in (first, first, second, first)]
    assert len(looks) == 3
    np.testing.assert_array_equal(masks[0][0], masks[1][0])
    np.testing.assert_array_equal(masks[0][0], masks[3][0])
    assert (masks[0][0] != masks[2][0]).any()
    empty, score = regions.mask_at(first, np.zeros((0, 2), np.int64))
    assert not empty.any() and empty.shape == (40, 60) and score == 0
    assert regions.encode_regions(first, masks[0][0], np.array([[0, 0, 9, 9]])).shape == (1, 8)


def test_incomplete_checkpoint_fails() -> None:
    from transformers import SamModel

    state = {
        re.sub(r"(mlps\.\d|prediction_head)\.layers\.0\.", r"\1.layers.1.", name)
        .replace(".proj_in.", ".layers.0.")
        .replace(".proj_out.", ".layers.2."): tensor
        for name, tensor in tiny_sam().state_dict().items()
        if "shared_image" not in name
    }
    model = fill_sam(SamModel(tiny_sam().config), state, "sam.pth")
    for name, tensor in tiny_sam().state_dict().items():
        assert (model.state_dict()[name] == tensor).all(), name
    state.pop("mask_decoder.iou_token.weight")
    with pytest.raises(DataError, match=r"sam\.pth: not a checkpoint of this SAM: .*iou_token"):
        fill_sam(SamModel(tiny_sam().config), state, "sam.pth")
