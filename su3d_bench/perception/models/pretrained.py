"""SAM and GroundingDINO from a model folder or SAM's original checkpoint, kept in memory from scene to scene."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar, cast

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import make_deterministic, require, require_transformers
from su3d_bench.perception.models.files import ModelFiles, bounded, load_pretrained, read_settings, read_weights
from su3d_bench.perception.models.masks.grounding_dino import GroundingDino
from su3d_bench.perception.models.masks.sam import TorchSam

# Width, layers, heads and layers with global attention of the image towers, from segment_anything/build_sam.py.
_SAM_TOWERS = {
    "sam-vit-h": (1280, 32, 16, (7, 15, 23, 31)),
    "sam-vit-l": (1024, 24, 16, (5, 11, 17, 23)),
    "sam-vit-b": (768, 12, 12, (2, 5, 8, 11)),
}
# The original's names and transformers' for the same tensors, as whole parts of a dotted name.
_SAM_NAMES = (
    (r"^image_encoder\.", "vision_encoder."),
    (r"\.patch_embed\.proj\.", ".patch_embed.projection."),
    (r"\.blocks\.", ".layers."),
    (r"\.neck\.0\.", ".neck.conv1."),
    (r"\.neck\.1\.", ".neck.layer_norm1."),
    (r"\.neck\.2\.", ".neck.conv2."),
    (r"\.neck\.3\.", ".neck.layer_norm2."),
    (r"\.norm(\d|_final_attn)\.", r".layer_norm\1."),
    (r"\.pe_layer\.positional_encoding_gaussian_matrix$", ".shared_embedding.positional_embedding"),
    (r"\.point_embeddings\.", ".point_embed."),
    (r"\.mask_downscaling\.0\.", ".mask_embed.conv1."),
    (r"\.mask_downscaling\.1\.", ".mask_embed.layer_norm1."),
    (r"\.mask_downscaling\.3\.", ".mask_embed.conv2."),
    (r"\.mask_downscaling\.4\.", ".mask_embed.layer_norm2."),
    (r"\.mask_downscaling\.6\.", ".mask_embed.conv3."),
    (r"\.output_upscaling\.0\.", ".upscale_conv1."),
    (r"\.output_upscaling\.1\.", ".upscale_layer_norm."),
    (r"\.output_upscaling\.3\.", ".upscale_conv2."),
    (r"(\.output_hypernetworks_mlps\.\d+|\.iou_prediction_head)\.layers\.0\.", r"\1.proj_in."),
    (r"(\.output_hypernetworks_mlps\.\d+|\.iou_prediction_head)\.layers\.2\.", r"\1.proj_out."),
    (r"(\.output_hypernetworks_mlps\.\d+|\.iou_prediction_head)\.layers\.1\.", r"\1.layers.0."),
)
_SAM_POSITIONS = "shared_image_embedding.positional_embedding"
_SAM_NO_WEIGHTS = ("pixel_mean", "pixel_std")  # of the image, which some copies of the checkpoint hold


Loaded = TypeVar("Loaded")
# A worker segments one scene after another; a segmenter, a detector and a tagger stay in memory.
MOST_KEPT = 3
_kept: OrderedDict[tuple[object, ...], object] = OrderedDict()


def kept(files: ModelFiles, place: tuple[str, ...], load: Callable[[], Loaded]) -> Loaded:
    """What ``load`` makes of ``files`` at ``place``, from memory where they are unchanged since it was last asked."""
    status = files.weights.stat()
    key = (files.entry.name, str(files.weights), status.st_size, status.st_mtime_ns, *place)
    if key not in _kept:
        while len(_kept) >= MOST_KEPT:
            _kept.popitem(last=False)
        _kept[key] = load()
    _kept.move_to_end(key)
    return cast("Loaded", _kept[key])


def load_sam(files: ModelFiles, device: str, precision: str) -> TorchSam:
    """SAM ready to run."""

    def load() -> TorchSam:
        model = _original_sam(files) if files.form.form == "original" else _pretrained(files, "SamModel")
        return TorchSam(_on_device(model, device, precision))

    return kept(files, (device, precision), load)


def load_grounding_dino(files: ModelFiles, device: str, precision: str) -> GroundingDino:
    """GroundingDINO with its tokenizer ready to run."""

    def load() -> GroundingDino:
        model = _pretrained(files, "GroundingDinoForObjectDetection")
        transformers = require_transformers(f"detector '{files.entry.name}'")
        try:
            tokenizer = transformers.BertTokenizer.from_pretrained(str(files.folder), local_files_only=True)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"{files.folder}: its tokenizer cannot be read: {bounded(error)}; fetch it anew") from error
        return GroundingDino(_on_device(model, device, precision), tokenizer)

    return kept(files, (device, precision), load)


def sam_names(tensors: dict[str, Any]) -> dict[str, Any]:
    """The tensors of an original SAM checkpoint under the names of ``transformers``' SamModel."""
    renamed = {}
    for name, tensor in tensors.items():
        if name in _SAM_NO_WEIGHTS:
            continue
        for old, new in _SAM_NAMES:
            name = re.sub(old, new, name)
        renamed[name] = tensor
    positions = renamed.get("prompt_encoder.shared_embedding.positional_embedding")
    if positions is not None:
        renamed[_SAM_POSITIONS] = positions  # one tensor in the original, two names in transformers
    return renamed


