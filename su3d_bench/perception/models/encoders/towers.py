"""The towers of CLIP and SigLIP: through transformers, through open_clip where it is installed, and exported to ONNX.

A folder of an exported encoder holds ``image.onnx``, ``text.onnx`` (and ``.data`` files beside large ones), the
tokenizer's files and ``manifest.json`` with the spec and the SHA-256 of every file.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import first_batch, make_deterministic, require, require_transformers
from su3d_bench.core.types import Float32Array, Int64Array
from su3d_bench.perception.models.encoders.encoder import EncoderSpec
from su3d_bench.perception.models.encoders.images import Convention, ImageTransform, read_transform
from su3d_bench.perception.models.files import (
    ModelFiles,
    bounded,
    checked,
    load_pretrained,
    read_settings,
    read_weights,
)
from su3d_bench.perception.models.onnx import OnnxManifest, Provider, open_session, wrong_files


class TorchTowers:
    """``Towers`` of a torch model on one device in one precision; a subclass says what encodes images and texts.

    ``n_values``: about how many numbers an image takes on its way, which rules the first batch on a GPU.
    """

    encode_image: Callable[[Any], Any]
    encode_text: Callable[[Any], Any]

    def __init__(self, model: Any, device: str, precision: str, batch: int, n_values: int) -> None:
        dtype = getattr(require("torch", f"device '{device}'"), precision)
        make_deterministic(device)
        self._device, self._dtype = device, dtype
        model.to(device=device, dtype=dtype)
        n_bytes = sum(p.numel() * p.element_size() for p in model.parameters())
        self.batch = batch or first_batch(device, n_values * dtype.itemsize, n_bytes)

    def image_features(self, pixels: Float32Array) -> Float32Array:
        return self._features(self.encode_image, pixels, self._dtype)

    def text_features(self, tokens: Int64Array) -> Float32Array:
        return self._features(self.encode_text, tokens, None)

    def _features(self, encode: Callable[[Any], Any], values: NDArray[Any], dtype: Any) -> Float32Array:
        import torch

        with torch.inference_mode():
            features = encode(torch.from_numpy(values).to(device=self._device, dtype=dtype))
            return np.asarray(features.float().cpu().numpy(), np.float32)


# ---- transformers

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


def transformers_spec(files: ModelFiles, convention: Convention) -> EncoderSpec:
    """What ``config.json`` and ``preprocessor_config.json`` say of an encoder; raises ``DataError`` for nonsense."""
    path = files.folder / "config.json"
    config = read_settings(path)
    kind = config.get("model_type")
    if kind not in ("clip", "siglip"):
        raise DataError(f"{path}: model_type is {str(kind)[:40]!r}; an encoder is 'clip' or 'siglip'")
    if "quantization_config" in config:
        raise DataError(
            f"{path}: the weights are quantised, which is not the published encoder; fetch the folder again"
        )
    text, vision = (_table(path, config, key) for key in ("text_config", "vision_config"))
    for table in (config, text, vision):
        _check_limits(path, table)
    transform = read_transform(files.folder / "preprocessor_config.json", convention)
    size = vision.get("image_size", 224)
    if transform.size != size:
        raise DataError(
            f"{files.folder}: the image tower takes {size} px, preprocessor_config.json makes {transform.size}"
        )
    # The defaults are what transformers takes for a configuration that does not say it.
    if kind == "clip":
        dim = config.get("projection_dim", 512)
        n_tokens, n_words, pad_id = text.get("max_position_embeddings", 77), text.get("vocab_size", 49408), None
    else:
        dim = text.get("projection_size", text.get("hidden_size", 768))
        n_tokens, n_words = text.get("max_position_embeddings", 64), text.get("vocab_size", 32000)
        pad_id = text.get("pad_token_id", 1)
    read = {"dim": dim, "n_tokens": n_tokens, "n_words": n_words, "tokens": kind, "pad_id": pad_id}
    return checked(EncoderSpec, {**read, "transform": asdict(transform)}, path)


def _table(path: Path, config: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    table: dict[str, Any] = {}
    for name in (key, f"{key}_dict"):  # older files, LAION's among them, repeat a part there, and that counts
        part = config.get(name)
        if not isinstance(part, dict | None):
            raise DataError(f"{path}: {name} is no table; fetch the file again")
        table |= part or {}
    return {name: value for name, value in table.items() if value is not None}


def _check_limits(path: Path, table: Mapping[str, Any]) -> None:
    """Refuse sizes that no encoder has before anything of that size is made."""
    for key, limit in _LIMITS.items():
        value = table.get(key, 1)
        if not isinstance(value, int) or not 1 <= value <= limit:
            raise DataError(f"{path}: {key} is {str(value)[:40]}; expected 1 to {limit}")


def load_transformers(files: ModelFiles) -> Any:
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


# ---- open_clip

OPEN_CLIP_TOKENS, OPEN_CLIP_WORDS = 77, 49408


def require_open_clip(name: str) -> Any:
    """The module open_clip; its import needs a torchvision that matches torch."""
    try:
        return require("open_clip", f"encoder '{name}' with perception.models.runtime 'open_clip'")
    except (RuntimeError, AttributeError) as error:
        raise DataError(
            f"open_clip cannot be imported ({bounded(error, 80)}); install a torchvision that matches torch, or use "
            "perception.models.runtime = 'torch'"
        ) from error


def open_clip_spec(files: ModelFiles, convention: Convention) -> EncoderSpec:
    """What open_clip knows of the architecture."""
    open_clip = require_open_clip(files.entry.name)
    config = open_clip.get_model_config(files.form.architecture)
    if config is None:
        raise DataError(f"open_clip {open_clip.__version__} knows no '{files.form.architecture}'; install a newer one")
    transform = ImageTransform(int(config["vision_cfg"]["image_size"]), convention=convention)
    text = config["text_cfg"]
    n_tokens, n_words = text.get("context_length", OPEN_CLIP_TOKENS), text.get("vocab_size", OPEN_CLIP_WORDS)
    return EncoderSpec(int(config["embed_dim"]), n_tokens, n_words, "clip", 0, transform)


def load_open_clip(files: ModelFiles) -> Any:
    """The model in evaluation mode and float32 on the CPU, with every weight out of the file."""
    open_clip = require_open_clip(files.entry.name)
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)  # of random weights, which are replaced below
    try:
        model = open_clip.create_model(files.form.architecture, pretrained=None, precision="fp32", device="cpu")
    finally:
        logging.disable(before)
    try:
        model.load_state_dict(read_weights(files.weights), strict=True)
    except RuntimeError as error:
        raise DataError(f"{files.weights}: is no {files.form.architecture}: {bounded(error)}") from error
    return model.eval()


def open_clip_tokeniser(files: ModelFiles) -> Callable[[Sequence[str]], Int64Array]:
    """open_clip's own tokenizer, whose words come with the package."""
    tokenizer = require_open_clip(files.entry.name).get_tokenizer(files.form.architecture)

    def tokens(texts: Sequence[str]) -> Int64Array:
        if not texts:
            return np.zeros((0, OPEN_CLIP_TOKENS), np.int64)
        return np.asarray(tokenizer(list(texts)).numpy(), np.int64)

    return tokens


