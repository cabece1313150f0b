"""SAM's automatic masks: every step by hand, and against transformers' functions where they run without torchvision."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tiny_models import blocks, tiny_sam

from su3d_bench.core.types import BoolArray, Float32Array
from su3d_bench.perception.models.masks.automatic_masks import (
    AUTOMATIC_MASKS,
    AutomaticMaskConfig,
    AutomaticMasks,
    Crop,
    crops_of,
    is_cut_by_crop,
    point_grid,
    stability,
    without_small_parts,
)
from su3d_bench.perception.models.masks.sam import Prompts, Sam, TorchSam


def mask_of(rows: str) -> BoolArray:
    return np.array([[character == "#" for character in row] for row in rows.split()])


def test_points_stand_in_the_middle_of_equal_cells() -> None:
    expected = [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]
    np.testing.assert_allclose(point_grid(2), expected)


def test_crops_of_one_layer_are_four_that_share_a_third_of_the_shorter_side() -> None:
    crops = crops_of(600, 900, 1, 512 / 1500)
    # overlap = int(0.3413 * 600 * 2 / 2) = 204; sides = ceil((204 + 900) / 2), ceil((204 + 600) / 2)
    assert [crop.box for crop in crops] == [
        (0, 0, 900, 600), (0, 0, 552, 402), (0, 198, 552, 600), (348, 0, 900, 402), (348, 198, 900, 600),
    ]  # fmt: skip
    assert [crop.layer for crop in crops] == [0, 1, 1, 1, 1]


def test_crops_and_points_equal_those_of_transformers() -> None:
    from transformers.models.sam.image_processing_pil_sam import _build_point_grid, _generate_per_layer_crops

    for height, width, n_layers in ((680, 1200, 2), (101, 57, 1), (480, 640, 0), (333, 1000, 3)):
        boxes, layers = _generate_per_layer_crops(n_layers, 512 / 1500, (height, width))
        mine = crops_of(height, width, n_layers, 512 / 1500)
        assert [list(crop.box) for crop in mine] == boxes
        assert [crop.layer for crop in mine] == layers
    np.testing.assert_array_equal(point_grid(12), _build_point_grid(12))


def test_stability_is_the_share_of_pixels_that_keep_their_side() -> None:
    import torch
    from transformers.models.sam.image_processing_pil_sam import _compute_stability_score

    # Above 1: two pixels; above -1: four. At exactly the thresholds a pixel counts as below.
    logits = torch.tensor([[[3.0, 1.5, 1.0], [-0.5, -1.0, -2.0]]])
    assert stability(logits, 1.0).tolist() == [0.5]
    assert np.isnan(stability(torch.full((1, 2, 2), -9.0), 1.0).numpy()).all()
    noise = torch.randn(20, 9, 11, generator=torch.Generator().manual_seed(0)) * 2
    assert torch.equal(stability(noise, 1.0), _compute_stability_score(noise, 0.0, 1))


def test_boxes_at_the_edge_of_a_crop_go_unless_the_image_ends_there() -> None:
    crop = Crop((100, 0, 300, 200), 1)
    boxes = np.array(
        [[150, 50, 200, 100], [120, 50, 200, 100], [121, 50, 200, 100], [150, 0, 200, 100], [150, 50, 280, 100]],
        np.float32,
    )
    assert is_cut_by_crop(boxes, crop, 400, 600).tolist() == [False, True, False, False, True]
    assert not is_cut_by_crop(boxes, Crop((0, 0, 600, 400), 0), 400, 600).any()


def test_which_boxes_a_crop_cuts_equals_transformers() -> None:
    import torch
    from transformers.models.sam.image_processing_pil_sam import _is_box_near_crop_edge

    random = np.random.default_rng(1)
    inside = np.sort(random.integers(0, 200, (500, 2, 2)), axis=1).reshape(-1, 4).astype(np.float32)
    crop = Crop((90, 15, 290, 215), 1)
    boxes = inside + np.array([90, 15, 90, 15], np.float32)
    theirs = _is_box_near_crop_edge(torch.from_numpy(inside), list(crop.box), [0, 0, 300, 400]).numpy()
    assert is_cut_by_crop(boxes, crop, 400, 300).tolist() == theirs.tolist()
    assert 0 < theirs.mean() < 1


def test_small_holes_are_filled_and_small_islands_go() -> None:
    mask = mask_of("######.. #.####.# ######.. ###..#.. ###..#.. ######..")
    filled, had_holes = without_small_parts(mask, 4, "holes")
    assert had_holes and filled[1, 1] and not filled[3, 3], "one hole has one pixel, the other four"
    clean, had_islands = without_small_parts(filled, 4, "islands")
    assert had_islands and not clean[1, 7] and clean[:, :6].sum() == 32


def test_a_mask_of_small_islands_keeps_the_largest_and_counts_as_changed() -> None:
    kept, changed = without_small_parts(mask_of("##..#. ......"), 5, "islands")
    assert changed
    np.testing.assert_array_equal(kept, mask_of("##.... ......"))
    alone, changed = without_small_parts(mask_of("##.... ......"), 5, "islands")
    assert changed, "as in the original: a small part was found, although it stays"
    np.testing.assert_array_equal(alone, mask_of("##.... ......"))
    # Corner to corner is one part.
    assert not without_small_parts(mask_of("#. .#"), 2, "islands")[1]
    assert not without_small_parts(mask_of(".. .."), 2, "islands")[1]


class Drawn:
    """A network that knows two squares and says of each point: the square, a larger one, and a vague one."""

    image_px = 64
    squares: tuple[tuple[int, int, int, int], ...] = ((8, 8, 24, 24), (40, 8, 56, 24))

    def embed(self, pixels: Float32Array) -> Any:
        assert pixels.shape == (3, 64, 64)

    def decode(self, embedding: Any, prompts: Prompts, is_single: bool) -> tuple[Any, Any]:
        import torch

        assert prompts.points is not None and not is_single
        logits = np.full((len(prompts), 3, 64, 64), -8, np.float32)
        scores = np.full((len(prompts), 3), 0.2, np.float32)
        for k, (x, y) in enumerate(prompts.points[:, 0].tolist()):
            for x0, y0, x1, y1 in self.squares:
                if x0 <= x < x1 and y0 <= y < y1:
                    logits[k, 0, y0:y1, x0:x1] = 8
                    logits[k, 1, y0 - 1 : y1 + 1, x0 - 1 : x1 + 1] = 8
                    logits[k, 2, :, :] = -0.5  # unsure everywhere: above -1, and a few pixels above 1
                    logits[k, 2, y0:y1, x0:x1] = 2
                    scores[k] = 1.02, 0.9, 0.99
        return torch.from_numpy(logits), torch.from_numpy(scores)


def test_each_drawn_square_is_found_once_and_the_vague_and_the_larger_go() -> None:
    config = AutomaticMaskConfig(points_per_side=8, points_per_batch=5)
    found = AutomaticMasks(Sam(Drawn()), config).regions(blocks(64, 64))
    np.testing.assert_array_equal(found.boxes, np.array(Drawn.squares) - [0, 0, 1, 1], "to the last pixel")
    for mask, (x0, y0, x1, y1) in zip(found.masks, Drawn.squares, strict=True):
        assert mask[y0:y1, x0:x1].all() and mask.sum() == (x1 - x0) * (y1 - y0)
    assert found.scores.tolist() == [1, 1], "a predicted IoU above 1 is cut there"


def test_a_lower_overlap_keeps_the_larger_square_too_and_no_filter_keeps_all() -> None:
    # Boxes from the first to the last pixel: 15 x 15 in 17 x 17, 225 / 289 = 0.78.
    loose = AutomaticMaskConfig(points_per_side=8, box_nms_thresh=0.79)
    assert [int(mask.sum()) for mask in AutomaticMasks(Sam(Drawn()), loose).regions(blocks(64, 64)).masks] == [
        256, 256, 324, 324,
    ]  # fmt: skip
    vague = AutomaticMaskConfig(points_per_side=8, stability_score_thresh=0.0)
    assert len(AutomaticMasks(Sam(Drawn()), vague).regions(blocks(64, 64)).masks) == 2


def test_every_batch_size_gives_the_same_masks_of_the_drawn_network() -> None:
    answers = [
        AutomaticMasks(Sam(Drawn()), AutomaticMaskConfig(points_per_side=8, points_per_batch=n)).regions(blocks(64, 64))
        for n in (1, 7, 64, 100)
    ]
    assert len({answer.masks.tobytes() for answer in answers}) == 1


def test_points_are_halved_where_the_memory_runs_out_and_give_the_same_masks() -> None:
    import torch

    asked = []

    class Short(Drawn):
        def decode(self, embedding: Any, prompts: Prompts, is_single: bool) -> tuple[Any, Any]:
            asked.append(len(prompts))
            if len(prompts) > 20:
                raise torch.OutOfMemoryError("CUDA out of memory")
            return super().decode(embedding, prompts, is_single)

    config = AutomaticMaskConfig(points_per_side=8)
    found, plain = (AutomaticMasks(Sam(network), config).regions(blocks(64, 64)) for network in (Short(), Drawn()))
    assert asked == [64, 32, 16, 16, 16, 16]
    assert found.masks.tobytes() == plain.masks.tobytes() and len(found.masks) > 1


def test_an_image_without_anything_has_no_regions() -> None:
    class Blind(Drawn):
        squares = ()

    config = AutomaticMaskConfig(points_per_side=4, crop_n_layers=1, min_mask_region_area=10)
    found = AutomaticMasks(Sam(Blind()), config).regions(blocks(64, 64))
    assert found.masks.shape == (0, 64, 64) and found.boxes.shape == (0, 4) and found.scores.shape == (0,)


def test_what_passes_the_filters_is_what_transformers_lets_pass() -> None:
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
    assert len(found.masks) == len(rle), "with an overlap of 1 allowed nothing but the filters acts"
    order = np.argsort(-scores.numpy(), kind="stable")
    np.testing.assert_allclose(found.scores, np.clip(scores.numpy()[order], 0, 1), atol=1e-4)
    np.testing.assert_allclose(found.boxes, boxes.numpy()[order], atol=1)


def test_crops_find_regions_of_their_own_on_random_weights_and_the_smaller_crop_wins() -> None:
    sam = Sam(TorchSam(tiny_sam()))
    open_filters: dict[str, Any] = {
        "pred_iou_thresh": 0.0,
        "stability_score_thresh": 0.0,
        "points_per_side": 2,
        "box_nms_thresh": 1.0,
    }
    whole = AutomaticMasks(sam, AutomaticMaskConfig(**open_filters)).regions(blocks(160, 200))
    layered = AutomaticMasks(
        sam, AutomaticMaskConfig(**open_filters, crop_n_layers=1, crop_nms_thresh=1.0, crop_n_points_downscale_factor=2)
    ).regions(blocks(160, 200))
    assert len(whole.masks) > 0
    kept = {mask.tobytes() for mask in layered.masks}
    assert {mask.tobytes() for mask in whole.masks} <= kept
    assert layered.masks[-len(whole.masks) :].tobytes() == whole.masks.tobytes(), "the whole image comes last"


@pytest.mark.parametrize(
    ("name", "values"),
    [("sam", (32, 64, 0.88, 0.95, 0, 1, 0)), ("conceptgraphs", (12, 144, 0.88, 0.95, 0, 1, 100)),
     ("conceptfusion", (8, 64, 0.92, 0.95, 1, 2, 0))],
)  # fmt: skip
def test_presets_hold_the_published_values(name: str, values: tuple[float, ...]) -> None:
    config = AUTOMATIC_MASKS[name]
    found: tuple[float, ...] = (
        config.points_per_side, config.points_per_batch, config.pred_iou_thresh, config.stability_score_thresh,
        config.crop_n_layers, config.crop_n_points_downscale_factor, config.min_mask_region_area,
    )  # fmt: skip
    thresholds: tuple[float, ...] = (config.box_nms_thresh, config.crop_nms_thresh, config.stability_score_offset)
    assert found == values
    assert thresholds == (0.7, 0.7, 1.0)
