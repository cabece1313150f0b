"""Results equal those of the original programs, recorded in tests/cases/front_end.json with their source."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import regex
from tiny_models import N_TOKENS, blocks, tiny_sam, write_clip_tokenizer

from su3d_bench.core.types import BoolArray
from su3d_bench.perception.cache import mask_boxes
from su3d_bench.perception.models.encoders.images import (
    normalised_bytes,
    resized,
    size_with_longest_side,
    size_with_shortest_side,
)
from su3d_bench.perception.models.encoders.texts import plain_text, without_marks
from su3d_bench.perception.models.masks.automatic_masks import (
    AutomaticMaskConfig,
    AutomaticMasks,
    point_grid,
    to_last_pixel,
)
from su3d_bench.perception.models.masks.grounded_sam import GROUNDED_MASKS, RAM_PX, GroundedConfig, ram_pixels
from su3d_bench.perception.models.masks.grounding_dino import suppress, tag_of, tag_of_first_word
from su3d_bench.perception.models.masks.sam import Prompts, Sam, as_shares_of_float32, sam_names

CASES: dict[str, Any] = json.loads((Path(__file__).parents[2] / "cases/front_end.json").read_text())


def test_every_case_names_its_source() -> None:
    assert set(CASES["sources"]) == set(CASES) - {"sources", "squares"}


def test_conceptgraphs_naming_matches_original_and_drops_no_box() -> None:
    n_lost = n_renamed = 0
    for case in CASES["names"]:
        for phrase, answer in case["phrases"]:
            assert tag_of_first_word(phrase, case["tags"]) == answer, phrase
            whole = tag_of(phrase, case["tags"])
            n_lost += whole is None
            n_renamed += whole not in (None, answer)
    assert n_lost > 20 and n_renamed > 2, "the cases distinguish the rule from that of whole tags"


@pytest.mark.parametrize("case", CASES["sizes"], ids=lambda case: f"{case[0]}x{case[1]}")
def test_detector_image_has_the_size_of_the_original(case: list[int]) -> None:
    height, width, *answer = case
    assert list(size_with_shortest_side(height, width, 800, 1333)) == answer


@pytest.mark.parametrize("case", CASES["suppressed"], ids=lambda case: f"{case['threshold']}")
def test_suppression_matches_torchvision_at_the_threshold(case: dict[str, Any]) -> None:
    boxes, scores = np.array(case["boxes"], np.float32), np.array(case["scores"], np.float32)
    assert suppress(boxes, scores, case["threshold"]).tolist() == case["kept"]


# ---- texts


@pytest.mark.parametrize(("text", "cleaned", "words"), CASES["texts"], ids=[ascii(case[0]) for case in CASES["texts"]])
def test_texts_are_cleaned_and_split_as_in_open_clip(text: str, cleaned: str, words: list[str]) -> None:
    assert plain_text(text) == cleaned
    # The split of transformers' tokenizer, which has the start and end marks as tokens.
    known = r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
    assert regex.findall(known, without_marks(plain_text(text))) == words


def test_texts_in_a_broken_encoding_are_not_repaired() -> None:
    for text, corrected in CASES["broken"]:
        assert plain_text(text) == text.lower() != corrected


def test_end_of_text_mark_does_not_end_a_text(tmp_path: Path) -> None:
    from su3d_bench.perception.models.encoders.texts import read_tokeniser

    write_clip_tokenizer(tmp_path)
    words = json.loads((tmp_path / "vocab.json").read_text())
    tokens = read_tokeniser(tmp_path, "clip", N_TOKENS, None, len(words))
    chair, end = words["chair</w>"], words["<|endoftext|>"]
    whole, plain, curly = tokens(["chair chair", "CHAIR\u3000chair\x07", "chair\n&#99;hair"])
    assert whole.tolist() == plain.tolist() == curly.tolist()
    marked, spelt = tokens(["chair<|ENDOFTEXT|>chair", "chair <| endoftext |> chair"])
    assert marked.tolist() == spelt.tolist()
    assert marked[:5].tolist() != [words["<|startoftext|>"], chair, end, chair, end]


# ---- SAM


def test_sam_pixels_match_the_original_to_the_bit() -> None:
    levels = np.arange(256, dtype=np.uint8)[None, :, None].repeat(3, axis=2)
    values = normalised_bytes(levels)[:, 0]
    assert hashlib.sha256(np.ascontiguousarray(values).astype("<f4").tobytes()).hexdigest() == CASES["sam_pixels"]


@pytest.mark.parametrize("case", CASES["sam_points"], ids=lambda case: f"{case['height']}x{case['width']}")
def test_grid_points_reach_sam_with_the_bits_of_the_original(case: dict[str, Any]) -> None:
    import torch

    result: list[Any] = []

    class Told:
        image_px = case["image_px"]

        def embed(self, pixels: Any) -> None: ...

        def decode(self, embedding: Any, prompts: Prompts, is_single: bool) -> Any:
            assert prompts.points is not None
            result.append(prompts.points)
            return torch.zeros(len(prompts), 3, 4, 4), torch.zeros(len(prompts), 3)

    n_side, side = case["points_per_side"], case["image_px"]
    config = AutomaticMaskConfig(points_per_side=n_side, points_per_batch=n_side**2)
    AutomaticMasks(Sam(Told()), config).regions(blocks(case["height"], case["width"]))
    # transformers' SamPositionalEmbedding, on the points from TorchSam.
    points = torch.from_numpy(as_shares_of_float32(result[0][:, 0], side))
    places = (2 * ((points + 0.5) / side) - 1).to(torch.float32).numpy()
    np.testing.assert_array_equal(places, np.array(case["places"], np.float32))
    # Points rounded before, as in the predictor, give different bits, so that the case detects a mix-up.
    size = case["width"], case["height"]
    scale = np.array(size_with_longest_side(*size, side)) / size
    rounded = ((point_grid(n_side) * size).astype(np.float32) * scale).astype(np.float32)
    assert (2 * ((rounded + np.float32(0.5)) / np.float32(side)) - 1 != places).any()


@pytest.mark.parametrize(("original", "name"), CASES["sam_names"])
def test_original_checkpoint_names_are_mapped_to_transformers(original: str, name: str) -> None:
    assert name in tiny_sam().state_dict()
    assert name in sam_names({original: 0})


def mask_of(rows: str) -> BoolArray:
    return np.array([[character == "#" for character in row] for row in rows.split()])


class Drawn:
    """The network of the case: for a point in a square it returns that square, a larger one, and a vague mask."""

    image_px = 64

    def embed(self, pixels: Any) -> None: ...

    def decode(self, embedding: Any, prompts: Prompts, is_single: bool) -> tuple[Any, Any]:
        import torch

        assert prompts.points is not None
        logits = np.full((len(prompts), 3, 64, 64), -8, np.float32)
        scores = np.full((len(prompts), 3), 0.2, np.float32)
        for k, (x, y) in enumerate(prompts.points[:, 0].tolist()):
            for x0, y0, x1, y1 in CASES["squares"]:
                if x0 <= x < x1 and y0 <= y < y1:
                    logits[k, 0, y0:y1, x0:x1] = 8
                    logits[k, 1, y0 - 1 : y1 + 1, x0 - 1 : x1 + 1] = 8
                    logits[k, 2] = -0.5
                    logits[k, 2, y0:y1, x0:x1] = 2
                    scores[k] = 1.02, 0.9, 0.99
        return torch.from_numpy(logits), torch.from_numpy(scores)


def test_automatic_mask_boxes_match_original() -> None:
    found = AutomaticMasks(Sam(Drawn()), AutomaticMaskConfig()).regions(np.zeros((64, 64, 3), np.uint8))
    sides = found.boxes[:, 2:] - found.boxes[:, :2]
    rows = np.concatenate([found.boxes[:, :2], sides, found.masks.sum(axis=(1, 2))[:, None]], axis=1)
    np.testing.assert_array_equal(rows, CASES["automatic"])
    assert (sides[2] == [0, 19]).all() and len(rows) == 13, "boxes without area suppress nothing"


@pytest.mark.parametrize(("rows", "box"), CASES["mask_boxes"])
def test_mask_boxes_end_at_the_last_pixel(rows: str, box: list[int]) -> None:
    assert to_last_pixel(mask_boxes(mask_of(rows)[None]))[0].tolist() == box


# ---- RAM


def test_ram_image_resizing_matches_ram_and_conceptgraphs() -> None:
    from PIL import Image

    rgb = blocks(96, 128)
    assert (GroundedConfig().ram_resample, GROUNDED_MASKS["conceptgraphs"].ram_resample) == ("bilinear", "bicubic")
    # generate_gsa_results.py (5c4da70): image_pil.resize((384, 384)); the following transform changes nothing.
    theirs = np.asarray(Image.fromarray(rgb).resize((RAM_PX, RAM_PX)))
    np.testing.assert_array_equal(resized(rgb, RAM_PX, RAM_PX, "bicubic"), theirs)
    assert (ram_pixels(rgb, "bicubic") != ram_pixels(rgb)).any()
