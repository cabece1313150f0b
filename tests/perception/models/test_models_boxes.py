"""Boxes, automatic masks and images of foundation models, compared with hand-computed values and transformers."""

from __future__ import annotations

from typing import Any

import numpy as np
from tiny_models import blocks, tiny_sam

from su3d_bench.core.types import BoolArray, Float32Array
from su3d_bench.perception.models.masks.automatic_masks import (
    AutomaticMaskConfig,
    AutomaticMasks,
    Crop,
    crops_of,
    is_cut_by_crop,
    point_grid,
    stability,
    without_small_parts,
)
from su3d_bench.perception.models.masks.grounding_dino import corners_of
from su3d_bench.perception.models.masks.sam import Sam, TorchSam


def boxes_of(*rows: tuple[float, ...]) -> Float32Array:
    return np.array(rows, np.float32).reshape(-1, 4)


def test_boxes_are_scaled_to_pixels_before_corners_as_in_the_original() -> None:
    """Boxes of 1200x680 by ``Model.post_process_result``; the other order changes the last bits."""
    result = corners_of(boxes_of((0.34, 0.43, 0.97, 0.56)), 680, 1200)
    np.testing.assert_array_equal(result, boxes_of((-174.0, 102.0, 990.0, 482.79998779296875)))


def mask_of(rows: str) -> BoolArray:
    return np.array([[character == "#" for character in row] for row in rows.split()])


def test_crops_and_points_match_transformers() -> None:
    from transformers.models.sam.image_processing_pil_sam import _build_point_grid, _generate_per_layer_crops

    for height, width, n_layers in ((680, 1200, 2), (101, 57, 1), (480, 640, 0), (333, 1000, 3)):
        boxes, layers = _generate_per_layer_crops(n_layers, 512 / 1500, (height, width))
        mine = crops_of(height, width, n_layers, 512 / 1500)
        assert [list(crop.box) for crop in mine] == boxes
        assert [crop.layer for crop in mine] == layers
    np.testing.assert_array_equal(point_grid(12), _build_point_grid(12))


def test_stability_score_matches_definition() -> None:
    import torch
    from transformers.models.sam.image_processing_pil_sam import _compute_stability_score

    # Above 1: two pixels; above -1: four. A pixel exactly at a threshold counts as below.
    logits = torch.tensor([[[3.0, 1.5, 1.0], [-0.5, -1.0, -2.0]]])
    assert stability(logits, 1.0).tolist() == [0.5]
    assert np.isnan(stability(torch.full((1, 2, 2), -9.0), 1.0).numpy()).all()
    noise = torch.randn(20, 9, 11, generator=torch.Generator().manual_seed(0)) * 2
    assert torch.equal(stability(noise, 1.0), _compute_stability_score(noise, 0.0, 1))


def test_boxes_cut_by_a_crop_match_transformers() -> None:
    import torch
    from transformers.models.sam.image_processing_pil_sam import _is_box_near_crop_edge

    random = np.random.default_rng(1)
    inside = np.sort(random.integers(0, 200, (500, 2, 2)), axis=1).reshape(-1, 4).astype(np.float32)
    crop = Crop((90, 15, 290, 215), 1)
    boxes = inside + np.array([90, 15, 90, 15], np.float32)
    theirs = _is_box_near_crop_edge(torch.from_numpy(inside), list(crop.box), [0, 0, 300, 400]).numpy()
    assert is_cut_by_crop(boxes, crop, 400, 300).tolist() == theirs.tolist()
    assert 0 < theirs.mean() < 1


def test_mask_of_small_islands_keeps_the_largest_and_counts_as_changed() -> None:
    kept, changed = without_small_parts(mask_of("##..#. ......"), 5, "islands")
    assert changed
    np.testing.assert_array_equal(kept, mask_of("##.... ......"))
    alone, changed = without_small_parts(mask_of("##.... ......"), 5, "islands")
    assert changed, "as in the original: a small part was found, although it stays"
    np.testing.assert_array_equal(alone, mask_of("##.... ......"))
    # Pixels touching at a corner are one part.
    assert not without_small_parts(mask_of("#. .#"), 2, "islands")[1]
    assert not without_small_parts(mask_of(".. .."), 2, "islands")[1]


def test_mask_filters_match_transformers() -> None:
    import torch
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil, _normalize_coordinates

    rgb = blocks(40, 60)
    side = {"height": 64, "width": 64}
    processor = SamImageProcessorPil(size={"longest_edge": 64}, pad_size=side)
    inputs = processor(rgb, return_tensors="pt")
    points = point_grid(5) * np.array([60, 40])
    prompts = torch.from_numpy(_normalize_coordinates(64, points, (40, 60))).float()[None, :, None]
    with torch.inference_mode():
        answer = tiny_sam()(pixel_values=inputs["pixel_values"], input_points=prompts, multimask_output=True)
    logits = processor.post_process_masks(
        answer.pred_masks, inputs["original_sizes"], inputs["reshaped_input_sizes"], binarize=False
    )[0]
    # Random weights give logits below 1, so the offset is small.
    settings: dict[str, Any] = {"pred_iou_thresh": 0.75, "stability_score_thresh": 0.3, "stability_score_offset": 0.2}
    rle, scores, boxes = processor.filter_masks(logits, answer.iou_scores[0], (40, 60), [0, 0, 60, 40], **settings)
    config = AutomaticMaskConfig(points_per_side=5, points_per_batch=25, box_nms_thresh=1.0, **settings)
    found = AutomaticMasks(Sam(TorchSam(tiny_sam())), config).regions(rgb)
    assert 3 < len(rle) < 75
    assert len(found.masks) == len(rle), "with an overlap of 1 allowed only the filters act"
    order = np.argsort(-scores.numpy(), kind="stable")
    np.testing.assert_allclose(found.scores, np.clip(scores.numpy()[order], 0, 1), atol=1e-4)
    np.testing.assert_allclose(found.boxes, boxes.numpy()[order], atol=1)
