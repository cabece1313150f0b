"""CLIP and SigLIP through transformers: the spec from a model folder's files, the towers from its weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import require_transformers
from su3d_bench.perception.models.encoders.encoder import EncoderSpec, TorchTowers, check_spec
from su3d_bench.perception.models.encoders.image_transform import Convention, read_transform
from su3d_bench.perception.models.files import ModelFiles, load_pretrained, read_settings

# What transformers takes for a CLIP configuration that does not say it.
_CLIP_DIM, _CLIP_TOKENS, _CLIP_WORDS = 512, 77, 49408
_SIGLIP_WIDTH, _SIGLIP_TOKENS, _SIGLIP_WORDS = 768, 64, 32000
_LIMITS = {
    "num_hidden_layers": 128,
    "hidden_size": 16384,
    "intermediate_size": 65536,
    "num_attention_heads": 256,
    "image_size": 2048,
    "patch_size": 256,
    "max_position_embeddings": 8192,
    "vocab_size": 2_000_000,
    "projection_dim": 16384,
}


def read_spec(files: ModelFiles, convention: Convention) -> EncoderSpec:
    """What ``config.json`` and ``preprocessor_config.json`` say of an encoder; raises ``DataError`` for nonsense."""
    path = files.folder / "config.json"
    config = read_settings(path)
    kind = config.get("model_type")
    if kind not in ("clip", "siglip"):
        raise DataError(f"{path}: model_type is {str(kind)[:40]!r}; an encoder is 'clip' or 'siglip'")
    if "quantization_config" in config:
        raise DataError(f"{path}: the weights are quantised, which is not the published encoder; fetch the folder anew")
    text, vision = (_table(path, config, key) for key in ("text_config", "vision_config"))
    for table in (config, text, vision):
        _check_limits(path, table)
    transform = read_transform(files.folder / "preprocessor_config.json", convention)
    size = vision.get("image_size", 224)
    if transform.size != size:
        raise DataError(
            f"{files.folder}: the image tower takes {size} px, preprocessor_config.json makes {transform.size}"
        )
    if kind == "clip":
        dim = config.get("projection_dim", _CLIP_DIM)
        n_tokens, n_words = text.get("max_position_embeddings", _CLIP_TOKENS), text.get("vocab_size", _CLIP_WORDS)
        return check_spec(EncoderSpec(dim, n_tokens, n_words, "clip", None, transform), path)
    dim = text.get("projection_size", text.get("hidden_size", _SIGLIP_WIDTH))
    n_tokens, n_words = text.get("max_position_embeddings", _SIGLIP_TOKENS), text.get("vocab_size", _SIGLIP_WORDS)
    spec = EncoderSpec(dim, n_tokens, n_words, "siglip", text.get("pad_token_id", 1), transform)
    return check_spec(spec, path)


def _table(path: Any, config: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    table: dict[str, Any] = {}
    for name in (key, f"{key}_dict"):  # older files, LAION's among them, repeat a part there, and that counts
        part = config.get(name)
        if not isinstance(part, dict | None):
            raise DataError(f"{path}: {name} is no table; fetch the file anew")
        table |= part or {}
    return {name: value for name, value in table.items() if value is not None}


def _check_limits(path: Any, table: Mapping[str, Any]) -> None:
    """Refuse sizes that no encoder has before anything of that size is made."""
    for key, limit in _LIMITS.items():
        value = table.get(key, 1)
        if not isinstance(value, int) or not 1 <= value <= limit:
            raise DataError(f"{path}: {key} is {str(value)[:40]}; expected 1 to {limit}")


def load_model(files: ModelFiles) -> Any:
    """The model in evaluation mode and float32 on the CPU; weights that are missing are an error, never random."""
    transformers = require_transformers(f"encoder '{files.entry.name}'")
    kind = read_settings(files.folder / "config.json").get("model_type")
    model_class = {"clip": transformers.CLIPModel, "siglip": transformers.SiglipModel}[str(kind)]
    return load_pretrained(files, model_class, attn_implementation="sdpa").eval()


class TransformersTowers(TorchTowers):
    """The towers of a transformers model on one device in one precision."""

    def __init__(self, model: Any, device: str, precision: str, batch: int) -> None:
        super().__init__(model, device, precision, batch, _image_values(model))
        self.encode_image = lambda pixels: model.get_image_features(pixel_values=pixels).pooler_output
        # No mask: in CLIP a token sees those before it alone, and SigLIP was trained without one.
        self.encode_text = lambda ids: model.get_text_features(input_ids=ids).pooler_output


def _image_values(model: Any) -> int:
    """About how many numbers one image takes on its way: the widest layer's four times over, and the attention's."""
    vision = model.config.vision_config
    n_tokens = (vision.image_size // vision.patch_size) ** 2 + 1
    return int(4 * n_tokens * vision.intermediate_size + vision.num_attention_heads * n_tokens**2)