def sam_config(name: str) -> Any:
    """``transformers``' configuration of the published SAM called ``name``."""
    transformers = require_transformers(f"segmenter '{name}'")
    width, n_layers, n_heads, global_layers = _SAM_TOWERS[name]
    tower = {
        "hidden_size": width,
        "num_hidden_layers": n_layers,
        "num_attention_heads": n_heads,
        "global_attn_indexes": list(global_layers),
    }
    return transformers.SamConfig(vision_config=tower)


def small_sam_config(tensors: dict[str, Any]) -> Any:
    """The configuration of a SAM that is smaller than the published ones, from its tensors' shapes, by SAM's names.

    Raises ``DataError`` where tensors lack or do not go together; heads of the decoder are SAM's eight.
    """
    transformers = require_transformers("a small SAM")
    try:
        n_side, width = tensors["image_encoder.pos_embed"].shape[1], tensors["image_encoder.pos_embed"].shape[3]
        patch_px = tensors["image_encoder.patch_embed.proj.weight"].shape[2]
        blocks = [int(found[1]) for name in tensors if (found := re.match(r"image_encoder\.blocks\.(\d+)\.", name))]
        sides = [
            tensors[f"image_encoder.blocks.{index}.attn.rel_pos_h"].shape
            for index in range(max(blocks, default=-1) + 1)
        ]
        hidden = tensors["prompt_encoder.point_embeddings.0.weight"].shape[1]
        tower = {
            "hidden_size": width,
            "num_hidden_layers": len(sides),
            "num_attention_heads": width // sides[0][1],
            "mlp_dim": tensors["image_encoder.blocks.0.mlp.lin1.weight"].shape[0],
            "image_size": n_side * patch_px,
            "patch_size": patch_px,
            "window_size": (min(side[0] for side in sides) + 1) // 2,
            "global_attn_indexes": [index for index, side in enumerate(sides) if side[0] == 2 * n_side - 1],
            "output_channels": hidden,
            "num_pos_feats": hidden // 2,
        }
        prompts = {
            "hidden_size": hidden,
            "image_size": n_side * patch_px,
            "patch_size": patch_px,
            "mask_input_channels": tensors["prompt_encoder.mask_downscaling.3.weight"].shape[0],
        }
        decoder = {
            "hidden_size": hidden,
            "mlp_dim": tensors["mask_decoder.transformer.layers.0.mlp.lin1.weight"].shape[0],
            "iou_head_hidden_dim": tensors["mask_decoder.iou_prediction_head.layers.0.weight"].shape[0],
        }
        return transformers.SamConfig(vision_config=tower, prompt_encoder_config=prompts, mask_decoder_config=decoder)
    except (KeyError, IndexError, ValueError, ZeroDivisionError) as error:
        raise DataError(f"is no checkpoint of a SAM: {bounded(error)}; fetch it anew") from error


def fill_sam(model: Any, tensors: dict[str, Any], where: str) -> Any:
    """``model`` with the weights of an original checkpoint, every one of them; raises ``DataError``."""
    try:
        model.load_state_dict(sam_names(tensors), strict=True)
    except RuntimeError as error:
        raise DataError(f"{where}: is no checkpoint of this SAM: {bounded(error)}; fetch it anew") from error
    return model


def _original_sam(files: ModelFiles) -> Any:
    transformers = require_transformers(f"segmenter '{files.entry.name}'")
    tensors = read_weights(files.weights)
    try:
        config = small_sam_config(tensors) if files.is_stand_in else sam_config(files.entry.name)
    except DataError as error:
        raise DataError(f"{files.weights}: {error}") from error
    return fill_sam(transformers.SamModel(config), tensors, str(files.weights))


def _pretrained(files: ModelFiles, class_name: str) -> Any:
    """A transformers model in float32 on the CPU; weights that are missing are an error, never random."""
    transformers = require_transformers(f"model '{files.entry.name}'")
    model_class = getattr(transformers, class_name)
    model_type = read_settings(files.folder / "config.json").get("model_type")
    if model_type != model_class.config_class.model_type:
        wanted = model_class.config_class.model_type
        raise DataError(f"{files.folder}: model_type is {str(model_type)[:40]!r}; '{files.entry.name}' is {wanted!r}")
    return load_pretrained(files, model_class)


def _on_device(model: Any, device: str, precision: str) -> Any:
    torch = require("torch", f"device '{device}'")
    make_deterministic(device)
    return model.eval().to(device=device, dtype=getattr(torch, precision))
