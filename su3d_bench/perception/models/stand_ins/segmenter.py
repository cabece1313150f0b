"""A tiny Segment Anything with random weights, whose masks are what a box holds or what lies around a point.

Random masks lie all over the image, and every method drops them. So the decoder's first layer is set by hand: each cell
of the image compares its place with the prompts', and where it is inside, the mask is. All else is random: edges are
ragged as the image says, and what lies in a box is all the same to it.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

from su3d_bench.core.system.devices import require_transformers

IMAGE_PX, FILLING_PX, PATCH_PX = 64, 128, 8
WIDTH = 32  # of its prompts and decoder; eight heads of two numbers in its attention from image to prompts
_N_FREQUENCIES = WIDTH // 2
# Channels of place. A quarter of a turn over half the image orders nearly all places; a whole one tells near from far,
# but begins again, where the third is far.
_X, _Y, _NEAR_X, _NEAR_Y, _ROUND_X, _ROUND_Y = range(6)
_TURNS = (0.26, 0.26, 1.0, 1.0, 0.42, 0.42)
# Channels without a frequency: which corner of a box a prompt is, or a point, or no prompt; and the mask itself.
_FIRST, _LAST, _POINT, _OTHER, _MASK = range(6, 11)
_TYPES = (_FIRST, _LAST, _POINT, _OTHER)
# From transformers' names back to the original's: pretrained.sam_names the other way round.
_ORIGINAL_NAMES = (
    (r"^vision_encoder(.*)\.layers\.", r"vision_encoder\1.blocks."),
    (r"^vision_encoder\.", "image_encoder."),
    (r"\.patch_embed\.projection\.", ".patch_embed.proj."),
    (r"\.neck\.conv1\.", ".neck.0."),
    (r"\.neck\.layer_norm1\.", ".neck.1."),
    (r"\.neck\.conv2\.", ".neck.2."),
    (r"\.neck\.layer_norm2\.", ".neck.3."),
    (r"\.mask_embed\.conv1\.", ".mask_downscaling.0."),
    (r"\.mask_embed\.layer_norm1\.", ".mask_downscaling.1."),
    (r"\.mask_embed\.conv2\.", ".mask_downscaling.3."),
    (r"\.mask_embed\.layer_norm2\.", ".mask_downscaling.4."),
    (r"\.mask_embed\.conv3\.", ".mask_downscaling.6."),
    (r"\.upscale_conv1\.", ".output_upscaling.0."),
    (r"\.upscale_layer_norm\.", ".output_upscaling.1."),
    (r"\.upscale_conv2\.", ".output_upscaling.3."),
    (r"\.layer_norm(\d|_final_attn)\.", r".norm\1."),
    (r"\.shared_embedding\.positional_embedding$", ".pe_layer.positional_encoding_gaussian_matrix"),
    (r"\.point_embed\.", ".point_embeddings."),
    (r"(\.output_hypernetworks_mlps\.\d+|\.iou_prediction_head)\.layers\.0\.", r"\1.layers.1."),
    (r"(\.output_hypernetworks_mlps\.\d+|\.iou_prediction_head)\.proj_in\.", r"\1.layers.0."),
    (r"(\.output_hypernetworks_mlps\.\d+|\.iou_prediction_head)\.proj_out\.", r"\1.layers.2."),
)
_SURE = 10.0
_SHARP = 60.0  # of the comparison with a box's sides
_N_TESTS = 4  # a cell is inside where four comparisons hold


@cache
def tiny_sam() -> Any:
    """``transformers``' SamModel of two layers, one of them global, and an image of 64 px; random throughout."""
    decoder = {"hidden_size": 8, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 8}
    return _random_sam(IMAGE_PX, 8, decoder).eval()


@cache
def filling_sam() -> Any:
    """The same with SAM's eight heads and an image of 128 px, whose masks fill boxes."""
    import torch

    model = _random_sam(FILLING_PX, WIDTH, {"hidden_size": WIDTH, "mlp_dim": 32, "iou_head_hidden_dim": 8})
    with torch.no_grad():
        _set_places(model)
        _set_prompts(model)
        _set_comparisons(model.mask_decoder.transformer.layers)
        _set_masks(model.mask_decoder)
    return model.eval()


def _random_sam(image_px: int, width: int, decoder: dict[str, int]) -> Any:
    import torch

    transformers = require_transformers("a stand-in of SAM")
    torch.manual_seed(1)
    config = transformers.SamConfig(
        vision_config={
            "hidden_size": 16, "output_channels": width, "num_hidden_layers": 2, "num_attention_heads": 2,
            "image_size": image_px, "patch_size": PATCH_PX, "window_size": 3, "global_attn_indexes": [1],
            "num_pos_feats": width // 2, "initializer_range": 0.05,
        },
        prompt_encoder_config={
            "hidden_size": width, "image_size": image_px, "patch_size": PATCH_PX, "mask_input_channels": 4,
        },
        mask_decoder_config=decoder,
    )  # fmt: skip
    model = transformers.SamModel(config)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.dim() > 1:  # weights that carry signals on; as initialised all images look the same
                parameter.normal_(0, 1.5 / parameter[0].numel() ** 0.5)
    return model