class OpenClipTowers(TorchTowers):
    """The towers of an open_clip model on one device in one precision."""

    def __init__(self, model: Any, device: str, precision: str, batch: int) -> None:
        # 30 MB an image in float32: about ViT-H-14's widest layer four times over
        super().__init__(model, device, precision, batch, 7_500_000)
        self.encode_image, self.encode_text = model.encode_image, model.encode_text


# ---- ONNX

IMAGE_FILE, TEXT_FILE = "image.onnx", "text.onnx"
GPU_BATCH = 32


class EncoderManifest(OnnxManifest):
    """The manifest of an exported encoder."""

    FORMAT = "su3d-bench onnx encoder 1"
    REQUIRES = (IMAGE_FILE, TEXT_FILE)

    spec: EncoderSpec


def onnx_spec(files: ModelFiles, convention: Convention) -> EncoderSpec:
    """The spec in the manifest, images prepared as ``convention`` says."""
    spec = EncoderManifest.read(files.weights).spec
    return replace(spec, transform=replace(spec.transform, convention=convention))


class OnnxTowers:
    """The towers of an exported encoder, each loaded at its first use."""

    def __init__(self, files: ModelFiles, provider: Provider, device_index: int, batch: int) -> None:
        if wrong := wrong_files(EncoderManifest.read(files.weights), files.folder):
            raise DataError(wrong[0])
        self._session = cache(lambda name: open_session(files.folder / name, provider, device_index))
        self.batch = batch or (1 if provider == "cpu" else GPU_BATCH)

    def image_features(self, pixels: Float32Array) -> Float32Array:
        return np.asarray(self._session(IMAGE_FILE).run(["features"], {"pixels": pixels})[0], np.float32)

    def text_features(self, tokens: Int64Array) -> Float32Array:
        return np.asarray(self._session(TEXT_FILE).run(["features"], {"tokens": tokens})[0], np.float32)
