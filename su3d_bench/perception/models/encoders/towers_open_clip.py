"""CLIP through open_clip, from its own checkpoint files, where the user has the package."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from su3d_bench.core.errors import DataError
from su3d_bench.core.system.devices import require
from su3d_bench.core.types import Int64Array
from su3d_bench.perception.models.encoders.encoder import EncoderSpec, TorchTowers
from su3d_bench.perception.models.encoders.image_transform import Convention, ImageTransform
from su3d_bench.perception.models.files import ModelFiles, bounded, read_weights

N_TOKENS, N_WORDS = 77, 49408


def require_open_clip(name: str) -> Any:
    """The module open_clip; its import needs a torchvision that matches torch."""
    try:
        return require("open_clip", f"encoder '{name}' with perception.models.runtime 'open_clip'")
    except (RuntimeError, AttributeError) as error:
        raise DataError(
            f"open_clip cannot be imported ({bounded(error, 80)}); install a torchvision that matches torch, or use "
            "perception.models.runtime = 'torch'"
        ) from error


def read_spec(files: ModelFiles, convention: Convention) -> EncoderSpec:
    """What open_clip knows of the architecture."""
    open_clip = require_open_clip(files.entry.name)
    config = open_clip.get_model_config(files.form.architecture)
    if config is None:
        raise DataError(f"open_clip {open_clip.__version__} knows no '{files.form.architecture}'; install a newer one")
    transform = ImageTransform(int(config["vision_cfg"]["image_size"]), convention=convention)
    text = config["text_cfg"]
    n_tokens, n_words = text.get("context_length", N_TOKENS), text.get("vocab_size", N_WORDS)
    return EncoderSpec(int(config["embed_dim"]), n_tokens, n_words, "clip", 0, transform)


def load_model(files: ModelFiles) -> Any:
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


def read_tokeniser(files: ModelFiles) -> Callable[[Sequence[str]], Int64Array]:
    """open_clip's own tokenizer, whose words come with the package."""
    tokenizer = require_open_clip(files.entry.name).get_tokenizer(files.form.architecture)

    def tokens(texts: Sequence[str]) -> Int64Array:
        if not texts:
            return np.zeros((0, N_TOKENS), np.int64)
        return np.asarray(tokenizer(list(texts)).numpy(), np.int64)

    return tokens


class OpenClipTowers(TorchTowers):
    """The towers of an open_clip model on one device in one precision."""

    def __init__(self, model: Any, device: str, precision: str, batch: int) -> None:
        # 30 MB an image in float32: about ViT-H-14's widest layer four times over
        super().__init__(model, device, precision, batch, 7_500_000)
        self.encode_image, self.encode_text = model.encode_image, model.encode_text