def _set_places(model: Any) -> None:
    """What is known of a place: frequencies along x and y, hardly disturbed by the image."""
    import torch

    frequencies = torch.zeros(2, _N_FREQUENCIES)
    for column, turns in enumerate(_TURNS):
        frequencies[column % 2, column] = turns
    frequencies[:, _MASK + 1 :] = torch.randn(2, _N_FREQUENCIES - _MASK - 1)
    for place in (model.shared_image_embedding, model.prompt_encoder.shared_embedding):
        place.positional_embedding.copy_(frequencies)
    said = model.vision_encoder.neck.layer_norm2
    for column in range(len(_TURNS)):
        said.weight[[column, column + _N_FREQUENCIES]] = 0.02
        said.bias[[column, column + _N_FREQUENCIES]] = 0.0


def _set_prompts(model: Any) -> None:
    """Each prompt says what it is in a channel of its own."""
    prompts, decoder = model.prompt_encoder, model.mask_decoder
    kinds = [
        (prompts.point_embed[0].weight, _OTHER),
        (prompts.point_embed[1].weight, _POINT),
        (prompts.point_embed[2].weight, _FIRST),
        (prompts.point_embed[3].weight, _LAST),
        (prompts.not_a_point_embed.weight, _OTHER),
        (decoder.iou_token.weight, _OTHER),
        (decoder.mask_tokens.weight, _OTHER),
    ]
    for weight, kind in kinds:
        weight.zero_()
        weight[:, kind] = _SURE
    prompts.no_mask_embed.weight.zero_()


def _set_comparisons(layers: Any) -> None:
    """The first layer: a prompt keeps its kind; a cell looks at the prompts' places and sums up what it finds."""
    first, second = layers
    own = first.self_attn
    for linear in (own.q_proj, own.k_proj, own.v_proj, own.out_proj):
        linear.weight.zero_()
        linear.bias.zero_()
    for row, kind in enumerate(_TYPES):
        for linear in (own.q_proj, own.k_proj, own.v_proj):
            linear.weight[row, kind] = 1.0
        own.out_proj.weight[kind, row] = 1.0
    for nothing in (
        first.cross_attn_token_to_image.out_proj,
        first.mlp.lin2,
        second.cross_attn_image_to_token.out_proj,
    ):
        nothing.weight.zero_()
        nothing.bias.zero_()
    first.layer_norm3.bias.fill_(1.0 / (WIDTH - 1) ** 0.5)  # what a layer norm takes off the channels beside the kind
    looks = first.cross_attn_image_to_token
    for linear in (looks.q_proj, looks.k_proj, looks.v_proj, looks.out_proj):
        linear.weight.zero_()
        linear.bias.zero_()
    # A head each: along which frequency, of which prompts, whether the cell is to come after them or before.
    tests = [(_X, _FIRST, 1), (_Y, _FIRST, 1), (_X, _LAST, -1), (_Y, _LAST, -1)]
    tests += [(column, _POINT, 1) for column in (_NEAR_X, _NEAR_Y, _ROUND_X, _ROUND_Y)]
    kept = float((WIDTH - 1) ** 0.5 + 1.0 / (WIDTH - 1) ** 0.5)  # of a kind after the layer norm and its bias
    for head, (column, kind, sign) in enumerate(tests):
        sine, cosine, row = column, column + _N_FREQUENCIES, 2 * head
        is_near = kind == _POINT
        looks.q_proj.weight[row, sine] = looks.q_proj.weight[row + 1, cosine] = 1.0
        # sin(a - b) = sin a cos b - cos a sin b tells before from after, cos(a - b) = ... + ... tells how near.
        looks.k_proj.weight[row, sine if is_near else cosine] = _SHARP * sign
        looks.k_proj.weight[row + 1, cosine if is_near else sine] = _SHARP * (sign if is_near else -sign)
        looks.v_proj.weight[row, kind] = 1.0 / kept
        looks.out_proj.weight[_MASK, row] = _SURE
    looks.out_proj.bias[_MASK] = -_SURE * (_N_TESTS - 0.5)


def _set_masks(decoder: Any) -> None:
    """The mask's channel at four times the size, and the prediction that most masks are good."""
    import torch

    wide, fine = decoder.upscale_conv1, decoder.upscale_conv2
    wide.weight.mul_(0.1)
    wide.weight[:, :2] = 0.0
    wide.weight[_MASK, 0], wide.weight[_MASK, 1] = 1.0, -1.0
    fine.weight.zero_()
    fine.weight[0, 0], fine.weight[1, 1] = 2.0, 2.0
    for linear in (wide, fine):
        linear.bias.zero_()
    for network in decoder.output_hypernetworks_mlps:
        network.proj_out.weight.mul_(0.01)
        network.proj_out.bias.zero_()
        network.proj_out.bias[0], network.proj_out.bias[1] = _SURE, -_SURE
    good = decoder.iou_prediction_head.proj_out
    good.weight.mul_(0.2)
    good.bias.copy_(torch.tensor([0.92, 0.9, 0.88, 0.86]))


def original_names(tensors: dict[str, Any]) -> dict[str, Any]:
    """The tensors of ``transformers``' SamModel under the names of an original checkpoint."""
    renamed = {}
    for name, tensor in tensors.items():
        if name.startswith("shared_image_embedding."):
            continue  # one tensor in the original, two names in transformers
        for ours, original in _ORIGINAL_NAMES:
            name = re.sub(ours, original, name)
        renamed[name] = tensor
    return renamed


def write_checkpoint(place: Path) -> Path:
    """``filling_sam`` as segment-anything publishes checkpoints: a torch file of tensors under the original's names."""
    import torch

    place.parent.mkdir(parents=True, exist_ok=True)
    torch.save(original_names(filling_sam().state_dict()), place)
    return place
